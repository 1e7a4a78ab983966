"""A free smooth series at a place, each batch its own: how far it explains what a calibration left, and what it is.

The series is a Gaussian process on hats (Rasmussen and Williams 2006, eq. 2.30): amplitude sigma by the marginal
likelihood, correlation falling with exp(-t / 1.5 h), so that it may jump where something is switched.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky

from data.arrays import Array
from data.errors import WorkError
from diagnosis.localisation.linearised import FitRows, ForcedNetwork, Hats, Optimum, on_channels
from diagnosis.policy import POLICY
from twin.calibration.fit_problem import Noise
from twin.calibration.least_squares import CONVERGED
from twin.calibration.problem import CalibrationProblem

Indices = NDArray[np.int64]
Kind = Literal["heat", "displacement", "sensor"]

# Of the best seen mode's signal against its noise, in sd: below the first nothing is seen, above the last all is.
SIGNAL_TO_NOISE_GRID = np.geomspace(0.3, 3e4, 9)
LOG_GRID_RANGE = float(np.log(SIGNAL_TO_NOISE_GRID[-1] / SIGNAL_TO_NOISE_GRID[0]))
STEP_HALVINGS = 3  # of the step between strengths
UNUSED_CORNER = 1e300


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
        return np.asarray(cholesky(np.exp(-gap_s / POLICY.series_correlation_s), lower=True))

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
    """A basis with the parameters, of `information` (p, p) and `pull` (p,), in modes: a batch's independent hats.

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
        """Information with the pull as last row and column, (p + 1, p + 1)."""
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
        sigma = SIGNAL_TO_NOISE_GRID[:, None] / np.sqrt(np.where(best > 0, best, np.inf))
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
        step = float(np.log(SIGNAL_TO_NOISE_GRID[1] / SIGNAL_TO_NOISE_GRID[0]))
        for _ in range(STEP_HALVINGS):
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
        peak = top + np.log(np.minimum(width / LOG_GRID_RANGE, 1.0))
        average = np.logaddexp.reduce(gain, axis=0) - np.log(len(gain))
        return Amplitudes(
            np.where(top > 0, best, 0.0), np.maximum(top, 0.0), np.where(top > POLICY.peaked_gain_nats, peak, average)
        )

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
    """``(bᵀ A⁻¹ b - log det A) / 2`` of an information A with its pull b as last row and column (..., p + 1, p + 1)."""
    shared = shared.copy()
    shared[..., -1, -1] = UNUSED_CORNER  # whatever its value, the row before it becomes the half-solved pull
    root = np.linalg.cholesky(shared)
    log_root = np.log(np.diagonal(root, 0, -2, -1)[..., :-1]).sum(axis=-1)
    return np.asarray(0.5 * (root[..., -1, :-1] ** 2).sum(axis=-1) - log_root)


@dataclass(frozen=True)
class Held:
    """A place, by the numbers of its basis and in it, whose series has an amplitude sigma."""

    basis: int
    place: int
    sigma: float

    @property
    def at(self) -> tuple[int, int]:
        return self.basis, self.place


@dataclass(frozen=True)
class PlaceSearch:
    """Every place of some bases under one noise; free series are worked out once for what is held."""

    fitted: FitRows
    bases: tuple[Basis, ...]
    noise: Noise
    _known: dict[tuple[Held, ...], tuple[FreeSeries, ...]] = field(default_factory=dict, repr=False, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        """Without what is long and quickly worked out anew."""
        return {"fitted": self.fitted, "bases": self.bases, "noise": self.noise, "_known": {}}

    @cached_property
    def grams(self) -> Array:
        """Every batch's Gram matrix (B, C, C) of all hats, place by place and basis by basis, and of [J r]."""
        return np.stack([
            self.fitted.gram(b, [x.rows[b].reshape(-1, x.rows[b].shape[-1]) for x in self.bases], self.noise.weight)
            for b in range(len(self.fitted.blocks))
        ])  # fmt: skip

    def columns(self, basis: int, place: int) -> slice:
        """Of one place's hats in `grams`."""
        first = sum(len(b.places) * len(b.hats.knot_s) for b in self.bases[:basis])
        count = len(self.bases[basis].hats.knot_s)
        return slice(first + place * count, first + (place + 1) * count)

    def shadow(self, held: Sequence[Held]) -> Array:
        """V (B, ·, C): ``grams - Vᵀ V`` is free of the series held, too."""
        if not held:
            return np.zeros((len(self.grams), 0, self.grams.shape[-1]))
        rows = []
        for h in held:
            rows.append(h.sigma * self.bases[h.basis].root.T @ self.grams[:, self.columns(*h.at)])
        seen = np.concatenate(rows, axis=1)
        own = [h.sigma * seen[..., self.columns(*h.at)] @ self.bases[h.basis].root for h in held]
        inner = np.concatenate(own, axis=-1)
        return np.asarray(np.linalg.solve(np.linalg.cholesky(np.eye(inner.shape[-1]) + inner), seen))

    def series(self, held: Sequence[Held] = ()) -> tuple[FreeSeries, ...]:
        """A free series at every place of each basis, given what is held."""
        key = tuple(sorted(held, key=lambda h: h.at))
        if key not in self._known:
            self._known[key] = tuple(self._series(key))
        return self._known[key]

    def _series(self, held: Sequence[Held]) -> list[FreeSeries]:
        z = slice(-len(self.fitted.z) - 1, None)
        shadow = self.shadow(held)
        shared = self.grams[:, z, z] - np.swapaxes(shadow[..., z], -1, -2) @ shadow[..., z]
        information, pull = self.fitted.shared(shared.sum(axis=0))
        out = []
        for i, basis in enumerate(self.bases):
            own, seen = [], []
            for k in range(len(basis.places)):
                at = self.columns(i, k)
                turned = np.swapaxes(shadow[..., at], -1, -2)
                own.append(self.grams[:, at, at] - turned @ shadow[..., at])
                seen.append(self.grams[:, at, z] - turned @ shadow[..., z])
            out.append(FreeSeries.of(basis, np.stack(own, axis=1), np.stack(seen, axis=1), information, pull))
        return out

    def best(self, held: Sequence[Held]) -> tuple[Held, float]:
        """The place of most evidence given what is held, and its evidence in nats."""
        found: list[tuple[float, Held]] = []
        for i, series in enumerate(self.series(held)):
            places = series.promising(POLICY.rough_amplitude_margin_nats, [h.place for h in held if h.basis == i])
            got = series.refined(places)
            for place, sigma, evidence in zip(places.tolist(), got.sigma, got.evidence, strict=True):
                found.append((float(evidence), Held(i, place, float(sigma))))
        evidence, best = max(found, key=lambda f: f[0])
        return best, evidence

    def forward(self, most: int) -> list[Held]:
        """Places taken one after the other while the evidence is beyond chance, each then tried against all others."""
        needed = POLICY.place_min_evidence_nats + float(np.log(sum(len(b.places) for b in self.bases)))
        held: list[Held] = []
        while len(held) < most:
            new, evidence = self.best(held)
            if evidence < needed:
                break
            held.append(new)
            needed = max(needed, POLICY.place_min_evidence_share * evidence)
            for k in range(len(held) if len(held) > 1 else 0):
                held[k], _ = self.best(held[:k] + held[k + 1 :])
        return held

    def optimum(self, held: Sequence[Held]) -> Optimum:
        """Of all unknowns given what is held, under the noise that is left there.

        Hats miss what is switched between them: under too small a noise the parameters would make up for that.
        """
        series = [self.bases[h.basis].nuisance(h.place, h.sigma) for h in held]
        noise = self.noise
        for _ in range(POLICY.place_noise_rounds):
            found = self.fitted.optimum(series, noise.weight)
            if found.noise.change(noise) < CONVERGED:
                break
            noise = found.noise
        return found

    def probabilities(self, held: Sequence[Held] = ()) -> list[Array]:
        """By basis the probability (places,) of each place given what is held; with that of nothing they sum to 1.

        Nothing and each kind are as likely beforehand, and within a kind each place.
        """
        log = [s.best.evidence - np.log(len(s.best.evidence)) for s in self.series(held)]
        total = np.logaddexp.reduce(np.concatenate([[0.0], *log]))
        return [np.asarray(np.exp(e - total)) for e in log]


@dataclass(frozen=True)
class Point:
    """A network linearised at parameters x (p,) and nuisances by batch, and the search there.

    A calibration that lacks an effect bends its parameters. Given what is found they move back, without the effect in
    the network: its own response then stays what it is, and does not trade its size against capacities.
    """

    problem: CalibrationProblem
    x: Array
    nuisance: tuple[Array, ...]
    hats: Hats
    forced: ForcedNetwork
    search: PlaceSearch
    last_step: float = np.inf  # prior sd of the parameter that moved most to come here

    @classmethod
    def of(cls, problem: CalibrationProblem, x: Array, nuisance: Sequence[Array], hats: Hats, noise: Noise) -> Point:
        """Linearised anew.

        Raises:
            WorkError: the simulation fails there.
        """
        forced = ForcedNetwork.of(problem, x, nuisance)
        search = PlaceSearch(FitRows.of(problem, x, nuisance), tuple(_bases(problem, forced, hats)), noise)
        return cls(problem, x, tuple(nuisance), hats, forced, search)

    @property
    def converged(self) -> bool:
        return self.last_step < POLICY.linear_step_converged_sd

    def moved(self, held: Sequence[Held]) -> Point:
        """To the optimum given what is held, with the residual noise there; with nothing held, only the noise."""
        optimum = self.search.optimum(held)
        here = replace(self, search=PlaceSearch(self.search.fitted, self.search.bases, optimum.noise), last_step=0.0)
        if not held:
            return here
        step = float(np.abs(optimum.dz).max(initial=0.0))
        dz = optimum.dz * min(1.0, POLICY.linear_step_max_sd / max(step, 1e-9))
        low, high = np.array([(u.low, u.high) for u in self.problem.unknowns]).T
        x = np.clip(self.x + self.search.fitted.spread * dz, low, high)
        nuisance = [v[:q] for v, q in zip(optimum.nuisance, self.problem.nuisance_sizes, strict=True)]
        try:
            return replace(Point.of(self.problem, x, nuisance, self.hats, optimum.noise), last_step=step)
        except WorkError:  # too far: what was found is kept
            return here


def _bases(problem: CalibrationProblem, forced: ForcedNetwork, hats: Hats) -> Iterator[Basis]:
    network, sensors = problem.network, len(problem.network.readings)
    errors = range(sensors, len(problem.channels))
    yield Basis("heat", tuple(network.bodies), ("W",) * len(network.bodies), hats, forced.responses(hats))
    if len(errors):
        yield Basis("displacement", *_named(problem, errors), hats, on_channels(problem, hats, errors))
    if sensors:
        yield Basis("sensor", *_named(problem, range(sensors)), hats, on_channels(problem, hats, range(sensors)))


def _named(problem: CalibrationProblem, channels: Sequence[int]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    return tuple(problem.channels[c] for c in channels), tuple(problem.units[c] for c in channels)
