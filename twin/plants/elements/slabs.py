"""Boxes and faces along the axes, clipped and cut, with their Gauss points: all integrals over pieces of a machine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from twin.plants.casting import Array
from twin.plants.elements.box import Piece

GAUSS = (0.5 - 0.5 / np.sqrt(3.0), 0.5 + 0.5 / np.sqrt(3.0))
FLAT_M = 1e-9


@dataclass(frozen=True)
class Slabs:
    """F boxes from `low_m` to `high_m` (F, 3), those without thickness along an axis being faces; `sign` (F,)."""

    low_m: Array
    high_m: Array
    sign: Array

    def within(self, pieces: Sequence[Piece]) -> Slabs:
        """What of them lies in the pieces; where a piece counts negative, it is taken away."""
        parts = []
        for sign, under, over in pieces:
            low, high = np.maximum(self.low_m, under), np.minimum(self.high_m, over)
            parts.append(_kept(self, low, high, sign * self.sign))
        return joined(parts)

    def side(self, axis: int, end: int) -> Slabs:
        """Their faces at the lower (0) or upper (1) end of an axis."""
        low, high = self.low_m.copy(), self.high_m.copy()
        low[:, axis] = high[:, axis] = (high if end else low)[:, axis]
        return Slabs(low, high, self.sign)

    def cut(self, lines_m: Sequence[Array]) -> Slabs:
        """What of them lies within a grid, cut at its planes: functions of that grid are smooth on each."""
        out = self
        for axis, line in enumerate(lines_m):
            n = len(line) - 1
            whole = Slabs(*(np.repeat(a, n, axis=0) for a in (out.low_m, out.high_m, out.sign)))
            low, high, cell = whole.low_m.copy(), whole.high_m.copy(), np.tile(np.arange(n), len(out.sign))
            at = np.clip(np.searchsorted(line, low[:, axis], "right") - 1, 0, n - 1)
            flat = high[:, axis] - low[:, axis] <= FLAT_M
            low[:, axis] = np.maximum(low[:, axis], line[cell])
            high[:, axis] = np.where(flat & (at != cell), -np.inf, np.minimum(high[:, axis], line[cell + 1]))
            out = _kept(whole, low, high, whole.sign)
        return out

    def gauss(self) -> tuple[Array, Array]:
        """Two points along each axis (8 F, 3) and the volumes or areas they stand for (8 F,)."""
        sides_m = self.high_m - self.low_m
        size = self.sign * np.prod(np.where(sides_m > FLAT_M, sides_m, 1.0), axis=1) / 8.0
        points = [self.low_m + sides_m * np.array(where) for where in product(GAUSS, repeat=3)]
        return np.concatenate(points), np.tile(size, 8)


def joined(parts: Sequence[Slabs]) -> Slabs:
    """All of them."""
    return Slabs(*(np.concatenate([getattr(p, n) for p in parts]) for n in ("low_m", "high_m", "sign")))


def _kept(whole: Slabs, low: Array, high: Array, sign: Array) -> Slabs:
    """Without those of which nothing is left; a face may lie up to `FLAT_M` off."""
    flat = whole.high_m - whole.low_m <= FLAT_M
    thick = high - low
    keep = np.all(np.where(flat, thick > -FLAT_M, thick > FLAT_M), axis=1)
    return Slabs(np.where(flat, whole.low_m, low)[keep], np.where(flat, whole.high_m, high)[keep], sign[keep])
