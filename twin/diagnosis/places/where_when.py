"""Where and when: which body's heat, which error's displacement or which sensor's reading a calibration cannot explain.

A free smooth series at each place stands for whatever is missing there, with all nuisances integrated out; places and
kinds compete by marginal likelihood (MacKay 1992). What is found is held while the next place is sought, so that a
second effect does not borrow the first one's, and noise is judged by what all of them leave.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from data.batch import Batch
from data.errors import InputError
from twin.calibration.fit_noise import Noise
from twin.calibration.fit_problem import Array
from twin.calibration.problem import CalibrationProblem
from twin.diagnosis.diagnosis import COLUMNS
from twin.diagnosis.places.forced import KNOT_S, Hats
from twin.diagnosis.places.free_series import Kind, Posterior
from twin.diagnosis.places.place_search import Held, PlaceSearch
from twin.diagnosis.places.point import Point
from twin.diagnosis.places.regimes import Regime, regimes_of

RANKING = ("rank", "kind", "place", "gain", "evidence", "probability", "sigma", "unit")
MOVES = 3  # at most: beyond it places and series hardly change


@dataclass(frozen=True)
class Found:
    """A place that explains what the others leave; `odds` are of nothing and of each kind with the others held.

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
    `twin.diagnosis.diagnosis`: every place beside what was found at others.
    """

    point: Point
    held: tuple[Held, ...]
    found: tuple[Found, ...]
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
        """The free series at a place beside what was found at others; columns of `twin.diagnosis.diagnosis`."""
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
    knot_s: float = KNOT_S,
    most: int = 3,
    progress: Callable[[str, int, int], None] | None = None,
) -> Located:
    """Where and when a calibrated network and its recordings differ, at a fit's x (p,) and nuisances.

    `batches` are the problem's, in its order; `most` places are sought one after the other. The noise is the machine
    file's own where the places found explain all else, and larger where they do not.

    Raises:
        InputError: batches that are not the problem's.
        WorkError: the simulation fails at the fit.
    """
    say = progress or (lambda what, done, of: None)
    _check(problem, batches)
    hats = Hats.over(float(_ends_s(problem).max()), knot_s)
    point = Point.of(problem, x, nuisance, hats, Noise.as_given(len(problem.channels)))
    held = point.search.forward(most)
    for number in range(MOVES):
        say("locate", number, MOVES)
        point = point.moved(held)
        held = point.search.forward(most)
        if point.settled:
            break
    found = tuple(_found(point.search, held, k) for k in range(len(held)))
    table = _map(point.search, held, regimes_of(batches), [b.time_s for b in batches])
    say("locate", MOVES, MOVES)
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


def _found(search: PlaceSearch, held: Sequence[Held], k: int) -> Found:
    others, own = [h for h in held if h is not held[k]], held[k]
    basis, series = search.bases[own.basis], search.series(others)[own.basis]
    sigma, gain = float(series.best.sigma[own.place]), float(series.best.gain[own.place])
    return Found(
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
