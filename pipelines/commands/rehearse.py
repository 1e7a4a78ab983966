"""`thermodrift rehearse`: a compensation in a closed loop with recordings, before it goes to the machine."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from data.errors import InputError
from pipelines import console
from pipelines.commands.compensate import MaxOffset, Period, Rate
from pipelines.options import Json

if TYPE_CHECKING:
    from compensation.rehearsal import Rehearsal


def rehearsal_dict(r: Rehearsal) -> dict[str, Any]:
    """The rehearsal's figures for other programs."""
    axes = {}
    for a in r.before_um:
        (band_before, band_after), (rms_before, rms_after) = r.band_um(a), r.rms_um(a)
        axes[a] = {"band95_before_um": band_before, "band95_after_um": band_after, "rms_before_um": rms_before,
                   "rms_after_um": rms_after}  # fmt: skip
    return {"machine": r.machine, "simulated": r.simulated, "samples": len(r.time_s), "readings": len(r.readings_s),
            "failures": len(r.failures), "axes": axes}  # fmt: skip


def rehearse(
    recordings: Annotated[list[Path], typer.Option(help="file or folder; batches that the model has not seen")],
    models: Annotated[
        list[str] | None, typer.Argument(help="models:/NAME@champion or a folder, one for each axis")
    ] = None,
    model: Annotated[list[str] | None, typer.Option("--model", help="the same, as `predict` takes it")] = None,
    fail: Annotated[
        list[str] | None, typer.Option(help="SENSOR:HOW@START+DURATION, HOW lost, frozen or stepping")
    ] = None,
    readings: Annotated[
        str | None, typer.Option(help="of a probe: 1h after the start of each recording, or every 1h; default: none")
    ] = None,
    readings_h: Annotated[
        float | None, typer.Option(help="hours between two readings, as --readings 'every 1h'")
    ] = None,
    sample_s: Annotated[float, typer.Option(help="time between two samples, s")] = 10.0,
    max_um: MaxOffset = None,
    rate_um_per_s: Rate = 0.1,
    period_s: Period = 10.0,
    through: Annotated[
        str | None, typer.Option(help="mqtt://…: talk to a running `thermodrift compensate --replay`")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="page; default: var/rehearsal/MACHINE.html")] = None,
    as_json: Json = False,
) -> None:
    """Play recordings to a compensation as if they happened now, let sensors fail, and show the error before and after.

    Each recording follows the other after a night. With --through it speaks to a compensation that runs elsewhere.
    """
    from data.account import Account
    from pipelines.commands.predict import load_model
    from pipelines.compensating import Given, labelled, rehearse_models
    from pipelines.recordings import check_recordings, played_files
    from pipelines.settings import configure_environment, home, load
    from reports.rehearsal import write_rehearsal

    configure_environment()
    settings = load()
    named = [*(models or ()), *(model or ())]
    if not named:
        raise InputError("rehearse: got no model; give --model models:/NAME@champion or a folder, one for each axis")
    stored = [load_model(m, settings) for m in named]
    machine = stored[0].machine
    check_recordings(recordings)
    batches = played_files(machine, recordings)
    given = Given(max_um, rate_um_per_s, sample_s)
    with console.progress(as_json) as (_, done):
        r = rehearse_models(
            stored, batches, given, period_s=period_s, failures=fail or (), readings=readings, readings_h=readings_h,
            through=through, done=lambda n, of: done("rehearse", n, of),
        )  # fmt: skip
    page = out or home() / "rehearsal" / f"{machine.machine}.html"
    account = Account.of(batches)
    write_rehearsal(page, r, labelled(named, stored), account.summary)
    remarks = {m.family.target: m.remark for m in stored if m.remark}
    if as_json:
        console.print_json(rehearsal_dict(r) | {"page": str(page), "remarks": remarks, "account": account.as_dict()})
        return
    console.line(account.summary)
    for a, remark in remarks.items():
        console.line(f"{a:<10} {remark}")
    for a in r.before_um:
        before, after = r.band_um(a)
        console.line(f"{a:<10} band of 95 % of the rows: {before:.2f} µm without, {after:.2f} µm with compensation")
    for m in stored:
        if said := m.info.get("faults", {}).get("summary"):
            console.line(f"{m.family.target:<10} {said}")
    console.line(f"page       {page}")
