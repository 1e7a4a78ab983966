"""Time grid of a simulation: regimes, pieces and steps, prepared once for many runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from data.arrays import Array
from data.errors import InputError
from twin.mechanisms.base import View
from twin.network import Law, Network
from twin.simulation.inputs import Inputs, parameters_of, reads_time

Ints = NDArray[np.intp]

_COMMON = 64  # a step that fills less than one 64th of all intervals is not worth a block of its own
_RUN = 4  # nor one that changes more often than every 4 intervals


@dataclass(frozen=True)
class Block:
    """Pieces of one regime, longest first. Rows lie position by position: all first rows, all second ones, …

    `source` (rows,) numbers the interval of a row (or the group of `n_held` intervals), batch after batch.
    `step_of_row` (rows,) numbers the step of each row where steps differ, else it is None and `step` holds for all.
    """

    regime: int
    n_held: int
    step: int
    step_of_row: Ints | None
    rows: slice
    pieces: slice
    source: Ints
    spans: tuple[tuple[int, int], ...]  # first row (within the block) and number of pieces of each position


@dataclass(frozen=True)
class Chain:
    """How pieces follow one another in their batches.

    `by_rank` (ranks, B) is each batch's piece of a rank, `n_pieces` where it has no more; `slot` (pieces,) where a
    piece is in it, flattened. `changes[k]` are the batches that enter a new regime before rank k, with the number
    of the (old, new) pair in `pairs` (…, 2); `first_regime` (B,) is the one they start in.
    """

    by_rank: Ints
    slot: Ints
    first_regime: Ints
    changes: tuple[tuple[Ints, Ints] | None, ...]
    pairs: Ints


@dataclass(frozen=True)
class Pieces:
    """How B batches of M intervals are cut when every `every`-th border is kept.

    `span` (pieces,) numbers each piece's regime and duration in `span_regime` and `span_s`. `border` (B, M // every
    + 1) is the row that ends at a kept border, `n_rows + b` at the start of batch b; behind the end the last one.
    """

    every: int
    blocks: tuple[Block, ...]
    n_rows: int
    n_pieces: int
    chain: Chain
    span: Ints
    span_regime: Ints
    span_s: Array
    border: Ints


def cut(step: Ints, step_s: Array, regime: Ints, n_rows: Ints, every: int) -> Pieces:
    """Cut batches into pieces: `step` (B, M) numbers each interval's length in `step_s`, `regime` (B, M) its regime."""
    n_batches, n_intervals = step.shape
    n_kept = n_intervals // every
    n_used = n_rows // every * every  # what follows the last kept border is not needed
    valid = np.arange(n_kept * every) < n_used[:, None]
    kind = (regime * len(step_s) + step)[:, : n_kept * every]
    common = _common(kind, valid)

    first, held, kind = _rows(kind, valid, common, every)
    batch = first // max(n_kept * every, 1)
    row_regime, row_step = kind // len(step_s), kind % len(step_s)
    lone = ~common[kind]
    key = np.where(lone, -1 - row_regime, kind * (every + 1) + held)

    # pieces in time order by their first rows; `order` puts blocks together, the longest pieces of each first
    head, length = _split(batch, key, longest=int(2.0 * np.sqrt(max(n_kept, 1))))
    order = np.lexsort((-length, key[head]))
    blocks: list[Block] = []
    rows_in_order: list[Ints] = []
    n_rows_before = 0
    for here in _runs(key[head[order]]):
        heads, lengths = head[order[here]], length[order[here]]
        counts = np.searchsorted(-lengths, -np.arange(lengths[0]))  # pieces longer than a position
        rows = np.concatenate([heads[:n] + position for position, n in enumerate(counts)])
        n_held = int(held[rows[0]])
        blocks.append(
            Block(
                regime=int(row_regime[rows[0]]),
                n_held=n_held,
                step=int(row_step[rows[0]]),
                step_of_row=row_step[rows] if lone[rows[0]] else None,
                rows=slice(n_rows_before, n_rows_before + len(rows)),
                pieces=here,
                source=first[rows] // n_held,
                spans=tuple(zip((np.cumsum(counts) - counts).tolist(), counts.tolist(), strict=True)),
            )
        )
        rows_in_order.append(rows)
        n_rows_before += len(rows)

    # the row at each kept border: padding holds the last valid one
    in_order = np.concatenate([*rows_in_order, np.zeros(0, np.intp)])
    row_after = np.zeros(n_batches * n_kept * every + 1, np.intp)
    row_after[(first + held)[in_order]] = np.arange(len(in_order))
    kept = np.minimum(np.arange(n_kept + 1) * every, n_used[:, None])
    border = row_after[np.arange(n_batches)[:, None] * n_kept * every + kept]
    border[kept == 0] = len(in_order) + np.nonzero(kept == 0)[0]

    duration_s = np.add.reduceat(held * step_s[row_step], head) if len(head) else np.zeros(0)
    spans, span = np.unique(np.column_stack([row_regime[head], duration_s])[order], axis=0, return_inverse=True)
    return Pieces(
        every=every,
        blocks=tuple(blocks),
        n_rows=len(in_order),
        n_pieces=len(head),
        chain=_chain(batch[head], row_regime[head], np.argsort(order), n_batches),
        span=span.reshape(-1),
        span_regime=spans[:, 0].astype(np.intp),
        span_s=spans[:, 1],
        border=border,
    )


def _chain(batch: Ints, regime: Ints, place: Ints, n_batches: int) -> Chain:
    """How pieces follow one another: `batch`, `regime` and place in block order (pieces,), in time order."""
    n_of_batch = np.bincount(batch, minlength=n_batches)
    rank = np.arange(len(batch)) - np.repeat(np.cumsum(n_of_batch) - n_of_batch, n_of_batch)
    by_rank = np.full((n_of_batch.max(initial=0), n_batches), len(batch))
    by_rank[rank, batch] = place
    slot = np.empty_like(place)
    slot[place] = rank * n_batches + batch
    first_regime = np.zeros(n_batches, np.intp)
    first_regime[batch[rank == 0]] = regime[rank == 0]
    changed = np.flatnonzero((rank[1:] > 0) & (regime[1:] != regime[:-1])) + 1
    pairs, pair = np.unique(np.column_stack([regime[changed - 1], regime[changed]]), axis=0, return_inverse=True)
    changes: list[tuple[Ints, Ints] | None] = [None] * len(by_rank)
    for k in np.unique(rank[changed]):
        here = rank[changed] == k
        changes[k] = batch[changed[here]], pair.reshape(-1)[here]
    return Chain(by_rank, slot, first_regime, tuple(changes), pairs)


def _common(kind: Ints, valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(kinds,): frequent and lasting enough for a block with one set of weights."""
    total = np.bincount(kind[valid], minlength=int(kind.max(initial=0)) + 1)
    begins = valid.copy()
    begins[:, 1:] &= (kind[:, 1:] != kind[:, :-1]) | ~valid[:, :-1]
    runs = np.bincount(kind[begins], minlength=len(total))
    return (total * _COMMON >= total.sum()) & (runs * _RUN <= total)


def _rows(kind: Ints, valid: NDArray[np.bool_], common: NDArray[np.bool_], every: int) -> tuple[Ints, Ints, Ints]:
    """First interval (batch after batch), number of merged intervals and kind of each row, in time order."""
    held = valid.astype(np.intp)
    if every > 1:
        groups = kind.reshape(len(kind), -1, every)
        whole = valid.reshape(groups.shape).all(axis=-1) & (groups == groups[..., :1]).all(axis=-1)
        whole[whole] = common[groups[whole, 0]]
        held = held.reshape(groups.shape)
        held[whole] = 0
        held[whole, 0] = every
    first = np.flatnonzero(held)
    return first, held.reshape(-1)[first], kind.reshape(-1)[first]


def _split(batch: Ints, key: Ints, longest: int) -> tuple[Ints, Ints]:
    """Cut runs of rows of one batch and key into nearly equal pieces: first row and length (at most `longest`)."""
    runs = np.array([(r.start, r.stop - r.start) for r in _runs(batch, key)], np.intp).reshape(-1, 2)
    n_cuts = -(-runs[:, 1] // longest)
    begin, size, n = (np.repeat(column, n_cuts) for column in (*runs.T, n_cuts))
    part = np.arange(len(begin)) - np.repeat(np.cumsum(n_cuts) - n_cuts, n_cuts)
    head = begin + -(-part * size // n)
    return head, np.diff(np.append(head, len(batch)))


def _runs(*columns: Ints) -> list[slice]:
    """Stretches over which every column stays the same."""
    n = len(columns[0])
    moved = np.zeros(n, bool)
    for column in columns:
        moved[1:] |= column[1:] != column[:-1]
    moved[:1] = True
    begins = np.flatnonzero(moved).tolist()
    return [slice(lo, hi) for lo, hi in zip(begins, [*begins[1:], n], strict=False)]


_SAME_STEP = 1e-11  # of the longest: steps closer than that are one; differences of large times carry rounding


class Schedule:
    """B batches of up to M intervals: `dt_s` (B, M), `regime` (B, M) from 0, valid for the first `n_rows` (B,).

    Values behind a batch's valid intervals are never read. Steps may differ from interval to interval; few
    distinct ones are fast, since each frequent one has weights of its own.

    Raises:
        InputError: shapes that disagree, a step that is not positive and finite, a negative regime.
    """

    def __init__(self, dt_s: Array, regime: ArrayLike, n_rows: ArrayLike | None = None) -> None:
        dt, regimes = np.asarray(dt_s, float), np.asarray(regime)
        if dt.ndim != 2 or regimes.shape != dt.shape:
            raise InputError(
                f"schedule: dt_s has shape {dt.shape} and regime {regimes.shape}, "
                "expected (batches, intervals) for both"
            )
        rows = np.full(len(dt), dt.shape[1]) if n_rows is None else np.asarray(n_rows)
        if rows.shape != (len(dt),) or (rows < 0).any() or (rows > dt.shape[1]).any():
            raise InputError(
                f"schedule: n_rows is {rows.tolist()}, expected one number from 0 to {dt.shape[1]} for each of "
                f"{len(dt)} batches"
            )
        valid = np.arange(dt.shape[1]) < rows[:, None]
        _check_steps(dt, valid)
        _check_regimes(regimes, valid)
        self.n_batches, self.n_intervals = dt.shape
        self.n_rows: Ints = rows.astype(np.intp)
        self.regime: Ints = np.where(valid, regimes, 0).astype(np.intp)
        self.n_regimes = int(self.regime.max(initial=0)) + 1
        self.step_s, step = _distinct_steps(dt[valid])
        self.step: Ints = np.zeros(dt.shape, np.intp)
        self.step[valid] = step
        self._pieces: dict[int, Pieces] = {}

    def pieces(self, every: int = 1) -> Pieces:
        """The pieces that keep every `every`-th border, cut at the first call.

        Raises:
            InputError: `every` is not a whole number from 1 to M.
        """
        if every not in self._pieces:
            if every != int(every) or not 1 <= every <= max(self.n_intervals, 1):
                raise InputError(
                    f"schedule: every is {every}, expected a whole number of intervals from 1 to {self.n_intervals}"
                )
            self._pieces[every] = cut(self.step, self.step_s, self.regime, self.n_rows, int(every))
        return self._pieces[every]

    def drive(self, series: Array) -> Drive:
        """Series (Q or 1, J, B, M, 2) for this schedule; see `Drive`."""
        return Drive(self, series)


class Drive:
    """Series (Q or 1, J, B, M, 2): values at the start and the end of every interval, linear in between.

    Shared series (leading axis 1) are sorted into pieces once and kept: use the same `Drive` for many runs.

    Raises:
        InputError: another shape.
    """

    def __init__(self, schedule: Schedule, series: Array) -> None:
        values = np.ascontiguousarray(series, float)
        expected = (schedule.n_batches, schedule.n_intervals, 2)
        if values.ndim != 5 or values.shape[2:] != expected:
            raise InputError(
                f"forcing: series have shape {values.shape}, expected (sets, series, batches, intervals, 2) = "
                f"(…, …, {', '.join(map(str, expected))})"
            )
        self.schedule, self.series = schedule, values
        self._sorted: dict[int, list[Array]] = {}

    @property
    def n_sets(self) -> int:
        return len(self.series)

    @property
    def n_series(self) -> int:
        return self.series.shape[1]

    def rows(self, every: int, sets: slice) -> list[Array]:
        """One matrix per block of `schedule.pieces(every)`: a row's intervals x sets x series x (start, end), flat."""
        if self.n_sets > 1:
            return self._sort(every, sets)
        if every not in self._sorted:
            self._sorted[every] = self._sort(every, slice(0, 1))
        return self._sorted[every]

    def first_bad(self) -> str | None:
        """Where the first value is that is not finite within the valid intervals, for messages."""
        valid = np.arange(self.schedule.n_intervals) < self.schedule.n_rows[:, None]
        bad = np.argwhere(~np.isfinite(self.series) & valid[:, :, None])
        if not len(bad):
            return None
        q, j, b, m, side = bad[0].tolist()
        value = self.series[q, j, b, m, side]
        return f"set {q}, series {j}, batch {b}, interval {m}: {('start', 'end')[side]} value is {value}"

    def _sort(self, every: int, sets: slice) -> list[Array]:
        pieces = self.schedule.pieces(every)
        n_used = self.schedule.n_intervals // every * every
        # (start, end) travel as one complex number: a transposition of 16-byte items is four times as fast
        chosen = self.series[sets]
        pairs = chosen.reshape(len(chosen) * self.n_series, *chosen.shape[2:]).view(np.complex128)[:, :, :n_used, 0]
        by_time = np.ascontiguousarray(pairs.transpose(1, 2, 0))
        return [
            by_time.reshape(-1, block.n_held * len(pairs)).take(block.source, axis=0, mode="clip").view(float)
            for block in pieces.blocks
        ]


def _distinct_steps(dt_s: Array) -> tuple[Array, Ints]:
    """The distinct steps and the number of each interval's; what differs by rounding alone is one step, their mean."""
    values, number = np.unique(dt_s, return_inverse=True)
    group = np.cumsum(np.diff(values, prepend=-np.inf) > _SAME_STEP * values.max(initial=0.0)) - 1
    return np.bincount(group, weights=values) / np.bincount(group), group[number]


def _check_steps(dt: Array, valid: NDArray[np.bool_]) -> None:
    bad = np.argwhere(valid & ~(np.isfinite(dt) & (dt > 0.0)))
    if len(bad):
        b, m = bad[0].tolist()
        raise InputError(
            f"schedule: batch {b}, interval {m}: dt_s is {dt[b, m]:g} s, expected a positive, finite time; "
            "sort the rows by time and drop repeated ones"
        )


def _check_regimes(regime: NDArray[np.generic], valid: NDArray[np.bool_]) -> None:
    used = np.where(valid, regime, 0)
    bad = np.argwhere((used < 0) | (used != np.floor(used)))
    if len(bad):
        b, m = bad[0].tolist()
        raise InputError(f"schedule: batch {b}, interval {m}: regime is {regime[b, m]}, expected a whole number from 0")


MOST = 64  # distinct driver values; beyond it a driver is a noisy continuous one
_DIGITS = 9  # relative resolution of driver values


@dataclass(frozen=True)
class Regimes:
    """`of` (B, M) numbers each interval's regime; `factor` (P, R, n_factors) are the factor laws' values there.

    Factors whose drivers take too many values, or that follow the clock, are `varying`: one constant replaces them
    (half way between their extremes) and the rest of them is heat that depends on temperature.
    """

    of: NDArray[np.int64]
    factor: Array
    varying: tuple[int, ...]

    @property
    def count(self) -> int:
        return self.factor.shape[1]


def regimes_of(network: Network, values: Array, inputs: Inputs) -> Regimes:
    """The regimes of B batches at parameter values (P, n)."""
    fixed: list[int] = []
    number, first = distinct(inputs, ())
    for k, law in enumerate(network.factors):
        if law.disabled or reads_time(law, "factor"):
            continue
        channels = [c for j in (*fixed, k) for c in network.factors[j].drivers.values()]
        finer, at = distinct(inputs, channels)
        if len(at) <= MOST:
            fixed, number, first = [*fixed, k], finer, at
    varying = tuple(k for k, law in enumerate(network.factors) if k not in fixed and not law.disabled)
    factor = np.ones((len(values), len(first), len(network.factors)))
    for k in fixed:
        factor[..., k] = at_tuples(network.factors[k], "factor", values, inputs, first)
    for k in varying:
        seen = factor_series(network.factors[k], values, inputs)
        valid = inputs.valid
        low = np.where(valid, seen, np.inf).min(axis=(1, 2))
        high = np.where(valid, seen, -np.inf).max(axis=(1, 2))
        factor[..., k] = ((low + high) / 2)[:, None]
    return Regimes(number, factor, varying)


def distinct(
    inputs: Inputs, channels: Sequence[str], also: NDArray[np.int64] | None = None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Distinct tuples of driver values: each interval's number (B, M), and each tuple's first interval, flattened.

    `also` (B, M) are regimes that distinguish tuples. Only valid intervals count; padding gets number 0.
    """
    names = tuple(dict.fromkeys(channels))
    key = ("distinct", names, id(also))
    if key not in inputs.kept:
        series = [inputs.drivers[n] for n in names] + ([] if also is None else [also.astype(float)])
        inputs.kept[key] = (*_distinct(inputs.valid, series), also)  # keeping `also` keeps its id its own
    number, first, _ = inputs.kept[key]
    return number, first


def _distinct(valid: NDArray[np.bool_], given: Sequence[Array]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    at = np.flatnonzero(valid)
    series = [v.ravel()[at] for v in given]
    changes = np.zeros(len(at), bool)
    changes[:1] = True
    for values in series:
        changes[1:] |= values[1:] != values[:-1]
    first = np.flatnonzero(changes)  # drivers hold for long: sorting what changes is enough
    tuples = np.zeros((len(first), len(series)))
    for k, values in enumerate(series):
        tuples[:, k] = np.round(values[first] / (np.abs(values).max(initial=0.0) or 1.0), _DIGITS)
    _, where, of_run = np.unique(tuples, axis=0, return_index=True, return_inverse=True)
    number = np.zeros(valid.size, np.int64)
    number[at] = np.repeat(of_run.ravel(), np.diff(np.append(first, len(at))))
    return number.reshape(valid.shape), at[first[where]]


def at_tuples(law: Law, effect: str, values: Array, inputs: Inputs, first: NDArray[np.int64]) -> Array:
    """A law's value (P, U) in the intervals numbered `first` (U,), of all batches' flattened."""
    view = View(driver={role: inputs.drivers[c].ravel()[first] for role, c in law.drivers.items()})
    out = getattr(law.mechanism, effect)(view, parameters_of(law, values, 1))
    return np.broadcast_to(out, (len(values), len(first)))


def factor_series(law: Law, values: Array, inputs: Inputs) -> Array:
    """A conductance factor (P, B, M) in every interval, by its start."""
    along = law.mechanism.along_time
    out = inputs.intervals.call(law, "factor", values, along)
    if not along and np.ndim(out) > 1:
        out = out[..., 0, :]
    return np.broadcast_to(out, (len(values), *inputs.valid.shape))
