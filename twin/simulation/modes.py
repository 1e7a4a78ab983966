"""Thermal modes of a linear network: independent first-order lags, and the exact weights of a driven one.

C dT/dt = -K T + q(t) becomes dz/dt = -rate z + w(t) with T = shape z (Özisik 1993, Heat Conduction, ch. 13).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.errors import InputError
from twin.simulation.schedule import Block, Pieces

_ASYMMETRY = 1e-9  # of the largest conductance; above it the matrix is no heat exchange between nodes
_SERIES = [float(1.0 / np.prod(np.arange(1.0, k + 3.0))) for k in range(19)]  # 1/(k + 2)!, enough for x <= 1


@dataclass(frozen=True)
class Modes:
    """Modes of P parameter sets in R regimes of a network of N nodes, slowest first.

    `rate_per_s` (P, R, N) are the decay rates, `shape` (P, R, N, N) has the modes as columns (T = shape z)
    and `inverse` (P, R, N, N) takes temperatures to modal amplitudes (z = inverse T).
    """

    rate_per_s: Array
    shape: Array
    inverse: Array

    @property
    def n_sets(self) -> int:
        return self.rate_per_s.shape[0]

    @property
    def n_regimes(self) -> int:
        return self.rate_per_s.shape[1]

    @property
    def n_nodes(self) -> int:
        return self.rate_per_s.shape[2]

    def time_constants_s(self) -> Array:
        """Time constants (P, R, N), s, slowest first; inf: the mode never decays."""
        with np.errstate(divide="ignore"):
            return np.asarray(1.0 / self.rate_per_s)

    def of_sets(self, sets: slice) -> Modes:
        """The modes of some parameter sets; of the only one, if there is only one."""
        if self.n_sets == 1:
            return self
        return Modes(self.rate_per_s[sets], self.shape[sets], self.inverse[sets])

    def of_regimes(self, numbers: NDArray[np.int64]) -> Modes:
        """The modes of regimes `numbers` (R,), which may repeat."""
        return Modes(self.rate_per_s[:, numbers], self.shape[:, numbers], self.inverse[:, numbers])


def modes_of(capacity_J_per_K: Array, conductance_W_per_K: Array) -> Modes:
    """Modes from heat capacities (P, N) and symmetric, positive semidefinite conductance matrices (P, R, N, N).

    A rate below N times the rounding of the fastest one counts as 0, so that a closed network keeps its energy.

    Raises:
        InputError: shapes that disagree, a capacity that is not positive and finite, a conductance matrix that
            is not finite, not symmetric or has a negative eigenvalue (a link that carries heat uphill).
    """
    capacity, conductance = np.asarray(capacity_J_per_K, float), np.asarray(conductance_W_per_K, float)
    _check(capacity, conductance)
    root = np.sqrt(capacity)[:, None, :]
    # the lower triangle alone would be read by eigh: average, so that rounding cannot depend on the node order
    scaled = 0.5 * (conductance + conductance.swapaxes(-1, -2)) / (root[..., :, None] * root[..., None, :])
    rate, vector = np.linalg.eigh(scaled)
    size = np.abs(rate).max(axis=-1, keepdims=True)
    if (rate < -1e-9 * size).any():
        p, r, n = (int(i) for i in np.unravel_index(np.argmin(rate / np.maximum(size, 1e-300)), rate.shape))
        raise InputError(
            f"parameter set {p}, regime {r}: the conductance matrix has a mode that grows at {-rate[p, r, n]:.3g} /s, "
            "expected every mode to decay; look for a negative conductance"
        )
    rate = np.where(rate <= rate.shape[-1] * np.finfo(float).eps * size, 0.0, rate)
    shape = vector / root[..., :, None]
    inverse = np.ascontiguousarray(vector.swapaxes(-1, -2) * root[..., None, :])
    return Modes(rate, shape, inverse)


def first_order_hold(rate_per_s: Array, dt_s: Array | float) -> tuple[Array, Array, Array]:
    """Decay and weights of one interval: z+ = decay z + p_start w_start + p_end w_end, w linear in between.

    Exact to a few roundings for every rate * dt >= 0, also 0: p_start = p_end = dt / 2. The arguments broadcast;
    the weights are in s. Source: phi functions of Hochbruck and Ostermann (2010), Acta Numerica 19, eq. 2.11.
    """
    dt = np.asarray(dt_s, float)
    x = np.asarray(rate_per_s * dt, float)
    decay = np.exp(-x)
    large = np.maximum(x, 1.0)
    start = (1.0 - np.exp(-large) * (1.0 + large)) / large**2
    end = (large + np.expm1(-large)) / large**2
    # below x = 1 the differences above cancel; there the Taylor series, by Horner's rule
    small = np.minimum(x, 1.0)
    start_series, end_series = np.zeros_like(x), np.zeros_like(x)
    for k in range(len(_SERIES) - 1, -1, -1):
        end_series = _SERIES[k] - small * end_series
        start_series = (k + 1) * _SERIES[k] - small * start_series
    return decay, dt * np.where(x < 1.0, start_series, start), dt * np.where(x < 1.0, end_series, end)


def _check(capacity: Array, conductance: Array) -> None:
    if capacity.ndim != 2 or conductance.ndim != 4 or conductance.shape[-2:] != (capacity.shape[1],) * 2:
        raise InputError(
            f"modes: got capacities of shape {capacity.shape} and conductances of shape {conductance.shape}, "
            "expected (sets, nodes) and (sets, regimes, nodes, nodes)"
        )
    if len(capacity) != len(conductance) and 1 not in (len(capacity), len(conductance)):
        raise InputError(
            f"modes: got {len(capacity)} sets of capacities and {len(conductance)} of conductances, expected as many"
        )
    bad = ~(np.isfinite(capacity) & (capacity > 0.0))
    if bad.any():
        p, n = (int(i[0]) for i in np.nonzero(bad))
        raise InputError(
            f"parameter set {p}, node {n}: heat capacity is {capacity[p, n]:g} J/K, expected a positive, finite "
            "number; check the node's capacity, or its mass and material"
        )
    bad = ~np.isfinite(conductance)
    if bad.any():
        p, r, i, k = (int(i[0]) for i in np.nonzero(bad))
        raise InputError(
            f"parameter set {p}, regime {r}, nodes {i} and {k}: conductance is {conductance[p, r, i, k]:g} W/K, "
            "expected a finite number; check the links and exposures of these nodes"
        )
    gap = np.abs(conductance - conductance.swapaxes(-1, -2))
    if (gap > _ASYMMETRY * np.abs(conductance).max(axis=(-2, -1), keepdims=True)).any():
        p, r, i, k = (int(i) for i in np.unravel_index(np.argmax(gap), gap.shape))
        raise InputError(
            f"parameter set {p}, regime {r}, nodes {i} and {k}: conductances {conductance[p, r, i, k]:g} and "
            f"{conductance[p, r, k, i]:g} W/K, expected a symmetric matrix; "
            "heat that flows one way only is a source, not a link"
        )


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
    would end with from zero, the last one zero: if they are finite, everything was.
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
    # (pairs, P, N, N): row amplitudes of the old regime times this are those of the new one
    changes = modes.inverse[:, chain.pairs[:, 1]] @ modes.shape[:, chain.pairs[:, 0]]
    into = np.ascontiguousarray(changes.transpose(1, 0, 3, 2))
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
