"""How well candidates predict batches left out: every fold of every candidate from one linearisation.

With the nuisances projected out (`Whitened`) a fold is a downdate of the normal matrix, and a candidate with the
shared parameters a Schur complement (Frisch and Waugh 1933): hundreds of candidates cost a few matrix products.
The score is the left-out log density with every channel's noise unknown, ``-1/2 sum_c n_c log(MSE_c)``, so that no
channel's units or misfit decide; rows that repeat each other are filtered first (`diagnosis.fitting.regression`).
Amplitudes maximise the same density of the other batches: a channel that the baseline's weights gave up counts again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from data.arrays import Array
from diagnosis.fitting.regression import Whitened
from diagnosis.policy import POLICY

TINY = 1e-300
Prior = tuple[Array, Array]  # (R, C), (C,): how far columns move parameters back to their prior, and its square


@dataclass(frozen=True)
class Fold:
    """What does not depend on the recordings when one batch is left out; C columns."""

    factor: tuple[Array, bool]  # Cholesky of the others' information and the prior
    left: Array  # (n, C) the left-out batch's columns beyond what the parameters can do
    square: Array  # (K, C) their squares by channel


@dataclass(frozen=True)
class Scores:
    """C columns one by one with the parameters: left-out gain in nats, batches that improve, in-sample z, amplitude.

    `amplitude` (C,) and its sd are of the whole fit; `absorbed` (C,) the share of a column's square that the shared
    parameters take; `by_batch` (B, C) the fall of each left-out batch's squared residual.
    """

    gain: Array
    improved: Array
    z: Array
    amplitude: Array
    sd: Array
    absorbed: Array
    by_batch: Array


@dataclass(frozen=True)
class Evidence:
    """B whitened batches; per channel (K,) the `rows` of all and the `weight` of each, its share of what noise leaves.

    Mean squares are in units of the given noise. Amplitudes lie within low and
    high (C,). Targets are B arrays (n_b, R): R recordings, or what stands for them, at once.
    """

    batches: tuple[Whitened, ...]
    rows: Array
    weight: Array
    low: Array
    high: Array

    @cached_property
    def targets(self) -> list[Array]:
        """The recordings themselves, R = 1."""
        return [b.target[:, None] for b in self.batches]

    @cached_property
    def _own(self) -> list[Array]:
        """Every batch's information (p, p)."""
        return [b.jacobian.T @ b.jacobian for b in self.batches]

    @cached_property
    def _cross(self) -> list[Array]:
        """What every batch's parameters share with its columns, (p, C)."""
        return [b.jacobian.T @ b.columns for b in self.batches]

    @cached_property
    def folds(self) -> list[Fold]:
        all_own, all_cross = np.sum(self._own, axis=0) + np.eye(len(self._own[0])), np.sum(self._cross, axis=0)
        out = []
        for b, h, g in zip(self.batches, self._own, self._cross, strict=True):
            factor = cho_factor(all_own - h)
            left = b.columns - b.jacobian @ cho_solve(factor, all_cross - g)
            out.append(Fold(factor, left, self._by_channel(b, left**2)))
        return out

    @cached_property
    def factor(self) -> tuple[Array, bool]:
        """Cholesky of all batches' information and the prior."""
        return cho_factor(np.sum(self._own, axis=0) + np.eye(len(self._own[0])))

    @cached_property
    def shadow(self) -> Array:
        """By how much the parameters (p, C) would move for a unit of each column."""
        return np.asarray(cho_solve(self.factor, np.sum(self._cross, axis=0)))

    @cached_property
    def _shadow_square(self) -> Array:
        """(C,): what the prior of the parameters takes for that."""
        return np.einsum("pc,pc->c", self.shadow, self.shadow)

    @cached_property
    def beyond(self) -> list[Array]:
        """Every batch's columns (n, C) beyond what the parameters of the whole fit can do."""
        return [b.columns - b.jacobian @ self.shadow for b in self.batches]

    @cached_property
    def _squares(self) -> Array:
        """Of `beyond` by batch and channel, (B, K, C)."""
        return np.stack([self._by_channel(b, c**2) for b, c in zip(self.batches, self.beyond, strict=True)])

    def left_out(self, targets: Sequence[Array] | None = None) -> list[Array]:
        """Residuals (n_b, R) of every batch at the parameters that all others say."""
        targets = self.targets if targets is None else targets
        to = [b.jacobian.T @ t for b, t in zip(self.batches, targets, strict=True)]
        total = np.sum(to, axis=0)
        return [
            t - b.jacobian @ cho_solve(f.factor, total - own)
            for b, f, t, own in zip(self.batches, self.folds, targets, to, strict=True)
        ]

    def inside(self, targets: Sequence[Array] | None = None) -> list[Array]:
        """Residuals (n_b, R) of every batch at the parameters of the whole fit."""
        targets = self.targets if targets is None else targets
        z = self._parameters(targets)
        return [t - b.jacobian @ z for b, t in zip(self.batches, targets, strict=True)]

    def residuals(self, targets: Sequence[Array] | None = None, left_out: bool = True) -> list[Array]:
        """Residuals (n_b, R) of every batch, `left_out` of the fit or inside it."""
        return self.left_out(targets) if left_out else self.inside(targets)

    def mean_squares(self, left: Sequence[Array]) -> Array:
        """Left-out mean squares (R, K) in units of the given noise's variance; nan where a channel has no rows."""
        total = np.sum([self._by_channel(b, e**2) for b, e in zip(self.batches, left, strict=True)], axis=0).T
        return np.asarray(np.where(self.rows > 0, total / np.maximum(self._least, TINY), np.nan))

    def base_score(self, targets: Sequence[Array] | None = None, left_out: bool = True) -> Array:
        """Log density (R,) without any candidate of batches left out, or inside the fit, in nats up to a constant.

        What the nuisances could do counts too, by the volume that they leave open (the determinant of a covariance),
        and so does how far the parameters must go from what the machine file says: a network that is bent to fit
        predicts as well as the right one as long as nothing new happens.
        """
        volume = sum(float(np.sum(np.log1p(-b.damping))) for b in self.batches)
        bent = -0.5 * np.sum(self._parameters(targets) ** 2, axis=0)
        return self.density(np.nan_to_num(self.mean_squares(self.residuals(targets, left_out)))) + volume + bent

    def _parameters(self, targets: Sequence[Array] | None = None) -> Array:
        """z (p, R) of the whole fit."""
        targets = self.targets if targets is None else targets
        total = np.sum([b.jacobian.T @ t for b, t in zip(self.batches, targets, strict=True)], axis=0)
        return np.asarray(cho_solve(self.factor, total))

    def group_score(self, group: Sequence[int]) -> float:
        """Log density of some batches left out together, per batch, predicted by all others."""
        chosen = set(group)
        rest = [k for k in range(len(self.batches)) if k not in chosen]
        own = np.sum([self._own[k] for k in rest], axis=0) + np.eye(len(self._own[0]))
        to = np.sum([self.batches[k].jacobian.T @ self.batches[k].target for k in rest], axis=0)
        z = cho_solve(cho_factor(own), to)
        square, least = np.zeros(len(self.rows)), np.zeros(len(self.rows))
        for k in group:
            b = self.batches[k]
            square += self._by_channel(b, (b.target - b.jacobian @ z) ** 2)
            least += self._by_channel(b, np.ones(len(b.target))) * self.weight
        volume = sum(float(np.sum(np.log1p(-self.batches[k].damping))) for k in group)
        share = least / np.maximum(self._least, TINY)
        mean = np.where(least > 0, square / np.maximum(least, TINY), 1.0)
        return float(
            -0.5 * np.sum(self.rows * share * np.log(np.maximum(mean, POLICY.min_noise_variance_share))) + volume
        )

    def density(self, mean_squares: Array) -> Array:
        """Log density (…,) in nats of mean squares (…, K); less than a quiet instrument's is not rewarded."""
        return np.asarray(-0.5 * np.log(np.maximum(mean_squares, POLICY.min_noise_variance_share)) @ self.rows)

    def gains(self, targets: Sequence[Array] | None = None, left_out: bool = True) -> tuple[Array, Array, Array]:
        """Of all columns one by one: gains (R, C) in nats, amplitudes (R, C), falls of batches' squares (R, B, C).

        Each batch is predicted by the others, or, not `left_out`, by the fit to all.
        """
        targets = self.targets if targets is None else targets
        z, inside = self._parameters(targets), self.inside(targets)
        own = np.stack([self._by_channel(b, e**2).T for b, e in zip(self.batches, inside, strict=True)], axis=1)
        cross = np.stack(
            [self._products(b, e, c) for b, e, c in zip(self.batches, inside, self.beyond, strict=True)], 1
        )
        square = self._squares
        sums = own.sum(axis=1), cross.sum(axis=1), square.sum(axis=0)
        prior = z.T @ self.shadow, self._shadow_square
        best = self._first_amplitude(*sums, prior)
        left = self.left_out(targets) if left_out else inside
        before = np.zeros(own[:, 0].shape)
        after = np.zeros(cross[:, 0].shape)
        falls = np.zeros((len(best), len(self.batches), best.shape[1]))
        for k, (b, fold, e) in enumerate(zip(self.batches, self.folds, left, strict=True)):
            if left_out:
                rest = sums[0] - own[:, k], sums[1] - cross[:, k], sums[2] - square[k]
                g, shared, squares = self._amplitude(best, *rest, prior), self._products(b, e, fold.left), fold.square
            else:
                g, shared, squares = self._amplitude(best, *sums, prior), cross[:, k], square[k]
            change = -2.0 * g[:, None] * shared + g[:, None] ** 2 * squares
            seen = self._by_channel(b, e**2).T
            before += seen
            after += seen[..., None] + change
            falls[:, k] = -change.sum(axis=1)
        gain = self._of_squares(after) - self._of_squares(before[..., None])
        relief = _relief(self._amplitude(best, *sums, prior), prior)
        return gain + relief, self._amplitude(best, *sums, prior, shrink=False), falls

    def scores(self) -> Scores:
        """All columns one by one for the recordings."""
        gain, amplitude, falls = self.gains()
        inside = np.maximum(self._squares.sum(axis=(0, 1)) + self._shadow_square, TINY)
        every = sum(np.einsum("nc,nc->c", b.columns, b.columns) for b in self.batches)
        z = self._parameters()[:, 0]
        along = z @ self.shadow + sum(
            c.T @ (b.target - b.jacobian @ z) for b, c in zip(self.batches, self.beyond, strict=True)
        )  # fmt: skip
        return Scores(
            gain[0], (falls[0] > 0).sum(axis=0), along / np.sqrt(inside), amplitude[0], 1.0 / np.sqrt(inside),
            1.0 - inside / np.maximum(every, TINY), falls[0],
        )  # fmt: skip

    def own_gain(self, columns: Sequence[Array]) -> float:
        """What it gains, in nats, that each batch has one more unknown of its own, of prior N(0, 1); B columns."""
        batches = tuple(b.with_own(c) for b, c in zip(self.batches, columns, strict=True))
        own = replace(self, batches=batches, low=self.low[:0], high=self.high[:0])
        return float(own.base_score()[0] - self.base_score()[0])

    def likeness(self, columns: Sequence[int]) -> Array:
        """|cos| (k, k) between columns once the shared parameters are projected out."""
        gram = sum(c[:, list(columns)].T @ c[:, list(columns)] for c in self.beyond)
        size = np.sqrt(np.diag(gram)) + TINY
        return np.asarray(np.abs(gram) / np.outer(size, size))

    def _by_channel(self, b: Whitened, values: Array) -> Array:
        """Sums (K, …) of rows (n, …)."""
        out = np.zeros((len(self.rows), *values.shape[1:]))
        out[b.channels] = np.add.reduceat(values, b.starts, axis=0)
        return out

    def _products(self, b: Whitened, e: Array, columns: Array) -> Array:
        """Sums over every channel's rows of residual times column, (R, K, C)."""
        out = np.zeros((e.shape[1], len(self.rows), columns.shape[1]))
        for c, rows in b.slices:
            out[:, c] = e[rows].T @ columns[rows]
        return out

    @cached_property
    def _least(self) -> Array:
        """The squares (K,) that the given noise alone would leave."""
        return self.rows * self.weight

    def _of_squares(self, square: Array) -> Array:
        """Density (R, C) of squares (R, K, C)."""
        mean = np.moveaxis(square, 1, -1) / np.maximum(self._least, TINY)
        return self.density(mean)

    def _first_amplitude(self, own: Array, cross: Array, square: Array, prior: Prior) -> Array:
        """Where reweighting starts (R, C): the best of plain least squares and of every channel's own optimum."""
        plain = (cross.sum(axis=1) + prior[0]) / np.maximum(square.sum(axis=0) + prior[1], TINY)
        best = np.clip(plain, self.low, self.high)
        most = self._of_squares(self._moved(best, own, cross, square)) + _relief(best, prior)
        for c in np.flatnonzero(self.rows):
            g = np.clip(cross[:, c] / np.maximum(square[c], TINY), self.low, self.high)
            density = self._of_squares(self._moved(g, own, cross, square)) + _relief(g, prior)
            best, most = np.where(density > most, g, best), np.maximum(density, most)
        return np.asarray(best)

    def _amplitude(self, g: Array, own: Array, cross: Array, square: Array, prior: Prior, shrink: bool = True) -> Array:
        """Amplitudes (R, C) of the highest density within the bounds, from sums (R, K), (R, K, C), (K, C).

        Reweighted iteratively, with the parameters' prior as a further channel; then less what noise alone would give
        (James and Stein 1961, positive part).
        """
        for _ in range(POLICY.amplitude_reweighting_rounds):
            mean = np.maximum(
                self._moved(g, own, cross, square), POLICY.min_noise_variance_share * self._least[:, None] + TINY
            )
            weight = self.rows[:, None] / mean
            along = np.einsum("rkc,rkc->rc", weight, cross) + prior[0]
            g = along / np.maximum(np.einsum("rkc,kc->rc", weight, square) + prior[1], TINY)
            g = np.clip(g, self.low, self.high)
        if not shrink:
            return np.asarray(g)
        seen = self._of_squares(self._moved(g, own, cross, square)) - self._of_squares(own[..., None])
        won = 2.0 * (seen + _relief(g, prior))
        return np.where(won > 1.0, g * (1.0 - 1.0 / np.maximum(won, 1.0)), 0.0)

    @staticmethod
    def _moved(g: Array, own: Array, cross: Array, square: Array) -> Array:
        """Squares (R, K, C) at amplitudes (R, C)."""
        return np.maximum(own[..., None] - 2.0 * g[:, None] * cross + g[:, None] ** 2 * square, 0.0)


def _relief(g: Array, prior: Prior) -> Array:
    """Nats (R, C) that the parameters' prior gives back when columns of amplitudes g take over what bent them."""
    return np.asarray(g * prior[0] - 0.5 * g**2 * prior[1])
