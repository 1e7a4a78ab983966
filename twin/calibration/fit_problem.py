"""Interface of the least-squares fit: unknowns with priors, noise, and problems linearised batch by batch."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from data.arrays import Array
from data.errors import InputError
from twin.calibration.whiteness import correlated_rows
from twin.quantity import Scale


@dataclass(frozen=True)
class Unknown:
    """One free parameter in fitting coordinates x: log of a positive value, logit of a share, a signed value itself.

    `prior` and `spread` are the prior's mean and standard deviation in x, `low` and `high` its bounds there
    (infinite where there is none); `unit` is the unit of the value, not of x.

    Raises:
        InputError: a prior that is not finite or lies outside its bounds, or a spread that is not positive.
    """

    name: str
    unit: str
    prior: float
    spread: float
    low: float = -math.inf
    high: float = math.inf
    scale: Scale = "log"

    def __post_init__(self) -> None:
        if not math.isfinite(self.prior):
            raise InputError(f"parameter {self.name!r}: its prior is {self.prior:g}, expected a finite number")
        if not (math.isfinite(self.spread) and self.spread > 0):
            raise InputError(
                f"parameter {self.name!r}: its prior spread is {self.spread:g}, expected a finite number above 0; "
                "give one, or make the parameter fixed"
            )
        if not (self.low < self.high and self.low <= self.prior <= self.high):
            raise InputError(
                f"parameter {self.name!r}: its value {self.value(self.prior):g} {self.unit} lies outside its bounds "
                f"{self.value(self.low):g} … {self.value(self.high):g}; widen the bounds or correct the value"
            )

    def value(self, x: float) -> float:
        """The parameter's value in its own unit at the fitting coordinate x."""
        if self.scale == "log":
            return math.exp(x) if x < 709 else math.inf
        return float(expit(x)) if self.scale == "logit" else float(x)


def x_of(unknowns: Sequence[Unknown], z: Array) -> Array:
    """Fitting coordinates x (p,) at z (p,), never outside the bounds by rounding."""
    prior, spread, low, high = np.array([(u.prior, u.spread, u.low, u.high) for u in unknowns]).reshape(-1, 4).T
    return np.clip(prior + spread * z, low, high)


def z_bounds(unknowns: Sequence[Unknown]) -> tuple[Array, Array]:
    """Lower and upper bounds in z, (p,) each."""
    low = np.array([(u.low - u.prior) / u.spread for u in unknowns])
    return low, np.array([(u.high - u.prior) / u.spread for u in unknowns])


@dataclass(frozen=True)
class Block:
    """One batch, whitened (divided by the noise's standard deviation), rows in time order within each channel.

    `residual` (n,) measured − modelled, NaN rows removed; `jacobian` (n, p) d(modelled)/dx; `nuisance` (n, q)
    d(modelled)/d(nuisance) for nuisances of prior N(0, 1); `channel` (n,) the index of the output channel.
    """

    batch_id: str
    residual: Array
    jacobian: Array
    nuisance: Array
    channel: NDArray[np.int64]


class Problem(Protocol):
    """What `fit` needs. Batches come in the same order and with the same rows every time.

    `nuisance_sizes` gives q of each batch. Either method may raise `WorkError` or give numbers that are not finite
    where the simulation fails: the step there is rejected. `linearise` may be a generator: one block lives at a time.
    """

    @property
    def unknowns(self) -> tuple[Unknown, ...]: ...

    @property
    def channels(self) -> tuple[str, ...]: ...

    @property
    def nuisance_sizes(self) -> tuple[int, ...]: ...

    def linearise(self, x: Array, nuisance: Sequence[Array]) -> Iterable[Block]:
        """A block per batch at x (p,) and the batches' nuisances (q_b,)."""

    def residuals(self, x: Array, nuisance: Sequence[Array]) -> Iterable[Array]:
        """Measured − simulated (n_b,) of every batch in given noises."""


@dataclass(frozen=True)
class Noise:
    """Per channel (c,): `factor` on the given standard deviation, at least 1, and `inflation`, the rows that count as
    one. A row's information is divided by ``factor² inflation``, so a smooth misfit does not pass for thousands of
    independent samples. Misfit that several channels share is not seen: each channel is judged alone.
    """

    factor: Array
    inflation: Array

    @classmethod
    def as_given(cls, channels: int) -> Noise:
        return cls(np.ones(channels), np.ones(channels))

    @property
    def weight(self) -> Array:
        """What a row's squared whitened residual counts, (c,)."""
        return np.asarray(1.0 / (self.factor**2 * self.inflation))

    def change(self, other: Noise) -> float:
        """The largest relative change of a channel's weight against another."""
        return float(np.max(np.abs(self.weight / other.weight - 1.0), initial=0.0))


def estimate(
    residuals: Iterable[Array], channels: Sequence[NDArray[np.int64]], n_channels: int, parameters: float
) -> Noise:
    """The noise of each channel from whitened residuals and their channels, one (n_b,) array of each per batch.

    `parameters` is the effective number that the fit has taken from the rows; it is spread over the channels by rows.
    """
    series: list[list[Array]] = [[] for _ in range(n_channels)]
    for residual, channel in zip(residuals, channels, strict=True):
        for c in np.unique(channel):
            series[c].append(residual[channel == c])
    rows = sum(len(c) for c in channels)
    left = max(1.0 - parameters / max(1, rows), 0.1)  # the noise of a nearly saturated fit is hardly determined
    factor, inflation = np.ones(n_channels), np.ones(n_channels)
    for c, parts in enumerate(series):
        n = sum(map(len, parts))
        if n:
            factor[c] = max(1.0, np.sqrt(sum(float(r @ r) for r in parts) / (n * left)))
            inflation[c] = correlated_rows(parts)
    return Noise(factor, inflation)
