"""`thermodrift compensate`: a promoted model next to the control."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from data.errors import InputError
from pipelines import console

MaxOffset = Annotated[
    float | None, typer.Option("--max-um", help="largest offset sent, µm; default: the training's largest error + 25 %")
]
Rate = Annotated[float, typer.Option("--rate-um-per-s", help="largest rate of what is sent, µm/s")]
Provisional = Annotated[
    bool, typer.Option("--provisional", help="accept a model that is better than none, but not shown beyond doubt")
]
Period = Annotated[float, typer.Option("--period-s", help="time between two steps of the models, s")]


def compensate(
    models: Annotated[list[str], typer.Argument(help="models:/NAME@champion or a folder, one for each axis")],
    given: Annotated[str, typer.Option("--from", help="-, PATH.csv, mqtt://HOST:PORT/PREFIX or opc.tcp://…")] = "-",
    to: Annotated[list[str] | None, typer.Option("--to", help="the same forms, several times; default: -")] = None,
    max_um: MaxOffset = None,
    rate_um_per_s: Rate = 0.1,
    sample_s: Annotated[float | None, typer.Option(help="how often samples arrive, s; default: machine file")] = None,
    period_s: Period = 10.0,
    state: Annotated[Path | None, typer.Option(help="file that survives a restart; default: var/compensation")] = None,
    replay: Annotated[bool, typer.Option(help="time is that of the samples; a CSV file ends at its end")] = False,
    fade_s: Annotated[
        float | None, typer.Option(help="longest time that a stop may fade, s; default: as the rate needs")
    ] = None,
    confirm: Annotated[bool, typer.Option(help="the sensors are right as they are now: a new run begins")] = False,
    provisional: Provisional = False,
) -> None:
    """Answer the samples of a machine with corrections: limited in size and rate, safe when sensors or networks fail.

    A correction is the negative of the expected error, relative to the first sample. Measured errors that arrive as
    readings (what is left with the correction that was sent) update it. Ctrl-C fades to 0 and ends, a second one ends
    at once; the state file keeps what was learned and sent.
    """
    from compensation.connectors import open_sink, open_source
    from compensation.serving import StateFile, serve
    from pipelines.commands.predict import load_model
    from pipelines.compensating import Given, check_standing, compensator
    from pipelines.settings import configure_environment, home, load

    if not period_s > 0:
        raise InputError(f"--period-s: got {period_s:g}, expected seconds above 0, e.g. 10")
    configure_environment()
    settings = load()
    stored = [load_model(m, settings) for m in models]
    check_standing(dict(zip(models, stored, strict=True)), provisional)
    machine = stored[0].machine
    running = compensator(stored, Given(max_um, rate_um_per_s, sample_s), period_s, console.note)
    source = open_source(given, machine, follow=not replay or not given.endswith(".csv"))
    sinks = [open_sink(address, machine) for address in to or ["-"]]
    kept = StateFile(state or home() / "compensation" / f"{machine.machine}.json") if state or not replay else None
    labels = ", ".join(
        f"{a.axis} ±{a.limits.max_offset_um:.3g} µm{f' ({a.remark})' if a.remark else ''}" for a in running.axes
    )
    stated = "SIMULATED model; " if any(m.simulated for m in stored) else ""
    console.note(f"{stated}compensating {machine.machine} from {given}: {labels}, at most {rate_um_per_s:g} µm/s")
    serve(running, source, sinks, kept, console.note, replay, fade_s=fade_s, confirm=confirm)
