"""Heat that depends on temperature: laws with ports, and exchange whose conductance follows a continuous factor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from twin.network import Edge, Heat, Law, Port
from twin.simulation.balance import Balance
from twin.simulation.law_calls import STEP, along_time, heat_W, parameters_of
from twin.simulation.regimes import factor_series

Array = NDArray[Any]
EVERY = slice(None)


@dataclass(frozen=True)
class Borders:
    """Temperatures (n, P, B, M + 1) of the places that sources look at, at the interval borders."""

    degC: Array

    def ends(self, k: int, part: slice = EVERY) -> Array:
        """Of place k at both ends of some intervals, (P, B, 2, m)."""
        row = self.degC[k]
        return np.stack([row[..., :-1][..., part], row[..., 1:][..., part]], axis=-2)


class Source(Protocol):
    """One series of temperature-dependent heat.

    `direction` (P, N) is where a watt goes, `places` the rows of `Borders` that it looks at. One `along` time needs
    the whole series from the start, and holds during an interval.
    """

    @property
    def name(self) -> str: ...

    @property
    def direction(self) -> Array: ...

    @property
    def places(self) -> tuple[int, ...]: ...

    @property
    def along(self) -> bool: ...

    def watts(self, seen: Borders, part: slice, values: Array | None = None) -> Array:
        """W (P, B, 2, m) in some intervals; other parameter values (P, n) for a derivative."""

    def slopes(self, seen: Borders, part: slice) -> dict[int, Array]:
        """Derivative by the temperature of each place, W/K (P, B, 2, m)."""

    def surrounding_slopes(self, seen: Borders, part: slice) -> dict[int, Array]:
        """The same by the temperature of each surrounding that it looks at."""


class Places:
    """The distinct places (weights over cells) that sources, sensors and errors look at, numbered."""

    def __init__(self) -> None:
        self._number: dict[bytes, int] = {}
        self.rows: list[Array] = []

    def number(self, weights: Array) -> int:
        key = weights.tobytes()
        if key not in self._number:
            self._number[key] = len(self.rows)
            self.rows.append(weights)
        return self._number[key]


@dataclass(frozen=True)
class HeatSource:
    """A heat whose law, or a law that multiplies it, has ports."""

    balance: Balance
    heat: Heat
    numbers: Mapping[tuple[str, str], int]  # (law, port) -> place
    _known: dict[tuple[str, str], Array] = field(default_factory=dict)

    @property
    def name(self) -> str:
        return self.heat.law.name

    @cached_property
    def direction(self) -> Array:
        return self.heat.direction(self.balance.values)

    @cached_property
    def places(self) -> tuple[int, ...]:
        return tuple(dict.fromkeys(self.numbers.values()))

    @cached_property
    def along(self) -> bool:
        return along_time(self.heat)

    def watts(self, seen: Borders, part: slice, values: Array | None = None) -> Array:
        return self._evaluate(seen, part, values=values)

    def slopes(self, seen: Borders, part: slice) -> dict[int, Array]:
        return {k: self._evaluate(seen, part, place=k).imag / STEP for k in self.places}

    def surrounding_slopes(self, seen: Borders, part: slice) -> dict[int, Array]:
        laws = (self.heat.law, *self.heat.factors)
        which = dict.fromkeys(p.surrounding for law in laws for p in law.ports.values() if p.cells is None)
        return {s: self._evaluate(seen, part, surrounding=s).imag / STEP for s in which}

    def _driven(self, law: Law, effect: str) -> Array:
        """What a law without ports gives in all intervals, worked out once."""
        if (law.name, effect) not in self._known:
            view = self.balance.inputs.intervals.view(law, self.along)
            p = parameters_of(law, self.balance.values, 2 if self.along else 3)
            out = np.asarray(getattr(law.mechanism, effect)(view, p))
            shape = (1, *self.balance.inputs.valid.shape)
            shape = shape if self.along else (1, shape[1], 2, shape[2])
            self._known[law.name, effect] = np.broadcast_to(out, np.broadcast_shapes(out.shape, shape))
        return self._known[law.name, effect]

    def _evaluate(
        self, seen: Borders, part: slice, values: Array | None = None, place: int = -1, surrounding: int = -1
    ) -> Array:
        balance, along = self.balance, self.along
        values = balance.values if values is None else values
        lo, hi, step = part.indices(seen.degC.shape[-1] - 1)
        part = slice(0, hi) if along else part

        def temperature(law: Law, role: str, port: Port) -> tuple[Array, Array]:
            if port.cells is None:
                ends = np.moveaxis(balance.air.ends(port.surrounding, part), -1, -2)
                first = np.moveaxis(balance.air.ends(port.surrounding, slice(0, 1)), -1, -2)[..., :1, :]
                degC, ahead = ends[..., 0, :] if along else ends, port.surrounding == surrounding
                first = first[..., 0, :] if along else first
            else:
                k = self.numbers[law.name, role]
                degC = seen.degC[k][..., :hi] if along else seen.ends(k, part)
                first = seen.degC[k][..., :1] if along else seen.degC[k][..., None, :1]
                ahead = k == place
            rise_K = degC - first
            return (degC + 1j * STEP, rise_K + 1j * STEP) if ahead else (degC, rise_K)

        def call(law: Law, effect: str) -> Array:
            if not law.ports and values is balance.values:
                return self._driven(law, effect)[..., part]
            pairs = {role: temperature(law, role, port) for role, port in law.ports.items()}
            degC, rise_K = ({r: pair[i] for r, pair in pairs.items()} for i in (0, 1))
            view = balance.inputs.intervals.view(law, along, part, degC, rise_K)
            return np.asarray(getattr(law.mechanism, effect)(view, parameters_of(law, values, 2 if along else 3)))

        out = heat_W(self.heat, call)
        times = balance.inputs.times.get(self.name)
        if times is not None:
            out = out * times.reshape(-1, *(1,) * (1 if along else 2))
        n_sets, n_batches = max(len(values), seen.degC.shape[1]), seen.degC.shape[2]
        if along:
            out = np.broadcast_to(out, (n_sets, n_batches, hi))[..., lo::step]
            return np.repeat(out[..., None, :], 2, axis=-2)
        return np.broadcast_to(out, (n_sets, n_batches, 2, len(range(lo, hi, step))))


@dataclass(frozen=True)
class ExchangeSource:
    """What the conductance of an edge is, in every interval, beyond the constant that its regime has."""

    balance: Balance
    edge: Edge
    place: int

    @property
    def along(self) -> bool:
        return False

    @property
    def name(self) -> str:
        return f"{self.edge.name} beyond its mean"

    @cached_property
    def direction(self) -> Array:
        return np.repeat(self.edge.direction[None], len(self.balance.values), axis=0)

    @property
    def places(self) -> tuple[int, ...]:
        return (self.place,)

    @cached_property
    def excess_W_per_K(self) -> Array:
        """(P, B, M)."""
        b, steady = self.balance, self.edge.conductance(self.balance.values)[:, None, None]
        now = steady
        for k in self.edge.factors:
            constant = b.regimes.factor[:, b.regimes.of, k]
            steady = steady * constant
            varies = k in b.regimes.varying
            now = now * (factor_series(b.network.factors[k], b.values, b.inputs) if varies else constant)
        return np.asarray(now - steady)

    def watts(self, seen: Borders, part: slice, values: Array | None = None) -> Array:
        own = seen.ends(self.place, part)
        if self.edge.surrounding is None:
            return -self.excess_W_per_K[..., None, part] * own
        air = np.moveaxis(self.balance.air.ends(self.edge.surrounding, part), -1, -2)
        return np.asarray(self.excess_W_per_K[..., None, part] * (air - own))

    def slopes(self, seen: Borders, part: slice) -> dict[int, Array]:
        return {self.place: -self._both(part)}

    def surrounding_slopes(self, seen: Borders, part: slice) -> dict[int, Array]:
        return {} if self.edge.surrounding is None else {self.edge.surrounding: self._both(part)}

    def _both(self, part: slice) -> Array:
        return np.repeat(self.excess_W_per_K[..., None, part], 2, axis=-2)


def sources_of(balance: Balance, places: Places) -> tuple[list[Source], list[HeatSource]]:
    """All temperature-dependent heat of a balance, and that asleep; the places that they look at join `places`."""
    awake: list[Source] = []
    asleep: list[HeatSource] = []
    for heat in balance.network.heats:
        if heat.temperature_dependent:
            numbers = {
                (law.name, role): places.number(port.cells)
                for law in (heat.law, *heat.factors)
                for role, port in law.ports.items()
                if port.cells is not None
            }
            source = HeatSource(balance, heat, numbers)
            if heat.asleep:
                asleep.append(source)
            else:
                awake.append(source)
    for edge in balance.network.edges:
        if set(edge.factors) & set(balance.regimes.varying):
            awake.append(ExchangeSource(balance, edge, places.number(edge.direction)))
    return awake, asleep
