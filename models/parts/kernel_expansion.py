"""Models that are sums of kernels over support rows: what LS-SVM and SVR have in common."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import NDArray

from features.decimation import even_rows
from features.design import Design
from models.base import Array, Family
from models.batchwise import by_batch

Rows = NDArray[np.int64]
SCALES = {"K": 10.0, "degC": 10.0, "K/h": 10.0, "rpm": 1000.0, "mm/min": 1000.0}
LINEAR_WEIGHT = 10.0  # at equal weight the RBF takes half of every slope, and keeps it at home
_OTHER_SCALE = 10.0  # inputs without a known unit are taken for rises
_ROWS_AT_ONCE = 128  # of a prediction: its kernel stays in a processor's cache


class KernelExpansion(Family):
    """`ŷ(u) = b + Σ_s α_s k(u_s, u)`, u the p inputs over a fixed scale per unit (`SCALES`).

    `k(u, v) = exp(−|u − v|²/(2 p σ²))`, plus `10 u·v/p` with `linear`. `fitted` has support (s, p), alpha (s,), bias,
    sigma and scale (p,).
    """

    closed_form = False
    linear: bool

    def predict_design(self, design: Design, batches: Sequence[int]) -> list[Array]:
        f = self.fitted
        scale, support, alpha = (np.asarray(f[k], float) for k in ("scale", "support", "alpha"))
        out = []
        for k in batches:
            u = design.x[design.rows(k)] / scale
            parts = [
                kernel(u[i : i + _ROWS_AT_ONCE], support, f["sigma"], self.linear) @ alpha
                for i in range(0, len(u), _ROWS_AT_ONCE)
            ]
            out.append(np.concatenate([*parts, np.empty(0)]) + f["bias"])
        return out

    def predict_folds(
        self, design: Design, fitted: Sequence[Self], wanted: Sequence[Sequence[int]]
    ) -> list[list[Array]]:
        """Models that share σ share the kernel of their united support rows."""
        out = np.empty((len(design.x), len(fitted)))
        asked = np.flatnonzero(np.isin(design.group, sorted({k for batches in wanted for k in batches})))
        by_kernel: dict[tuple[float, bytes], list[int]] = {}
        for f, m in enumerate(fitted):
            by_kernel.setdefault((m.fitted["sigma"], np.asarray(m.fitted["scale"]).tobytes()), []).append(f)
        for (sigma, _), members in by_kernel.items():
            models = [fitted[f] for f in members]
            support, place = _united([np.atleast_2d(m.fitted["support"]) for m in models])
            alpha = np.zeros((len(support), len(members)))
            for c, m in enumerate(models):
                np.add.at(alpha[:, c], place[c], m.fitted["alpha"])
            scale = np.asarray(models[0].fitted["scale"], float)
            bias = np.array([m.fitted["bias"] for m in models])
            for start in range(0, len(asked), _ROWS_AT_ONCE):
                some = asked[start : start + _ROWS_AT_ONCE]
                values = kernel(design.x[some] / scale, support, sigma, self.linear) @ alpha + bias
                out[some[:, None], members] = values
        return by_batch(design, out, wanted)

    def n_parameters(self) -> int:
        return int(np.size(self.fitted["alpha"])) + 3


def kernel(u: Array, v: Array, sigma: float, linear: bool) -> Array:
    """Ω (n, m) of scaled inputs u (n, p), v (m, p); NaN rows give NaN."""
    return kernel_of(*products(u, v), sigma, linear)


def products(u: Array, v: Array) -> tuple[Array, Array]:
    """−|u_i − v_j|²/(2p), never above 0, and u_i·v_j/p: all that a kernel needs besides σ."""
    p = max(1, u.shape[1])
    dot = u @ v.T / p
    half = dot - (u**2).sum(axis=1)[:, None] / (2.0 * p)
    half -= (v**2).sum(axis=1) / (2.0 * p)
    return np.minimum(half, 0.0, out=half), dot


def kernel_of(half: Array, dot: Array, sigma: float, linear: bool) -> Array:
    """Ω (n, m) from what `products` gives."""
    omega: Array = half / sigma**2
    np.exp(omega, out=omega)
    if linear:
        omega += LINEAR_WEIGHT * dot
    return omega


def unit_scale(design: Design) -> Array:
    """What inputs are divided by for their unit, (p,): the same in every fold."""
    units = design.input_units or ("",) * len(design.inputs)
    return np.array([SCALES.get(u, _OTHER_SCALE) for u in units])


def evenly(design: Design, batches: Sequence[int], most: int) -> Rows:
    """Numbers of at most `most` usable rows of each batch, evenly over them."""
    return np.concatenate([np.empty(0, np.int64), *(even_rows(design, k, most) for k in batches)])


def _united(supports: Sequence[Array]) -> tuple[Array, list[Rows]]:
    """Distinct support rows and where each model's lie among them."""
    stacked = np.concatenate(supports)
    keys = np.ascontiguousarray(stacked).view(np.dtype((np.void, stacked.shape[1] * 8)))[:, 0]
    _, first, place = np.unique(keys, return_index=True, return_inverse=True)
    borders = np.cumsum([len(s) for s in supports])[:-1]
    return stacked[first], np.split(place, borders)
