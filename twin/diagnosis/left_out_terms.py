"""Which of many terms predict batches left out: greedy, a term at a time, every fold from one Gram matrix.

Parameters and nuisances are projected out of the terms' rows (Frisch and Waugh 1933), so that no smoothing of a
reconstruction bends a coefficient.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from twin.calibration.fit_problem import Array

MOST = 3
LEAST = 3.0  # nats that a further term must gain
SHARE = 0.02  # of the gain so far: less only mends the form of the terms before
FLAT = 1e-6  # of a term's own information: a prior that says nothing


@dataclass(frozen=True)
class LeftOutTerms:
    """Gram matrices (B, Q + p + 1, ·) of Q terms, derivatives by z and residual, free of nuisances; z (p,) of the fit.

    `rows` (B,) is the expected square of a batch's residual if it is noise.
    """

    grams: Array
    z: Array
    rows: Array

    @property
    def count(self) -> int:
        return int(self.grams.shape[1] - len(self.z) - 1)

    @cached_property
    def _folds(self) -> tuple[Array, Array]:
        """Terms' information (B + 1, Q, Q) and pull (B + 1, Q) beyond parameters: of all batches, and without each."""
        q, total = self.count, self.grams.sum(axis=0)
        own, pull = [], []
        for gram in (total, *(total - g for g in self.grams)):
            factor = cho_factor(gram[q:-1, q:-1] + np.eye(len(self.z)))
            shadow = cho_solve(factor, gram[q:-1, :q])
            own.append(gram[:q, :q] - gram[:q, q:-1] @ shadow)
            pull.append(gram[:q, -1] - shadow.T @ (gram[q:-1, -1] - self.z))
        return np.stack(own), np.stack(pull)

    def _prior(self, at: NDArray[np.int64]) -> Array:
        return np.diag(FLAT * self.grams.sum(axis=0)[at, at] + 1e-300)

    def gain(self, terms: Sequence[int]) -> float:
        """Left-out log score of the terms less that of none, nats, summed over batches."""
        own, pull = self._folds
        at = np.asarray(terms, np.int64)
        if not len(at):
            return 0.0
        information = own[:, at[:, None], at] + self._prior(at)
        found = np.linalg.solve(information, pull[:, at, None])[..., 0]
        log = 0.5 * ((pull[:, at] * found).sum(axis=1) - np.linalg.slogdet(information)[1])
        return float(np.sum(log[0] - log[1:]))

    def chosen(self, allowed: Sequence[int], most: int = MOST) -> list[int]:
        """Terms taken one after the other, each then tried against the others, while every step gains enough."""
        terms: list[int] = []
        gain = 0.0
        while len(terms) < most:
            trial = self._best([*terms, -1], len(terms), allowed)
            for k in range(len(trial) - 1):
                trial = self._best(trial, k, allowed)
            reached = self.gain(trial)
            if len(set(trial)) < len(trial) or reached < gain + max(LEAST, SHARE * gain):
                break
            terms, gain = trial, reached
        return terms

    def _best(self, terms: Sequence[int], k: int, allowed: Sequence[int]) -> list[int]:
        """The terms with the k-th exchanged for the best; the earlier of equals."""
        others = [*terms[:k], *terms[k + 1 :]]
        free = [q for q in allowed if q not in others]
        if not free:
            return list(terms)
        best = max(free, key=lambda q: self.gain([*others, q]))
        return [*terms[:k], best, *terms[k + 1 :]]

    def coefficients(self, terms: Sequence[int]) -> tuple[Array, Array]:
        """Values and covariance (k, k) from all batches."""
        own, pull = self._folds
        at = np.asarray(terms, np.int64)
        covariance = np.linalg.inv(own[0][at[:, None], at] + self._prior(at))
        return covariance @ pull[0, at], covariance

    def explained(self, terms: Sequence[int]) -> tuple[float, int]:
        """Share of the left-out misfit beyond noise that the terms explain, and in how many batches it falls."""
        before, after = self._squares([]), self._squares(terms)
        noise = float(self.rows.sum())
        misfit = max(float(before.sum()) - noise, 1e-9)
        share = (before.sum() - max(float(after.sum()), noise)) / misfit
        return float(np.clip(share, 0.0, 1.0)), int((after < before).sum())

    def _squares(self, terms: Sequence[int]) -> Array:
        """Every batch's squared residual (B,) predicted by all others."""
        q = self.count
        at = np.r_[np.asarray(terms, np.int64), np.arange(q, q + len(self.z))]
        prior = np.eye(len(at))
        prior[: len(terms), : len(terms)] = self._prior(at[: len(terms)])
        centre = np.r_[np.zeros(len(terms)), self.z]
        total, out = self.grams.sum(axis=0), []
        for gram in self.grams:
            rest = total - gram
            w = np.linalg.solve(rest[at[:, None], at] + prior, rest[at, -1] - centre)
            out.append(gram[-1, -1] - 2 * w @ gram[at, -1] + w @ gram[at[:, None], at] @ w)
        return np.array(out)
