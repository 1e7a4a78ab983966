"""`thermodrift export`: a promoted model in the form that a control or another program takes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipelines import console
from pipelines.commands.compensate import MaxOffset, Period, Provisional, Rate
from pipelines.options import Json


def export(
    models: Annotated[list[str], typer.Argument(help="models:/NAME@champion or a folder, one for each axis")],
    to: Annotated[str, typer.Option("--to", help="receiver, c, st, onnx, json or sinumerik")],
    out: Annotated[Path | None, typer.Option("--out", help="folder; default: var/export/MACHINE")] = None,
    max_um: MaxOffset = None,
    rate_um_per_s: Rate = 0.1,
    period_s: Period = 10.0,
    stale_s: Annotated[
        float | None,
        typer.Option(help="time without a usable row that is a fault, s; default: three steps, at least 30"),
    ] = None,
    provisional: Provisional = False,
    as_json: Json = False,
) -> None:
    """Write the receiver for a control, or a model as C, structured text, ONNX or JSON, with limits and fallback."""
    from pipelines.commands.predict import model_folder
    from pipelines.compensating import Given, write_export
    from pipelines.settings import configure_environment, load

    configure_environment()
    settings = load()
    folders = {m: model_folder(m, settings) for m in models}
    given, paths = write_export(folders, to, out, Given(max_um, rate_um_per_s, stale_s=stale_s), period_s, provisional)
    remarks = [f"{a.axis}: {a.remark}" for a in given.axes if a.remark]
    if as_json:
        console.print_json({"machine": given.machine, "simulated": given.simulated, "sha256": given.digest,
                            "files": [str(p) for p in paths], "remarks": remarks})  # fmt: skip
        return
    for text in (*remarks, *paths):
        console.line(text)
