"""Training rows of many sequence nets as one rectangle, scaled so that all nets see numbers of one size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from models.base import Array
from models.parts.sequences import Sequences

_LEAST_SPREAD = 0.1  # inputs that hardly move (K, or the driver's unit) are not blown up to unit size
_LEAST_REST = 1e-3  # of the target's size: below, the linear part leaves rounding only


@dataclass(frozen=True)
class Stack:
    """Rows of S nets: x (R, S, p, T, B), rest and known (R, S, T, B), n_batches (S,).

    R phases, T steps and B batches, filled up with batches of which nothing is known. x is the input over its rms
    `spread` (S, p), `rest` what the linear part leaves over its rms `sigma_um` (S,), both over the known rows.
    """

    x: Array
    rest: Array
    known: Array
    n_batches: Array
    spread: Array
    sigma_um: Array

    @classmethod
    def of(cls, sequences: Sequences, folds: Sequence[Sequence[int]], rest_um: Array) -> Self:
        """Folds of a design's batches; `rest_um` (K, R, T, F) is the target less each fold's linear part."""
        n_batches = np.array([len(fold) for fold in folds])
        most = int(n_batches.max())
        batch = np.array([[*fold, *fold[:1] * (most - len(fold))] for fold in map(list, folds)])
        real = np.arange(most) < n_batches[:, None]
        known = sequences.known[batch] & real[:, :, None, None]
        count = known.sum(axis=(1, 2, 3))

        def rms(values: Array) -> Array:
            return np.asarray(np.sqrt(np.where(known, values**2, 0.0).sum(axis=(1, 2, 3)) / count))

        x = sequences.x[batch]
        spread = np.sqrt(np.einsum("sbrtp,sbrt->sp", x**2, known) / count[:, None])
        spread = np.maximum(spread, _LEAST_SPREAD)
        rest = np.where(known, rest_um[batch, :, :, np.arange(len(folds))[:, None]], 0.0)
        sigma_um = np.maximum(rms(rest), _LEAST_REST * rms(sequences.y_um[batch]))
        sigma_um = np.where(sigma_um > 0, sigma_um, 1.0)
        x = x / spread[:, None, None, None]
        rest = rest / sigma_um[:, None, None, None]
        return cls(np.ascontiguousarray(x.transpose(2, 0, 4, 3, 1)), np.ascontiguousarray(rest.transpose(2, 0, 3, 1)),
                   known.transpose(2, 0, 3, 1).astype(float), n_batches, spread, sigma_um)  # fmt: skip

    def halves(self) -> Self:
        """Twice the nets: first each with its batches of even place, then each with those of odd place."""
        filled = [(0, self.x.shape[-1] % 2)]
        x, rest, known = (
            np.concatenate([v[..., 0::2], np.pad(v, [(0, 0)] * (v.ndim - 1) + filled)[..., 1::2]], axis=1)
            for v in (self.x, self.rest, self.known)
        )
        n_batches = np.concatenate([(self.n_batches + 1) // 2, self.n_batches // 2])
        return type(self)(x, rest, known, n_batches, np.tile(self.spread, (2, 1)), np.tile(self.sigma_um, 2))

    def unit_directions(self, directions: Array) -> Array:
        """Directions (h, p) as (S, h, p), each scaled so that its sum has rms 1 over a net's known rows."""
        along = np.einsum("hp,rsptb->rshtb", directions, self.x) * self.known[:, :, None]
        rms = np.sqrt((along**2).sum(axis=(0, 3, 4)) / self.known.sum(axis=(0, 2, 3))[:, None])
        return np.asarray(directions / np.where(rms > 0, rms, 1.0)[:, :, None])
