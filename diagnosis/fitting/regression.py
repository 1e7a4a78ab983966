"""A fit whose rows remember each other: generalised least squares with the memory that the fit itself leaves.

Rows divided by a channel's own misfit and by the rows that count as one would let a fit give a channel up: what a
smooth misfit of tens of standard deviations costs there is little, and many white rows elsewhere are bought with it.
Filtered by its memory (`memory`), a slow misfit costs what it is worth and what is sharp counts in full.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from data.arrays import Array
from diagnosis.policy import POLICY
from twin.calibration.fit_problem import Block, Noise, Problem, Unknown
from twin.calibration.least_squares import State, descend, x_of
from twin.calibration.problem import CalibrationProblem

MEMORY_REACHES_ROWS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)  # after which the memory has decayed to 1/e
MEMORY_SHARES = (0.1, 0.25, 0.4, 0.6, 0.75, 0.87, 0.94, 0.97, 0.985)
MATRIX_FILTER_ROWS = (
    110  # rows up to which a filter's matrix is quicker than its recursion; at 73 rows of 150 columns twice
)

Slices = Sequence[tuple[int, slice]]  # every channel's number and rows


@dataclass(frozen=True)
class Memory:
    """Per channel (K,): the `share` w of the variance that remembers, and what it `keep`s from row to row, φ."""

    share: Array
    keep: Array

    @classmethod
    def none(cls, channels: int) -> Memory:
        return cls(np.zeros(channels), np.zeros(channels))

    @property
    def inflation(self) -> Array:
        """Rows (K,) that count as one for a trace that does not change: 1 + 2 Σ ρ."""
        return np.asarray(1.0 + 2.0 * self.share * self.keep / (1.0 - self.keep))

    @property
    def white(self) -> Array:
        """The variance (K,) that white noise of variance 1 has when it is filtered."""
        theta, variance = _moving_average(self.share, self.keep)
        return np.asarray((1.0 + (theta - self.keep) ** 2 / (1.0 - theta**2)) / variance)

    def filtered(self, slices: Slices, rows: Array) -> Array:
        """The innovations of rows (n,) or (n, p), of variance 1 where the rows have it: what is left of each less what
        those before it in its channel foretell."""
        out = np.empty(rows.shape)
        for channel, at in slices:
            phi, theta, sd = self._filter[channel]
            if phi == 0.0:
                out[at] = rows[at]
            elif (n := at.stop - at.start) <= MATRIX_FILTER_ROWS:
                np.matmul(_matrix(phi, theta, sd)[:n, :n], rows[at], out=out[at])
            else:
                out[at] = _innovations(phi, theta, sd, rows[at])
        return out

    def restored(self, slices: Slices, rows: Array) -> Array:
        """The rows whose innovations these are: the inverse of `filtered`."""
        out = np.array(rows, float)
        for channel, at in slices:
            phi, theta, sd = self._filter[channel]
            if phi != 0.0:
                out[at] = _passed([sd, -theta * sd], [1.0, -phi], rows[at])
        return out

    @cached_property
    def _filter(self) -> list[tuple[float, float, float]]:
        """φ, θ and the innovations' standard deviation of each channel; φ is 0 where its rows are independent."""
        theta, variance = _moving_average(self.share, self.keep)
        phi = np.where(self.share > 0.0, self.keep, 0.0)
        return list(zip(phi.tolist(), theta.tolist(), np.sqrt(variance).tolist(), strict=True))


def slices_of(channel: NDArray[np.int64]) -> Slices:
    """Every channel's number and rows, of the channels (n,) of rows in their order."""
    starts = np.flatnonzero(np.diff(channel, prepend=-1))
    ends = np.append(starts[1:], len(channel))
    return [(c, slice(a, b)) for c, a, b in zip(channel[starts].tolist(), starts.tolist(), ends.tolist(), strict=True)]


def whiter(one: Memory, other: Memory) -> Memory:
    """Per channel the memory of the shorter reach."""
    first = one.inflation <= other.inflation
    return Memory(np.where(first, one.share, other.share), np.where(first, one.keep, other.keep))


def memory_of(residuals: Sequence[Array], channels: Sequence[NDArray[np.int64]], n_channels: int) -> Memory:
    """The likeliest memory of what a fit leaves over, of all shares and reaches on the grid.

    Args:
        residuals: (n_b,) of every batch in units of the given noise, in time order within each channel.
        channels: (n_b,) the channel of each row.
    """
    lengths = np.array([np.bincount(at, minlength=n_channels) for at in channels]).T
    rows = np.zeros((lengths.max(initial=0), n_channels, len(lengths.T)))
    there = np.arange(len(rows))[:, None, None] < lengths
    for b, (left, at) in enumerate(zip(residuals, channels, strict=True)):
        rows[:, :, b].T[there[:, :, b].T] = left[np.argsort(at, kind="stable")]
    w, rows_to_1_e = np.array([(0.0, 1.0), *product(MEMORY_SHARES, MEMORY_REACHES_ROWS)]).T
    keep = np.where(w > 0.0, np.exp(-1.0 / rows_to_1_e), 0.0)
    likely = _likelihoods(rows, there, w, keep)
    best = 1 + np.argmax(likely[1:], axis=0)
    found = (lengths.sum(axis=1) >= POLICY.memory_min_rows) & (
        likely[best, np.arange(n_channels)] > likely[0] + POLICY.memory_min_gain_nats
    )
    return Memory(np.where(found, w[best], 0.0), np.where(found, keep[best], 0.0))


def _likelihoods(rows: Array, there: NDArray[np.bool_], w: Array, keep: Array) -> Array:
    """Log likelihood (G, K) of series (n, K, B) with each of G memories, the variance at its best.

    Each series ends with the last row that is `there`.
    """
    theta, variance = _moving_average(w, keep)
    squares, n = np.zeros((len(w), rows.shape[1])), there.sum(axis=(0, 2))
    now = np.zeros((len(w), *rows.shape[1:]))
    phi, back, sd = (v[:, None, None] for v in (keep, theta, np.sqrt(variance)))
    for t, (row, known) in enumerate(zip(rows, there, strict=True)):
        if t == 0:
            now += row
        else:
            now *= back
            now += (row - phi * rows[t - 1]) / sd
        squares += np.einsum("gkb,gkb,kb->gk", now, now, known)
    mean = squares / np.maximum(n, 1)
    scale = np.maximum(mean, (POLICY.min_noise_variance_share / (1.0 - w))[:, None])
    return np.asarray(-0.5 * n * (np.log(scale) + np.log(variance)[:, None] + mean / scale))


@lru_cache(maxsize=len(MEMORY_SHARES) * len(MEMORY_REACHES_ROWS))  # of every memory that `memory_of` may find
def _matrix(phi: float, theta: float, sd: float) -> Array:
    """The filter of SHORT rows; what it does to the first n of them is its corner of n rows."""
    return _innovations(phi, theta, sd, np.eye(MATRIX_FILTER_ROWS))


def _innovations(phi: float, theta: float, sd: float, rows: Array) -> Array:
    return _passed([1.0 / sd, -phi / sd], [1.0, -theta], rows)


def _passed(ahead: list[float], back: list[float], rows: Array) -> Array:
    """Rows (n, …) through a filter that passes the first, which has no past and is of full variance, as it is."""
    return np.asarray(lfilter(ahead, back, rows, axis=0, zi=rows[:1] * (1.0 - ahead[0]))[0])


def _moving_average(share: Array, keep: Array) -> tuple[Array, Array]:
    """θ and the innovations' variance of ``y_t = φ y_(t-1) + e_t - θ e_(t-1)`` for an AR(1) share and white noise."""
    a = 1.0 + keep**2 - 2.0 * keep**2 * share
    b = keep * (1.0 - share)
    theta = 2.0 * b / (a + np.sqrt(np.maximum(a**2 - 4.0 * b**2, 0.0)))
    return theta, np.asarray(np.where(theta > 0, b / np.where(theta > 0, theta, 1.0), a))


@dataclass(frozen=True)
class Filtered:
    """Implements `twin.calibration.fit_problem.Problem`: the problem's rows less what those before foretell."""

    problem: CalibrationProblem
    memory: Memory

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        return self.problem.unknowns

    @property
    def channels(self) -> tuple[str, ...]:
        return self.problem.channels

    @property
    def nuisance_sizes(self) -> tuple[int, ...]:
        return self.problem.nuisance_sizes

    def linearise(self, x: Array, nuisance: Sequence[Array]) -> Iterator[Block]:
        for block in self.problem.linearise(x, nuisance):
            p = block.jacobian.shape[1]
            rows = self._innovations(np.column_stack([block.residual, block.jacobian, block.nuisance]), block.channel)
            yield replace(block, residual=rows[:, 0], jacobian=rows[:, 1 : p + 1], nuisance=rows[:, p + 1 :])

    def residuals(self, x: Array, nuisance: Sequence[Array]) -> list[Array]:
        every = zip(self.problem.residuals(x, nuisance), self.problem.measured, strict=True)
        return [self._innovations(rows, m.channel) for rows, m in every]

    def noise_of(self, left: Sequence[Array], parameters: float = 0.0) -> Noise:
        """The standard deviation of the innovations of each channel in rows left over (n_b,), at least the given
        noise; `parameters` were fitted."""
        own = [self._innovations(rows, m.channel) for rows, m in zip(left, self.problem.measured, strict=True)]
        square = square_sums(self.problem, own)
        rows = np.bincount(np.concatenate([m.channel for m in self.problem.measured]), minlength=len(square))
        left_over = max(1.0 - parameters / max(1.0, rows.sum()), POLICY.min_residual_freedom)
        factor = np.sqrt(square / (np.maximum(rows, 1.0) * left_over))
        return Noise(np.maximum(factor, 1.0), np.ones(len(factor)))

    def _innovations(self, rows: Array, channel: NDArray[np.int64]) -> Array:
        return self.memory.filtered(slices_of(channel), rows)


def square_sums(problem: CalibrationProblem, rows: Sequence[Array]) -> Array:
    """Sums (K,) over each channel of the squares of every batch's rows (n_b,)."""
    k = len(problem.channels)
    every = [np.bincount(m.channel, r**2, k) for m, r in zip(problem.measured, rows, strict=True)]
    return np.asarray(np.sum(every, axis=0))


def memory_left(problem: CalibrationProblem, left: Sequence[Array]) -> Memory:
    """What the rows of each channel remember of each other in rows left over (n_b,)."""
    return memory_of(left, [m.channel for m in problem.measured], len(problem.channels))


def left_where_own_follow(problem: Problem, state: State) -> list[Array]:
    """The rows (n_b,) that would be left once each batch's own unknowns follow to the state's z: these act linearly."""
    still = np.zeros(len(state.z))
    blocks = problem.linearise(x_of(problem.unknowns, state.z), state.nuisance)
    return [b.residual - b.nuisance @ c.step(still) for b, c in zip(blocks, state.arrow.corners, strict=True)]


def settle_filtered(problem: CalibrationProblem, state: State, steps: int, tolerance: float, rounds: int) -> State:
    """Down from a state, memory and noise estimated anew in every round of so many steps, until they stand."""
    for _ in range(rounds):
        left = problem.residuals(x_of(problem.unknowns, state.z), state.nuisance)
        filtered = Filtered(problem, memory_left(problem, left))
        noise = filtered.noise_of(left, state.arrow.effective_parameters())
        before = state.z
        state = descend(filtered, State.at(filtered, before, state.nuisance, noise), steps, tolerance)
        if np.abs(state.z - before).max(initial=0.0) < POLICY.settle_max_move_sd:
            break
    return state


MIN_DIRECTION_SQUARE = 1e-9  # sum of squares below which a direction of the nuisances, of variance 1, shows in no row


@dataclass(frozen=True)
class Whitened:
    """One batch: ``target = jacobian z + columns g + noise`` of unit variance; z = (x − prior) / spread ~ N(0, 1).

    target (n,), jacobian (n, p), columns (n, C), channel (n,) of every row, in order of channels; `mixing` (n, q) and
    `damping` (q,) are the nuisances' part: ``(I + N Nᵀ)^(-1/2) = I - mixing diag(damping) mixingᵀ``.
    """

    batch_id: str
    target: Array
    jacobian: Array
    columns: Array
    channel: NDArray[np.int64]
    scale: Array  # (n,) sqrt of the rows' weights
    mixing: Array
    damping: Array
    memory: Memory | None = None  # of each channel's rows; None: they are independent

    @classmethod
    def at(
        cls,
        block: Block,
        nuisance: Array,
        z: Array,
        unknowns: Sequence[Unknown],
        columns: Sequence[int],
        weight: Array,
        memory: Memory | None = None,
    ) -> Whitened:
        """A block at z and its nuisances (q,), the unknowns numbered `columns` taken as amplitudes.

        z (p,) of the other unknowns in their order; `weight` (channels,) of the rows, `memory` of each channel's.
        """
        scale = np.sqrt(weight[block.channel])
        bare = np.zeros((len(scale), 0))
        none = cls(block.batch_id, scale[:0], bare, bare, block.channel, scale, bare, scale[:0], memory)
        own = none.of(block.nuisance)
        square, turn = np.linalg.eigh(own.T @ own)  # what rounding makes of small ones is damped by no more than that
        kept = square > MIN_DIRECTION_SQUARE
        mixing, damping = own @ (turn[:, kept] / np.sqrt(square[kept])), 1.0 - 1.0 / np.sqrt(1.0 + square[kept])
        chosen = np.zeros(len(unknowns), bool)
        chosen[list(columns)] = True
        spread = np.array([u.spread for u in unknowns])
        out = replace(none, mixing=mixing, damping=damping)
        rows = out.of(
            np.column_stack(
                [block.residual + block.nuisance @ nuisance, block.jacobian[:, ~chosen] * spread[~chosen],
                 block.jacobian[:, list(columns)]]
            )
        )  # fmt: skip
        p = int((~chosen).sum())
        jacobian = rows[:, 1 : 1 + p]
        return replace(out, target=rows[:, 0] + jacobian @ z, jacobian=jacobian, columns=rows[:, 1 + p :])

    @cached_property
    def starts(self) -> NDArray[np.int64]:
        """Rows at which each channel begins."""
        return np.flatnonzero(np.r_[True, np.diff(self.channel) != 0])

    @cached_property
    def channels(self) -> NDArray[np.int64]:
        """The numbers of the channels that have rows."""
        return self.channel[self.starts]

    @cached_property
    def slices(self) -> Slices:
        """Every channel's number and rows."""
        return slices_of(self.channel)

    def with_slack(self, loose: Mapping[int, float]) -> Whitened:
        """The same batch in which some columns are shared unknowns too, of the prior sd given, about 0."""
        if not loose:
            return self
        more = self.columns[:, list(loose)] * np.array(list(loose.values()))
        return replace(self, jacobian=np.hstack([self.jacobian, more]))

    def with_own(self, column: Array) -> Whitened:
        """The same batch with one more unknown of its own, of prior N(0, 1); column (n,) is whitened already."""
        square = float(column @ column)
        if square < 1e-18:
            return replace(self, columns=self.columns[:, :0])
        damping = 1.0 - 1.0 / np.sqrt(1.0 + square)
        unit = column / np.sqrt(square)

        def damped(rows: Array) -> Array:
            return np.asarray(rows - damping * np.multiply.outer(unit, unit @ rows))

        return replace(
            self, target=damped(self.target), jacobian=damped(self.jacobian), columns=self.columns[:, :0],
            damping=np.append(self.damping, damping), mixing=np.column_stack([self.mixing, unit]),
        )  # fmt: skip

    def of(self, rows: Array) -> Array:
        """Other quantities of the same rows (n, …), in units of the given noise, whitened alike."""
        rows = self.innovations(rows * self.scale.reshape(-1, *(1,) * (rows.ndim - 1)))
        return np.asarray(rows - self.mixing @ (self.damping * (self.mixing.T @ rows).T).T)

    def innovations(self, rows: Array) -> Array:
        """Rows (n, …) less what each channel's memory of the rows before foretells."""
        if self.memory is None:
            return rows
        return self.memory.filtered(self.slices, rows)

    def restored(self, rows: Array) -> Array:
        """Rows (n, …) as they were before `of`, in units of the weighted noise."""
        back = self.damping / (1.0 - self.damping)
        rows = np.asarray(rows + self.mixing @ (back * (self.mixing.T @ rows).T).T)
        if self.memory is None:
            return rows
        return self.memory.restored(self.slices, rows)
