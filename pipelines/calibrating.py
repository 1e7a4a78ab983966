"""`thermodrift calibrate`: recordings into a calibrated machine file, and what the screen says of it."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from data.errors import InputError
from data.machine import load_machine
from pipelines import screen
from pipelines.recordings import gather_batches
from twin.calibration import Calibration, calibrate
from twin.calibration.calibrated_file import Origin, calibrated_text, check_target, check_writable, write_file
from twin.calibration.identifiability import Interval, readable_names
from twin.compile import compile_network

Say = Callable[[str], None]
SHOWN = 8  # directions that the recordings do not determine; --json tells all


@dataclass(frozen=True)
class CalibrationRequest:
    """What to calibrate. `recordings` empty: what the lake holds. `batch_ids` empty: all of them."""

    machine_file: Path
    out: Path
    recordings: tuple[Path, ...] = ()
    batch_ids: tuple[str, ...] = ()
    starts: int = 1
    leave_out: bool = True
    report: bool = True
    overwrite: bool = False
    seed: int = 0


@dataclass(frozen=True)
class CalibrationOutcome:
    """A calibration and the file that it was written to."""

    calibration: Calibration
    out: Path
    when: str
    report: Path | None = None


def calibrate_file(request: CalibrationRequest, say: Say, done: screen.Done) -> CalibrationOutcome:
    """Calibrate a machine file on recordings and write the calibrated one.

    Everything that can be wrong with the files is looked at before the work starts.

    Raises:
        InputError: a file, batch or option that cannot be used.
        WorkError: the fit did not converge, or the file cannot be written; what stood there is unchanged.
    """
    if request.starts < 1:
        raise InputError(f"--starts: got {request.starts}, expected 1 or more")
    check_target(request.out, request.machine_file, request.overwrite)
    machine = load_machine(request.machine_file)
    network = compile_network(machine, f"machine file {request.machine_file}")
    text = check_writable(request.machine_file, network)
    batches = gather_batches(machine, request.recordings, request.batch_ids, say).batches
    say(f"calibrate {machine.machine}: {len(network.free)} free parameters, {len(batches)} batches")

    def told(step: str, n: int, of: int) -> None:
        done(step, n, of) if of else say(step)

    found = calibrate(
        machine, batches, starts=request.starts, seed=request.seed, leave_out=request.leave_out and len(batches) > 1,
        processes=os.cpu_count() or 1, progress=told,
    )  # fmt: skip
    when = datetime.now().astimezone().isoformat(timespec="seconds")
    origin = Origin(found.batches, when, found.simulated, _rounded(found), _origin_words(found))
    where = f"machine file {request.out}"
    new = calibrated_text(text, network, found.values, found.intervals90, origin, where)
    write_file(request.out, new, request.machine_file, request.overwrite)
    if not request.report:
        return CalibrationOutcome(found, request.out, when)
    from reports.twin.page import twin_data, write_twin_report

    say("pictures")
    page = request.out.with_suffix(".html")
    write_twin_report(page, twin_data(machine, batches, found))
    return CalibrationOutcome(found, request.out, when, page)


def _rounded(found: Calibration) -> dict[str, float]:
    """The left-out errors by channel and unit, as the file keeps them."""
    if found.left_out is None:
        return {}
    table = found.left_out.by_channel()
    units = dict(zip(table["channel"], table["unit"], strict=True))
    return {f"{channel}_{units[channel]}": rms for channel, rms in found.left_out.rms.items()}


def _origin_words(found: Calibration) -> str:
    parts = [found.fit.words]
    if found.left_out is not None:
        parts.append(f"left_out_rms: mean over {found.left_out.words}")
    return "; ".join(parts)


def outcome_dict(outcome: CalibrationOutcome) -> dict[str, Any]:
    """What came of a calibration, for machines."""
    c = outcome.calibration
    return {
        "machine": c.machine.machine,
        "simulated": c.simulated,
        "out": str(outcome.out),
        "when": outcome.when,
        "report": str(outcome.report) if outcome.report else None,
        "batches": list(c.batches),
        "fit": {"words": c.fit.words, "converged": c.fit.converged, "cost": c.fit.cost, "rows": c.fit.rows,
                "dof": c.fit.dof, "at_bound": list(c.fit.at_bound)},
        "parameters": [
            {"name": i.name, "unit": i.unit, "prior": prior, "value": i.value, "interval90": [i.low, i.high],
             "prior_shrinkage": i.prior_shrinkage}
            for i, prior in _with_priors(c)
        ],
        "undetermined": [{"names": list(u.names), "words": u.words} for u in c.undetermined],
        "rms": screen.records(c.rms),
        "left_out": None if c.left_out is None else {
            "words": c.left_out.words,
            "by_channel": screen.records(c.left_out.by_channel()),
            "batches": screen.records(c.left_out.table),
        },
        "whiteness": list(c.whiteness_in_words.values()),
        "seconds": {k: round(v, 3) for k, v in c.seconds.items()},
    }  # fmt: skip


def print_outcome(outcome: CalibrationOutcome) -> None:
    """Parameters, what is not determined, left-out errors, whiteness, time, and where the file is."""
    c = outcome.calibration
    label = "  (simulated recordings)" if c.simulated else ""
    screen.line(
        f"{c.machine.machine}: {len(c.unknowns)} parameters from {len(c.batches)} batches{label}; {c.fit.words}"
    )
    screen.out.print(parameter_table(c))
    if c.undetermined:
        screen.line("not determined by these recordings")
        for u in c.undetermined[:SHOWN]:
            screen.line(f"  {u.words}")
        if len(c.undetermined) > SHOWN:
            screen.line(f"  and {len(c.undetermined) - SHOWN} more, better determined; --json lists them")
    screen.out.print(error_table(c))
    if c.left_out is not None:
        screen.line(f"left out: {c.left_out.words}; free-running from each batch's own first readings")
    for sentence in c.whiteness_in_words.values():
        screen.line(f"  {sentence}")
    screen.line("seconds  " + ", ".join(f"{k} {v:.1f}" for k, v in c.seconds.items() if v >= 0.05))
    screen.line(f"{outcome.out}: calibrated machine file")
    if outcome.report:
        screen.line(f"{outcome.report}: pictures")


def parameter_table(c: Calibration) -> Table:
    """Every free parameter with its prior, value, 90 % interval, and how wide it still is against the prior."""
    table = _table("parameters")
    table.add_column("parameter")
    table.add_column("unit", no_wrap=True)
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
    table = _table("rms over a batch, mean ± sd over batches")
    table.add_column("channel", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    titles = ["batches", "file before", "calibrated", *(["left out", "no model"] if left is not None else [])]
    for name in titles:
        table.add_column(name, justify="right", no_wrap=True)
    shown = {} if left is None else {str(k): part for k, part in left.table.groupby("channel", sort=False)}
    for channel, part in c.rms.groupby("channel", sort=False):
        row = [str(channel), str(part["unit"].iloc[0]), str(len(part)), _spread(part["before"]), _spread(part["after"])]
        if left is not None:
            row += [_spread(shown[str(channel)]["left_out"]), f"{shown[str(channel)]['zero'].mean():.2f}"]
        table.add_row(*row)
    return table


def _table(title: str) -> Table:
    return Table(title=title, box=SIMPLE_HEAD, title_justify="left", pad_edge=False, show_edge=False)


def _with_priors(c: Calibration) -> Sequence[tuple[Interval, float]]:
    return [(i, u.value(u.prior)) for i, u in zip(c.intervals90, c.unknowns, strict=True)]


def _spread(values: Any) -> str:
    sd = f" ± {values.std():.2f}" if len(values) > 1 else ""
    return f"{values.mean():.2f}{sd}"


def _few(value: float) -> str:
    """Three digits, without powers of ten below a million."""
    return f"{float(f'{value:.3g}'):g}"
