"""Forward selection by the Bayesian information criterion on the recordings themselves, nuisances fitted alongside.

Schwarz (1978). Every channel has an unknown noise, no smaller than stated; every row counts as independent; effects
enter one at a time as long as the criterion falls, all amplitudes refitted at each step in the linearised model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from data.arrays import Array
from diagnosis.contracts import Scored
from diagnosis.fitting.covariance import slices_of
from diagnosis.policy import POLICY
from diagnosis.search.claims import Round
from diagnosis.search.search import Search
from thermodrift_rivals.base import Claim, Reply, beyond_slack, bounds
from twin.calibration.fit_problem import Block

LOOKED_AT = 40  # candidates of a step whose criterion is computed, by their reduction at the weights of the step before
REWEIGHTING_ROUNDS = 5  # of reweighting the channels
ALIKE = 2.0  # of the criterion: "not worth more than a bare mention" (Raftery 1995)


def in_sample_bic(done: Search) -> Reply:
    """All effects that lower the criterion, in the order of entry; those that lower it equally are alike."""
    news = beyond_slack(done.rounds[0])
    sums = _Sums.of(done.rounds[0], news)
    chosen: list[int] = []
    claims: list[Claim] = []
    now = sums.criterion([])
    while len(chosen) < POLICY.max_effects:
        tried = {j: sums.criterion([*chosen, j]) for j in sums.promising(chosen)}
        best = min(tried, key=lambda j: tried[j], default=None)
        if best is None or tried[best] >= now:
            break
        alike = tuple(news[j].candidate for j, v in tried.items() if j != best and v < tried[best] + ALIKE)
        claims.append(Claim(news[best].candidate, alike=alike))
        chosen.append(best)
        now = tried[best]
    return Reply.of(claims)


@dataclass(frozen=True)
class _Sums:
    """Products by channel (K, C + 1, C + 1) of the columns and the target, nuisances projected out; target last."""

    gram: Array
    rows: Array  # (K,)
    least: Array  # (K,) sum of squares of the stated noise alone
    low: Array
    high: Array

    @classmethod
    def of(cls, done: Round, news: list[Scored]) -> _Sums:
        now, at = done.before, [s.column for s in news]
        blocks = list(now.problem.linearise(now.x, now.nuisance))
        spread = np.array([u.spread for u in now.problem.unknowns])
        every = [
            np.column_stack([x[:, at], b.residual]) for x, b in zip(done.screen.signatures.columns, blocks, strict=True)
        ]
        gram = np.zeros((len(now.rows), len(at) + 1, len(at) + 1))
        for m, rows in zip(now.problem.measured, _beyond_parameters(blocks, spread, every), strict=True):
            for c, where in slices_of(m.channel):
                gram[c] += rows[where].T @ rows[where]
        return cls(gram, now.rows, now.rows, *bounds(news))

    def criterion(self, chosen: list[int]) -> float:
        """n log of every channel's mean square, and log n for each effect; infinite where a size is not allowed."""
        square, size = self._fit(chosen)
        if any(not self.low[j] <= g <= self.high[j] for j, g in zip(chosen, size, strict=True)):
            return float("inf")
        known = self.rows > 0
        mean = np.maximum(square[known] / self.least[known], 1.0)
        return float(self.rows[known] @ np.log(mean) + len(chosen) * np.log(self.rows.sum()))

    def promising(self, chosen: list[int]) -> list[int]:
        """Candidates that reduce the weighted squares most, given those chosen."""
        total = np.tensordot(self._weight(self._fit(chosen)[0]), self.gram, 1)
        own, to = total[:-1, :-1], total[:-1, -1]
        if chosen:
            share = np.linalg.lstsq(own[np.ix_(chosen, chosen)], own[chosen], rcond=None)[0]
            left, square = to - share.T @ to[chosen], np.diag(own) - np.einsum("kc,kc->c", share, own[chosen])
        else:
            left, square = to, np.diag(own)
        off = np.where(square > 1e-9 * np.diag(own), left**2 / np.maximum(square, 1e-30), 0.0)
        off[chosen] = 0.0
        return [int(j) for j in np.argsort(-off, kind="stable")[:LOOKED_AT] if off[j] > 0]

    def _fit(self, chosen: list[int]) -> tuple[Array, Array]:
        """Residual squares (K,) and sizes, the channels weighted by their residuals."""
        square: Array = self.gram[:, -1, -1]
        size: Array = np.zeros(len(chosen))
        if not chosen:
            return square, size
        to = self.gram[:, chosen, -1]
        own = self.gram[:, chosen][:, :, chosen]
        for _ in range(REWEIGHTING_ROUNDS):
            weight = self._weight(square)
            size = np.asarray(np.linalg.lstsq(np.tensordot(weight, own, 1), weight @ to, rcond=None)[0])
            square = np.asarray(
                self.gram[:, -1, -1] - 2.0 * to @ size + np.einsum("i,kij,j->k", size, own, size), float
            )
        return square, size

    def _weight(self, square: Array) -> Array:
        return np.asarray(self.rows / np.maximum(square, np.maximum(self.least, 1e-300)))


def _beyond_parameters(blocks: Sequence[Block], spread: Array, drawn: Sequence[Array]) -> list[Array]:
    """Signatures (n_b, K) less what one linear step of the parameters and nuisances, within their priors, explains.

    Args:
        blocks: of every batch, the problem linearised at a point.
        spread: prior sd (p,) of the parameters.
        drawn: signatures (n_b, K) of every batch, in units of the given noise.
    """
    size = len(spread)
    information, shared, own = np.eye(size), np.zeros((size, drawn[0].shape[1])), []
    for b, d in zip(blocks, drawn, strict=True):
        jacobian, n = b.jacobian * spread, b.nuisance
        factor = cho_factor(n.T @ n + np.eye(n.shape[1]))
        of_jacobian, of_drawn = cho_solve(factor, n.T @ jacobian), cho_solve(factor, n.T @ d)
        information += jacobian.T @ (jacobian - n @ of_jacobian)
        shared += jacobian.T @ (d - n @ of_drawn)
        own.append((jacobian, of_jacobian, of_drawn))
    z = np.linalg.solve(information, shared)
    return [
        d - jacobian @ z - b.nuisance @ (of_drawn - of_jacobian @ z)
        for b, d, (jacobian, of_jacobian, of_drawn) in zip(blocks, drawn, own, strict=True)
    ]
