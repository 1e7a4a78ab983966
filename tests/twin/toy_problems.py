"""Problems with known answers for the estimation mathematics."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from twin.calibration.least_squares import Block, Unknown

Model = Callable[[Array, int], tuple[Array, Array]]  # (x, batch) -> modelled (n,), derivative (n, p)


@dataclass
class ToyProblem:
    """Measured batches against a model plus `nuisance_design[b] @ nuisance`, noise sd 1 in every row."""

    unknowns: tuple[Unknown, ...]
    measured: list[Array]
    model: Model
    nuisance_design: list[Array] = field(default_factory=list)
    channel: list[NDArray[np.int64]] = field(default_factory=list)
    channels: tuple[str, ...] = ("bed",)
    linearised: int = 0

    def __post_init__(self) -> None:
        self.nuisance_design = self.nuisance_design or [np.zeros((len(m), 0)) for m in self.measured]
        self.channel = self.channel or [np.zeros(len(m), np.int64) for m in self.measured]

    @property
    def nuisance_sizes(self) -> tuple[int, ...]:
        return tuple(d.shape[1] for d in self.nuisance_design)

    def linearise(self, x: Array, nuisance: Sequence[Array]) -> Iterator[Block]:
        self.linearised += 1
        for b, measured in enumerate(self.measured):
            modelled, derivative = self.model(x, b)
            residual = measured - modelled - self.nuisance_design[b] @ nuisance[b]
            yield Block(f"b{b}", residual, derivative, self.nuisance_design[b], self.channel[b])

    def residuals(self, x: Array, nuisance: Sequence[Array]) -> list[Array]:
        return [m - self.model(x, b)[0] - self.nuisance_design[b] @ nuisance[b] for b, m in enumerate(self.measured)]


def unknowns(count: int, spread: float = 1.0) -> tuple[Unknown, ...]:
    """Log unknowns named p0, p1, … around 1."""
    return tuple(Unknown(f"p{i}", "W/K", 0.0, spread) for i in range(count))


def linear(designs: list[Array]) -> Model:
    return lambda x, b: (designs[b] @ x, designs[b])


def decay(times: Array, noise_sd: float) -> Model:
    """Two log parameters: rise ``a (1 − exp(−t / tau))``, in units of the noise."""

    def model(x: Array, b: int) -> tuple[Array, Array]:
        a, tau = np.exp(x)
        left = np.exp(-times / tau)
        rise = a * (1 - left) / noise_sd
        return rise, np.column_stack([rise, -a * left * times / tau / noise_sd])

    return model
