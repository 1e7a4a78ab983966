"""Calibration of a machine file's free parameters from recordings, with intervals and left-out errors."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from data.arrays import Array
from data.batch import Batch
from data.errors import InputError, WorkError
from data.machine import Machine
from data.processes import Processes, one_thread
from twin.calibration.fit_problem import Unknown
from twin.calibration.identifiability import Interval, Undetermined, correlation, intervals90, undetermined
from twin.calibration.least_squares import Fit, FitOptions, fit
from twin.calibration.problem import EVERY_S, CalibrationProblem
from twin.calibration.recorder import converge_with_lead, first_lead_rows, lead_remarks, must_learn_lead
from twin.calibration.whiteness import in_words, whiteness
from twin.compile import compile_network
from twin.network import Network
from twin.simulation.inputs import MAX_GAP_S, acting

COLUMNS = ("batch", "channel", "unit", "rows", "left_out", "before", "zero")


@dataclass(frozen=True)
class Fold:
    """One batch left out: the values (n,) fitted on all others, whether that fit converged, and its message."""

    batch_id: str
    values: Array
    converged: bool
    message: str


@dataclass(frozen=True)
class LeftOut:
    """Errors of batches that the calibration never saw, rms over each batch's rows in the channel's unit.

    `table` has a row per batch and channel, columns `COLUMNS`: `left_out` by the calibration on all other batches,
    `before` by the machine file as it was, `zero` if nothing ever moved from its first value.
    """

    folds: tuple[Fold, ...]
    table: pd.DataFrame

    def by_channel(self) -> pd.DataFrame:
        """Mean and standard deviation over batches: channel, unit, batches, left_out, left_out_sd, before, zero."""
        groups = self.table.groupby("channel", sort=False)
        out = groups.agg(unit=("unit", "first"), batches=("batch", "count"), left_out=("left_out", "mean"),
                         left_out_sd=("left_out", "std"), before=("before", "mean"), zero=("zero", "mean"))  # fmt: skip
        return out.reset_index()

    @property
    def rms(self) -> dict[str, float]:
        """Mean over batches of the left-out rms, by channel."""
        table = self.by_channel()
        return dict(zip(table["channel"], table["left_out"].astype(float), strict=True))

    @property
    def summary(self) -> str:
        """How many batches were left out, and which fits did not converge."""
        lost = [f.batch_id for f in self.folds if not f.converged]
        summary = f"{len(self.folds)} batches left out one by one"
        return summary + (f"; the fit did not converge without {', '.join(lost)}" if lost else "")


LEAD_TOLERANCE = 0.1  # of the fits that say when drivers act: their posteriors differ by tens of nats
TOLERANCE = 1e-3  # of the fit: parameters within 3 % of a posterior standard deviation of their optimum


@dataclass(frozen=True)
class CalibrationOptions(FitOptions):
    """How a calibration searches (`FitOptions`), and what it uses.

    Rows nearer than `every_s` are left out; holes up to `max_gap_s` are bridged. `channels` takes some sensors and
    errors alone. With `reweight` a smooth misfit does not pass for certainty. `leave_out` predicts every batch by a
    calibration on the others, in `processes` processes; results do not depend on their number, and more than one needs
    an importable main module.
    """

    tolerance: float = TOLERANCE
    reweight: bool = True
    every_s: float = EVERY_S
    max_gap_s: float = MAX_GAP_S
    channels: Sequence[str] | None = None
    leave_out: bool = False
    processes: int = 1


_DEFAULT = CalibrationOptions()


def leave_batch_out(
    problem: CalibrationProblem,
    options: CalibrationOptions = _DEFAULT,
    progress: Callable[[str, int, int], None] | None = None,
) -> LeftOut:
    """Every batch predicted by a calibration on all others, started at the priors' mean, not at a fit of all batches.

    Raises:
        InputError: fewer than two batches, or too few rows in a fold.
        WorkError: a fold's model is not finite.
    """
    n = problem.inputs.n_batches
    if n < 2:
        raise InputError(f"leave-batch-out: got {n} batch, needs 2 or more; give more recordings or leave it off")
    work = partial(_fold, problem, options=replace(options, starts=1))
    folds = []
    with Processes(min(options.processes, n), _start) as pool:
        for fold in pool.map(work, range(n)):
            folds.append(fold)
            if progress:
                progress("leave a batch out", len(folds), n)
    table = pd.DataFrame(_rows(problem, folds), columns=list(COLUMNS))
    return LeftOut(tuple(folds), table)


def free_running_rms(problem: CalibrationProblem, values: Array) -> list[dict[int, float]]:
    """By batch the rms of each usable channel, simulated from its own first readings at parameter values (n,)."""
    errors = problem.free_running_errors(values)
    return [_rms_of(e, m.channel) for e, m in zip(errors, problem.measured, strict=True)]


def _rms_of(error: Array, channel: NDArray[np.int64]) -> dict[int, float]:
    return {int(c): float(np.sqrt(np.mean(error[channel == c] ** 2))) for c in np.unique(channel)}


def _rows(problem: CalibrationProblem, folds: Sequence[Fold]) -> Iterator[tuple[object, ...]]:
    before = free_running_rms(problem, problem.network.values)
    for b, (fold, m) in enumerate(zip(folds, problem.measured, strict=True)):
        one = problem.only([b])
        left_out = free_running_rms(one, fold.values)[0]
        zero = _rms_of(m.value - m.at_rest, m.channel)
        for c in m.usable.tolist():
            yield (m.batch_id, problem.channels[c], problem.units[c], int((m.channel == c).sum()), left_out[c],
                   before[b][c], zero[c])  # fmt: skip


def _fold(problem: CalibrationProblem, b: int, options: FitOptions) -> Fold:
    name = problem.measured[b].batch_id
    rest = problem.only([k for k in range(problem.inputs.n_batches) if k != b])
    try:
        done = fit(rest, options)
    except (InputError, WorkError) as error:
        raise type(error)(f"leave-batch-out without {name}: {error}") from None
    return Fold(name, rest.values_at(done.x), done.converged, done.message)


def _start() -> None:
    """First call in a worker process: to find it here loads the twin, since only loaded libraries are limited."""
    one_thread()


RMS_COLUMNS = ("batch", "channel", "unit", "rows", "before", "after", "fitted")


@dataclass(frozen=True)
class Calibration:
    """A calibrated network and its uncertainty; p free parameters.

    `network` has the new values, each with its old centre as prior. `rms` has a row per batch and channel, columns
    `RMS_COLUMNS`, in the channel's unit: free-running from first readings with the machine file's values (`before`)
    and with the new ones (`after`), and with the batch's own start and offsets as fitted (`fitted`). `whiteness` is
    that of the fitted residual. `left_out` is None where no batch was left out. A driver's change comes `lead_rows`
    before the row that first shows it.
    """

    machine: Machine
    network: Network
    batches: tuple[str, ...]
    simulated: bool
    unknowns: tuple[Unknown, ...]
    fit: Fit
    rms: pd.DataFrame
    whiteness: pd.DataFrame
    left_out: LeftOut | None
    seconds: Mapping[str, float]
    lead_rows: float = 0.0

    @cached_property
    def values(self) -> dict[str, float]:
        """The calibrated values by parameter, in their units."""
        return {u.name: u.value(x) for u, x in zip(self.unknowns, self.fit.x, strict=True)}

    @cached_property
    def intervals90(self) -> list[Interval]:
        """90 % intervals of the free parameters."""
        return intervals90(self.fit, self.unknowns)

    @cached_property
    def correlation(self) -> Array:
        """Of the free parameters in fitting coordinates, (p, p)."""
        return correlation(self.fit)

    @cached_property
    def undetermined(self) -> list[Undetermined]:
        """Combinations that the recordings do not determine, least determined first."""
        return undetermined(self.fit, self.unknowns)

    @property
    def remarks(self) -> tuple[str, ...]:
        """What was learned of the recordings besides values."""
        return lead_remarks(self.machine, self.lead_rows)

    @cached_property
    def whiteness_in_words(self) -> dict[str, str]:
        """A sentence per channel."""
        return in_words(self.whiteness, dict(zip(self.rms["channel"], self.rms["unit"], strict=True)))


def calibrate(
    machine: Machine,
    batches: Sequence[Batch],
    options: CalibrationOptions = _DEFAULT,
    progress: Callable[[str, int, int], None] | None = None,
) -> Calibration:
    """The machine's free parameters from its recordings, by MAP least squares (`twin.calibration.least_squares`).

    Raises:
        InputError: no twin part, nothing free, a batch that cannot be used, or fewer rows than free parameters.
        WorkError: the fit did not converge, or the model is not finite.
    """
    begun = time.perf_counter()
    check_batches(machine, batches)
    network = compile_network(machine)

    def problem_at(lead_rows: float) -> CalibrationProblem:
        own = acting(batches, lead_rows)
        return CalibrationProblem.of(network, own, options.every_s, options.channels, options.max_gap_s)

    report = (lambda text: progress(text, 0, 0)) if progress else None
    lead_rows = first_lead_rows(machine)
    problem = problem_at(lead_rows)
    if must_learn_lead(machine, problem):
        rough = replace(options, starts=1, tolerance=max(options.tolerance, LEAD_TOLERANCE))
        lead_rows, problem, *_ = converge_with_lead(machine, problem_at, rough, progress=report)
    done = fit(problem, options, report)
    if not (done.converged and np.isfinite(done.x).all() and np.isfinite(done.covariance).all()):
        raise WorkError(
            f"calibration of {machine.machine}: {done.message}; nothing is kept; give more starts, check the "
            "recordings and the bounds, or fix parameters that they do not determine"
        )
    fitted = time.perf_counter()
    left_out = leave_batch_out(problem, options, progress) if options.leave_out else None
    return Calibration(
        machine=machine,
        network=_calibrated(problem, done),
        batches=tuple(b.batch_id for b in batches),
        simulated=machine.simulated or any(b.simulated for b in batches),
        unknowns=problem.unknowns,
        fit=done,
        rms=_rms(problem, done),
        whiteness=whiteness(problem.residual_series(done.x, done.nuisance)),
        left_out=left_out,
        seconds={"fit": fitted - begun, "leave out": time.perf_counter() - fitted},
        lead_rows=lead_rows,
    )


def check_batches(machine: Machine, batches: Sequence[Batch]) -> None:
    """Raises InputError: a batch of another machine, or given twice."""
    ids = [b.batch_id for b in batches]
    for batch in batches:
        if batch.machine != machine.machine:
            raise InputError(
                f"batch {batch.batch_id}: is of machine {batch.machine!r}, expected {machine.machine!r}; leave it out"
            )
        if ids.count(batch.batch_id) > 1:
            raise InputError(f"batch {batch.batch_id}: given {ids.count(batch.batch_id)} times; give it once")


def _calibrated(problem: CalibrationProblem, done: Fit) -> Network:
    values = problem.values_at(done.x)
    changed = tuple(
        replace(p, value=float(v), prior=p.prior_value) if p.free else p
        for p, v in zip(problem.network.parameters, values, strict=True)
    )
    return replace(problem.network, parameters=changed)


def _rms(problem: CalibrationProblem, done: Fit) -> pd.DataFrame:
    before = free_running_rms(problem, problem.network.values)
    after = free_running_rms(problem, problem.values_at(done.x))
    rows = []
    residuals = problem.residual_series(done.x, done.nuisance)
    for b, m in enumerate(problem.measured):
        for c in m.usable.tolist():
            own = residuals[m.batch_id][problem.channels[c]]
            own = own[np.isfinite(own)]
            rows.append((m.batch_id, problem.channels[c], problem.units[c], len(own), before[b][c], after[b][c],
                         float(np.sqrt(np.mean(own**2)))))  # fmt: skip
    return pd.DataFrame(rows, columns=list(RMS_COLUMNS))
