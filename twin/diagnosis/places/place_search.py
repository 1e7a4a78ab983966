"""Places sought one after the other: what is found is held, as a nuisance of its own, while the next is sought."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from twin.calibration.annealing import SETTLED
from twin.calibration.fit_noise import Noise
from twin.calibration.fit_problem import Array
from twin.diagnosis.places.fit_rows import FitRows, Optimum
from twin.diagnosis.places.free_series import Basis, FreeSeries

SEEN = 5.0  # nats of evidence beyond the number of places: odds of 150 to 1
NOISE_ROUNDS = 5
MARGIN = 200.0  # nats that a rough amplitude may cost a place
REMAINS = 0.01  # of the first place's evidence: less may be what hats and linearisation leave of a strong effect


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
        """A free series at every place of each basis, beside what is held."""
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
        """The place of most evidence beside what is held, and its evidence in nats."""
        found: list[tuple[float, Held]] = []
        for i, series in enumerate(self.series(held)):
            places = series.promising(MARGIN, [h.place for h in held if h.basis == i])
            got = series.refined(places)
            for place, sigma, evidence in zip(places.tolist(), got.sigma, got.evidence, strict=True):
                found.append((float(evidence), Held(i, place, float(sigma))))
        evidence, best = max(found, key=lambda f: f[0])
        return best, evidence

    def forward(self, most: int) -> list[Held]:
        """Places taken one after the other while the evidence is beyond chance, each then tried against all others."""
        needed = SEEN + float(np.log(sum(len(b.places) for b in self.bases)))
        held: list[Held] = []
        while len(held) < most:
            new, evidence = self.best(held)
            if evidence < needed:
                break
            held.append(new)
            needed = max(needed, REMAINS * evidence)
            for k in range(len(held) if len(held) > 1 else 0):
                held[k], _ = self.best(held[:k] + held[k + 1 :])
        return held

    def optimum(self, held: Sequence[Held]) -> Optimum:
        """Of all unknowns beside what is held, under the noise that is left there.

        Hats miss what is switched between them: under too small a noise the parameters would make up for that.
        """
        series = [self.bases[h.basis].nuisance(h.place, h.sigma) for h in held]
        noise = self.noise
        for _ in range(NOISE_ROUNDS):
            found = self.fitted.optimum(series, noise.weight)
            if found.noise.change(noise) < SETTLED:
                break
            noise = found.noise
        return found

    def probabilities(self, held: Sequence[Held] = ()) -> list[Array]:
        """By basis each place's probability beside what is held; with that of nothing they sum to 1.

        Nothing and each kind are as likely beforehand, and within a kind each place.
        """
        log = [s.best.evidence - np.log(len(s.best.evidence)) for s in self.series(held)]
        total = np.logaddexp.reduce(np.concatenate([[0.0], *log]))
        return [np.asarray(np.exp(e - total)) for e in log]
