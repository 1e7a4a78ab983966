"""Correction of a free-running prediction by rare readings of a touch probe: a Kalman filter along every run.

The residual of a run, recorded less predicted, is

    r(t) = a(t) + d t + Σ g_j x_j(t) + n,    da ~ N(0, q dt),

with an offset a that walks at random, a slow drift d per hour and gains g_j of the family's inputs (of its prediction,
where it has none), which are constant in a run and zero on average. Their variances, q and the noise n of a reading are
what served training runs that were predicted out of fold; no reading and the last residual held are limits of them. A
row uses the readings of its run before it. Along a feed axis the residual is taken as common to all positions.

Readings that correct a thermal model in process: Blaser et al. (2017), J. Manuf. Syst. 44, 302; filter: Kalman (1960).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import pandas as pd

from data.arrays import Array, Index, Mask
from data.errors import InputError
from features.design import Design
from models import FAMILIES
from models.crossing import Crossing
from models.metrics import SIDE_OF_90, residual_std_um
from models.solvers.kernels import unit_scale

_HOUR_S = 3600.0
_PER_RUN = 60  # known rows of a training run that are learned from
_READINGS = 24  # of a training run that are learned from, at most
_LEAST_RUNS = 2
_LEAST_UM = 1e-6  # residuals of rounding alone
_SHARPNESS = 4.0  # a candidate that doubles the S of one training run weighs exp(−4) of the best
_FITS_ITERATIVE = 4  # of an iterative family inside a training set
_PARTS = ("drift", "gain", "walk", "offset", "noise")
# Variances that are tried, in those of an hour's walk; the gain's times the mean square of the inputs.
_TRIED = np.array([(d, g, 1.0, 3.0, n) for d in (0.01, 0.1, 1) for g in (0.01, 0.1, 1, 10) for n in (0.01, 0.1, 1, 10)])


@dataclass(frozen=True)
class Readings:
    """When a probe reads the error of a run: after `first_s`, then every `every_s` (infinite: once)."""

    first_s: float = _HOUR_S
    every_s: float = np.inf

    def __post_init__(self) -> None:
        if not (self.first_s > 0 and self.every_s > 0):
            raise InputError(
                f"readings: got first_s={self.first_s!r}, every_s={self.every_s!r}, expected seconds above 0, e.g. 3600"
            )

    @classmethod
    def evenly(cls, count: int, duration_s: float) -> Self:
        """`count` readings that cut a run of that duration into equal parts."""
        part_s = duration_s / (count + 1)
        return cls(part_s, part_s)

    def rows(self, time_s: Array, known: Mask) -> Index:
        """Rows read, rising: the first known one at or after every due time and before the next, but not the last row.

        Args:
            time_s: times from the run's start (n,). known: rows (n,) at which an error was recorded.
        """
        candidates = np.flatnonzero(known[:-1])
        end_s = float(time_s[-1]) * (1.0 - 1e-9) if len(time_s) else 0.0
        due_s = np.arange(self.first_s, end_s, self.every_s) if self.every_s < np.inf else np.array([self.first_s])
        at = np.searchsorted(time_s[candidates], due_s - 1e-6)
        found = candidates[at[at < len(candidates)]]
        return np.unique(found[time_s[found] < due_s[: len(found)] + self.every_s])


SCHEDULES: Mapping[str, Readings] = {
    "one reading an hour": Readings(_HOUR_S, _HOUR_S),
    "one a shift": Readings(_HOUR_S),
}
COUNTS = (0, 1, 2, 4, 8)  # readings a run of the curve


@dataclass(frozen=True)
class Track:
    """One run: time_s, predicted_um, recorded_um (n,), NaN where not known, and the inputs (n, p) in scale of their
    units; of a family without inputs the prediction (n, 1)."""

    time_s: Array
    predicted_um: Array
    recorded_um: Array
    inputs: Array

    @classmethod
    def of(cls, design: Design, k: int, predicted_um: Array) -> Self:
        """Batch k of a design, with what was predicted for it (n,)."""
        rows = design.rows(k)
        inputs = design.x[rows] / unit_scale(design) if design.inputs else predicted_um[:, None]
        return cls(design.time_s[rows], predicted_um, design.y_um[rows], inputs)

    @property
    def residual_um(self) -> Array:
        return np.asarray(self.recorded_um - self.predicted_um)


def _learned_on(track: Track) -> tuple[Readings, ...]:
    return (SCHEDULES["one a shift"], Readings.evenly(2, float(track.time_s[-1])), SCHEDULES["one reading an hour"])


@dataclass(frozen=True)
class State:
    """Drift, gains and offset (p + 2,) with their covariance after the rows up to `time_s`; `started` after the
    first predicted row, where error and prediction are 0 by definition."""

    mean: Array
    cov: Array
    time_s: float = 0.0
    started: bool = False


@dataclass(frozen=True)
class Updated:
    """Corrected prediction and predictive standard deviation of a recorded value, µm, (n,), and the state behind."""

    corrected_um: Array
    sd_um: Array
    state: State


@dataclass(frozen=True)
class Updater:
    """The filter of one family, error channel and set of inputs.

    n_inputs: p. variance_um2: by part, of the drift (per h²), of the gain of each input (per its squared unit), of the
    walk (per h), of the offset at the start and of the noise of a reading. before: factor of the standard deviation
    until the first reading.
    """

    n_inputs: int
    variance_um2: Mapping[str, float]
    before: float = 1.0

    @classmethod
    def learn(cls, tracks: Sequence[Track]) -> Self:
        """From training runs that were each predicted by a model that did not know it.

        Each candidate of `_TRIED` corrects the training runs with one, two and hourly readings. The variances are the
        geometric mean of the candidates, weighted by exponentials of their S: few runs leave it near the residual held,
        many lead it to what serves them. A likelihood trusts drift and gains too much where runs differ in spread.

        Raises:
            InputError: fewer than 2 runs with 2 known residuals after their first row.
        """
        sampled = [(track, rows) for track in tracks if len(rows := _sampled(track)) > 1]
        if len(sampled) < _LEAST_RUNS:
            raise InputError(
                f"updating by readings: got {len(sampled)} run(s) with known residuals, need at least {_LEAST_RUNS}; "
                "give more batches"
            )
        moved = float(np.mean([np.mean(np.sum(_regressors(t)[rows, 1:-1] ** 2, axis=1)) for t, rows in sampled]))
        tried = _TRIED / np.array([1.0, moved or 1.0, 1.0, 1.0, 1.0])
        S_um = np.array([[_tried_S_um(t, rows, r, tried) for r in _learned_on(t)] for t, rows in sampled])
        lost = np.sum(S_um / np.maximum(S_um.mean(axis=0).min(axis=-1, keepdims=True), _LEAST_UM), axis=0).mean(axis=0)
        weight = np.exp(-_SHARPNESS * (lost - lost.min()))
        found = np.exp(weight @ np.log(tried) / weight.sum())
        return cls(tracks[0].inputs.shape[1], dict(zip(_PARTS, found.tolist(), strict=True)))._scaled(sampled)

    def _scaled(self, sampled: Sequence[tuple[Track, Index]]) -> Self:
        """With standard deviations before and after a first reading that hold nine in ten of the training's rows."""
        ratios: dict[bool, list[Array]] = {False: [], True: []}
        for track, judged in sampled:
            for readings in _learned_on(track):
                rows = readings.rows(track.time_s, np.isfinite(track.residual_um))
                done = self.run(track, rows, self.begin())
                ratio = np.abs(track.recorded_um - done.corrected_um)[judged] / done.sd_um[judged]
                for after, some in ratios.items():
                    some.append(ratio[(np.searchsorted(rows, judged) > 0) == after])
        pooled = [np.concatenate(some) for some in ratios.values()]
        before, after = (max(float(np.quantile(r, 0.9)) / SIDE_OF_90, _LEAST_UM) if len(r) else 1.0 for r in pooled)
        return replace(
            self, before=before / after, variance_um2={k: v * after**2 for k, v in self.variance_um2.items()}
        )

    def begin(self) -> State:
        """State before the first row of a run."""
        v = self.variance_um2
        variance = [v["drift"], *[v["gain"]] * self.n_inputs, v["offset"]]
        return State(np.zeros(len(variance)), np.diag(variance))

    def step(
        self, state: State, time_s: float, predicted_um: float, inputs: Array, read_um: float = np.nan
    ) -> tuple[float, float, State]:
        """Corrected prediction and standard deviation of a recorded value at one row, µm, and the state after it.

        `inputs` (p,) in scale of their units; `read_um` is what a probe reads at this row, for the rows after it.
        """
        track = Track(np.array([time_s]), np.array([predicted_um]), np.array([read_um]), np.asarray(inputs)[None])
        done = self.run(track, np.array([0] if np.isfinite(read_um) else [], np.int64), state)
        return float(done.corrected_um[0]), float(done.sd_um[0]), done.state

    def run(self, track: Track, rows: Index, state: State) -> Updated:
        """A run, or the next rows of one, with readings of the recorded error at the given rows (rising).

        `state` is that of `begin`, or after the rows before.
        """
        h = _regressors(track)
        predicted, residual_um = np.flatnonzero(np.isfinite(track.predicted_um)), track.residual_um
        if not state.started:
            h[: predicted[0] + 1 if len(predicted) else None] = 0.0
        corrected, sd = track.predicted_um.copy(), np.full(len(h), np.nan)
        before = 1.0 if state.mean.any() else self.before
        mean, cov, now_s, at = state.mean, state.cov.copy(), state.time_s, 0
        for row in [*rows[np.isfinite(residual_um[rows])].tolist(), len(h)]:
            part = slice(at, row + 1)
            walked = self.variance_um2["walk"] * (track.time_s[part] - now_s) / _HOUR_S
            corrected[part] += h[part] @ mean
            own = np.einsum("ij,jk,ik->i", h[part], cov, h[part]) + h[part, -1] * walked
            sd[part] = np.sqrt(np.maximum(own, 0.0) + self.variance_um2["noise"]) * before
            if len(walked):
                cov[-1, -1] += walked[-1]
                now_s = float(track.time_s[part][-1])
            if row < len(h):
                gain = cov @ h[row] / (h[row] @ cov @ h[row] + self.variance_um2["noise"])
                mean = mean + gain * (residual_um[row] - h[row] @ mean)
                cov = cov - np.outer(gain, h[row] @ cov)
                before = 1.0
            at = row + 1
        sd[~np.isfinite(corrected)] = np.nan
        return Updated(corrected, sd, State(mean, cov, now_s, state.started or bool(len(predicted))))

    def as_plain(self) -> dict[str, Any]:
        """Numbers."""
        return {"n_inputs": self.n_inputs, "variance_um2": dict(self.variance_um2), "before": self.before}

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Self:
        """The inverse of `as_plain`."""
        variance_um2 = {part: float(plain["variance_um2"][part]) for part in _PARTS}
        return cls(int(plain["n_inputs"]), variance_um2, float(plain.get("before", 1.0)))


def _regressors(track: Track) -> Array:
    """What drift, gains and offset multiply, (n, p + 2): hours, inputs (0 where missing), 1."""
    inputs = np.nan_to_num(track.inputs, nan=0.0)
    return np.column_stack([track.time_s / _HOUR_S, inputs, np.ones(len(inputs))])


def _parts(one: Array, other: Array) -> Array:
    """Covariance (4, n, m) of drift, gains, walk and offset between rows with these regressors, variances of 1."""
    walk = np.minimum.outer(one[:, 0], other[:, 0])
    return np.array([np.outer(one[:, 0], other[:, 0]), one[:, 1:-1] @ other[:, 1:-1].T, walk, np.ones_like(walk)])


def _tried_S_um(track: Track, judged: Index, readings: Readings, tried: Array) -> Array:
    """S (C,) over the judged rows of a run with readings, by C candidates' variances (C, 5)."""
    rows = readings.rows(track.time_s, np.isfinite(track.residual_um))[:_READINGS]
    h, residual_um = _regressors(track), track.residual_um
    missed_um = np.repeat(residual_um[None, judged], len(tried), axis=0)
    ahead = np.tensordot(tried[:, :-1], _parts(h[judged], h[rows]), 1)
    among = np.tensordot(tried[:, :-1], _parts(h[rows], h[rows]), 1) + tried[:, -1, None, None] * np.eye(len(rows))
    last = np.searchsorted(rows, judged)  # readings before each judged row
    for n in range(1, len(rows) + 1):
        weights = np.linalg.solve(among[:, :n, :n], residual_um[rows[:n], None])
        missed_um[:, last == n] -= (ahead[:, last == n, :n] @ weights)[:, :, 0]
    return np.asarray(residual_std_um(missed_um.T))


def _sampled(track: Track) -> Index:
    """At most so many known rows of a run, evenly, the last one among them and the first row, which is 0, not."""
    known = np.flatnonzero(np.isfinite(track.residual_um))[1:]
    return known[np.unique(np.linspace(0, len(known) - 1, _PER_RUN + 1).astype(int)[1:])] if len(known) else known


COLUMNS = [
    "cell", "protocol", "schedule", "fold", "batch_id", "n_readings", "S_um", "held_S_um", "free_S_um", "coverage90",
]  # fmt: skip
FORWARD = ("forward", "forward-gap")
EVERY: Mapping[str, Readings | int] = {**SCHEDULES, **{f"{n} evenly": n for n in COUNTS}}


def updated_scores(
    crossing: Crossing,
    selector: str,
    family: str,
    n_tsp: int,
    schedules: Mapping[str, Readings | int] = EVERY,
    protocols: Sequence[str] = FORWARD,
) -> pd.DataFrame:
    """One row per protocol forward in time, schedule, fold and judged batch of a cell, with the columns `COLUMNS`.

    cell: "selector|family|n_tsp"; n_readings: of the batch; S_um: with readings, over all rows, a row that was read
    included with what was predicted before; held_S_um: the same where the residual of the last reading is held, the
    plain way; free_S_um: of the free-running prediction; coverage90: share of rows within
    1.645 of the stated standard deviations. A schedule of a number is so many readings evenly over each run. The
    updater is learned from the fold's training batches. Folds that cannot be fitted are left out.
    """
    rows, cell = [], f"{selector}|{family}|{n_tsp}"
    for protocol in protocols:
        for fold in crossing.folds.get(protocol, []):
            design = crossing.subset(crossing.inputs(selector, fold.train, n_tsp))
            try:
                updater = Updater.learn(out_of_fold(design, family, fold.train))
                tracks = predicted(design, family, fold.train, fold.test)
            except InputError:
                continue
            for name, schedule in schedules.items():
                for k, track in zip(fold.test, tracks, strict=True):
                    rows.append(
                        (cell, protocol, name, fold.name, design.batch_ids[k], *scores(updater, track, schedule))
                    )
    return pd.DataFrame(rows, columns=COLUMNS)


def learn_updater(crossing: Crossing, selector: str, family: str, n_tsp: int) -> Updater:
    """The updater of a cell from all batches, for runs to come.

    Raises:
        InputError: too few batches, or their order in time is not known.
    """
    folds = next((crossing.folds[p] for p in FORWARD if crossing.folds.get(p)), [])
    if not folds:
        raise InputError(
            f"updating by readings of {crossing.design.target}: no protocol forward in time among the folds; give "
            "batches with start times, at least 6"
        )
    order = (*folds[-1].train, *folds[-1].test)
    design = crossing.subset(crossing.inputs(selector, crossing.everything, n_tsp))
    return Updater.learn(out_of_fold(design, family, order))


def out_of_fold(design: Design, family: str, train: Sequence[int]) -> list[Track]:
    """Training batches, in order of time, each predicted by a model of those before it (the first half is not).

    Iterative families are fitted four times, others for every batch; of fewer than 4 batches each is left out in turn.

    Raises:
        InputError: a model cannot be fitted.
    """
    half = len(train) // 2
    step = 1 if FAMILIES[family].closed_form else max(1, -(-(len(train) - half) // _FITS_ITERATIVE))
    inner = [(tuple(train[:at]), tuple(train[at : at + step])) for at in range(half, len(train), step)]
    if half < _LEAST_RUNS:
        inner = [(tuple(j for j in train if j != k), (k,)) for k in train]
    fitted = FAMILIES[family]().fit_folds(design, [past for past, _ in inner])
    found = fitted[0].predict_folds(design, fitted, [later for _, later in inner])
    pairs = [(k, p) for (_, later), ps in zip(inner, found, strict=True) for k, p in zip(later, ps, strict=True)]
    return [Track.of(design, k, p) for k, p in pairs]


def predicted(design: Design, family: str, train: Sequence[int], test: Sequence[int]) -> list[Track]:
    """Batches `test` predicted by a model of the batches `train`. Raises: InputError, the model cannot be fitted."""
    fitted = FAMILIES[family]().fit_design(design, train)
    return [Track.of(design, k, p) for k, p in zip(test, fitted.predict_design(design, test), strict=True)]


def scores(updater: Updater, track: Track, schedule: Readings | int) -> tuple[int, float, float, float, float]:
    """Number of readings, S with them, with the last one held and without, and coverage of one run."""
    known = np.isfinite(track.residual_um)
    free_S_um = float(residual_std_um(track.residual_um))
    if schedule == 0 or not known.any():
        return 0, free_S_um, free_S_um, free_S_um, float("nan")
    if not isinstance(schedule, Readings):
        schedule = Readings.evenly(schedule, float(track.time_s[-1]))
    rows = schedule.rows(track.time_s, known)
    done = updater.run(track, rows, updater.begin())
    missed_um = track.recorded_um - done.corrected_um
    inside = np.abs(missed_um[known]) <= SIDE_OF_90 * done.sd_um[known]
    held_S_um = float(residual_std_um(track.residual_um - held_um(track, rows)))
    return len(rows), float(residual_std_um(missed_um)), held_S_um, free_S_um, float(inside.mean())


def held_um(track: Track, rows: Index) -> Array:
    """The residual (n,) of the last reading before each row, 0 before the first."""
    last = np.searchsorted(rows, np.arange(len(track.time_s)))
    return np.asarray(np.concatenate([[0.0], track.residual_um[rows]])[last])
