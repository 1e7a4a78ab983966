"""The modal recursion over pieces: array work without bookkeeping; rows lie as `twin.simulation.pieces` says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from twin.simulation.modes import Array, Modes, first_order_hold
from twin.simulation.pieces import Block, Ints, Pieces


@dataclass(frozen=True)
class Weights:
    """Of one block: `decay` (P, S, N) over a row and `gain` (P, S, n_held, 2, N), s, of its interval ends.

    S is 1 where all rows have one step, else the number of distinct steps.
    """

    decay: Array
    gain: Array

    def of_sets(self, sets: slice) -> Weights:
        return self if len(self.decay) == 1 else Weights(self.decay[sets], self.gain[sets])


def weights_of(modes: Modes, block: Block, step_s: Array) -> Weights:
    """Exact weights of the rows of a block."""
    steps = step_s[block.step : block.step + 1] if block.step_of_row is None else step_s
    rate = modes.rate_per_s[:, block.regime, None, :]
    decay, start, end = first_order_hold(rate, steps[:, None])
    # what enters in the i-th of the held intervals decays over the ones behind it
    behind = np.arange(block.n_held - 1, -1, -1)[:, None, None]
    later = np.exp(-rate[:, :, None, None, :] * steps[:, None, None, None] * behind)
    gain = later * np.stack([start, end], axis=2)[:, :, None]
    return Weights(decay if block.n_held == 1 else np.exp(-rate * steps[:, None] * block.n_held), gain)


def heat(block: Block, weights: Weights, modal_W: Array, series: Array, out: Array | None = None) -> Array:
    """What the sources add to each mode in each row: (rows, Q * N), into `out` if given.

    `modal_W` (Q, J, N) is the sources' effect on the modes, `series` (rows, n_held * J * 2) as `Drive.rows` gives them.
    """
    n_sets, n_series, n_modes = modal_W.shape
    if block.step_of_row is None:
        gain = weights.gain[:, 0, :, None] * modal_W[:, None, :, None, :]  # (Q, n_held, J, 2, N)
        n_sets = len(gain)
        matrix = gain.reshape(n_sets, -1, n_modes).transpose(1, 0, 2).reshape(-1, n_sets * n_modes)
        return np.matmul(series, matrix, out=out)
    # steps differ from row to row: heat at both interval ends by matrix product, weights row by row
    n_sets = max(n_sets, len(weights.gain))
    flat = np.broadcast_to(modal_W.transpose(1, 0, 2), (n_series, n_sets, n_modes)).reshape(n_series, -1)
    gain = np.broadcast_to(weights.gain[:, :, 0], (n_sets, *weights.gain.shape[1:2], 2, n_modes))
    by_step = np.ascontiguousarray(gain.transpose(2, 1, 0, 3)).reshape(2, gain.shape[1], -1)
    total = np.empty((len(series), n_sets * n_modes)) if out is None else out
    np.multiply(series[:, 0::2] @ flat, by_step[0].take(block.step_of_row, axis=0), out=total)
    total += (series[:, 1::2] @ flat) * by_step[1].take(block.step_of_row, axis=0)
    return total


def advance(amplitude: Array, modes: Modes, pieces: Pieces, weights: Sequence[Weights], start_degC: Array) -> Array:
    """Turn modal heat per row (rows, Q, N) into modal amplitudes at the rows' ends, in place.

    `start_degC` (Q or 1, B, N) are node temperatures. Returns the amplitudes (pieces + 1, Q, N) that the pieces
    would end with from zero, the last one zero: one look at them tells whether everything was finite.
    """
    n_sets, n_modes = amplitude.shape[1:]
    width = n_sets * n_modes
    flat = amplitude.reshape(-1, width)
    ends = np.zeros((pieces.n_pieces + 1, width))
    if not pieces.n_pieces:
        return ends.reshape(-1, n_sets, n_modes)
    decays = [_decay_of_rows(b, w, n_sets) for b, w in zip(pieces.blocks, weights, strict=True)]
    for block, decay in zip(pieces.blocks, decays, strict=True):
        _end_from_zero(flat[block.rows], block, decay, ends[block.pieces])
    starts = _starts(modes, pieces, ends, start_degC, n_sets)
    for block, decay in zip(pieces.blocks, decays, strict=True):
        _fill(flat[block.rows], block, decay, starts.take(pieces.chain.slot[block.pieces], axis=0))
    return ends.reshape(-1, n_sets, n_modes)


def _decay_of_rows(block: Block, weights: Weights, n_sets: int) -> Array:
    """(pieces, Q * N) where all rows have one step, else (rows, Q * N)."""
    decay = np.broadcast_to(weights.decay, (n_sets, *weights.decay.shape[1:])).swapaxes(0, 1)
    by_step = decay.reshape(len(decay), -1)
    if block.step_of_row is not None:
        return by_step.take(block.step_of_row, axis=0)
    return by_step.repeat(block.pieces.stop - block.pieces.start, axis=0)


def _end_from_zero(rows: Array, block: Block, decay: Array, end: Array) -> None:
    for lo, n in block.spans:
        if lo:
            end[:n] *= decay[:n] if block.step_of_row is None else decay[lo : lo + n]
        end[:n] += rows[lo : lo + n]


def _fill(rows: Array, block: Block, decay: Array, before: Array) -> None:
    step = np.empty_like(before)
    for lo, n in block.spans:
        here = rows[lo : lo + n]
        np.multiply(before[:n], decay[:n] if block.step_of_row is None else decay[lo : lo + n], out=step[:n])
        here += step[:n]
        before = here


def _starts(modes: Modes, pieces: Pieces, ends: Array, start_degC: Array, n_sets: int) -> Array:
    """True amplitudes (ranks * B, Q * N) at the pieces' starts, in the modes of each piece's regime."""
    chain = pieces.chain
    n_ranks, n_batches = chain.by_rank.shape
    n_modes = modes.n_nodes
    rate = np.broadcast_to(modes.rate_per_s[:, pieces.span_regime], (n_sets, len(pieces.span_s), n_modes))
    by_span = np.exp(-rate * pieces.span_s[:, None]).transpose(1, 0, 2).reshape(len(pieces.span_s), -1)
    decay = by_span.take(np.append(pieces.span, 0)[chain.by_rank], axis=0)
    starts = np.empty((n_ranks, n_batches, n_sets, n_modes))
    first = modes.inverse[:, chain.first_regime] @ start_degC[..., None]
    flat = starts.reshape(n_ranks, n_batches, -1)
    starts[0] = first[..., 0].swapaxes(0, 1)
    flat[1:] = ends.take(chain.by_rank[:-1], axis=0)
    into = _basis_changes(modes, chain.pairs)
    step = np.empty(flat.shape[1:])
    for k in range(1, n_ranks):
        np.multiply(flat[k - 1], decay[k - 1], out=step)
        flat[k] += step
        change = chain.changes[k]
        if change is not None:
            batches, pair = change
            old = starts[k][batches]
            # one set of modes: all right-hand sides in one product; else one small product each
            new = old @ into[pair, 0] if len(modes.shape) == 1 else (old[:, :, None] @ into[pair])[:, :, 0]
            starts[k][batches] = new
    return flat.reshape(-1, n_sets * n_modes)


def _basis_changes(modes: Modes, pairs: Ints) -> Array:
    """(pairs, P, N, N): row amplitudes of the old regime times this are those of the new one."""
    change = modes.inverse[:, pairs[:, 1]] @ modes.shape[:, pairs[:, 0]]
    return np.ascontiguousarray(change.transpose(1, 0, 3, 2))
