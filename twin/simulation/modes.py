"""Thermal modes of a linear network: independent first-order lags, and the exact weights of a driven one.

C dT/dt = -K T + q(t) becomes dz/dt = -rate z + w(t) with T = shape z (Özisik 1993, Heat Conduction, ch. 13).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data.errors import InputError

Array = NDArray[np.float64]

_ASYMMETRY = 1e-9  # of the largest conductance; above it the matrix is no heat exchange between nodes
_SERIES = [float(1.0 / np.prod(np.arange(1.0, k + 3.0))) for k in range(19)]  # 1/(k + 2)!, enough for x <= 1


@dataclass(frozen=True)
class Modes:
    """Modes of P parameter sets in R regimes of a network of N nodes, slowest first.

    `rate_per_s` (P, R, N) are the decay rates, `shape` (P, R, N, N) has the modes as columns (T = shape z)
    and `inverse` (P, R, N, N) takes temperatures to modal amplitudes (z = inverse T).
    """

    rate_per_s: Array
    shape: Array
    inverse: Array

    @property
    def n_sets(self) -> int:
        return self.rate_per_s.shape[0]

    @property
    def n_regimes(self) -> int:
        return self.rate_per_s.shape[1]

    @property
    def n_nodes(self) -> int:
        return self.rate_per_s.shape[2]

    def time_constants_s(self, regime: int | None = None) -> Array:
        """Time constants, s, slowest first: (P, R, N), or (P, N) of one regime. inf: the mode never decays."""
        rate = self.rate_per_s if regime is None else self.rate_per_s[:, regime]
        with np.errstate(divide="ignore"):
            return np.asarray(1.0 / rate)

    def of_sets(self, sets: slice) -> Modes:
        """The modes of some parameter sets; of the only one, if there is only one."""
        if self.n_sets == 1:
            return self
        return Modes(self.rate_per_s[sets], self.shape[sets], self.inverse[sets])

    def of_regimes(self, numbers: NDArray[np.int64]) -> Modes:
        """The modes of some regimes, which may repeat."""
        return Modes(self.rate_per_s[:, numbers], self.shape[:, numbers], self.inverse[:, numbers])


def modes_of(capacity_J_per_K: Array, conductance_W_per_K: Array) -> Modes:
    """Modes from heat capacities (P, N) and symmetric, positive semidefinite conductance matrices (P, R, N, N).

    A rate below N times the rounding of the fastest one counts as 0, so that a closed network keeps its energy.

    Raises:
        InputError: shapes that disagree, a capacity that is not positive and finite, a conductance matrix that
            is not finite, not symmetric or has a negative eigenvalue (a link that carries heat uphill).
    """
    capacity, conductance = np.asarray(capacity_J_per_K, float), np.asarray(conductance_W_per_K, float)
    _check(capacity, conductance)
    root = np.sqrt(capacity)[:, None, :]
    # the lower triangle alone would be read by eigh: average, so that rounding cannot depend on the node order
    scaled = 0.5 * (conductance + conductance.swapaxes(-1, -2)) / (root[..., :, None] * root[..., None, :])
    rate, vector = np.linalg.eigh(scaled)
    size = np.abs(rate).max(axis=-1, keepdims=True)
    if (rate < -1e-9 * size).any():
        p, r, n = (int(i) for i in np.unravel_index(np.argmin(rate / np.maximum(size, 1e-300)), rate.shape))
        raise InputError(
            f"parameter set {p}, regime {r}: the conductance matrix has a mode that grows at {-rate[p, r, n]:.3g} /s, "
            "expected every mode to decay; look for a negative conductance"
        )
    rate = np.where(rate <= rate.shape[-1] * np.finfo(float).eps * size, 0.0, rate)
    shape = vector / root[..., :, None]
    inverse = np.ascontiguousarray(vector.swapaxes(-1, -2) * root[..., None, :])
    return Modes(rate, shape, inverse)


def first_order_hold(rate_per_s: Array, dt_s: Array | float) -> tuple[Array, Array, Array]:
    """Decay and weights of one interval: z+ = decay z + p_start w_start + p_end w_end, w linear in between.

    Exact to a few roundings for every rate * dt >= 0, also 0: p_start = p_end = dt / 2. The arguments broadcast;
    the weights are in s. Source: phi functions of Hochbruck and Ostermann (2010), Acta Numerica 19, eq. 2.11.
    """
    dt = np.asarray(dt_s, float)
    x = np.asarray(rate_per_s * dt, float)
    decay = np.exp(-x)
    large = np.maximum(x, 1.0)
    start = (1.0 - np.exp(-large) * (1.0 + large)) / large**2
    end = (large + np.expm1(-large)) / large**2
    # below x = 1 the differences above cancel; there the Taylor series, by Horner's rule
    small = np.minimum(x, 1.0)
    start_series, end_series = np.zeros_like(x), np.zeros_like(x)
    for k in range(len(_SERIES) - 1, -1, -1):
        end_series = _SERIES[k] - small * end_series
        start_series = (k + 1) * _SERIES[k] - small * start_series
    return decay, dt * np.where(x < 1.0, start_series, start), dt * np.where(x < 1.0, end_series, end)


def _check(capacity: Array, conductance: Array) -> None:
    if capacity.ndim != 2 or conductance.ndim != 4 or conductance.shape[-2:] != (capacity.shape[1],) * 2:
        raise InputError(
            f"modes: got capacities of shape {capacity.shape} and conductances of shape {conductance.shape}, "
            "expected (sets, nodes) and (sets, regimes, nodes, nodes)"
        )
    if len(capacity) != len(conductance) and 1 not in (len(capacity), len(conductance)):
        raise InputError(
            f"modes: got {len(capacity)} sets of capacities and {len(conductance)} of conductances, expected as many"
        )
    bad = ~(np.isfinite(capacity) & (capacity > 0.0))
    if bad.any():
        p, n = (int(i[0]) for i in np.nonzero(bad))
        raise InputError(
            f"parameter set {p}, node {n}: heat capacity is {capacity[p, n]:g} J/K, expected a positive, finite "
            "number; check the node's capacity, or its mass and material"
        )
    bad = ~np.isfinite(conductance)
    if bad.any():
        p, r, i, k = (int(i[0]) for i in np.nonzero(bad))
        raise InputError(
            f"parameter set {p}, regime {r}, nodes {i} and {k}: conductance is {conductance[p, r, i, k]:g} W/K, "
            "expected a finite number; check the links and exposures of these nodes"
        )
    gap = np.abs(conductance - conductance.swapaxes(-1, -2))
    if (gap > _ASYMMETRY * np.abs(conductance).max(axis=(-2, -1), keepdims=True)).any():
        p, r, i, k = (int(i) for i in np.unravel_index(np.argmax(gap), gap.shape))
        raise InputError(
            f"parameter set {p}, regime {r}, nodes {i} and {k}: conductances {conductance[p, r, i, k]:g} and "
            f"{conductance[p, r, k, i]:g} W/K, expected a symmetric matrix; "
            "heat that flows one way only is a source, not a link"
        )
