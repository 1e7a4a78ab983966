"""Calibration: a machine file's free parameters from recordings, with intervals, and what can be trusted of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pandas as pd

from data.batch import Batch
from data.errors import InputError, WorkError
from data.machine import Machine
from twin.calibration.fit_problem import Array, Unknown
from twin.calibration.identifiability import Interval, Undetermined, correlation, intervals90, undetermined
from twin.calibration.least_squares import Fit, fit
from twin.calibration.left_out import LeftOut, free_running_rms, leave_batch_out
from twin.calibration.measured import EVERY_S
from twin.calibration.problem import CalibrationProblem
from twin.calibration.whiteness import in_words, whiteness
from twin.compile import compile_network
from twin.network import Network
from twin.simulation.inputs import MAX_GAP_S

TOLERANCE = 1e-3  # of the fit: parameters within 3 % of a posterior standard deviation of their optimum
RMS_COLUMNS = ("batch", "channel", "unit", "rows", "before", "after", "fitted")


@dataclass(frozen=True)
class Calibration:
    """A calibrated network and how far it can be trusted; p free parameters.

    `network` has the new values, each with its old centre as prior. `rms` has a row per batch and channel, columns
    `RMS_COLUMNS`, in the channel's unit: free-running from first readings with the machine file's values (`before`)
    and with the new ones (`after`), and with the batch's own start and offsets as fitted (`fitted`). `whiteness` is
    that of the fitted residual. `left_out` is None where no batch was left out.
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
        """What the recordings leave to the priors, least determined first."""
        return undetermined(self.fit, self.unknowns)

    @cached_property
    def whiteness_in_words(self) -> dict[str, str]:
        """A sentence per channel."""
        return in_words(self.whiteness, dict(zip(self.rms["channel"], self.rms["unit"], strict=True)))


def calibrate(
    machine: Machine,
    batches: Sequence[Batch],
    *,
    starts: int = 1,
    seed: int = 0,
    every_s: float = EVERY_S,
    channels: Sequence[str] | None = None,
    reweight: bool = True,
    leave_out: bool = False,
    processes: int = 1,
    max_iterations: int = 60,
    tolerance: float = TOLERANCE,
    max_gap_s: float = MAX_GAP_S,
    progress: Callable[[str, int, int], None] | None = None,
) -> Calibration:
    """The machine's free parameters from its recordings, by MAP least squares (`twin.calibration.least_squares`).

    `starts` begins at the priors' means and, beyond one, at draws from the priors by `seed`. Rows nearer than
    `every_s` are left out. `channels` takes some sensors and errors alone. With `reweight` each channel's noise and
    its correlation are re-estimated from what remains, so that a smooth misfit does not pass for certainty.
    `leave_out` predicts every batch by a calibration on the others, in `processes` processes.

    Raises:
        InputError: no twin part, nothing free, a batch that cannot be used, or fewer rows than free parameters.
        WorkError: the fit did not converge, or the model is not finite.
    """
    begun = time.perf_counter()
    check_batches(machine, batches)
    network = compile_network(machine)
    problem = CalibrationProblem.of(network, batches, every_s, channels, max_gap_s)
    say = (lambda text: progress(text, 0, 0)) if progress else None
    done = fit(problem, starts, seed, max_iterations, tolerance, say, reweight)
    if not (done.converged and np.isfinite(done.x).all() and np.isfinite(done.covariance).all()):
        raise WorkError(
            f"calibration of {machine.machine}: {done.words}; nothing is kept; give more starts, check the recordings "
            "and the bounds, or fix parameters that they do not determine"
        )
    fitted = time.perf_counter()
    left_out = None
    if leave_out:
        left_out = leave_batch_out(
            problem, processes, max_iterations=max_iterations, reweight=reweight, progress=progress
        )
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
