"""The compiled network: a machine file's twin part as arrays, with every number traced to a named parameter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.errors import InputError, closest
from twin.mechanisms.base import Mechanism
from twin.quantity import Monomial, Parameter, values_of


@dataclass(frozen=True)
class Port:
    """A temperature that a law needs: of cells (weights (N,), sum 1) or, where `cells` is None, of a surrounding."""

    cells: Array | None
    surrounding: int = -1


@dataclass(frozen=True)
class Law:
    """A mechanism at work: parameter numbers by name, driver channels and ports by the law's own names for them.

    A `disabled` law has its null values, at which it has no effect: it costs a simulation nothing, and the derivatives
    by its parameters are its first-order response. A diagnosis thus screens all candidates in one pass.
    """

    name: str
    mechanism: Mechanism
    parameters: Mapping[str, int]
    drivers: Mapping[str, str]
    ports: Mapping[str, Port]
    disabled: bool = False

    @property
    def temperature_dependent(self) -> bool:
        return bool(self.ports)


@dataclass(frozen=True)
class Outlet:
    """Where a heat law's watts go: weights over cells (N,), the share of them (a parameter, or the rest to 1)."""

    cells: Array
    share: int | None = None  # parameter number; None: `rest`
    place: str = ""


@dataclass(frozen=True)
class Heat:
    """A heat source: a law, its outlets, the laws that multiply it, and the cells (N,) that lose its watts, if any.

    `bent` is a reference in W and an exponent: what the law says counts as reference · (watts / reference)^exponent,
    for machines whose heat grows with its drivers by another power.
    """

    law: Law
    outlets: tuple[Outlet, ...]
    factors: tuple[Law, ...] = ()
    taken: Array | None = None
    bent: tuple[float, float] = (1.0, 1.0)

    @property
    def disabled(self) -> bool:
        """Whether its watts do not count: some law of it is a candidate's."""
        return self.law.disabled or any(f.disabled for f in self.factors)

    @property
    def temperature_dependent(self) -> bool:
        return self.law.temperature_dependent or any(f.temperature_dependent for f in self.factors)

    def direction(self, values: Array) -> Array:
        """Cells' shares (..., N) of one watt, at parameter values (..., n)."""
        out = np.zeros((*values.shape[:-1], len(self.outlets[0].cells)))
        if self.taken is not None:
            out -= self.taken
        rest = np.ones(values.shape[:-1])
        for outlet in self.outlets:
            if outlet.share is not None:
                out += values[..., outlet.share, None] * outlet.cells
                rest = rest - values[..., outlet.share]
        for outlet in self.outlets:
            if outlet.share is None:
                out += rest[..., None] * outlet.cells
        return out

    def direction_slope(self, j: int) -> Array:
        """Derivative (N,) of `direction` by parameter j's value: it is affine in the shares."""
        out = np.zeros(len(self.outlets[0].cells))
        for outlet in self.outlets:
            if outlet.share == j:
                out += outlet.cells
                out -= sum((o.cells for o in self.outlets if o.share is None), np.zeros_like(out))
        return out


@dataclass(frozen=True)
class Edge:
    """A conductance between two places: heat ``G f (direction · T)`` leaves along `direction` (N,), sum 0.

    With a `surrounding` it is an exposure instead: ``G f (T_surrounding - direction · T)`` enters along `direction`,
    whose weights sum to 1. `factors` number the network's factor laws that multiply G.
    """

    name: str
    direction: Array
    conductance: Monomial
    factors: tuple[int, ...] = ()
    surrounding: int | None = None


@dataclass(frozen=True)
class CompiledSurrounding:
    """A surrounding: recorded `channel`, constant parameter `value`, or mean `first` reading; plus offset and laws.

    With `follow` (a parameter's number) it is value + follow (first - value).
    """

    name: str
    channel: str | None = None
    value: int | None = None
    first: tuple[str, ...] = ()
    follow: int | None = None
    offset: int | None = None
    per_batch_K: float = 0.0  # prior sd of a batch's own offset; 0: none
    effects: tuple[Law, ...] = ()


@dataclass(frozen=True)
class Reading:
    """A temperature channel: the cells it sits on (N,), what the sensor makes of it in order, and its noise."""

    channel: str
    cells: Array
    effects: tuple[Law, ...]
    noise: float  # K


@dataclass(frozen=True)
class ErrorRow:
    """An error channel: ``sum_k gain_k (row_k · (T - T(0)))`` plus displacement laws; gains in unit/K."""

    channel: str
    unit: str
    rows: Array  # (K, N)
    gains: tuple[Monomial, ...]
    words: tuple[str, ...]  # of each row
    effects: tuple[Law, ...]  # displacements to add
    readings: tuple[Law, ...]  # what the probe makes of the sum, in order
    noise: float

    def matrix(self, values: Array) -> Array:
        """Rows over cells (..., N), unit/K, at parameter values (..., n)."""
        gains = np.stack([g(values) for g in self.gains], axis=-1) if self.gains else np.zeros((*values.shape[:-1], 0))
        return np.asarray(gains @ self.rows)


@dataclass(frozen=True)
class Network:
    """A machine's thermal network and displacement chains, ready to be given numbers.

    Parameter values are vectors (..., n) in the parameters' own units and this order; leading axes are parameter sets.
    """

    machine: str
    cells: tuple[str, ...]  # "shaft", or "column[3]" for a body of several
    bodies: Mapping[str, NDArray[np.int64]]  # body -> its cells' numbers
    parameters: tuple[Parameter, ...]
    capacities: tuple[Monomial, ...]  # per cell, J/K
    edges: tuple[Edge, ...]
    factors: tuple[Law, ...]
    surroundings: tuple[CompiledSurrounding, ...]
    heats: tuple[Heat, ...]
    starts: tuple[tuple[Law, Array], ...]  # added to the start temperature of cells (N,)
    readings: tuple[Reading, ...]
    errors: tuple[ErrorRow, ...]
    drivers: tuple[str, ...]  # driver channels that some law needs
    start_spread_K: float = 1.0

    @cached_property
    def values(self) -> Array:
        """The parameters' values (n,) as the machine file gives them."""
        return values_of(self.parameters)

    @cached_property
    def free(self) -> NDArray[np.int64]:
        """Numbers of the free parameters."""
        return np.flatnonzero([p.free for p in self.parameters])

    @property
    def n_cells(self) -> int:
        return len(self.cells)

    def index(self, name: str) -> int:
        """Number of a parameter.

        Raises:
            InputError: unknown, with the closest.
        """
        names = [p.name for p in self.parameters]
        if name not in names:
            raise InputError(f"machine {self.machine}: no twin parameter {name!r}; {closest(name, names)}")
        return names.index(name)

    def capacity_J_per_K(self, values: Array) -> Array:
        """(..., N) at parameter values (..., n)."""
        return np.stack([c(values) for c in self.capacities], axis=-1)

    def conductance_W_per_K(self, values: Array, factor: Array | None = None) -> Array:
        """The symmetric conductance matrix (..., N, N) at parameter values (..., n).

        `factor` (..., n_factors) are the factor laws' values in the regime; None: 1.
        """
        out = np.zeros((*values.shape[:-1], self.n_cells, self.n_cells))
        for edge in self.edges:
            g = self.edge_W_per_K(edge, values, factor)
            at = np.flatnonzero(edge.direction)
            d = edge.direction[at]
            out[..., at[:, None], at[None, :]] += g[..., None, None] * np.outer(d, d)
        return out

    def edge_W_per_K(self, edge: Edge, values: Array, factor: Array | None = None) -> Array:
        """One edge's conductance (...), factors included."""
        g = edge.conductance(values)
        for f in edge.factors:
            if factor is not None:
                g = g * factor[..., f]
        return g

    def surrounding_W_per_K(self, values: Array, factor: Array | None = None) -> Array:
        """Heat into the cells per kelvin of each surrounding, (..., n_surroundings, N)."""
        out = np.zeros((*values.shape[:-1], len(self.surroundings), self.n_cells))
        for edge in self.edges:
            if edge.surrounding is not None:
                g = self.edge_W_per_K(edge, values, factor)
                out[..., edge.surrounding, :] += g[..., None] * edge.direction
        return out
