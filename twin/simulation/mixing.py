"""Acceleration of a fixed-point iteration over trajectories."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Mixing:
    """Anderson's acceleration of depth 2, batch by batch (Walker and Ni 2011, SIAM J. Numer. Anal. 49, 1715)."""

    def __init__(self, valid: NDArray[np.bool_], off: bool) -> None:
        self.valid, self.off = valid, off
        self.was: list[tuple[Array, Array]] = []  # changes of (what a round gives, what it changes), newest last
        self.last: tuple[Array, Array] | None = None

    def __call__(self, old: Array, new: Array) -> Array:
        """The next trajectory (n, P, B, m + 1) from the last one and what a round made of it."""
        if self.off:
            return new
        gap = np.where(self.valid, new - old, 0.0)
        if self.last is not None:
            self.was = [*self.was[-1:], (new - self.last[0], gap - self.last[1])]
        self.last = (new, gap)
        if not self.was:
            return new
        normal = np.stack([[np.einsum("npbm,npbm->pb", f, g) for _, g in self.was] for _, f in self.was])
        right = np.stack([np.einsum("npbm,npbm->pb", f, gap) for _, f in self.was])
        normal, right = np.moveaxis(normal, (0, 1), (-2, -1)), np.moveaxis(right, 0, -1)
        size = np.trace(normal, axis1=-2, axis2=-1)[..., None, None]
        ridge = 1e-12 * size + (size == 0)
        share = np.linalg.solve(normal + ridge * np.eye(len(self.was)), right[..., None])[..., 0]
        return np.asarray(new - sum(share[..., k, None] * self.was[k][0] for k in range(len(self.was))))
