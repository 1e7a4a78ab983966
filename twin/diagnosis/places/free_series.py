"""A free smooth series at a place, each batch its own: how far it explains what a calibration left, and what it is.

The series is a Gaussian process on hats (Rasmussen and Williams 2006, eq. 2.30): amplitude sigma by the marginal
likelihood, correlation falling with exp(-t / 1.5 h), so that it may jump where something is switched.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky

from twin.calibration.fit_problem import Array
from twin.diagnosis.places.forced import Hats

Indices = NDArray[np.int64]
Kind = Literal["heat", "displacement", "sensor"]

CORRELATION_S = 5400.0
# Of the best seen mode's signal against its noise, in sd: below the first nothing is seen, above the last all is.
STRENGTHS = np.geomspace(0.3, 3e4, 9)
RANGE = float(np.log(STRENGTHS[-1] / STRENGTHS[0]))
HALVINGS = 3  # of the step between strengths
CORNER = 1e300
PEAKED = 5.0  # nats of gain, above which a marginal likelihood is a peak


@dataclass(frozen=True)
class Basis:
    """Unit hats at P places of one kind: `rows` by batch (P, K, n_b) in given noises, K hats."""

    kind: Kind
    places: tuple[str, ...]
    units: tuple[str, ...]
    hats: Hats
    rows: list[Array]

    @cached_property
    def root(self) -> Array:
        """Lower triangular (K, K) of the hats' correlation."""
        gap_s = np.abs(self.hats.knot_s[:, None] - self.hats.knot_s)
        return np.asarray(cholesky(np.exp(-gap_s / CORRELATION_S), lower=True))

    @cached_property
    def shown(self) -> Array:
        """(K, K) from a series' values to what can be known of them: errors count from their first value."""
        out = np.eye(len(self.hats.knot_s))
        if self.kind == "displacement":
            out[:, 0] -= 1.0
        return out

    def nuisance(self, place: int, sigma: float) -> list[Array]:
        """By batch the rows (n_b, K) of one place's series as K nuisances of prior N(0, 1)."""
        return [(sigma * self.root.T @ rows[place]).T for rows in self.rows]


@dataclass(frozen=True)
class Amplitudes:
    """Best sigma of some places (P,), their gain over sigma = 0 in nats, 0 where nothing is gained, and evidence.

    The evidence is the marginal likelihood averaged over log sigma (Laplace): what a free amplitude costs is paid.
    """

    sigma: Array
    gain: Array
    evidence: Array


@dataclass(frozen=True)
class FreeSeries:
    """A basis beside parameters, of `information` (p, p) and `pull` (p,), in modes that are a batch's independent hats.

    `modes` (B, P, K, K) lead from modes to the values shown at the hats, of unit prior variance times sigma²;
    `strength` (B, P, K) is their squared signal to noise per sigma²; `by_z` (B, P, K, p) and `along` (B, P, K) what
    they see of the parameters and of the residual.
    """

    basis: Basis
    information: Array
    pull: Array
    modes: Array
    strength: Array
    by_z: Array
    along: Array

    @classmethod
    def of(cls, basis: Basis, own: Array, seen: Array, information: Array, pull: Array) -> FreeSeries:
        """From the hats' products free of nuisances: with each other (B, P, K, K), with [J r] (B, P, K, p + 1)."""
        strength, turned = np.linalg.eigh(basis.root.T @ own @ basis.root)
        modes = basis.root @ turned
        now = np.swapaxes(modes, -1, -2) @ seen
        return cls(
            basis, information, pull, basis.shown @ modes, np.maximum(strength, 0.0), now[..., :-1], now[..., -1]
        )

    @cached_property
    def _by_place(self) -> tuple[Array, Array]:
        """Strength, and what is seen of dz and residual, with places first and all batches' modes in one axis."""
        places, seen = len(self.basis.places), np.concatenate([self.by_z, self.along[..., None]], axis=-1)
        strength = np.moveaxis(self.strength, 1, 0).reshape(places, -1)
        return strength, np.moveaxis(seen, 1, 0).reshape(places, -1, seen.shape[-1])

    @cached_property
    def _shared(self) -> Array:
        """Information with the pull beside it (p + 1, p + 1)."""
        return np.block([[self.information, self.pull[:, None]], [self.pull, np.zeros(1)]])

    def gains(self, sigma: Array, places: Indices | slice = slice(None)) -> Array:
        """Log marginal likelihood (P,) of some places at amplitudes (P,) less that at sigma = 0, nats."""
        strength, seen = (a[places] for a in self._by_place)
        var = sigma[:, None] ** 2
        scaled = np.sqrt(var / (1.0 + var * strength))[..., None] * seen
        gram = np.swapaxes(scaled, -1, -2) @ scaled
        spent = np.log1p(var * strength).sum(axis=1)
        return np.asarray(_log(self._shared - gram) + 0.5 * (gram[:, -1, -1] - spent) - _log(self._shared))

    @cached_property
    def _tried(self) -> tuple[Array, Array]:
        """Sigmas and gains (strengths, P) all over the range of sigma; 0 where a place is not seen at all."""
        best = self.strength.max(axis=(0, 2))
        sigma = STRENGTHS[:, None] / np.sqrt(np.where(best > 0, best, np.inf))
        return sigma, np.stack([self.gains(s) for s in sigma])

    def promising(self, margin: float, without: Sequence[int] = ()) -> Indices:
        """Places that may be within `margin` nats of the best of them, before any sigma is refined."""
        gain = self._tried[1].max(axis=0)
        gain[list(without)] = -np.inf
        return np.flatnonzero((gain >= gain.max() - margin) & np.isfinite(gain))

    def refined(self, places: Indices) -> Amplitudes:
        """Sigma of the highest marginal likelihood at some places, by halving steps and a parabola through the last."""
        sigma, gain = (a[:, places] for a in self._tried)
        at, each = gain.argmax(axis=0), np.arange(len(places))
        best, top = sigma[at, each], gain[at, each]
        step = float(np.log(STRENGTHS[1] / STRENGTHS[0]))
        for _ in range(HALVINGS):
            step /= 2
            around = np.stack([best * np.exp(-step), best, best * np.exp(step)])
            three = np.stack([self.gains(around[0], places), top, self.gains(around[2], places)])
            at = three.argmax(axis=0)
            centre, best, top = best, around[at, each], three[at, each]
        bend = (three[0] - 2 * three[1] + three[2]) / step**2
        hump = bend < 0
        move = np.where(hump, (three[0] - three[2]) / (2 * step * np.where(hump, bend, -1.0)), 0.0)
        vertex = centre * np.exp(np.clip(move, -step, step))
        there = self.gains(vertex, places)
        best, top = np.where(there > top, vertex, best), np.maximum(there, top)
        width = np.sqrt(2 * np.pi / np.where(hump, -bend, 1e-9))
        peak = top + np.log(np.minimum(width / RANGE, 1.0))
        average = np.logaddexp.reduce(gain, axis=0) - np.log(len(gain))
        return Amplitudes(np.where(top > 0, best, 0.0), np.maximum(top, 0.0), np.where(top > PEAKED, peak, average))

    @cached_property
    def best(self) -> Amplitudes:
        """Of every place."""
        return self.refined(np.arange(len(self.basis.places)))

    def posterior(self, place: int) -> Posterior:
        """What the series at one place is, at its best sigma."""
        sigma = float(self.best.sigma[place])
        kept = sigma**2 / (1.0 + sigma**2 * self.strength[:, place])
        by_z, along = self.by_z[:, place], self.along[:, place]
        flat, flat_kept = by_z.reshape(-1, len(self.pull)), kept.reshape(-1)
        information = self.information - flat.T @ (flat_kept[:, None] * flat)
        dz = np.linalg.solve(information, self.pull - flat.T @ (flat_kept * along.reshape(-1)))
        mean = kept * (along - by_z @ dz)
        return Posterior(
            self.modes[:, place], mean, kept, kept[..., None] * by_z, np.asarray(np.linalg.cholesky(information))
        )


@dataclass(frozen=True)
class Posterior:
    """Mean and covariance of one place's series in B batches at K hats, parameters and nuisances integrated out."""

    modes: Array  # (B, K, K)
    mode_mean: Array  # (B, K)
    mode_var: Array  # (B, K), given the parameters
    by_z: Array  # (B, K, p) the modes' shift with dz
    z_root: Array  # (p, p) lower triangular, of dz's information

    @cached_property
    def mean(self) -> Array:
        """At the hats, (B, K)."""
        return np.asarray((self.modes @ self.mode_mean[..., None])[..., 0])

    @cached_property
    def sd(self) -> Array:
        """At the hats, (B, K)."""
        own = np.einsum("bkm,bm->bk", self.modes**2, self.mode_var)
        shift = np.linalg.solve(self.z_root, (self.modes @ self.by_z).reshape(-1, len(self.z_root)).T)
        return np.asarray(np.sqrt(own + (shift**2).sum(axis=0).reshape(own.shape)))

    def averages(self, weights: Array) -> tuple[Array, Array]:
        """Mean and sd (A,) of weighted sums over all batches' hats, weights (A, B, K)."""
        turned = np.moveaxis(np.moveaxis(weights, 0, 1) @ self.modes, 0, 1)
        own = ((turned**2) * self.mode_var).sum(axis=(1, 2))
        seen = turned.reshape(len(turned), -1) @ self.by_z.reshape(-1, len(self.z_root))
        shift = np.linalg.solve(self.z_root, seen.T)
        mean = (turned * self.mode_mean).sum(axis=(1, 2))
        return mean, np.asarray(np.sqrt(own + (shift**2).sum(axis=0)))


def _log(shared: Array) -> Array:
    """``(bᵀ A⁻¹ b - log det A) / 2`` of an information A with its pull b beside it (..., p + 1, p + 1)."""
    shared = shared.copy()
    shared[..., -1, -1] = CORNER  # whatever stands there, the row before it becomes the half-solved pull
    root = np.linalg.cholesky(shared)
    log_root = np.log(np.diagonal(root, 0, -2, -1)[..., :-1]).sum(axis=-1)
    return np.asarray(0.5 * (root[..., -1, :-1] ** 2).sum(axis=-1) - log_root)
