"""A quantity over a range by its values at a few evenly spaced points: the smooth course through them."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from twin.mechanisms.base import Array, real


def course(share: Array, *values: Array) -> Array:
    """The natural cubic spline through `values` at shares 0 … 1 of the range; beyond its ends, the end's value.

    All arguments broadcast. Linear in the values, so that a fit of them stays easy; equal values give exactly
    themselves.
    """
    inside = np.where(real(share) < 0, 0.0, np.where(real(share) > 1, 1.0, share))
    points = inside * (len(values) - 1)
    piece = np.minimum(np.floor(real(points)).astype(int), len(values) - 2)
    beyond = points - piece
    out = values[0]
    for value, (cubic, square, slope, constant) in zip(values[1:], _pieces(len(values))[1:, :, piece], strict=True):
        weight = ((cubic * beyond + square) * beyond + slope) * beyond + constant
        out = out + weight * (value - values[0])
    return np.asarray(out)


@cache
def _pieces(n: int) -> NDArray[np.float64]:
    """Coefficients (n, 4, n - 1): what each value adds, by power from the third down and by piece."""
    return np.moveaxis(CubicSpline(np.arange(n), np.eye(n), bc_type="natural").c, -1, 0)
