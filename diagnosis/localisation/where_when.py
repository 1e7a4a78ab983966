"""Where and when: which body's heat, which error's displacement or which sensor's reading a calibration cannot explain.

A free smooth series at each place represents whatever is missing there, with all nuisances integrated out; places and
kinds compete by marginal likelihood (MacKay 1992). What is found is held while the next place is sought, so that a
second effect does not borrow the first one's, and noise is judged by what all of them leave.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from data.arrays import Array, Mask
from data.batch import Batch
from data.errors import InputError
from diagnosis.contracts import COLUMNS
from diagnosis.localisation.free_series import Held, Kind, PlaceSearch, Point, Posterior
from diagnosis.localisation.linearised import Hats
from diagnosis.policy import POLICY
from twin.calibration.fit_problem import Noise
from twin.calibration.problem import CalibrationProblem

MAX_DRIVER_LEVELS = 4  # of a driver: more distinct values are put into as many bands
SINCE_START_EDGES_MIN = (0, 30, 60, 120, 240, 360, 480, 720, 1440, 100_000)
CLOCK_EDGES_H = (0, 6, 10, 14, 18, 22, 24)


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
    for low, high in itertools.pairwise(SINCE_START_EDGES_MIN):
        out.append(Regime("since_start", _span(low, high), _all(minutes, _between(low, high))))
    rows = sum(b.n_rows for b in batches)
    return [
        r
        for r in out
        if sum(int(m.sum()) for m in r.mask) > (0 if r.by == "batch" else POLICY.regime_min_row_share * rows)
    ]


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
    if len(running) <= MAX_DRIVER_LEVELS:
        for v in running:
            yield Regime("regime", f"{name} = {v:g}", _all(series, _between(v, np.nextafter(v, np.inf))))
    else:
        edges = np.quantile(np.concatenate(series)[np.concatenate(on)], np.linspace(0, 1, MAX_DRIVER_LEVELS))
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
    for low, high in itertools.pairwise(CLOCK_EDGES_H):
        yield Regime("hour", f"{low:02d}–{high:02d} h", _all(clock, _between(low, high)))


def _span(low_min: int, high_min: int) -> str:
    if high_min == SINCE_START_EDGES_MIN[-1]:
        return f"after {low_min // 60} h"
    if high_min <= 60:
        return f"{low_min}–{high_min} min"
    return f"{low_min // 60}–{high_min // 60} h"


RANKING = ("rank", "kind", "place", "gain", "evidence", "probability", "sigma", "unit")


@dataclass(frozen=True)
class FoundPlace:
    """A place that explains the residual of the others; `odds` are of nothing and of each kind with the others held.

    `gain` in nats over leaving it out, `sigma` its amplitude in `unit`; `series` holds mean and sd (B, K) at the hats.
    """

    kind: Kind
    place: str
    unit: str
    gain: float
    sigma: float
    odds: Mapping[str, float]
    series: Posterior


@dataclass(frozen=True)
class Located:
    """What is missing where and when.

    `ranking` (columns `RANKING`) has every place alone, the likeliest first: `gain` over nothing in nats at its best
    sigma, `evidence` with sigma averaged over; `probability` sums to 1 with that of nothing. `map` is the table of
    `diagnosis.result`: every place given what was found at others.
    """

    point: Point
    held: tuple[Held, ...]
    found: tuple[FoundPlace, ...]
    ranking: pd.DataFrame
    map: pd.DataFrame

    @property
    def kind(self) -> str:
        """heat, displacement, sensor or nothing: what the first place found is."""
        return self.found[0].kind if self.found else "nothing"

    @property
    def odds(self) -> Mapping[str, float]:
        """Probabilities of nothing and of each kind, every place alone."""
        return _odds(self.point.search, ())

    def over_time(self, kind: str, place: str) -> pd.DataFrame:
        """The free series at a place given what was found at others; columns of `diagnosis.result`."""
        i = next(n for n, basis in enumerate(self.point.search.bases) if basis.kind == kind)
        basis = self.point.search.bases[i]
        k = basis.places.index(place)
        others = [h for h in self.held if h.at != (i, k)]
        series = self.point.search.series(others)[i].posterior(k)
        rows = []
        for b, end_s in enumerate(_ends_s(self.point.problem)):
            for h in np.flatnonzero(self.point.hats.knot_s < end_s + self.point.hats.step_s / 2):
                time_s = float(min(self.point.hats.knot_s[h], end_s))
                value, sd = float(series.mean[b, h]), float(series.sd[b, h])
                rows.append((kind, place, self.point.problem.measured[b].batch_id, time_s, value, sd, basis.units[k]))
        return pd.DataFrame(rows, columns=list(COLUMNS["flux"]))


def locate(
    problem: CalibrationProblem,
    x: Array,
    nuisance: Sequence[Array],
    batches: Sequence[Batch],
    *,
    most: int = POLICY.located_places,
    progress: Callable[[str, int, int], None] | None = None,
) -> Located:
    """Where and when a calibrated network and its recordings differ, at a fit's x (p,) and nuisances.

    `batches` are the problem's, in its order; at most `most` places are located, one after the other. The noise is the
    machine file's own where the places found explain all else, and larger where they do not.

    Raises:
        InputError: batches that are not the problem's.
        WorkError: the simulation fails at the fit.
    """
    report = progress or (lambda what, done, of: None)
    _check(problem, batches)
    hats = Hats.over(float(_ends_s(problem).max()))
    point = Point.of(problem, x, nuisance, hats, Noise.as_given(len(problem.channels)))
    held = point.search.forward(most)
    for number in range(POLICY.linearisations):
        report("locate", number, POLICY.linearisations)
        point = point.moved(held)
        held = point.search.forward(most)
        if point.converged:
            break
    found = tuple(_found(point.search, held, k) for k in range(len(held)))
    table = _map(point.search, held, regimes_of(batches), [b.time_s for b in batches])
    report("locate", POLICY.linearisations, POLICY.linearisations)
    return Located(point, tuple(held), found, _ranking(point.search), table)


def _check(problem: CalibrationProblem, batches: Sequence[Batch]) -> None:
    given, needed = [b.batch_id for b in batches], [m.batch_id for m in problem.measured]
    if given != needed:
        raise InputError(
            f"locate: got the batches {', '.join(given) or 'none'}, expected those of the calibration in its order: "
            f"{', '.join(needed)}"
        )


def _ends_s(problem: CalibrationProblem) -> Array:
    """Every batch's length, s (B,)."""
    return np.asarray(problem.inputs.time_s[np.arange(problem.inputs.n_batches), problem.inputs.n_intervals])


def _odds(search: PlaceSearch, held: Sequence[Held]) -> dict[str, float]:
    each = {b.kind: float(p.sum()) for b, p in zip(search.bases, search.probabilities(held), strict=True)}
    return {"nothing": max(0.0, 1.0 - sum(each.values()))} | each


def _found(search: PlaceSearch, held: Sequence[Held], k: int) -> FoundPlace:
    others, own = [h for h in held if h is not held[k]], held[k]
    basis, series = search.bases[own.basis], search.series(others)[own.basis]
    sigma, gain = float(series.best.sigma[own.place]), float(series.best.gain[own.place])
    return FoundPlace(
        basis.kind, basis.places[own.place], basis.units[own.place], gain, sigma, _odds(search, others),
        series.posterior(own.place),
    )  # fmt: skip


def _ranking(search: PlaceSearch) -> pd.DataFrame:
    rows = []
    for series, probability in zip(search.series(), search.probabilities(), strict=True):
        basis = series.basis
        for k, place in enumerate(basis.places):
            sigma, gain, evidence = (float(v[k]) for v in (series.best.sigma, series.best.gain, series.best.evidence))
            rows.append((basis.kind, place, gain, evidence, float(probability[k]), sigma, basis.units[k]))
    rows.sort(key=lambda r: -r[3])
    return pd.DataFrame([(n + 1, *r) for n, r in enumerate(rows)], columns=list(RANKING))


def _map(search: PlaceSearch, held: Sequence[Held], regimes: Sequence[Regime], time_s: Sequence[Array]) -> pd.DataFrame:
    rows = []
    weights = _weights(search.bases[0].hats, regimes, time_s)
    for i, basis in enumerate(search.bases):
        for k, place in enumerate(basis.places):
            others = [h for h in held if h.at != (i, k)]
            mean, sd = search.series(others)[i].posterior(k).averages(weights)
            for regime, value, spread in zip(regimes, mean, sd, strict=True):
                z = float(value / spread) if spread > 0 else 0.0
                rows.append((basis.kind, place, regime.by, regime.label, float(value), basis.units[k], z))
    return pd.DataFrame(rows, columns=list(COLUMNS["map"]))


def _weights(hats: Hats, regimes: Sequence[Regime], time_s: Sequence[Array]) -> Array:
    """What every hat counts in a regime's average, (A, B, K)."""
    shape = [hats.at(t) for t in time_s]
    sums = np.array([[m @ s for m, s in zip(r.mask, shape, strict=True)] for r in regimes])
    return np.asarray(sums / sums.sum(axis=(1, 2), keepdims=True))
