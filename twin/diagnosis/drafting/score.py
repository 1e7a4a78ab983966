"""How well a drafted network predicts parts that it did not see: fits without each of four folds, free-running."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from data.batch import Batch
from twin.calibration.descent import State, descend, x_of
from twin.calibration.fit_noise import Noise
from twin.calibration.left_out import free_running_rms
from twin.calibration.problem import CalibrationProblem
from twin.network import Network

Array = NDArray[np.float64]

FOLDS = 4
MISFIT = 0.1  # of a channel's movement: what a drafted network leaves; it weighs the channel's rows
ALIKE = 10.0  # rows of a smooth misfit that count as one: at full weight priors would say nothing
ITERATIONS, FOLD_ITERATIONS = 30, 10
TOLERANCE = 1e-3  # of the cost per row


@dataclass(frozen=True)
class Scored:
    """A fitted draft: all parameter values (n,), and by part and channel the rms left out and that of no movement.

    `left_out` and `zero` are (B, C) in the channels' units (K for sensors), NaN where a part has no value of a
    channel; `noise` (C,) the channels' own.
    """

    network: Network
    values: Array
    channels: tuple[str, ...]
    units: tuple[str, ...]
    noise: Array
    left_out: Array
    zero: Array

    @cached_property
    def log_score(self) -> Array:
        """Mean over channels of the logarithm of the share of the movement that is left, (B,); noise counts in both."""
        ratio = np.sqrt((self.left_out**2 + self.noise**2) / (self.zero**2 + self.noise**2))
        return np.asarray(np.nanmean(np.log(ratio), axis=1))

    @property
    def share_left(self) -> float:
        """Geometric mean of it over parts and channels: 1 is as good as nothing."""
        return float(np.exp(self.log_score.mean()))

    def better_than(self, other: Scored) -> tuple[float, float]:
        """By how much the logarithm is below another's on the same parts: mean and its standard error."""
        gain = other.log_score - self.log_score
        return float(gain.mean()), float(gain.std(ddof=1) / np.sqrt(len(gain))) if len(gain) > 1 else 0.0


def scored(network: Network, batches: Sequence[Batch], moved: Mapping[str, float]) -> Scored:
    """Fit the network to all parts, and predict each part by the fit without its fold from first readings alone.

    `moved` is the rms movement of every channel, in its unit.

    Raises:
        InputError: see `CalibrationProblem.of`, or fewer rows than parameters. WorkError: the model is not finite.
    """
    readings = tuple(replace(r, noise=_soft(r.noise, moved[r.channel])) for r in network.readings)
    errors = tuple(replace(e, noise=_soft(e.noise, moved[e.channel])) for e in network.errors)
    soft = replace(network, readings=readings, errors=errors)
    problem = CalibrationProblem.of(soft, batches, every_s=min(b.step_s for b in batches))
    nuisance = [np.zeros(q) for q in problem.nuisance_sizes]
    done = _fit(problem, np.zeros(len(problem.unknowns)), nuisance, ITERATIONS)
    count = len(batches)
    left_out, zero = np.full((2, count, len(problem.channels)), np.nan)
    for fold in range(min(FOLDS, count)):
        out = list(range(fold, count, FOLDS))
        part = problem.only(out)
        for b, m, rms in zip(out, part.measured, free_running_rms(part, _without(problem, done, out)), strict=True):
            for c, value in rms.items():
                at = m.channel == c
                left_out[b, c] = value
                zero[b, c] = np.sqrt(np.mean((m.value[at] - m.at_rest[at]) ** 2))
    noise = np.array([r.noise for r in network.readings] + [e.noise for e in network.errors])
    return Scored(network, _values(problem, done), problem.channels, problem.units, noise, left_out, zero)


def _soft(noise: float, moved: float) -> float:
    return float(np.hypot(noise, MISFIT * moved))


def _fit(problem: CalibrationProblem, z: Array, nuisance: list[Array], iterations: int) -> State:
    channels = len(problem.channels)
    start = State.at(problem, z, nuisance, Noise(np.ones(channels), np.full(channels, ALIKE)))
    return descend(problem, start, iterations, TOLERANCE * start.rows)


def _without(problem: CalibrationProblem, done: State, out: Sequence[int]) -> Array:
    """All parameter values (n,) of the fit without some parts; begun at the fit with them, which saves steps."""
    kept = [b for b in range(len(done.nuisance)) if b not in out]
    if kept:
        done = _fit(problem.only(kept), done.z, [done.nuisance[b] for b in kept], FOLD_ITERATIONS)
    return _values(problem, done)


def _values(problem: CalibrationProblem, state: State) -> Array:
    return problem.values_at(x_of(problem.unknowns, state.z))
