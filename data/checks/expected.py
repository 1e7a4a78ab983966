"""What a channel should do, by its own past, the drivers and the other channels: a fault contradicts all of them.

The step of a channel into a row is regressed, over the other rows of the run, on what it depends on in physics: its own
level before (it relaxes), the levels of the other channels before (they exchange heat with it), the drivers and their
squares now and over the rows before, and the step that the other temperatures make in common. The coefficients have a
Gaussian prior whose total variance is that of the steps: a step that comes with a change of a driver which the run
never repeats has a wide prediction and contradicts nothing (Bishop 2006, Pattern Recognition and Machine Learning,
eq. 3.53, 3.54 and 3.59).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from data.batch import Batch
from data.checks.base import SIGMAS, THERMAL, Array, Bools, in_time, robust_sigma, signals

LAGS = (
    (-1, -1),
    (0, 0),
    (1, 1),
    (2, 4),
    (5, 12),
)  # first and last row before (a clock may be a row late), of which a driver's mean is taken
_LEVELS = 4  # principal components of the other channels' levels
_TAILS = 30.0  # noise; a larger step is no measure of what steps usually are
_FITS = 4
_RUNS = 12  # other runs, the nearest ones, say how a channel follows the machine
_LEVELS_RIDGE = 0.01  # of levels, which follow each other too smoothly for their rows to count one by one
_UNEXPLAINED = 0.7  # of a change: a driver that explains the larger part is its cause, be the regression crude


@dataclass(frozen=True)
class Prediction:
    """`values` (n,) of all rows by the regression of the others, its `noise`, regressors (n, p), covariance (p, p)."""

    values: Array
    noise: float
    x: Array
    core: Array

    def deviation(self, direction: Array) -> float:
        """Standard deviation of a combination (p,) of the regressors, by the coefficients alone."""
        return self.noise * float(np.sqrt(direction @ self.core @ direction))


def predicted(x: Array, y: Array, out: Bools, resolution: float | None, ridge: float = 0.0) -> Prediction:
    """y (n,) by a ridge regression on x (n, p) in all rows but `out` (n,).

    Rows far off the regression, as those of other faults, have little weight. `resolution` bounds the noise, `ridge`
    the prior's weight, as a share of the rows.
    """
    x = x - x.mean(axis=0)
    scale = x.std(axis=0)
    x = np.column_stack([np.ones(len(x)), x[:, scale > 1e-12] / scale[scale > 1e-12]])
    known, target = x[~out], y[~out]
    noise, weights, core = robust_sigma(target - np.median(target), resolution), np.ones(len(target)), np.empty(0)
    for _ in range(_FITS):  # the prior needs the noise, the noise the coefficients
        size = max(float(np.mean(np.clip(y, -_TAILS * noise, _TAILS * noise) ** 2)), noise**2)
        prior = max(noise**2 / size * x.shape[1], ridge * len(known)) * np.eye(x.shape[1])
        core = np.linalg.inv((known.T * weights) @ known + prior)
        leverage = weights * np.einsum("ij,jk,ik->i", known, core, known)
        coefficients = core @ (known.T @ (weights * target))
        residual = (target - known @ coefficients) / np.sqrt(np.maximum(1.0 - leverage, 0.05))
        noise = robust_sigma(residual, resolution)
        weights = np.minimum(1.0, SIGMAS * noise / np.maximum(np.abs(residual), 1e-12))
    return Prediction(x @ coefficients, noise, x, core)


class Expected:
    """The regression of one channel's steps in a run."""

    def __init__(self, batch: Batch, name: str) -> None:
        values = signals(batch).values(name)
        self._steps = np.diff(values, prepend=np.nan)
        self._known = np.isfinite(self._steps)
        self._x = np.column_stack([*_surroundings(batch, name), *driven(batch)])
        self._resolution = batch.channels[name].resolution

    def contradicts(self, row: int, least: float) -> bool:
        """Whether the step into a row is no effect of the machine.

        What the regression leaves of it must exceed `least`, its own noise by far, and the larger part of the step,
        which resampling can share out over two rows.
        """
        other = max((row - 1, row + 1), key=lambda r: self._along(row, r))
        rows = [row, other] if self._along(row, other) > 0 else [row]
        out = np.isin(np.arange(len(self._steps)), rows)[self._known]
        if not out.any() or out.all():
            return False
        steps = self._steps[self._known]
        fit = predicted(self._x[self._known], steps, out, self._resolution)
        step = float(steps[out].sum())
        spread = np.hypot(fit.noise * np.sqrt(out.sum()), fit.deviation(fit.x[out].sum(axis=0)))
        return abs(step - float(fit.values[out].sum())) > max(least, SIGMAS * spread, _UNEXPLAINED * abs(step))

    def _along(self, row: int, other: int) -> float:
        """Size of the step into another row, negative where it is against that into the row."""
        if not 0 <= other < len(self._steps):
            return 0.0
        return float(np.nan_to_num(np.sign(self._steps[row]) * self._steps[other]))


def unexplained(
    batches: Sequence[Batch], name: str, suspected: Sequence[int], offsets: Sequence[tuple[float, float]] = ()
) -> Array:
    """Change of a channel over each suspected run, less what the other runs predict of it row by row, (suspected,).

    The regression of the other runs has the levels of all temperatures before each row and the drivers; `offsets`
    at start and end, and the line between them, are taken off the channel first. A part that starts warm cools as it
    should; what is off, or dead, does not.
    """
    others = sorted(set(range(len(batches))) - set(suspected), key=lambda k: min(abs(k - s) for s in suspected))[:_RUNS]
    shift = dict(zip(suspected, offsets, strict=False))
    names = [n for n in batches[0].names(*THERMAL) if n != name and all(n in b.table.columns for b in batches)]
    x, steps, at = [], [], []
    for k in (*suspected, *sorted(others)):
        seen = signals(batches[k])
        own = seen.values(name) - np.linspace(*shift.get(k, (0.0, 0.0)), batches[k].n_rows)
        step = np.diff(own, prepend=np.nan)
        levels = [_before(_held(v), 1) for v in (own, *(seen.values(n) for n in names))]
        x.append(np.column_stack([*levels, *driven(batches[k], every=True)])[np.isfinite(step)])
        steps.append(step[np.isfinite(step)])
        at.append(np.full(len(steps[-1]), k))
    y, run = np.concatenate(steps), np.concatenate(at)
    fit = predicted(np.vstack(x), y, np.isin(run, suspected), batches[0].channels[name].resolution)
    return np.array([float((y - fit.values)[run == k].sum()) for k in suspected])


def movement(
    batch: Batch, name: str, first: int, last: int, without: Collection[str | None] = ()
) -> tuple[float, float]:
    """Range over rows first..last that the temperatures predict of a channel by all other rows, and its noise.

    Both 0 where they cannot: no temperature that is known and moves, or fewer other rows than suspected ones.
    """
    seen = signals(batch)
    inputs = [seen.values(n) for n in batch.names(*THERMAL) if n != name and n not in without]
    inputs = [v for v in inputs if np.isfinite(v).all() and np.ptp(v) > 0]
    values, rows = seen.values(name), np.arange(batch.n_rows)
    suspected = (rows >= first) & (rows <= last)
    known = np.isfinite(values) | suspected
    out = suspected[known]
    if not inputs or (~out).sum() < max(30, last - first):
        return 0.0, 0.0
    y = np.nan_to_num(values[known] - np.nanmedian(values[~suspected]))
    fit = predicted(np.column_stack(inputs)[known], y, out, batch.channels[name].resolution, _LEVELS_RIDGE)
    return float(np.ptp(fit.values[out])), float(np.std((y - fit.values)[~out]))


def _surroundings(batch: Batch, name: str) -> list[Array]:
    """Levels of this and the other channels in the row before, and what the temperatures' steps have in common."""
    seen = signals(batch)
    thermal = [n for n in in_time(batch, *THERMAL) if n != name]
    columns = [_before(_held(seen.values(name)), 1)]
    if not thermal:
        return columns
    levels = np.column_stack([_held(seen.values(n)) for n in thermal])
    columns += [_before(level, 1) for level in _components(levels).T]
    if len(thermal) > 2:
        steps = np.diff(levels, axis=0, prepend=levels[:1])
        scale = np.maximum(1.4826 * np.median(np.abs(steps), axis=0), steps.std(axis=0)) + 1e-9
        step = np.median(steps / scale, axis=1)
        columns += [_before(step, k) for k in (-1, 0, 1)]  # resampling can move a step by a row
    return columns


def driven(batch: Batch, every: bool = False) -> list[Array]:
    """Drivers, their squares and where they are unknown, now and over the rows before, each (n,).

    Of what does not vary, or only repeats another, there is no column; with `every` there is, as runs must match.
    """
    columns = []
    for driver in batch.names("driver"):
        v = batch.values(driver) if driver in batch.table.columns else np.full(batch.n_rows, np.nan)
        u = _held(v)
        levels = (u, 1.0 * np.isnan(v), u**2) if every or len(np.unique(u)) > 2 else (u, 1.0 * np.isnan(v))
        columns += [_mean_before(level, *lag) for level in levels if every or np.ptp(level) > 0 for lag in LAGS]
    return columns


def _components(levels: Array) -> Array:
    """Principal components of channels' levels (n, p), standardized: (n, at most _LEVELS)."""
    centred = levels - levels.mean(axis=0)
    scale = centred.std(axis=0)
    u, s, _ = np.linalg.svd(centred[:, scale > 1e-12] / scale[scale > 1e-12], full_matrices=False)
    return np.asarray(u[:, : min(_LEVELS, len(s))])


def _held(values: Array) -> Array:
    """Holes take the last value before them, or the first one after; 0 where there is none at all."""
    ok = np.flatnonzero(np.isfinite(values))
    if not len(ok):
        return np.zeros(len(values))
    return values[ok[np.maximum(np.searchsorted(ok, np.arange(len(values)), side="right") - 1, 0)]]


def _before(values: Array, rows: int) -> Array:
    """The value so many rows before; the first one before the start."""
    return values[np.clip(np.arange(len(values)) - rows, 0, len(values) - 1)]


def _mean_before(values: Array, first: int, last: int) -> Array:
    return np.asarray(np.mean([_before(values, k) for k in range(first, last + 1)], axis=0))
