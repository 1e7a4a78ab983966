"""Heat balance of a network on given inputs: conductances by regime, surroundings, known and dependent heat."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array, Numeric
from data.errors import InputError
from twin.network import Edge, Heat, Law, Network, Port
from twin.simulation.air import Air, air_of
from twin.simulation.inputs import EVERY, STEP, Inputs, along_time, heat_W, reads_time
from twin.simulation.response import Forcing, Response
from twin.simulation.schedule import MOST, Drive, Regimes, Schedule, at_tuples, distinct, factor_series, regimes_of

LASTING = 64  # intervals of a regime; below it one more series costs less than one more block


@dataclass(frozen=True)
class Balance:
    """``C dT/dt = -K T + q`` of P parameter sets on B batches; what depends on temperature is not in q.

    capacity (P, N), conductance (P, R, N, N) and into (P, R, S, N), the heat per kelvin of each surrounding. Regimes
    also distinguish the drivers of heats, so that held_W (P, R, N) holds within one; `mode_group` (R,) has one number
    for all of the same conductances, from 0. Driven heats that follow the clock or take too many values are `timed`.
    """

    network: Network
    values: Array  # (P, n)
    inputs: Inputs
    regimes: Regimes
    capacity_J_per_K: Array
    conductance_W_per_K: Array
    into_W_per_K: Array
    air: Air
    held_W: Array
    mode_group: NDArray[np.int64]
    timed: tuple[Heat, ...]

    @cached_property
    def schedule(self) -> Schedule:
        """Cut into pieces once for all runs on the same inputs."""
        kept, key = self.inputs.kept, ("schedule", id(self.regimes.of))  # the regimes are kept there too
        if key not in kept:
            kept[key] = Schedule(self.inputs.dt_s, self.regimes.of, self.inputs.n_intervals)
        schedule: Schedule = kept[key]
        return schedule

    @cached_property
    def known(self) -> tuple[tuple[Array, Array], ...]:
        """Directions (P or 1, R, J, N) and series (P or 1, J, B, M, 2) of surroundings and driven heats."""
        moving = self.air.moving
        steady_W = self.held_W + np.einsum("prsn,ps->prn", self.into_W_per_K, self.air.steady_degC)
        into = self.into_W_per_K[:, :, moving] * self.air.follow[:, None, moving, None]
        terms = [(np.concatenate([steady_W[:, :, None], into], axis=2), self._recorded.series)]
        if self.air.extra_K is not None:
            terms.append((self.into_W_per_K, self.air.extra_K))
        if self.timed:
            series = np.stack([self.driven_W(h) for h in self.timed], axis=1)
            terms.append((self.directions(self.timed), series))
        return tuple(terms)

    def forcing(self, response: Response) -> Forcing:
        """The known heat for a response on this balance's schedule."""
        (directions, _), *others = self.known
        out = response.forcing(directions, self._recorded)
        for directions, series in others:
            out = out + response.forcing(directions, series)
        return out

    @cached_property
    def _recorded(self) -> Drive:
        """A series of ones, for what holds, and the recorded surroundings; sorted once for all runs."""
        kept, key = self.inputs.kept, ("recorded", id(self.schedule), id(self.air.recorded_degC))
        if key not in kept:
            moving = self.air.recorded_degC[self.air.moving]
            kept[key] = self.schedule.drive(np.concatenate([np.ones((1, *moving.shape[1:])), moving])[None])
        drive: Drive = kept[key]
        return drive

    def directions(self, heats: Sequence[Heat | Source]) -> Array:
        """Where heats or sources go, (P, R, J, N), the same in every regime."""
        each = [h.direction(self.values) if isinstance(h, Heat) else h.direction for h in heats]
        return np.repeat(np.stack(each, axis=1)[:, None], self.regimes.count, axis=1)

    def driven_W(self, heat: Heat, values: Array | None = None) -> Array:
        """Watts (P or 1, B, M, 2) of a heat that does not depend on temperature, at both ends of every interval."""
        along, values = along_time(heat), self.values if values is None else values
        intervals = self.inputs.intervals
        out = heat_W(heat, lambda law, effect: intervals.call(law, effect, values, along))
        return intervals.ends(intervals.times(heat, out, along), len(values), along)


def balance_of(network: Network, values: Array, inputs: Inputs) -> Balance:
    """The heat balance at parameter values (P, n).

    Raises:
        InputError: parameter values of another length, or that are not finite.
    """
    check_values(network, values)
    regimes, held_W, mode_group, timed = _finer(network, values, inputs, regimes_of(network, values, inputs))
    spread = np.repeat(values[:, None], regimes.count, axis=1)
    return Balance(
        network,
        values,
        inputs,
        regimes,
        network.capacity_J_per_K(values),
        network.conductance_W_per_K(spread, regimes.factor),
        network.surrounding_W_per_K(spread, regimes.factor),
        air_of(network, values, inputs),
        held_W,
        mode_group,
        timed,
    )


def _finer(
    network: Network, values: Array, inputs: Inputs, regimes: Regimes
) -> tuple[Regimes, Array, NDArray[np.int64], tuple[Heat, ...]]:
    """Regimes in which driven heats hold as well; their watts, the given regime of each, and the remaining heats."""
    driven = [h for h in network.heats if not h.temperature_dependent and not h.disabled]
    held = [h for h in driven if not _timed(h) and h.law.name not in inputs.times]
    number, first = distinct(
        inputs, [c for h in held for law in (h.law, *h.factors) for c in law.drivers.values()], regimes.of
    )
    short = len(first) > regimes.count and inputs.valid.sum() < LASTING * len(first)
    if len(first) > MOST or short:
        held, number, first = [], *distinct(inputs, (), regimes.of)
    mode_group = regimes.of.ravel()[first]
    watts = np.zeros((len(values), len(first), network.n_cells))
    for heat in held:
        at = heat_W(heat, lambda law, effect: at_tuples(law, effect, values, inputs, first))
        watts += at[..., None] * heat.direction(values)[:, None]
    timed = tuple(h for h in driven if all(h is not other for other in held))
    return replace(regimes, of=number, factor=regimes.factor[:, mode_group]), watts, mode_group, timed


def check_values(network: Network, values: Array) -> None:
    if values.ndim != 2 or values.shape[1] != len(network.parameters):
        raise InputError(
            f"machine {network.machine}: parameter values have shape {values.shape}, expected (sets, "
            f"{len(network.parameters)})"
        )
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        p, j = bad[0]
        raise InputError(
            f"machine {network.machine}: parameter {network.parameters[j].name} is {values[p, j]:g} "
            f"{network.parameters[j].unit} in set {p}, expected a finite number; correct its value"
        )


def _timed(heat: Heat) -> bool:
    return reads_time(heat.law, "heat_W") or any(reads_time(f, "factor") for f in heat.factors)


@dataclass(frozen=True)
class Borders:
    """Temperatures (n, P, B, M + 1) of the places that sources depend on, at the interval borders."""

    degC: Numeric

    def ends(self, k: int, part: slice = EVERY) -> Numeric:
        """Of place k at both ends of some intervals, (P, B, 2, m)."""
        row = self.degC[k]
        return np.stack([row[..., :-1][..., part], row[..., 1:][..., part]], axis=-2)


class Places:
    """The distinct places (weights over cells) that sources, sensors and errors depend on, numbered."""

    def __init__(self) -> None:
        self._number: dict[bytes, int] = {}
        self.rows: list[Numeric] = []

    def number(self, weights: Numeric) -> int:
        """The number of a place, by its weights (N,) over the cells."""
        key = weights.tobytes()
        if key not in self._number:
            self._number[key] = len(self.rows)
            self.rows.append(weights)
        return self._number[key]


@dataclass(frozen=True)
class HeatSource:
    """A heat whose law, or a law that multiplies it, has ports: one series of temperature-dependent heat.

    `direction` (P, N) is where a watt goes, `places` the rows of `Borders` that it depends on. One `along` time needs
    the whole series from the start, and holds during an interval.
    """

    balance: Balance
    heat: Heat
    numbers: Mapping[tuple[str, str], int]  # (law, port) -> place
    _known: dict[tuple[str, str], Numeric] = field(default_factory=dict)

    @property
    def name(self) -> str:
        return self.heat.law.name

    @cached_property
    def direction(self) -> Numeric:
        return self.heat.direction(self.balance.values)

    @cached_property
    def places(self) -> tuple[int, ...]:
        return tuple(dict.fromkeys(self.numbers.values()))

    @cached_property
    def along(self) -> bool:
        return along_time(self.heat)

    def watts(self, seen: Borders, part: slice, values: Numeric | None = None) -> Numeric:
        """W (P, B, 2, m) in some intervals; other parameter values (P, n) for a derivative."""
        return self._evaluate(seen, part, values=values)

    def slopes(self, seen: Borders, part: slice) -> dict[int, Numeric]:
        """Derivative by the temperature of each place, W/K (P, B, 2, m)."""
        return {k: self._evaluate(seen, part, place=k).imag / STEP for k in self.places}

    def surrounding_slopes(self, seen: Borders, part: slice) -> dict[int, Numeric]:
        """Derivative by the temperature of each surrounding, W/K (P, B, 2, m)."""
        laws = (self.heat.law, *self.heat.factors)
        which = dict.fromkeys(p.surrounding for law in laws for p in law.ports.values() if p.cells is None)
        return {s: self._evaluate(seen, part, surrounding=s).imag / STEP for s in which}

    def _driven(self, law: Law, effect: str) -> Numeric:
        """What a law without ports gives in all intervals, worked out once."""
        if (law.name, effect) not in self._known:
            out = self.balance.inputs.intervals.call(law, effect, self.balance.values, self.along)
            shape = (1, *self.balance.inputs.valid.shape)
            shape = shape if self.along else (1, shape[1], 2, shape[2])
            self._known[law.name, effect] = np.broadcast_to(out, np.broadcast_shapes(out.shape, shape))
        return self._known[law.name, effect]

    def _evaluate(
        self, seen: Borders, part: slice, values: Numeric | None = None, place: int = -1, surrounding: int = -1
    ) -> Numeric:
        balance, along = self.balance, self.along
        values = balance.values if values is None else values
        lo, hi, step = part.indices(seen.degC.shape[-1] - 1)
        part = slice(0, hi) if along else part

        def temperature(law: Law, role: str, port: Port) -> tuple[Numeric, Numeric]:
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

        def call(law: Law, effect: str) -> Numeric:
            if not law.ports and values is balance.values:
                return self._driven(law, effect)[..., part]
            pairs = {role: temperature(law, role, port) for role, port in law.ports.items()}
            degC, rise_K = ({r: pair[i] for r, pair in pairs.items()} for i in (0, 1))
            return balance.inputs.intervals.call(law, effect, values, along, part, degC, rise_K)

        out = balance.inputs.intervals.times(self.heat, heat_W(self.heat, call), along)
        n_sets, n_batches = max(len(values), seen.degC.shape[1]), seen.degC.shape[2]
        if along:
            out = np.broadcast_to(out, (n_sets, n_batches, hi))[..., lo::step]
            return np.repeat(out[..., None, :], 2, axis=-2)
        return np.broadcast_to(out, (n_sets, n_batches, 2, len(range(lo, hi, step))))


@dataclass(frozen=True)
class ExchangeSource:
    """What the conductance of an edge is, in every interval, beyond the constant that its regime has.

    Methods as of `HeatSource`.
    """

    balance: Balance
    edge: Edge
    place: int
    along: ClassVar[bool] = False

    @property
    def name(self) -> str:
        return f"{self.edge.name} beyond its mean"

    @cached_property
    def direction(self) -> Numeric:
        return np.repeat(self.edge.direction[None], len(self.balance.values), axis=0)

    @property
    def places(self) -> tuple[int, ...]:
        return (self.place,)

    @cached_property
    def excess_W_per_K(self) -> Numeric:
        """(P, B, M)."""
        b, steady = self.balance, self.edge.conductance(self.balance.values)[:, None, None]
        now = steady
        for k in self.edge.factors:
            constant = b.regimes.factor[:, b.regimes.of, k]
            steady = steady * constant
            varies = k in b.regimes.varying
            now = now * (factor_series(b.network.factors[k], b.values, b.inputs) if varies else constant)
        return np.asarray(now - steady)

    def watts(self, seen: Borders, part: slice, values: Numeric | None = None) -> Numeric:
        own = seen.ends(self.place, part)
        if self.edge.surrounding is None:
            return -self.excess_W_per_K[..., None, part] * own
        air = np.moveaxis(self.balance.air.ends(self.edge.surrounding, part), -1, -2)
        return np.asarray(self.excess_W_per_K[..., None, part] * (air - own))

    def slopes(self, seen: Borders, part: slice) -> dict[int, Numeric]:
        return {self.place: -self._both(part)}

    def surrounding_slopes(self, seen: Borders, part: slice) -> dict[int, Numeric]:
        return {} if self.edge.surrounding is None else {self.edge.surrounding: self._both(part)}

    def _both(self, part: slice) -> Numeric:
        return np.repeat(self.excess_W_per_K[..., None, part], 2, axis=-2)


Source = HeatSource | ExchangeSource


def sources_of(balance: Balance, places: Places) -> tuple[list[Source], list[HeatSource]]:
    """Temperature-dependent heat sources of a balance, enabled and disabled; their places are added to `places`."""
    enabled: list[Source] = []
    disabled: list[HeatSource] = []
    for heat in balance.network.heats:
        if heat.temperature_dependent:
            numbers = {
                (law.name, role): places.number(port.cells)
                for law in (heat.law, *heat.factors)
                for role, port in law.ports.items()
                if port.cells is not None
            }
            source = HeatSource(balance, heat, numbers)
            if heat.disabled:
                disabled.append(source)
            else:
                enabled.append(source)
    for edge in balance.network.edges:
        if set(edge.factors) & set(balance.regimes.varying):
            enabled.append(ExchangeSource(balance, edge, places.number(edge.direction)))
    return enabled, disabled
