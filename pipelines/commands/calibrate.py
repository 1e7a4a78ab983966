"""`thermodrift calibrate`: recordings into a calibrated machine file."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from data.errors import InputError
from pipelines import console
from pipelines.options import Json, MachineFile, split

if TYPE_CHECKING:
    from rich.table import Table

    from data.account import Account
    from data.machine import Machine
    from twin.calibration import Calibration
    from twin.calibration.identifiability import Interval

SHOWN = 8  # directions that the recordings do not determine; --json lists all


@dataclass(frozen=True)
class CalibrationOutcome:
    """A calibration and the file that it was written to."""

    calibration: Calibration
    out: Path
    when: str
    account: Account
    report: Path | None = None


def check_calibrated(machine_file: Path, out: Path, overwrite: bool) -> tuple[Machine, str]:
    """The machine and the text of its file; nothing is written.

    Raises:
        InputError: a machine file without a usable twin part, or an `out` that must not be written.
    """
    from data.machine import load_machine
    from twin.calibration.calibrated_file import check_target, check_writable
    from twin.compile import compile_network

    check_target(out, machine_file, overwrite)
    machine = load_machine(machine_file)
    return machine, check_writable(machine_file, compile_network(machine, f"machine file {machine_file}"))


def write_calibrated(found: Calibration, text: str, machine_file: Path, out: Path, overwrite: bool) -> str:
    """Write the calibrated machine file; returns the time that it states.

    Args:
        text: of the machine file that was calibrated.

    Raises:
        InputError: `out` exists and must not be overwritten.
        WorkError: it cannot be written; what stood there is unchanged.
    """
    from twin.calibration.calibrated_file import calibrated_text, write_file
    from twin.compile import compile_network
    from twin.schema import Calibrated

    remarks = [found.fit.message, *found.remarks]
    if found.left_out is not None:
        remarks.append(f"left_out_rms: mean over {found.left_out.summary}")
    when = datetime.now().astimezone().isoformat(timespec="seconds")
    origin = Calibrated(
        batches=found.batches, when=when, simulated=found.simulated, left_out_rms=_left_out_rms(found),
        words="; ".join(remarks),
    )  # fmt: skip
    network = compile_network(found.machine, f"machine file {machine_file}")
    new = calibrated_text(text, network, found.values, found.intervals90, origin, f"machine file {out}")
    write_file(out, new, machine_file, overwrite)
    return when


def _left_out_rms(found: Calibration) -> dict[str, float]:
    """The left-out errors by channel and unit, as the file keeps them."""
    if found.left_out is None:
        return {}
    table = found.left_out.by_channel()
    units = dict(zip(table["channel"], table["unit"], strict=True))
    return {f"{channel}_{units[channel]}": rms for channel, rms in found.left_out.rms.items()}


def calibration_dict(outcome: CalibrationOutcome) -> dict[str, Any]:
    """The outcome of a calibration for other programs."""
    c = outcome.calibration
    return {
        "machine": c.machine.machine,
        "simulated": c.simulated,
        "out": str(outcome.out),
        "when": outcome.when,
        "report": str(outcome.report) if outcome.report else None,
        "batches": list(c.batches),
        "account": outcome.account.as_dict(),
        "remarks": list(c.remarks),
        "fit": {"words": c.fit.message, "converged": c.fit.converged, "cost": c.fit.cost, "rows": c.fit.rows,
                "dof": c.fit.dof, "at_bound": list(c.fit.at_bound)},
        "parameters": [
            {"name": i.name, "unit": i.unit, "prior": prior, "value": i.value, "interval90": [i.low, i.high],
             "prior_shrinkage": i.prior_shrinkage}
            for i, prior in _with_priors(c)
        ],
        "undetermined": [{"names": list(u.names), "words": u.summary} for u in c.undetermined],
        "rms": console.records(c.rms),
        "left_out": None if c.left_out is None else {
            "words": c.left_out.summary,
            "by_channel": console.records(c.left_out.by_channel()),
            "batches": console.records(c.left_out.table),
        },
        "whiteness": list(c.whiteness_in_words.values()),
        "seconds": {k: round(v, 3) for k, v in c.seconds.items()},
    }  # fmt: skip


def print_calibration(outcome: CalibrationOutcome) -> None:
    """Parameters, what is not determined, left-out errors, whiteness, time, and where the file is."""
    c = outcome.calibration
    label = "  (simulated recordings)" if c.simulated else ""
    console.line(
        f"{c.machine.machine}: {len(c.unknowns)} parameters from {len(c.batches)} batches{label}; {c.fit.message}"
    )
    console.line(outcome.account.summary)
    for remark in c.remarks:
        console.line(remark)
    console.out.print(parameter_table(c))
    if c.undetermined:
        console.line("not determined by these recordings")
        for u in c.undetermined[:SHOWN]:
            console.line(f"  {u.summary}")
        if len(c.undetermined) > SHOWN:
            console.line(f"  and {len(c.undetermined) - SHOWN} more, better determined; --json lists them")
    console.out.print(error_table(c))
    if c.left_out is not None:
        console.line(f"left out: {c.left_out.summary}; free-running from each batch's own first readings")
    for sentence in c.whiteness_in_words.values():
        console.line(f"  {sentence}")
    console.line("seconds  " + ", ".join(f"{k} {v:.1f}" for k, v in c.seconds.items() if v >= 0.05))
    console.line(f"{outcome.out}: calibrated machine file")
    if outcome.report:
        console.line(f"{outcome.report}: pictures")


def parameter_table(c: Calibration) -> Table:
    """Every free parameter with its prior, value, 90 % interval, and the interval's width against the prior's."""
    from twin.calibration.identifiability import readable_names

    table = console.table("parameters", "parameter", "unit", left=("parameter", "unit"), wrap=("parameter",))
    for name, width in (("prior", 6), ("value", 6), ("90 % interval", 17), ("width left", 10)):
        table.add_column(name, justify="right", no_wrap=True, min_width=width)
    names = readable_names([u.name for u in c.unknowns])
    for name, (i, prior) in zip(names, _with_priors(c), strict=True):
        interval = f"{_few(i.low)} … {_few(i.high)}"
        table.add_row(name, i.unit, _few(prior), _few(i.value), interval, f"{100 * i.prior_shrinkage:.0f} %")
    return table


def error_table(c: Calibration) -> Table:
    """Errors by channel, mean ± sd over batches of each batch's rms."""
    left = c.left_out
    columns = ["channel", "unit", "batches", "file before", "calibrated"]
    columns += ["left out", "no model"] if left is not None else []
    table = console.table("rms over a batch, mean ± sd over batches", *columns, left=columns[:2])
    shown = {} if left is None else {str(k): part for k, part in left.table.groupby("channel", sort=False)}
    for channel, part in c.rms.groupby("channel", sort=False):
        row = [str(channel), str(part["unit"].iloc[0]), str(len(part)), _spread(part["before"]), _spread(part["after"])]
        if left is not None:
            row += [_spread(shown[str(channel)]["left_out"]), f"{shown[str(channel)]['zero'].mean():.2f}"]
        table.add_row(*row)
    return table


def _with_priors(c: Calibration) -> Sequence[tuple[Interval, float]]:
    return [(i, u.value(u.prior)) for i, u in zip(c.intervals90, c.unknowns, strict=True)]


def _spread(values: Any) -> str:
    sd = f" ± {values.std():.2f}" if len(values) > 1 else ""
    return f"{values.mean():.2f}{sd}"


def _few(value: float) -> str:
    """Three digits, without powers of ten below a million."""
    return f"{float(f'{value:.3g}'):g}"


def calibrate(
    machine: MachineFile,
    to: Annotated[Path, typer.Option("--out", help="the calibrated machine file")],
    recordings: Annotated[
        list[Path] | None, typer.Option(help="files or folders to ingest and calibrate on; default: the lake")
    ] = None,
    batches: Annotated[str, typer.Option(help="batch ids, comma separated; default: all")] = "",
    starts: Annotated[int, typer.Option(help="starts of the fit: the priors' means, then draws from them")] = 1,
    leave_out: Annotated[
        bool, typer.Option("--leave-out/--no-leave-out", help="predict every batch by a fit on the others")
    ] = True,
    report: Annotated[bool, typer.Option(help="pictures of the fit next to --out, as .html")] = True,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace --out if it exists")] = False,
    as_json: Json = False,
) -> None:
    """Fit the machine file's free parameters to recordings: values with 90 % intervals, and their left-out errors."""
    from data.account import Account
    from pipelines.jobs.recordings import gather_batches
    from twin.calibration import CalibrationOptions
    from twin.calibration import calibrate as fit

    if starts < 1:
        raise InputError(f"--starts: got {starts}, expected 1 or more")
    known, text = check_calibrated(machine, to, overwrite)
    with console.progress(as_json) as (say, done):
        gathered = gather_batches(known, tuple(recordings or ()), split(batches), say).batches
        say(f"calibrate {known.machine}: {len(gathered)} batches")
        options = CalibrationOptions(starts, leave_out=leave_out and len(gathered) > 1, processes=os.cpu_count() or 1)
        found = fit(known, gathered, options, lambda step, n, of: done(step, n, of) if of else say(step))
        when = write_calibrated(found, text, machine, to, overwrite)
        page = None
        if report:
            from reports.twin.page import twin_data, write_twin_report

            say("pictures")
            page = to.with_suffix(".html")
            write_twin_report(page, twin_data(known, gathered, found))
    outcome = CalibrationOutcome(found, to, when, Account.of(gathered), page)
    if as_json:
        console.print_json(calibration_dict(outcome))
    else:
        print_calibration(outcome)
