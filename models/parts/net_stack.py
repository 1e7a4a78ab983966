"""Training rows of many sequence nets as one rectangle, scaled so that all nets see numbers of one size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from models.base import Array
from models.parts.sequences import Sequences

_LEAST_SPREAD = 0.1  # inputs that hardly move (K, or the driver's unit) are not blown up to unit size
FEWEST_BATCHES = 3  # of fewer, none can be spared to tell whether a net helps
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

    @classmethod
    def joined(cls, stacks: Sequence[Self]) -> Self:
        """One stack of all nets; phases, inputs and steps must agree."""
        most = max(s.x.shape[-1] for s in stacks)

        def filled(values: Array) -> Array:
            return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, most - values.shape[-1])])

        x, rest, known = (
            np.concatenate([filled(v) for v in part], axis=1)
            for part in zip(*((s.x, s.rest, s.known) for s in stacks), strict=True)
        )
        n_batches, spread, sigma_um = (
            np.concatenate(part) for part in zip(*((s.n_batches, s.spread, s.sigma_um) for s in stacks), strict=True)
        )
        return cls(x, rest, known, n_batches, spread, sigma_um)

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


def alike(n_batches: Sequence[int], n_nets: Sequence[int], most: int) -> list[list[int]]:
    """Stacks to train as one: places in the order of their numbers of batches, cut where these are half as many again,
    where few batches become enough to tell whether a net helps, or where `most` batches are together."""
    groups: list[list[int]] = []
    size = 0
    for i in sorted(range(len(n_batches)), key=lambda i: n_batches[i]):
        least = n_batches[groups[-1][0]] if groups else 0
        size += n_batches[i] * n_nets[i]
        if not groups or size > most or n_batches[i] > 1.5 * least or least < FEWEST_BATCHES <= n_batches[i]:
            groups.append([])
            size = n_batches[i] * n_nets[i]
        groups[-1].append(i)
    return groups
