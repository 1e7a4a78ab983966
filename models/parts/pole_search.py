"""Where a transfer function's poles stand: a search over a grid by leave-batch-out, then each pole by itself.

All of it on sums per batch. The search is one coordinate after the other: poles that all sources share, which
sources take part, the penalty. Folds ask for the same few candidates, so each is solved once for all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from features.design import Moments
from models.linear import EPS
from models.parts.pole_responses import DRIVERS, TAUS_S, Dictionary, combination
from models.parts.pooled_sums import Blocks, Mask, Pool, left_out_mean_S_um

Array = NDArray[np.float64]
PENALTIES = np.geomspace(1e1, 1e-7, 9)
_COARSE = (1, 4, 7, 10, 13)  # of the grid: 3 min to 8 h
_FEW_PENALTIES = PENALTIES[2::2]  # while poles are sought
_BATCHES_PER_GAP = 2  # a gap is one number a batch
_STEPS, _LONGEST_STEP = 8, 0.7  # in log τ
_LOOSENESS = 0.5  # prior standard deviation of a pole's log τ about the shared one


@dataclass(frozen=True)
class Candidate:
    """Poles of the grid that all sources share, the speed's exponent (0: no drivers), and whether gaps take part."""

    poles: tuple[int, ...] = ()
    exponent: float = 0.0
    gaps: bool = False

    def sources(self, dictionary: Dictionary) -> list[int]:
        """Which sources of a dictionary take part."""
        takes = {"input": True, "gap": self.gaps and bool(self.poles), **dict.fromkeys(DRIVERS, self.exponent > 0)}
        return [
            i
            for i, s in enumerate(dictionary.sources)
            if takes[s.kind] and (s.kind != "speed" or s.exponent == self.exponent)
        ]


class Search:
    """The best candidate and penalty of every training set, masks (F, B) over the dictionary's blocks of rows."""

    def __init__(self, dictionary: Dictionary, moments: Moments, masks: Mask) -> None:
        self.dictionary, self.moments, self.masks = dictionary, moments, masks
        self._scores: dict[Candidate, Array] = {}

    def run(self, n_poles: int) -> tuple[list[Candidate], Array]:
        """A candidate and a penalty k (F,) per set."""
        exponents = tuple(dict.fromkeys(s.exponent for s in self.dictionary.sources if s.kind in DRIVERS))
        least = _BATCHES_PER_GAP * sum(s.kind == "gap" for s in self.dictionary.sources)
        start = Candidate((), exponents[0] if exponents else 0.0)
        best = [replace(start, gaps=0 < least <= n) for n in self.masks.sum(axis=1)]
        if n_poles > 0:
            best = self._better(best, lambda c: [c, *(replace(c, poles=(a,)) for a in _COARSE)])
        if n_poles > 1:
            best = self._better(best, _second_pole)
        best = self._better(best, lambda c: [c, replace(c, gaps=False)])
        if exponents:
            best = self._better(best, lambda c: [c, *(replace(c, exponent=m) for m in (0.0, *exponents))])
        penalty = np.zeros(len(self.masks))
        for candidate in dict.fromkeys(best):
            some = [f for f, own in enumerate(best) if own == candidate]
            penalty[some] = self.penalties(candidate, some)
        return best, penalty

    def penalties(self, candidate: Candidate, sets: Sequence[int] | None = None) -> Array:
        """The best k of a candidate for some of the sets, None all."""
        masks = self.masks if sets is None else self.masks[list(sets)]
        return PENALTIES[np.argmin(self._left_out(candidate, masks, PENALTIES), axis=1)]

    def _better(self, best: Sequence[Candidate], others: Callable[[Candidate], list[Candidate]]) -> list[Candidate]:
        """Every set's least of what stands beside its best; equal scores keep the first."""
        tried = [list(dict.fromkeys(others(candidate))) for candidate in best]
        asked: dict[Candidate, list[int]] = {}
        for f, candidates in enumerate(tried):
            for candidate in candidates:
                asked.setdefault(candidate, []).append(f)
        for candidate, sets in asked.items():
            score = self._scores.setdefault(candidate, np.full(len(best), np.nan))
            if new := [f for f in sets if np.isnan(score[f])]:
                score[new] = self._left_out(candidate, self.masks[new], _FEW_PENALTIES).min(axis=1)
        return [c[int(np.argmin([self._scores[one][f] for one in c]))] for f, c in enumerate(tried)]

    def _left_out(self, candidate: Candidate, masks: Mask, penalties: Array) -> Array:
        columns = self.dictionary.places(candidate.sources(self.dictionary), candidate.poles)
        return left_out_mean_S_um(
            Blocks.of(self.moments.subset(columns)), masks, False, lambda pool: gains(pool, penalties)
        )


def gains(pool: Pool, penalties: Array) -> Array:
    """Ridge (S, p, G): (XX + k trace(XX)/p) g = Xy for every penalty k."""
    alpha = _mean_diagonal(pool.xx)
    out = np.empty((*pool.xy.shape, len(penalties)))
    matrix = pool.xx.copy()
    diagonal = np.einsum("sjj->sj", matrix)
    own = diagonal.copy()
    for g, k in enumerate(penalties):
        diagonal[:] = own + k * alpha[:, None]
        out[:, :, g] = np.linalg.solve(matrix, pool.xy[:, :, None])[:, :, 0]
    return out


def _second_pole(c: Candidate) -> list[Candidate]:
    """One more pole beside the first, on the coarse grid."""
    if len(c.poles) != 1:
        return [c]
    return [c, *(replace(c, poles=tuple(sorted((c.poles[0], b)))) for b in _COARSE if b != c.poles[0])]


@dataclass(frozen=True)
class _Solved:
    """Gains at given poles: weight and slope of `combination`, ridge alpha (F,), gain (F, p), sum of squares (F,)."""

    log_tau: Array
    weight: Array
    slope: Array
    alpha: Array
    gain: Array
    sse: Array

    @classmethod
    def at(cls, log_tau: Array, pool: Pool, yy: Array, direct: NDArray[np.bool_], penalty: Array) -> Self:
        weight, slope = combination(log_tau, direct)
        across = weight.transpose(0, 2, 1)
        matrix, right = across @ pool.xx @ weight, (across @ pool.xy[:, :, None])[:, :, 0]
        alpha = penalty * _mean_diagonal(matrix)
        ridge = alpha[:, None, None] * np.eye(matrix.shape[1])
        gain = np.asarray(np.linalg.solve(matrix + ridge, right[:, :, None])[:, :, 0], float)
        square = np.einsum("fj,fj->f", gain, (matrix @ gain[:, :, None])[:, :, 0])
        sse = np.maximum(yy - 2.0 * np.einsum("fj,fj->f", gain, right) + square, 0.0)
        return cls(log_tau, weight, slope, alpha, gain, sse)

    def cost(self, shared: Array, hold: Array) -> Array:
        away = ((self.log_tau - shared[:, None, :]) ** 2).sum(axis=(1, 2))
        return np.asarray(self.sse + self.alpha * (self.gain**2).sum(axis=1) + hold * away)

    def step(self, pool: Pool, shared: Array, hold: Array) -> Array:
        """The Gauss–Newton step in log τ, (F, S, L), gains moving along."""
        n_fits, n_sources, n_poles = self.log_tau.shape
        p, n_lags = self.gain.shape[1], n_sources * n_poles
        columns = np.concatenate([self.weight, self.slope * self.gain[:, None, p - n_lags :]], axis=2)
        across = columns.transpose(0, 2, 1)
        rest = pool.xy - (pool.xx @ self.weight @ self.gain[:, :, None])[:, :, 0]
        right = (across @ rest[:, :, None])[:, :, 0]
        away = (self.log_tau - shared[:, None, :]).transpose(0, 2, 1).reshape(n_fits, -1)
        right -= np.concatenate([self.alpha[:, None] * self.gain, hold[:, None] * away], axis=1)
        matrix = across @ pool.xx @ columns
        ridge = [np.repeat(self.alpha[:, None], p, axis=1), np.repeat(hold[:, None], n_lags, axis=1)]
        np.einsum("fjj->fj", matrix)[:] += np.concatenate(ridge, axis=1)
        step = np.linalg.solve(matrix, right[:, :, None])[:, p:, 0]
        return np.clip(step, -_LONGEST_STEP, _LONGEST_STEP).reshape(n_fits, n_poles, -1).transpose(0, 2, 1)

    def where(self, better: NDArray[np.bool_], other: Self) -> Self:
        """`other` in the fits where it is better."""
        parts = {
            name: np.where(better.reshape(-1, *[1] * (old.ndim - 1)), getattr(other, name), old)
            for name, old in vars(self).items()
        }
        return replace(self, **parts)


def refined(
    pool: Pool, yy: Array, direct: NDArray[np.bool_], shared: Array, penalty: Array, rows: Array
) -> tuple[Array, Array]:
    """Each source's poles by itself: penalised Gauss–Newton on log τ, shortened until it helps (variable projection).

    Minimises `|y − Σ g v|² + α |g|² + σ² m |log τ − log τ_shared|² / looseness²`: α is the ridge of `gains`, σ² the
    residual variance, and the m rows of a batch count as one observation, because they are not independent.

    Args:
        pool: sums over the dictionary's columns of the S sources in the order of `Dictionary.block`, F sets.
        yy: the target's centred sum of squares, (F,). shared: log τ of the poles that all sources start from, (F, L).
        penalty: k of `gains`, (F,). rows: mean rows per batch, (F,).

    Returns:
        log τ (F, S, L) and gains (F, D + L S) of the columns of `combination`.
    """
    now = _Solved.at(np.repeat(shared[:, None, :], len(direct), axis=1), pool, yy, direct, penalty)
    share = np.ones(len(shared))
    for _ in range(_STEPS if shared.shape[1] else 0):
        hold = rows * now.sse / np.maximum(pool.count, 1.0) / _LOOSENESS**2 + EPS * (yy + 1.0)
        moved = now.log_tau + share[:, None, None] * now.step(pool, shared, hold)
        trial = _Solved.at(np.clip(moved, *np.log(TAUS_S[[0, -1]])), pool, yy, direct, penalty)
        better = trial.cost(shared, hold) < now.cost(shared, hold)
        now, share = now.where(better, trial), np.where(better, np.minimum(2.0 * share, 1.0), 0.3 * share)
    return now.log_tau, now.gain


def _mean_diagonal(matrix: Array) -> Array:
    """trace/p (S,) of (S, p, p); 1 where nothing moves."""
    mean = np.einsum("sjj->s", matrix) / matrix.shape[1]
    return np.where(mean > 0, mean, 1.0)
