"""From a machine file's twin part to a `Network`: places become weights over cells, values become parameters."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from data.errors import InputError, closest
from data.machine import Machine
from twin.cells import Cells
from twin.mechanisms import MECHANISMS
from twin.mechanisms.base import Mechanism
from twin.network import CompiledSurrounding, Edge, ErrorRow, Heat, Law, Network, Outlet, Port, Reading
from twin.parameters import (
    AREA,
    COEFFICIENT,
    CONDUCTANCE,
    LENGTH,
    MATERIAL,
    OFFSET,
    SHARE,
    TEMPERATURE,
    ParameterTable,
)
from twin.quantity import Monomial, Spec, Value, convert, same_dimension
from twin.schema import ChainLink, ErrorChain, MechanismPart, Sensor, Surrounding, Tilt, TwinPart, twin_part

Array = NDArray[np.float64]


def compile_network(machine: Machine, where: str = "", part: TwinPart | None = None) -> Network:
    """The network of a machine file; `part` replaces its twin part (a candidate of a diagnosis, a refined body).

    Raises:
        InputError: no twin part, or one that makes no sense; one line with file, key, remedy.
    """
    at = where or f"machine {machine.machine}"
    part = part or twin_part(machine, at)
    try:
        return _Compiler(machine, expanded(part)).network()
    except ValueError as error:
        raise InputError(f"{at}: twin.{error}") from None


def expanded(part: TwinPart) -> TwinPart:
    """The twin part with its structural mechanisms written out as bodies, links, exposures and chain links."""
    for name, given in part.mechanisms.items():
        mechanism = mechanism_of(name, given)
        if "expand" in mechanism.effects():
            part = mechanism.expand(name, given, part)
            rest = {k: v for k, v in part.mechanisms.items() if k != name}
            part = part.model_copy(update={"mechanisms": rest})
    return part


def mechanism_of(name: str, given: MechanismPart) -> Mechanism:
    """An object of the mechanism's class.

    Raises:
        ValueError: no such mechanism, with the closest.
    """
    if given.law not in MECHANISMS:
        raise ValueError(f"mechanisms.{name}.law: no mechanism {given.law!r}; {closest(given.law, MECHANISMS)}")
    mechanism: Mechanism = MECHANISMS[given.law]()
    return mechanism


class _Compiler:
    """Collects the parts of one network; every method reads one group of the twin part."""

    def __init__(self, machine: Machine, part: TwinPart) -> None:
        self.machine, self.part = machine, part
        self.table = ParameterTable(part)
        self.cells = Cells(part.bodies)
        self.surroundings = {name: k for k, name in enumerate(part.surroundings)}
        self.drivers: set[str] = set()
        self.laws = {name: self._law(name, given) for name, given in part.mechanisms.items()}

    def network(self) -> Network:
        part = self.part
        shares = {name: self.table.capacity(name, body) for name, body in part.bodies.items()}
        capacities = [shares[b].times(1.0 / len(self.cells.of[b])) for b in part.bodies for _ in self.cells.of[b]]
        factors = self._acting_on({**part.links, **part.exposures}, "factor", "link", "exposure")
        edges = [e for b in part.bodies for e in self._inside(b)]
        edges += [e for n in part.links for e in self._link(n)] + [e for n in part.exposures for e in self._exposure(n)]
        used = [name for name, targets in factors.items() if targets]
        edges = [
            replace(e, factors=tuple(k for k, f in enumerate(used) if e.name in factors[f])) if used else e
            for e in edges
        ]
        return Network(
            machine=self.machine.machine,
            cells=self.cells.names,
            bodies=self.cells.of,
            capacities=tuple(capacities),
            edges=tuple(edges),
            factors=tuple(self.laws[n] for n in used),
            surroundings=tuple(self._surrounding(n, s) for n, s in part.surroundings.items()),
            heats=self._heats(),
            starts=self._starts(),
            readings=tuple(self._reading(n, s) for n, s in part.sensors.items()),
            errors=tuple(self._error(n, e) for n, e in part.errors.items()),
            parameters=tuple(self.table.rows),
            drivers=tuple(n for n in self.machine.channels if n in self.drivers),
            start_spread_K=_number("initial_spread", part.initial_spread, "K"),
        )

    def _inside(self, name: str) -> list[Edge]:
        """Conduction between neighbouring cells of a bar or a plate."""
        nx, ny = self.cells.shape[name]
        if nx * ny == 1:
            return []
        along, across = self.table.inside(name, self.part.bodies[name])
        number = self.cells.of[name].reshape(nx, ny)
        edges = []
        for a, b, g in (
            (number[:-1], number[1:], along.times(nx / ny)),
            (number[:, :-1], number[:, 1:], across.times(ny / nx)),
        ):
            edges += [Edge(name, self._from_to(i, j), g) for i, j in zip(a.ravel(), b.ravel(), strict=True)]
        return edges

    def _from_to(self, i: int, j: int) -> Array:
        d = np.zeros(len(self.cells))
        d[i], d[j] = 1.0, -1.0
        return d

    def _link(self, name: str) -> list[Edge]:
        link, key = self.part.links[name], f"links.{name}"
        ends = [self.cells.weights(p, f"{key}.between") for p in link.between]
        if np.array_equal(ends[0], ends[1]):
            raise ValueError(f"{key}.between: both ends are {link.between[0]!r}; link two different places")
        given = {k for k in ("conductance", "coefficient", "length") if getattr(link, k) is not None}
        if given == {"conductance"}:
            g = self.table.one(f"{key}.conductance", CONDUCTANCE, link.conductance)
        elif given == {"coefficient"}:
            g = self._joint(key, link.area, link.coefficient)
        elif given == {"length"}:
            k = self.table.material(link.material, "conductivity", f"{key}.material")
            area = self.table.add(f"{key}.area", AREA, link.area)
            g = Monomial(1.0, ((k, 1.0), (area, 1.0), (self.table.add(f"{key}.length", LENGTH, link.length), -1.0)))
        else:
            raise ValueError(f"{key}: give one of conductance, area with coefficient, or length with area and material")
        return [Edge(name, ends[0] - ends[1], g)]

    def _joint(self, key: str, area: Value | None, coefficient: Value | None) -> Monomial:
        return self.table.product(
            (f"{key}.area", AREA, area, 1.0), (f"{key}.coefficient", COEFFICIENT, coefficient, 1.0)
        )

    def _exposure(self, name: str) -> list[Edge]:
        given, key = self.part.exposures[name], f"exposures.{name}"
        if given.conductance is not None:
            g = self.table.one(f"{key}.conductance", CONDUCTANCE, given.conductance)
        else:
            g = self._joint(key, given.area, given.coefficient)
        body = self.cells.body_of(given.of, f"{key}.of")
        if "@" in given.of:
            places, g = [self.cells.weights(given.of, f"{key}.of")], g
        else:
            places = [np.eye(len(self.cells))[i] for i in self.cells.of[body]]
            g = g.times(1.0 / len(places))
        if given.to in self.surroundings:
            return [Edge(name, w, g, surrounding=self.surroundings[given.to]) for w in places]
        if given.to not in self.part.bodies:
            raise ValueError(
                f"{key}.to: no surrounding {given.to!r}; {closest(given.to, [*self.surroundings, *self.part.bodies])}"
            )
        other = self.cells.weights(given.to, f"{key}.to")
        return [Edge(name, w - other, g) for w in places]

    def _law(self, name: str, given: MechanismPart) -> Law:
        """A mechanism with its parameters, drivers and ports looked up."""
        key, mechanism = f"mechanisms.{name}", mechanism_of(name, given)
        specs = {s.name: s for s in mechanism.parameters}
        for p in given.parameters:
            if p not in specs:
                raise ValueError(f"{key}.parameters: {given.law} has no parameter {p!r}; {closest(p, specs)}")
        parameters = {
            s.name: self.table.add(f"{key}.{s.name}", s, given.parameters.get(s.name), mechanism.source)
            for s in mechanism.parameters
        }
        return Law(
            name, mechanism, parameters, self._drivers(key, mechanism, given), self._ports(key, mechanism, given)
        )

    def _drivers(self, key: str, mechanism: Mechanism, given: MechanismPart) -> dict[str, str]:
        """Driver channels by the law's names; a law with one driver takes its bare channel name."""
        wanted, drivers = list(mechanism.drivers), given.drivers or {}
        if isinstance(drivers, str):
            drivers = {wanted[0]: drivers} if len(wanted) == 1 else {}
        if set(drivers) != set(wanted):
            raise ValueError(f"{key}.drivers: {mechanism.key} needs {', '.join(wanted) or 'none'}, got {list(drivers)}")
        for role, channel in drivers.items():
            if channel not in self.machine.channels:
                raise ValueError(
                    f"{key}.drivers.{role}: no channel {channel!r}; {closest(channel, self.machine.channels)}"
                )
            unit = self.machine.channels[channel].unit
            if not same_dimension(unit, mechanism.drivers[role]):
                raise ValueError(
                    f"{key}.drivers.{role}: channel {channel!r} is in {unit}, {mechanism.key} needs "
                    f"{mechanism.drivers[role]}; name another channel"
                )
        self.drivers.update(drivers.values())
        return dict(drivers)

    def _ports(self, key: str, mechanism: Mechanism, given: MechanismPart) -> dict[str, Port]:
        at = given.at or {}
        if isinstance(at, str):
            at = {mechanism.ports[0]: at} if mechanism.ports else {}
        if set(at) != set(mechanism.ports):
            raise ValueError(f"{key}.at: {mechanism.key} needs {', '.join(mechanism.ports) or 'none'}, got {list(at)}")
        return {port: self._port(place, f"{key}.at.{port}") for port, place in at.items()}

    def _port(self, place: str | tuple[str, ...], key: str) -> Port:
        if not isinstance(place, str):
            return Port(np.mean([self.cells.weights(p, key) for p in place], axis=0))
        if place in self.surroundings:
            return Port(None, self.surroundings[place])
        if place.partition("@")[0] not in self.part.bodies:
            raise ValueError(
                f"{key}: no body or surrounding {place!r}; {closest(place, [*self.part.bodies, *self.surroundings])}"
            )
        return Port(self.cells.weights(place, key))

    def _acting_on(self, targets: Mapping[str, object], effect: str, *kinds: str) -> dict[str, tuple[str, ...]]:
        """Names that every mechanism with this effect acts on, of those among `targets`."""
        out = {}
        for name, given in self.part.mechanisms.items():
            if effect in self.laws[name].mechanism.effects():
                out[name] = tuple(t for t in _several(given.on) if t in targets)
        return out

    def _acting(self, effect: str, target: str) -> tuple[Law, ...]:
        """Laws with this effect on one target, in the file's order."""
        return tuple(
            self.laws[name]
            for name, given in self.part.mechanisms.items()
            if effect in self.laws[name].mechanism.effects() and target in _several(given.on)
        )

    def _heats(self) -> tuple[Heat, ...]:
        heats = []
        for name, given in self.part.mechanisms.items():
            if "heat_W" in self.laws[name].mechanism.effects():
                heats.append(Heat(self.laws[name], self._outlets(name, given), self._acting("factor", name)))
        return tuple(heats)

    def _starts(self) -> tuple[tuple[Law, Array], ...]:
        return tuple(
            (self.laws[name], sum(o.cells for o in self._outlets(name, given)))
            for name, given in self.part.mechanisms.items()
            if "start_K" in self.laws[name].mechanism.effects()
        )

    def _outlets(self, name: str, given: MechanismPart) -> tuple[Outlet, ...]:
        key, into = f"mechanisms.{name}.into", given.into
        if into is None and isinstance(given.at, str):
            into = given.at
        if into is None:
            raise ValueError(
                f"{key} is missing; name the places that the heat goes into, e.g. {{shaft: 0.5, front: rest}}"
            )
        if isinstance(into, str):
            into = {into: "rest"}
        rest = [place for place, share in into.items() if share == "rest"]
        if len(rest) != 1:
            raise ValueError(f"{key}: got {len(rest)} places with 'rest', expected one, so that the shares make up 1")
        outlets = []
        for place, share in into.items():
            number = None if isinstance(share, str) else self.table.add(f"{key}.{place}", SHARE, share)
            outlets.append(Outlet(self.cells.weights(place, key), number, place))
        if sum(self.table.rows[o.share].value for o in outlets if o.share is not None) > 1:
            raise ValueError(f"{key}: the shares add up to more than 1; lower them, or leave one out as 'rest'")
        return tuple(outlets)

    def _surrounding(self, name: str, given: Surrounding) -> CompiledSurrounding:
        key = f"surroundings.{name}"
        for channel in [given.channel] if given.channel else given.first or ():
            if channel not in self.machine.channels:
                raise ValueError(f"{key}: no channel {channel!r}; {closest(channel, self.machine.channels)}")
        return CompiledSurrounding(
            name,
            given.channel,
            None if given.value is None else self.table.add(f"{key}.value", TEMPERATURE, given.value),
            given.first or (),
            None if given.offset is None else self.table.add(f"{key}.offset", OFFSET, given.offset),
            0.0 if given.per_batch is None else _number(f"{key}.per_batch", given.per_batch, "K"),
            self._acting("surrounding_K", name),
        )

    def _reading(self, channel: str, given: Sensor) -> Reading:
        key = f"sensors.{channel}"
        self._channel(key, channel, "temperature", "ambient")
        effects = []
        for attribute, law in (("bonding", "sensor_bonding"), ("lag", "sensor_lag"), ("offset", "sensor_offset")):
            value = getattr(given, attribute)
            if value is None:
                continue
            mechanism = MECHANISMS[law]()
            ports = {}
            if mechanism.ports:
                if given.air is None:
                    raise ValueError(f"{key}.air is missing; name the surrounding that cools the sensor")
                ports = {mechanism.ports[0]: self._port(given.air, f"{key}.air")}
            number = self.table.add(f"{key}.{attribute}", mechanism.parameters[0], value)
            effects.append(Law(f"{channel}.{attribute}", mechanism, {mechanism.parameters[0].name: number}, {}, ports))
        noise = self._noise(key, channel, given.noise, "K")
        return Reading(
            channel,
            self.cells.weights(given.at, f"{key}.at"),
            (*effects, *self._acting("reading", channel)),
            noise,
        )

    def _channel(self, key: str, channel: str, *roles: str) -> None:
        if channel not in self.machine.channels:
            raise ValueError(f"{key}: no channel {channel!r} in 'channels'; {closest(channel, self.machine.channels)}")
        if self.machine.channels[channel].role not in roles:
            raise ValueError(
                f"{key}: channel {channel!r} is a {self.machine.channels[channel].role}, expected {roles[0]}"
            )

    def _noise(self, key: str, channel: str, given: str | float | None, unit: str) -> float:
        """Standard deviation: as given, or a step's rounding error, resolution / sqrt(12), and not below a third of it."""
        if given is not None:
            return _number(f"{key}.noise", given, unit)
        resolution = self.machine.channels[channel].resolution
        if resolution is None:
            raise ValueError(f"{key}.noise is missing and channel {channel!r} states no resolution; give one of them")
        return resolution / math.sqrt(12.0)

    def _error(self, channel: str, given: ErrorChain) -> ErrorRow:
        key = f"errors.{channel}"
        self._channel(key, channel, "error")
        unit = self.machine.channels[channel].unit
        gain = Spec("gain", f"{unit}/K", "a displacement per kelvin", scale="linear")
        rows, gains, words = [], [], []
        for k, c in enumerate(given.chain):
            at = f"{key}.chain[{k}]"
            rows.append(self.cells.weights(c.body, f"{at}.body"))
            gains.append(self._chain_gain(at, c, gain))
            words.append(c.words or c.body)
        for k, t in enumerate(given.tilts):
            at = f"{key}.tilts[{k}]"
            rows.append(self.cells.weights(t.hot, f"{at}.hot") - self.cells.weights(t.cold, f"{at}.cold"))
            gains.append(self._tilt_gain(at, t, gain))
            words.append(t.words or f"{t.hot} - {t.cold}")
        return ErrorRow(
            channel, unit, np.array(rows).reshape(len(rows), len(self.cells)), tuple(gains), tuple(words),
            self._acting("displacement", channel), self._acting("reading", channel),
            self._noise(key, channel, given.noise, unit),
        )  # fmt: skip

    def _expansion(self, at: str, given: Value | None, place: str) -> tuple[int, float]:
        if given is not None:
            return self.table.add(f"{at}.expansion", MATERIAL["expansion"], given), 1.0
        body = self.part.bodies[place.partition("@")[0]]
        return self.table.material(body.material, "expansion", f"{at}.expansion"), 1.0

    def _chain_gain(self, at: str, c: ChainLink, gain: Spec) -> Monomial:
        if c.gain is not None:
            return Monomial(float(c.sign), ((self.table.add(f"{at}.gain", gain, c.gain), 1.0),))
        return Monomial(
            float(c.sign),
            (self._expansion(at, c.expansion, c.body), (self.table.add(f"{at}.length", LENGTH, c.length), 1.0)),
        )

    def _tilt_gain(self, at: str, t: Tilt, gain: Spec) -> Monomial:
        if t.gain is not None:
            return Monomial(float(t.sign), ((self.table.add(f"{at}.gain", gain, t.gain), 1.0),))
        sizes = {"height": 1.0, "lever": 1.0, "depth": -1.0}
        return Monomial(
            float(t.sign),
            (
                self._expansion(at, t.expansion, t.hot),
                *((self.table.add(f"{at}.{s}", LENGTH, getattr(t, s)), e) for s, e in sizes.items()),
            ),
        )


def _several(on: tuple[str, ...] | str | None) -> tuple[str, ...]:
    return (on,) if isinstance(on, str) else on or ()


def _number(key: str, given: str | float, unit: str) -> float:
    try:
        value = convert(given, unit)
    except ValueError as error:
        raise ValueError(f"{key}: {error}") from None
    if value < 0:
        raise ValueError(f"{key}: got {given!r}, expected 0 {unit} or more")
    return value
