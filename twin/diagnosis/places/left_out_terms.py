"""Which of many terms predict batches left out: a term more at a time, every fold from one Gram matrix.

Parameters and nuisances are projected out of the terms' rows (Frisch and Waugh 1933), so that no smoothing of a
reconstruction bends a coefficient.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

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

    @cached_property
    def _flat(self) -> Array:
        """Prior information (Q,) of every coefficient."""
        return FLAT * np.diagonal(self.grams.sum(axis=0))[: self.count] + 1e-300

    def gains(self, sets: NDArray[np.int64]) -> Array:
        """Left-out log scores (S,) of sets of terms (S, k) less that of none, nats, summed over batches."""
        own, pull = self._folds
        information = own[:, sets[:, :, None], sets[:, None, :]] + self._flat[sets][..., None] * np.eye(sets.shape[1])
        seen = pull[:, sets]
        found = np.linalg.solve(information, seen[..., None])[..., 0]
        log = 0.5 * ((seen * found).sum(axis=-1) - np.linalg.slogdet(information)[1])
        return np.asarray((log[0] - log[1:]).sum(axis=0))

    def gain(self, terms: Sequence[int]) -> float:
        """That of one set."""
        return float(self.gains(np.array([terms], np.int64))[0]) if len(terms) else 0.0

    def chosen(self, allowed: Sequence[int], most: int = MOST, beside: Sequence[int] = ()) -> list[int]:
        """The best terms while every further one gains enough: one, the best pair, then what goes best with those.

        All pairs are tried, since a difference of two temperatures shows in neither alone. `beside` are in all along
        and not among what is returned.
        """
        terms: list[int] = []
        gain, without = 0.0, self.gain(beside)
        trial: list[int] = []
        for size in range(1, min(most, len(allowed)) + 1):
            trial = self._pair(allowed, beside) if size == 2 else self._extended(trial, allowed, beside)
            reached = self.gain([*beside, *trial]) - without
            if reached >= gain + (size - len(terms)) * max(LEAST, SHARE * gain):
                terms, gain = trial, reached
        return terms

    def _pair(self, allowed: Sequence[int], beside: Sequence[int]) -> list[int]:
        pairs = list(combinations(allowed, 2))
        return list(pairs[int(self.gains(np.array([[*beside, *pair] for pair in pairs], np.int64)).argmax())])

    def _extended(self, terms: Sequence[int], allowed: Sequence[int], beside: Sequence[int]) -> list[int]:
        """With one more term, then each exchanged for a better one; the earlier of equals."""
        out = self._best([*terms, -1], len(terms), allowed, beside)
        for k in range(len(out) - 1):
            out = self._best(out, k, allowed, beside)
        return out

    def _best(self, terms: Sequence[int], k: int, allowed: Sequence[int], beside: Sequence[int]) -> list[int]:
        """The terms with the k-th exchanged for the best."""
        others = [*terms[:k], *terms[k + 1 :]]
        free = [q for q in allowed if q not in others]
        best = free[int(self.gains(np.array([[*beside, *others, q] for q in free], np.int64)).argmax())]
        return [*terms[:k], best, *terms[k + 1 :]]

    def coefficients(self, terms: Sequence[int]) -> tuple[Array, Array]:
        """Values and covariance (k, k) from all batches."""
        own, pull = self._folds
        at = np.asarray(terms, np.int64)
        covariance = np.linalg.inv(own[0][at[:, None], at] + np.diag(self._flat[at]))
        return covariance @ pull[0, at], covariance

    def explained(self, terms: Sequence[int], beside: Sequence[int] = ()) -> tuple[float, int]:
        """Share of the left-out misfit beyond noise that the terms explain, and in how many batches it falls.

        `beside` are in all along.
        """
        before, after = self._squares(beside), self._squares([*beside, *terms])
        noise = float(self.rows.sum())
        misfit = max(float(before.sum()) - noise, 1e-9)
        share = (before.sum() - max(float(after.sum()), noise)) / misfit
        return float(np.clip(share, 0.0, 1.0)), int((after < before).sum())

    def _squares(self, terms: Sequence[int]) -> Array:
        """Every batch's squared residual (B,) predicted by all others."""
        q = self.count
        at = np.r_[np.asarray(terms, np.int64), np.arange(q, q + len(self.z))]
        prior = np.diag(np.r_[self._flat[at[: len(terms)]], np.ones(len(self.z))])
        centre = np.r_[np.zeros(len(terms)), self.z]
        total, out = self.grams.sum(axis=0), []
        for gram in self.grams:
            rest = total - gram
            w = np.linalg.solve(rest[at[:, None], at] + prior, rest[at, -1] - centre)
            out.append(gram[-1, -1] - 2 * w @ gram[at, -1] + w @ gram[at[:, None], at] @ w)
        return np.array(out)
