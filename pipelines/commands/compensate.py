"""`thermodrift compensate`: a promoted model next to the control; `thermodrift rehearse`: the same in a closed loop
with recordings, before it goes to the machine; `thermodrift export`: the model for a control or another program."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from data.errors import InputError, masked
from pipelines import console, stopping
from pipelines.commands import load_settings
from pipelines.home import home
from pipelines.options import Json

if TYPE_CHECKING:
    from compensation.rehearsal import Rehearsal

_ONE_EACH = "models:/NAME or a folder, one for each axis"
Models = Annotated[list[str], typer.Argument(help="models:/NAME@champion or a folder, one for each axis")]
OrModels = Annotated[list[str] | None, typer.Argument(help=_ONE_EACH)]
Named = Annotated[list[str] | None, typer.Option("--model", help=_ONE_EACH)]
MaxOffset = Annotated[
    float | None, typer.Option("--max-um", help="largest offset sent, µm; default: the training's largest error + 25 %")
]
Rate = Annotated[float, typer.Option("--rate-um-per-s", help="largest rate of what is sent, µm/s")]
Provisional = Annotated[
    bool, typer.Option("--provisional", help="accept a model that is better than none, but not shown beyond doubt")
]
Period = Annotated[float, typer.Option("--period-s", help="time between two steps of the models, s")]


def compensate(
    models: Models,
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
    start: Annotated[bool, typer.Option(help="ends a stop by the operator, which a restart keeps")] = False,
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
    from pipelines.jobs.compensating import Given, check_standing, compensator

    if not period_s > 0:
        raise InputError(f"--period-s: got {period_s:g}, expected seconds above 0, e.g. 10")
    settings = load_settings()
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
    console.note(
        f"{stated}compensating {machine.machine} from {masked(given)}: {labels}, at most {rate_um_per_s:g} µm/s"
    )
    if not replay:
        stopping.release()  # `serve` lets what is sent fade first
    ended = serve(running, source, sinks, kept, console.note, replay, fade_s=fade_s, confirm=confirm, start=start)
    if ended:
        raise typer.Exit(128 + ended)


def _named(command: str, models: list[str] | None, model: list[str] | None) -> list[str]:
    """The models, as arguments or by --model. Raises: InputError, none."""
    if not (named := [*(models or ()), *(model or ())]):
        raise InputError(f"{command}: got no model; give --model {_ONE_EACH}")
    return named


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
    models: OrModels = None,
    model: Named = None,
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
    from pipelines.jobs.compensating import Given, labelled, rehearse_models
    from pipelines.jobs.recordings import check_recordings, played_files
    from reports.rehearsal import write_rehearsal

    settings = load_settings()
    named = _named("rehearse", models, model)
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
    if r.simulated:
        console.line("SIMULATED recordings")
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


def export(
    models: OrModels = None,
    to: Annotated[str, typer.Option("--to", help="receiver, c, st, onnx, json or sinumerik")] = "c",
    model: Named = None,
    out: Annotated[Path | None, typer.Option("--out", help="folder; default: var/export/MACHINE")] = None,
    max_um: MaxOffset = None,
    rate_um_per_s: Rate = 0.1,
    period_s: Period = 10.0,
    stale_s: Annotated[
        float | None,
        typer.Option(help="time without a usable row that is a fault, s; default: three steps, at least 30"),
    ] = None,
    provisional: Annotated[
        bool, typer.Option("--provisional/--no-provisional", help="take a model that is not shown beyond doubt")
    ] = True,
    as_json: Json = False,
) -> None:
    """Write the receiver for a control, or a model as C, structured text, ONNX or JSON, with limits and fallback."""
    from pipelines.commands.predict import model_folder
    from pipelines.jobs.compensating import Given, write_export

    settings = load_settings()
    folders = {m: model_folder(m, settings) for m in _named("export", models, model)}
    given, paths = write_export(folders, to, out, Given(max_um, rate_um_per_s, stale_s=stale_s), period_s, provisional)
    remarks = [f"{a.axis}: {a.remark}" for a in given.axes if a.remark]
    if as_json:
        console.print_json({"machine": given.machine, "simulated": given.simulated, "sha256": given.digest,
                            "files": [str(p) for p in paths], "remarks": remarks})  # fmt: skip
        return
    for text in (*remarks, *paths):
        console.line(text)
