"""When: the regimes, hours and minutes over which a mismatch is averaged, from the recordings' own channels."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data.batch import Batch

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MOST_LEVELS = 4  # of a driver: more distinct values are put into as many bands
SINCE_MIN = (0, 30, 60, 120, 240, 360, 480, 720, 1440, 100_000)
CLOCK_H = (0, 6, 10, 14, 18, 22, 24)
LEAST_SHARE = 0.005  # of all rows: rarer regimes are left out


@dataclass(frozen=True)
class Regime:
    """Rows of B batches that belong together; `by` is batch, regime, hour or since_start, `mask` B arrays (n_b,)."""

    by: str
    label: str
    mask: tuple[Mask, ...]


def regimes_of(batches: Sequence[Batch]) -> list[Regime]:
    """Every batch; drivers' levels, on, off and cooling down; thirds of the ambient; hours; time since the start.

    A driver without a unit that has two values is on or off; others have their values, or bands of them, and "cooling
    down" is such a driver at 0 after it ran in that batch.
    """
    out = [Regime("batch", b.batch_id, tuple(np.full(o.n_rows, o is b) for o in batches)) for b in batches]
    for name in _names(batches, "driver"):
        out += _driver(name, [held_driver(b, name) for b in batches], batches[0].channels[name].unit == "1")
    for name in _names(batches, "ambient"):
        out += _ambient(name, [b.masked(name) for b in batches])
    out += _hours(batches)
    minutes = [b.time_s / 60.0 for b in batches]
    for low, high in itertools.pairwise(SINCE_MIN):
        out.append(Regime("since_start", _span(low, high), _all(minutes, _between(low, high))))
    rows = sum(b.n_rows for b in batches)
    return [r for r in out if sum(int(m.sum()) for m in r.mask) > (0 if r.by == "batch" else LEAST_SHARE * rows)]


def _names(batches: Sequence[Batch], role: str) -> list[str]:
    """Channels of a role that every batch has with some value."""
    return [
        n for n in batches[0].names(role)
        if all(n in b.table.columns and np.isfinite(b.masked(n)).any() for b in batches)
    ]  # fmt: skip


def held_driver(batch: Batch, name: str) -> Array:
    """A driver in the interval that begins at each row, gaps held."""
    values = batch.masked(name)
    known = np.flatnonzero(np.isfinite(values))
    return np.asarray(values[known[np.maximum(np.searchsorted(known, np.arange(len(values)), "right") - 1, 0)]])


def _all(series: Sequence[Array], test: Callable[[Array], Mask]) -> tuple[Mask, ...]:
    return tuple(np.asarray(test(s)) for s in series)


def _between(low: float, high: float) -> Callable[[Array], Mask]:
    return lambda v: (v >= low) & (v < high)


def _driver(name: str, series: Sequence[Array], switch: bool) -> Iterator[Regime]:
    levels = np.unique(np.concatenate(series))
    if len(levels) < 2:
        return
    on = [s != 0 for s in series]
    running = levels[levels != 0]
    if len(running) == 1 and switch:
        yield Regime("regime", f"{name} off", tuple(~o for o in on))
        yield Regime("regime", f"{name} on", tuple(on))
        return
    after = [~o & (np.cumsum(o) > 0) for o in on]
    if 0.0 in levels:
        yield Regime("regime", f"{name} = 0 before it ran", tuple(~o & ~a for o, a in zip(on, after, strict=True)))
    if len(running) <= MOST_LEVELS:
        for v in running:
            yield Regime("regime", f"{name} = {v:g}", _all(series, _between(v, np.nextafter(v, np.inf))))
    else:
        edges = np.quantile(np.concatenate(series)[np.concatenate(on)], np.linspace(0, 1, MOST_LEVELS))
        for low, high in itertools.pairwise(edges):
            last = high == edges[-1]
            test = _between(low, np.nextafter(high, np.inf) if last else high)
            mask = tuple(m & o for m, o in zip(_all(series, test), on, strict=True))
            yield Regime("regime", f"{name} {low:.4g}–{high:.4g}", mask)
    if any(a.any() for a in after):
        yield Regime("regime", f"cooling down after {name}", tuple(after))


def _ambient(name: str, series: Sequence[Array]) -> Iterator[Regime]:
    every = np.concatenate(series)
    low, high = np.nanquantile(every, [1 / 3, 2 / 3])
    if high - low < 0.2:
        return
    yield Regime("regime", f"{name} below {low:.1f} degC", _all(series, lambda s: s < low))
    yield Regime("regime", f"{name} {low:.1f}–{high:.1f} degC", _all(series, lambda s: (s >= low) & (s <= high)))
    yield Regime("regime", f"{name} above {high:.1f} degC", _all(series, lambda s: s > high))


def _hours(batches: Sequence[Batch]) -> Iterator[Regime]:
    """Times of day, of batches whose start is known."""
    clock = []
    for b in batches:
        start = np.nan if b.start is None else (b.start - b.start.normalize()).total_seconds() / 3600.0
        clock.append((start + b.time_s / 3600.0) % 24.0)
    for low, high in itertools.pairwise(CLOCK_H):
        yield Regime("hour", f"{low:02d}–{high:02d} h", _all(clock, _between(low, high)))


def _span(low_min: int, high_min: int) -> str:
    if high_min == SINCE_MIN[-1]:
        return f"after {low_min // 60} h"
    if high_min <= 60:
        return f"{low_min}–{high_min} min"
    return f"{low_min // 60}–{high_min // 60} h"
