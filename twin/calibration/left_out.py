"""How well a calibration predicts batches that it never saw: free-running, from their own first readings alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from data.errors import InputError, WorkError
from twin.calibration.fit_problem import Array
from twin.calibration.least_squares import fit
from twin.calibration.problem import CalibrationProblem

COLUMNS = ("batch", "channel", "unit", "rows", "left_out", "before", "zero")


@dataclass(frozen=True)
class Fold:
    """One batch left out: the values (n,) fitted on all others, whether that fit converged, in words."""

    batch_id: str
    values: Array
    converged: bool
    words: str


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
    def words(self) -> str:
        """How many batches were left out, and which fits did not converge."""
        lost = [f.batch_id for f in self.folds if not f.converged]
        told = f"{len(self.folds)} batches left out one by one"
        return told + (f"; the fit did not converge without {', '.join(lost)}" if lost else "")


def leave_batch_out(
    problem: CalibrationProblem,
    processes: int = 1,
    max_iterations: int = 60,
    tolerance: float = 1e-3,
    reweight: bool = True,
    progress: Callable[[str, int, int], None] | None = None,
) -> LeftOut:
    """Every batch predicted by a calibration on all others, each started at the priors' mean and never at a fit that
    saw the batch. Results do not depend on `processes`; more than one needs an importable main module.

    Raises:
        InputError: fewer than two batches, or too few rows in a fold.
        WorkError: a fold's model is not finite.
    """
    n = problem.inputs.n_batches
    if n < 2:
        raise InputError(f"leave-batch-out: got {n} batch, needs 2 or more; give more recordings or leave it off")
    work = partial(_fold, max_iterations=max_iterations, tolerance=tolerance, reweight=reweight)
    folds = []
    for fold in _mapped(work, problem, range(n), min(processes, n)):
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


def _fold(problem: CalibrationProblem, b: int, max_iterations: int, tolerance: float, reweight: bool) -> Fold:
    name = problem.measured[b].batch_id
    rest = problem.only([k for k in range(problem.inputs.n_batches) if k != b])
    try:
        done = fit(rest, max_iterations=max_iterations, tolerance=tolerance, reweight=reweight)
    except (InputError, WorkError) as error:
        raise type(error)(f"leave-batch-out without {name}: {error}") from None
    return Fold(name, rest.values_at(done.x), done.converged, done.words)


def _mapped(
    work: Callable[[CalibrationProblem, int], Fold], problem: CalibrationProblem, items: Sequence[int], processes: int
) -> Iterator[Fold]:
    if processes < 2:
        yield from (work(problem, b) for b in items)
        return
    with ProcessPoolExecutor(
        processes, get_context("spawn"), _keep, (work, problem.only(range(problem.inputs.n_batches)))
    ) as pool:
        yield from pool.map(_kept, items)


_held: dict[str, Callable[[int], Fold]] = {}


def _keep(work: Callable[[CalibrationProblem, int], Fold], problem: CalibrationProblem) -> None:
    """Once in every process: the problem is sent there once, not with every fold."""
    threadpool_limits(limits=1)
    _held["work"] = partial(work, problem)


def _kept(b: int) -> Fold:
    return _held["work"](b)
