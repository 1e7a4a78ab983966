"""The cutting of batches into pieces that one array pass can advance together.

A *row* is one interval, or `every` intervals of one regime and one step merged into one. A *piece* is up to some
dozen consecutive rows of a batch, a *block* all pieces of one regime (and step): one matrix product, one recursion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
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
    piece stands in it, flattened. `changes[k]` are the batches that enter a new regime before rank k, with the number
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
