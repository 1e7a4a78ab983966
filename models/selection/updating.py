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
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import pandas as pd

from data.arrays import Array, Index, Mask
from data.errors import InputError
from features.design import Design
from models.families import FAMILIES
from models.metrics import SIDE_OF_90, residual_std_um
from models.numerics.kernels import unit_scale
from models.selection.crossing import Crossing

_HOUR_S = 3600.0
_PER_RUN = 60  # known rows of a training run that are learned from
_READINGS = 24  # of a training run that are learned from, at most
_LEAST_RUNS = 2
_LATEST = 4  # training runs that the bands hold as well as all: a machine's spread may have grown
_LEAST_UM = 1e-6  # residuals of rounding alone
_SHARPNESS = 4.0  # a candidate that doubles the S of one training run weighs exp(−4) of the best
_FITS_ITERATIVE = 4  # of an iterative family inside a training set
_PARTS = ("drift", "gain", "walk", "offset", "noise")
_LEVELS = (0.01, 0.1, 1, 10)
# Variances that are tried, in those of an hour's walk; the gain's times the mean square of the inputs. With the last a
# reading changes nothing: it wins where residuals do not last.
_TRIED = np.array([*((d, g, 1, 3, n) for d in (1e-4, 0.01, 0.1, 1, 100) for g in _LEVELS for n in _LEVELS),
                   (1e-4, 0.01, 1, 3, 1e6)])  # fmt: skip


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


Schedule = Readings | int  # a number: so many readings evenly over a run
SCHEDULES: Mapping[str, Readings] = {
    "one reading an hour": Readings(_HOUR_S, _HOUR_S),
    "one a shift": Readings(_HOUR_S),
}
COUNTS = (0, 1, 2, 4, 8)  # readings a run of the curve
_LEARNED_ON: tuple[Schedule, ...] = (Readings(), 2, Readings(every_s=_HOUR_S))


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

    def rows(self, schedule: Schedule) -> Index:
        """Rows read."""
        readings = schedule if isinstance(schedule, Readings) else Readings.evenly(schedule, float(self.time_s[-1]))
        return readings.rows(self.time_s, np.isfinite(self.residual_um))


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
    walk (per h), of the offset at the start and of the noise of a reading.
    """

    n_inputs: int
    variance_um2: Mapping[str, float]

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
            got = f"got {len(sampled)} run(s) with known residuals, need at least {_LEAST_RUNS}"
            raise InputError(f"updating by readings: {got}; give more batches")
        moved = float(np.mean(np.concatenate([(_regressors(t)[rows, 1:-1] ** 2).sum(axis=1) for t, rows in sampled])))
        tried = _TRIED / np.array([1.0, moved or 1.0, 1.0, 1.0, 1.0])
        S_um = np.array([[_tried_S_um(t, rows, s, tried) for s in _LEARNED_ON] for t, rows in sampled])
        lost = np.sum(S_um / np.maximum(S_um.mean(axis=0).min(axis=-1, keepdims=True), _LEAST_UM), axis=0).mean(axis=0)
        weight = np.exp(-_SHARPNESS * (lost - lost.min()))
        found = np.exp(weight @ np.log(tried) / weight.sum())
        return cls(tracks[0].inputs.shape[1], dict(zip(_PARTS, found.tolist(), strict=True)))._scaled(sampled)

    def _scaled(self, sampled: Sequence[tuple[Track, Index]]) -> Self:
        """With variances whose bands hold nine in ten of the rows of all runs, and of the latest ones."""
        ratios = []
        for track, judged in sampled:
            done = [self.run(track, track.rows(schedule), self.begin()) for schedule in _LEARNED_ON]
            ratios.append(np.hstack([(np.abs(track.recorded_um - d.corrected_um) / d.sd_um)[judged] for d in done]))
        needed = max(float(np.quantile(np.hstack(some), 0.9)) for some in (ratios, ratios[-_LATEST:]))
        scale = max(needed, _LEAST_UM) / SIDE_OF_90
        return type(self)(self.n_inputs, {part: v * scale**2 for part, v in self.variance_um2.items()})

    @property
    def noise_um2(self) -> float:
        """Variance of the noise of a reading."""
        return self.variance_um2["noise"]

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
        """A run, or the next rows of one after those of `state`, with readings of the error at given rows (rising)."""
        h = _regressors(track)
        predicted, residual_um = np.flatnonzero(np.isfinite(track.predicted_um)), track.residual_um
        if not state.started:
            h[: predicted[0] + 1 if len(predicted) else None] = 0.0
        corrected, sd = track.predicted_um.copy(), np.full(len(h), np.nan)
        mean, cov, now_s, at = state.mean, state.cov.copy(), state.time_s, 0
        for row in [*rows[np.isfinite(residual_um[rows])].tolist(), len(h)]:
            part = slice(at, row + 1)
            walked = self.variance_um2["walk"] * (track.time_s[part] - now_s) / _HOUR_S
            corrected[part] += h[part] @ mean
            own = np.einsum("ij,jk,ik->i", h[part], cov, h[part]) + h[part, -1] * walked
            sd[part] = np.sqrt(np.maximum(own, 0.0) + self.variance_um2["noise"])
            if len(walked):
                cov[-1, -1] += walked[-1]
                now_s = float(track.time_s[part][-1])
            if row < len(h):
                gain = cov @ h[row] / (h[row] @ cov @ h[row] + self.variance_um2["noise"])
                mean = mean + gain * (residual_um[row] - h[row] @ mean)
                cov = cov - np.outer(gain, h[row] @ cov)
            at = row + 1
        sd[~np.isfinite(corrected)] = np.nan
        return Updated(corrected, sd, State(mean, cov, now_s, state.started or bool(len(predicted))))

    def as_plain(self) -> dict[str, Any]:
        """Numbers."""
        return {"n_inputs": self.n_inputs, "variance_um2": dict(self.variance_um2)}

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Self:
        """The inverse of `as_plain`."""
        return cls(int(plain["n_inputs"]), {part: float(plain["variance_um2"][part]) for part in _PARTS})


def _regressors(track: Track) -> Array:
    """What drift, gains and offset multiply, (n, p + 2): hours, inputs (0 where missing), 1."""
    inputs = np.nan_to_num(track.inputs, nan=0.0)
    return np.column_stack([track.time_s / _HOUR_S, inputs, np.ones(len(inputs))])


def _tried_S_um(track: Track, judged: Index, schedule: Schedule, tried: Array) -> Array:
    """S (C,) over the judged rows of a run with readings, by C candidates' variances (C, 5)."""
    rows = track.rows(schedule)[:_READINGS]
    h, residual_um = _regressors(track), track.residual_um

    def covariance(one: Array, other: Array) -> Array:
        walk = np.minimum.outer(one[:, 0], other[:, 0])
        parts = np.outer(one[:, 0], other[:, 0]), one[:, 1:-1] @ other[:, 1:-1].T, walk, np.ones_like(walk)
        return np.tensordot(tried[:, :-1], np.array(parts), 1)

    ahead, among = covariance(h[judged], h[rows]), covariance(h[rows], h[rows])
    among += tried[:, -1, None, None] * np.eye(len(rows))
    missed_um = np.repeat(residual_um[None, judged], len(tried), axis=0)
    last = np.searchsorted(rows, judged)  # readings before each judged row
    for n in range(1, len(rows) + 1):
        weights = np.linalg.solve(among[:, :n, :n], residual_um[rows[:n], None])
        missed_um[:, last == n] -= (ahead[:, last == n, :n] @ weights)[:, :, 0]
    return np.asarray(residual_std_um(missed_um.T))


def _sampled(track: Track) -> Index:
    """At most so many known rows of a run, evenly, the last one among them and the first row, which is 0, not."""
    known = np.flatnonzero(np.isfinite(track.residual_um))[1:]
    return known[np.unique(np.linspace(0, len(known) - 1, _PER_RUN + 1).astype(int)[1:])] if len(known) else known


COLUMNS = ["cell", "protocol", "schedule", "fold", "batch_id", "n_readings", "S_um", "held_S_um", "free_S_um",
           "coverage90"]  # fmt: skip
_LED_BY = ("forward", "leave-batch-out")
EVERY: Mapping[str, Schedule] = {**SCHEDULES, **{f"{n} evenly": n for n in COUNTS}}


def updated_scores(
    crossing: Crossing,
    selector: str,
    family: str,
    n_tsp: int,
    curves: pd.DataFrame,
    schedules: Mapping[str, Schedule] = EVERY,
) -> pd.DataFrame:
    """One row per schedule and forward run of a cell, with the columns `COLUMNS`.

    cell: "selector|family|n_tsp"; n_readings: of the batch; S_um: with readings, over all rows, a row that was read
    included with what was predicted before; held_S_um: the same where the residual of the last reading is held;
    free_S_um: of the free-running prediction; coverage90: share of rows within 1.645 of the stated standard deviations.
    The updater of a block is learned from the predictions of the blocks before it, so that the first one has none.

    Args:
        curves: the cell's left-out predictions, see `GridResult.curves`.
    """
    own = curves[curves["protocol"] == "forward"] if len(curves) else curves
    predicted = {str(k): g["predicted_um"].to_numpy(float) for k, g in own.groupby("batch_id")} if len(own) else {}
    rows: list[tuple[object, ...]] = []
    earlier: list[int] = []
    cell = f"{selector}|{family}|{n_tsp}"
    for fold in crossing.folds.get("forward", []) if predicted else []:
        design = crossing.subset(crossing.inputs(selector, fold.train, n_tsp))
        tracks = {k: Track.of(design, k, predicted[design.batch_ids[k]]) for k in (*earlier, *fold.test)}
        with suppress(InputError):
            updater = Updater.learn([tracks[k] for k in earlier])
            for name, schedule in schedules.items():
                for k in fold.test:
                    where = cell, "forward", name, fold.name, design.batch_ids[k]
                    rows.append((*where, *scores(updater, tracks[k], schedule)))
        earlier += fold.test
    return pd.DataFrame(rows, columns=COLUMNS)


def left_out_tracks(design: Design, curves: pd.DataFrame) -> list[Track]:
    """The runs of a design with their left-out predictions: forward where there are such, else leave-batch-out."""
    run = [p for p in _LED_BY if len(curves) and (curves["protocol"] == p).any()]
    own = curves[curves["protocol"] == run[0]] if run else curves.iloc[:0]
    predicted = {str(k): g["predicted_um"].to_numpy(float) for k, g in own.groupby("batch_id")} if run else {}
    known = ((k, predicted.get(batch_id)) for k, batch_id in enumerate(design.batch_ids))
    sizes = [design.rows(k).stop - design.rows(k).start for k in range(design.n_batches)]
    return [Track.of(design, k, p) for k, p in known if p is not None and len(p) == sizes[k]]


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
    pairs = zip((k for _, later in inner for k in later), (p for some in found for p in some), strict=True)
    return [Track.of(design, k, p) for k, p in pairs]


def scores(updater: Updater, track: Track, schedule: Schedule) -> tuple[int, float, float, float, float]:
    """Number of readings, S with them, with the last one held and without, and coverage of one run."""
    known = np.isfinite(track.residual_um)
    free_S_um = float(residual_std_um(track.residual_um))
    if schedule == 0 or not known.any():
        return 0, free_S_um, free_S_um, free_S_um, float("nan")
    done = updater.run(track, rows := track.rows(schedule), updater.begin())
    missed_um = track.recorded_um - done.corrected_um
    inside = np.abs(missed_um[known]) <= SIDE_OF_90 * done.sd_um[known]
    held_S_um = float(residual_std_um(track.residual_um - held_um(track, rows)))
    return len(rows), float(residual_std_um(missed_um)), held_S_um, free_S_um, float(inside.mean())


def held_um(track: Track, rows: Index) -> Array:
    """The residual (n,) of the last reading before each row, 0 before the first."""
    last = np.searchsorted(rows, np.arange(len(track.time_s)))
    return np.asarray(np.concatenate([[0.0], track.residual_um[rows]])[last])
