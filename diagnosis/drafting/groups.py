"""Temperatures that move together: which sensors one body can represent, and its temperature."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial.distance import squareform

from data.arrays import Array
from data.batch import Batch
from data.errors import InputError
from data.machine import Machine
from diagnosis.policy import POLICY
from twin.simulation.inputs import MAX_GAP_S

DIFFERENCE_ORDERS, NORMAL_MEDIAN = (1, 2, 3, 4), 0.6745


@dataclass(frozen=True)
class Rows:
    """Thinned batches and what of the machine can be used in them; `blocks`: cut from fewer than four batches.

    `rooms` are ambient channels with values; `tops` the drivers that ever move, with their largest size; `noise` is
    the sd (K or the channel's unit) of every temperature and error. `remarks` say what was left out and why.
    """

    batches: tuple[Batch, ...]
    blocks: bool
    temperatures: tuple[str, ...]
    errors: tuple[str, ...]
    rooms: tuple[str, ...]
    tops: Mapping[str, float]
    noise: Mapping[str, float]
    remarks: tuple[str, ...]


def rows_of(machine: Machine, batches: Sequence[Batch]) -> Rows:
    """At most twelve batches, evenly over those given, at some 48 rows each.

    Raises:
        InputError: no batch, no temperature with values, nothing that moves, or no batch with its drivers.
    """
    where = f"machine {machine.machine}: no network can be drafted"
    if not batches:
        raise InputError(f"{where}: got no batch; give one or more recordings")
    batches = sorted(batches, key=lambda b: b.batch_id)  # folds must not depend on the order of files
    remarks: list[str] = []
    share = POLICY.draft_min_channel_share
    used = {
        role: _usable(machine, batches, role, at_least, remarks)
        for role, at_least in (("temperature", 0.0), ("error", 0.0), ("ambient", share), ("driver", share))
    }
    if not used["temperature"]:
        raise InputError(f"{where}: no temperature channel has a value; record one, or give it role: temperature")
    tops = {n: float(max(np.nanmax(np.abs(_values(b, n)), initial=0.0) for b in batches)) for n in used["driver"]}
    remarks += [f"driver {n} is never other than 0: left out" for n, top in tops.items() if top == 0]
    tops = {n: top for n, top in tops.items() if top > 0}
    if not tops and not any(_moves(batches, n) for n in used["ambient"]):
        raise InputError(
            f"{where}: no driver is ever other than 0 and no ambient moves by {POLICY.ambient_min_range_K:g} K: "
            "nothing warms it; record what the machine did (speed, feed) or the room, and give it role: driver or "
            "ambient"
        )
    whole = [b for b in batches if _whole(b, [*tops, *used["ambient"][:1]], remarks)]
    if not whole:
        raise InputError(
            f"{where}: in every batch a driver or the ambient has no value for more than {MAX_GAP_S:g} s; "
            "correct the recordings, or overrule the masks"
        )
    at = np.unique(np.linspace(0, len(whole) - 1, min(POLICY.draft_max_batches, len(whole))).round().astype(int))
    parts, blocks = _parts([whole[k] for k in at.tolist()], remarks)
    step_s = min(POLICY.draft_max_step_s, float(np.median([b.time_s[-1] for b in parts])) / POLICY.draft_rows_per_batch)
    thin = tuple(_thinned(b, step_s) for b in parts)
    recorded = {r: tuple(n for n in used[r] if any(_numbers(b, n) for b in thin)) for r in ("temperature", "error")}
    if not recorded["temperature"]:
        raise InputError(f"{where}: no temperature has a value in the batches that can be simulated; mask fewer")
    noise = {n: _noise(machine, batches, n, tops) for n in (*recorded["temperature"], *recorded["error"])}
    return Rows(thin, blocks, recorded["temperature"], recorded["error"], used["ambient"], tops, noise, tuple(remarks))


def _values(batch: Batch, channel: str) -> Array:
    return batch.masked(channel) if channel in batch.table.columns else np.full(batch.n_rows, np.nan)


def _usable(machine: Machine, batches: Sequence[Batch], role: str, share: float, remarks: list[str]) -> tuple[str, ...]:
    """Channels of a role with values in more than a share of the batches."""
    out = []
    for name, channel in machine.channels.items():
        if channel.role == role:
            count = sum(_numbers(b, name) > 0 for b in batches)
            if count and count >= share * len(batches):
                out.append(name)
            else:
                remarks.append(f"{role} {name} has values in {count} of {len(batches)} batches: left out")
    return tuple(out)


def _numbers(batch: Batch, channel: str) -> int:
    return int(np.isfinite(_values(batch, channel)).sum())


def _moves(batches: Sequence[Batch], channel: str) -> bool:
    values = np.concatenate([_values(b, channel) for b in batches])
    low, high = np.nanquantile(values, [POLICY.ambient_range_tail, 1.0 - POLICY.ambient_range_tail])
    return bool(high - low > POLICY.ambient_min_range_K)


def _whole(batch: Batch, needed: Sequence[str], remarks: list[str]) -> bool:
    """Can the batch be simulated: rows enough, and no long hole in what drives it?"""
    if batch.n_rows < POLICY.draft_min_rows:
        remarks.append(f"batch {batch.batch_id} has {batch.n_rows} rows: left out of the draft")
        return False
    for name in needed:
        good = np.flatnonzero(np.isfinite(_values(batch, name)))
        edges = np.concatenate([[0], good, [batch.n_rows - 1]])
        if not len(good) or np.diff(edges).max() * batch.step_s > MAX_GAP_S + batch.step_s:
            remarks.append(f"batch {batch.batch_id} has holes in {name}: left out of the draft")
            return False
    return True


def _parts(batches: Sequence[Batch], remarks: list[str]) -> tuple[list[Batch], bool]:
    """The batches, or blocks of them where they are fewer than four."""
    if len(batches) >= POLICY.draft_min_parts:
        return list(batches), False
    each = -(-POLICY.draft_min_parts // len(batches))
    if min(b.n_rows for b in batches) // each < POLICY.draft_min_rows:
        remarks.append("the recordings are too short to leave any out: one body alone is drafted")
        return list(batches), False
    few = f"{len(batches)} batch{'es' if len(batches) > 1 else ''}"
    remarks.append(f"{few} alone: cut into {each} blocks each, and blocks were left out instead of batches")
    return [block for b in batches for block in _cut(b, each)], True


def _cut(batch: Batch, each: int) -> list[Batch]:
    out = []
    for k, at in enumerate(np.array_split(np.arange(batch.n_rows), each)):
        table = batch.table.assign(**{n: _values(batch, n) for n in batch.channels}).iloc[at].reset_index(drop=True)
        begun_s = float(table["time_s"].iloc[0])
        start = None if batch.start is None else batch.start + pd.Timedelta(seconds=begun_s)
        table["time_s"] -= begun_s
        out.append(replace(batch, batch_id=f"{batch.batch_id}.{k + 1}", table=table, start=start, findings=()))
    return out


def _thinned(batch: Batch, step_s: float) -> Batch:
    """Every k-th row: drivers and ambients as means, holes filled; readings as they are, or the next one's."""
    k = max(1, round(step_s / batch.step_s))
    at = np.arange(0, batch.n_rows, k)
    table: dict[str, Array] = {"time_s": batch.time_s[at]}
    for name, channel in batch.channels.items():
        series = pd.Series(_values(batch, name))
        if channel.role == "driver":
            held = series.ffill().bfill()[::-1]
            series = held.rolling(k, min_periods=1).mean()[::-1]
        elif channel.role == "ambient":
            filled = series.interpolate(limit_direction="both")
            series = filled.rolling(k, min_periods=1, center=True).mean()
        elif k > 1:
            series = series.bfill(limit=k // 2)
        table[name] = np.asarray(series, np.float64)[at]
    return replace(batch, table=pd.DataFrame(table), findings=())


def _noise(machine: Machine, batches: Sequence[Batch], name: str, drivers: Mapping[str, float]) -> float:
    """Sd of a channel: its resolution's rounding error, or where none is stated from differences while at rest.

    Differences of the order with the least residual: smooth warming cancels, noise does not. What is shown in steps has
    at least a step's rounding error.
    """
    channel = machine.channels[name]
    if channel.resolution is not None:
        return channel.resolution / math.sqrt(12.0)
    every: dict[int, list[Array]] = {order: [] for order in DIFFERENCE_ORDERS}
    steps: list[Array] = []
    largest = 0.0
    for b in batches:
        values, still = _values(b, name), np.ones(b.n_rows, bool)
        for d in drivers:
            still &= _values(b, d) == 0
        if still.sum() < 2 * POLICY.draft_min_rows:
            still[:] = True
        for order, found in every.items():
            difference = np.abs(np.diff(values, order)[still[order:]])
            found.append(difference[np.isfinite(difference)])
        steps.append(np.abs(np.diff(values[np.isfinite(values)])))
        largest = max(largest, float(np.ptp(values[np.isfinite(values)])) if np.isfinite(values).any() else 0.0)
    spread = min(
        float(np.median(np.concatenate(found))) / (NORMAL_MEDIAN * math.sqrt(math.comb(2 * order, order)))
        if sum(map(len, found))
        else 0.0
        for order, found in every.items()
    )
    step = np.concatenate(steps)
    step = step[step > 1e-9 * largest]
    least = dict(POLICY.draft_min_noise).get(channel.unit, POLICY.draft_min_noise_share * largest)
    return float(max(least, spread, step.min() / math.sqrt(12.0) if len(step) else 0.0)) or 1.0


@dataclass(frozen=True)
class Rises:
    """Temperatures of S sensors over the rows of all parts, one below the other: `degC` (n, S), holes filled.

    `part` (n,) numbers the parts; `rise_K` is counted from each part's first reading. NaN: a sensor without a value
    in that part. `offset_K` (S,) is by how much a sensor starts above the mean of all, the same in every part.
    """

    names: tuple[str, ...]
    part: NDArray[np.int64]
    time_s: Array
    degC: Array
    noise_K: Array

    @classmethod
    def of(cls, rows: Rows) -> Rises:
        columns = [np.column_stack([_filled(b.values(n)) for n in rows.temperatures]) for b in rows.batches]
        return cls(
            rows.temperatures,
            np.repeat(np.arange(len(columns)), [len(c) for c in columns]),
            np.concatenate([b.time_s for b in rows.batches]),
            np.concatenate(columns),
            np.array([rows.noise[n] for n in rows.temperatures]),
        )

    @cached_property
    def parts(self) -> list[NDArray[np.int64]]:
        """Numbers (n_b,) of the rows of every part."""
        return [np.flatnonzero(self.part == b) for b in range(int(self.part[-1]) + 1)]

    @cached_property
    def first_degC(self) -> Array:
        """First readings (B, S)."""
        return np.array([self.degC[at[0]] for at in self.parts])

    @cached_property
    def rise_K(self) -> Array:
        """(n, S)."""
        return self.degC - self.first_degC[self.part]

    @cached_property
    def size_K(self) -> Array:
        """Rms of each sensor's rise, (S,)."""
        return np.sqrt(np.nanmean(self.rise_K**2, axis=0))

    @cached_property
    def distance(self) -> Array:
        """How far two sensors are from reading one body, (S, S): rms difference of their rises over their size."""
        small = POLICY.draft_small_rise_share * float(np.median(self.size_K))
        scale = np.sqrt(np.outer(self.size_K, self.size_K) + small**2 + np.outer(self.noise_K, self.noise_K))
        distance = np.sqrt(_mean((self.rise_K[:, :, None] - self.rise_K[:, None, :]) ** 2)) / scale
        never_together = 2.0 * float(np.nanmax(distance, initial=1.0))
        return np.where(np.isfinite(distance), distance, never_together)

    def clusters(self, count: int) -> list[list[int]]:
        """At most `count` groups of sensors, each a part of one group of the next smaller count; by sensors' order."""
        if len(self.names) == 1:
            return [[0]]
        tree = linkage(squareform(self.distance, checks=False), "average")
        label = fcluster(tree, count, "maxclust")
        groups = [np.flatnonzero(label == k).tolist() for k in np.unique(label)]
        return sorted(groups)

    def centre(self, group: Sequence[int]) -> int:
        """The sensor that is nearest to all others of its group and gives the body its name."""
        return int(group[int(np.argmin(self.distance[np.ix_(group, group)].sum(axis=1)))])

    def offsets_K(self, group: Sequence[int]) -> Array:
        """By how much each sensor of a group starts above the group's mean, median over parts; 0 of too few."""
        first = self.first_degC[:, group]
        difference = first - _mean(first, axis=1)[:, None]
        if len(first) < POLICY.draft_min_offset_batches:
            return np.zeros(len(group))
        return np.nan_to_num(_median(difference))

    def body_degC(self, group: Sequence[int]) -> Array:
        """The group's mean temperature (n,), sensors without a value left out; NaN where none has one."""
        return _mean(self.degC[:, group] - self.offsets_K(group), axis=1)


def tree_of(distance: Array) -> list[tuple[int, int]]:
    """The pairs of a minimum spanning tree over K groups at distances (K, K)."""
    tree = minimum_spanning_tree(distance + 1e-9 * (1 - np.eye(len(distance)))).tocoo()
    return sorted((int(min(i, j)), int(max(i, j))) for i, j in zip(tree.row, tree.col, strict=True))


def between(distance: Array, groups: Sequence[Sequence[int]]) -> Array:
    """Mean distance of the sensors of two groups, (K, K), 0 on the diagonal."""
    out = np.array([[distance[np.ix_(a, b)].mean() for b in groups] for a in groups])
    np.fill_diagonal(out, 0.0)
    return out


def _filled(values: Array) -> Array:
    """Holes interpolated, ends held; all NaN stays."""
    good = np.isfinite(values)
    return np.interp(np.arange(len(values)), np.flatnonzero(good), values[good]) if good.any() else values


def _mean(values: Array, axis: int = 0) -> Array:
    """Mean of what is finite, NaN where nothing is, without a warning."""
    good = np.isfinite(values)
    count = good.sum(axis=axis)
    total = np.where(good, values, 0.0).sum(axis=axis)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def _median(values: Array) -> Array:
    """Median along the first axis of what is finite; NaN where nothing is."""
    return np.array([np.median(v[np.isfinite(v)]) if np.isfinite(v).any() else np.nan for v in values.T])
