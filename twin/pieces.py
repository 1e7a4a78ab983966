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
class Pieces:
    """How B batches of M intervals are cut when every `every`-th border is kept.

    `chain` (ranks, B) is the piece of each batch by rank (`n_pieces` where the batch has no more), `slot` (pieces,)
    where a piece stands in it. `span` numbers each piece's (regime, duration) in `spans`; `changes[k]` are the
    batches that enter a new regime before rank k, with the number of the (old, new) pair in `pairs`.
    `border` (B, M // every + 1) is the row that ends at a kept border, `n_rows + b` for the start of batch b.
    """

    every: int
    blocks: tuple[Block, ...]
    n_rows: int
    n_pieces: int
    chain: Ints
    slot: Ints
    span: Ints
    span_regime: Ints
    span_s: Array
    first_regime: Ints
    changes: tuple[tuple[Ints, Ints] | None, ...]
    pairs: Ints
    border: Ints


def cut(step: Ints, step_s: Array, regime: Ints, n_rows: Ints, every: int) -> Pieces:
    """Cut batches into pieces: `step` (B, M) numbers each interval's length in `step_s`, `regime` (B, M) its regime."""
    n_batches, n_intervals = step.shape
    n_kept = n_intervals // every
    n_used = n_rows // every * every  # what follows the last kept border is not needed
    valid = np.arange(n_kept * every) < n_used[:, None]
    step, regime = step[:, : n_kept * every], regime[:, : n_kept * every]
    kind = regime * len(step_s) + step
    common = _common(kind, valid)

    batch, first, held, kind = _rows(kind, valid, common, every)
    row_regime, row_step = kind // len(step_s), kind % len(step_s)
    lone = ~common[kind]
    block_key = np.where(lone, -1 - row_regime, kind * (every + 1) + held)

    piece_of_row, position, length = _split(batch, block_key, int(2.0 * np.sqrt(max(n_kept, 1))))
    head = np.flatnonzero(position == 0)  # first row of each piece, in time order
    order = np.lexsort((np.arange(len(head)), -length, block_key[head]))  # blocks together, longest first
    place = np.empty_like(order)
    place[order] = np.arange(len(order))

    sorted_rows = np.lexsort((place[piece_of_row], position, block_key))
    blocks: list[Block] = []
    n_before = 0
    for rows in np.split(sorted_rows, np.flatnonzero(np.diff(block_key[sorted_rows])) + 1) if len(sorted_rows) else ():
        counts = np.bincount(position[rows])
        offsets = np.cumsum(counts) - counts
        lo = blocks[-1].rows.stop if blocks else 0
        n_held = int(held[rows[0]])
        blocks.append(
            Block(
                regime=int(row_regime[rows[0]]),
                n_held=n_held,
                step=int(row_step[rows[0]]),
                step_of_row=row_step[rows] if lone[rows[0]] else None,
                rows=slice(lo, lo + len(rows)),
                pieces=slice(n_before, n_before + int(counts[0])),
                source=(batch[rows] * n_kept * every + first[rows]) // n_held,
                spans=tuple(zip(offsets.tolist(), counts.tolist(), strict=True)),
            )
        )
        n_before += int(counts[0])

    # the chain of pieces along each batch
    piece_batch, piece_regime = batch[head], row_regime[head]
    starts = np.flatnonzero(np.diff(piece_batch, prepend=-1))
    rank = np.arange(len(head)) - np.repeat(starts, np.diff(np.append(starts, len(head))))
    n_ranks = int(rank.max()) + 1 if len(rank) else 0
    chain = np.full((n_ranks, n_batches), len(head))
    chain[rank, piece_batch] = place
    slot = np.empty_like(place)
    slot[place] = rank * n_batches + piece_batch
    first_regime = np.zeros(n_batches, int)
    first_regime[piece_batch[rank == 0]] = piece_regime[rank == 0]
    changed = np.flatnonzero((rank[1:] > 0) & (piece_regime[1:] != piece_regime[:-1])) + 1
    pairs, pair = np.unique(
        np.column_stack([piece_regime[changed - 1], piece_regime[changed]]), axis=0, return_inverse=True
    )
    changes: list[tuple[Ints, Ints] | None] = [None] * n_ranks
    for k in np.unique(rank[changed]):
        here = rank[changed] == k
        changes[k] = piece_batch[changed[here]], pair.reshape(-1)[here]

    duration = np.bincount(piece_of_row, weights=held * step_s[row_step], minlength=len(head))
    spans, span_of = np.unique(np.column_stack([piece_regime, duration])[order], axis=0, return_inverse=True)

    # the row at each kept border: padding holds the last valid one
    row_at = np.full((n_batches, n_kept * every + 1), -1)
    row_at[batch[sorted_rows], (first + held)[sorted_rows]] = np.arange(len(sorted_rows))
    row_at[:, 0] = len(sorted_rows) + np.arange(n_batches)
    kept = np.minimum(np.arange(n_kept + 1) * every, n_used[:, None])
    return Pieces(
        every=every,
        blocks=tuple(blocks),
        n_rows=len(sorted_rows),
        n_pieces=len(head),
        chain=chain,
        slot=slot,
        span=span_of.reshape(-1),
        span_regime=spans[:, 0].astype(int),
        span_s=spans[:, 1],
        first_regime=first_regime,
        changes=tuple(changes),
        pairs=pairs,
        border=np.take_along_axis(row_at, kept, axis=1),
    )


def _common(kind: Ints, valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(kinds,): frequent and lasting enough for a block with one set of weights."""
    total = np.bincount(kind[valid], minlength=int(kind.max(initial=0)) + 1)
    begins = valid.copy()
    begins[:, 1:] &= (kind[:, 1:] != kind[:, :-1]) | ~valid[:, :-1]
    runs = np.bincount(kind[begins], minlength=len(total))
    return (total * _COMMON >= total.sum()) & (runs * _RUN <= total)


def _rows(kind: Ints, valid: NDArray[np.bool_], common: NDArray[np.bool_], every: int) -> tuple[Ints, Ints, Ints, Ints]:
    """Batch, first interval, number of merged intervals and kind of each row, in time order."""
    n_batches, n_intervals = kind.shape
    held = valid.astype(int)
    if every > 1:
        groups = np.where(valid, kind, 0).reshape(n_batches, -1, every)
        whole = (groups == groups[..., :1]).all(axis=-1) & common[groups[..., 0]]
        whole &= valid.reshape(groups.shape).all(axis=-1)
        held = held.reshape(groups.shape)
        held[whole] = 0
        held[whole, 0] = every
        held = held.reshape(n_batches, n_intervals)
    batch, first = np.nonzero(held)
    return batch, first, held[batch, first], kind[batch, first]


def _split(batch: Ints, key: Ints, longest: int) -> tuple[Ints, Ints, Ints]:
    """Cut runs of rows of one batch and key into nearly equal pieces of at most `longest` rows.

    Returns each row's piece and position in it, and each piece's length.
    """
    n = len(batch)
    begins = np.flatnonzero(np.append(n > 0, (np.diff(batch) != 0) | (np.diff(key) != 0))[: n or 0])
    size = np.diff(np.append(begins, n))
    n_cuts = -(-size // longest)
    within = np.arange(n) - np.repeat(begins, size)
    part = within * np.repeat(n_cuts, size) // np.repeat(size, size)
    piece = np.repeat(np.cumsum(n_cuts) - n_cuts, size) + part
    length = np.bincount(piece) if n else np.zeros(0, int)
    return piece, np.arange(n) - np.repeat(np.cumsum(length) - length, length), length
