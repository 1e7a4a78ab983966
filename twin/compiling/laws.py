"""Compilation of mechanisms, and of the surroundings, sensors and error chains that they act on."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from data.arrays import Array
from data.errors import closest
from twin.compiling.cells import Scope, number
from twin.compiling.parameters import LENGTH, MATERIAL, OFFSET, SHARE, TEMPERATURE
from twin.mechanisms import MECHANISMS
from twin.mechanisms.base import Mechanism
from twin.network import CompiledSurrounding, ErrorRow, Heat, Law, Outlet, Port, Reading
from twin.quantity import Monomial, Spec, Value, same_dimension
from twin.schema import ChainLink, ErrorChain, MechanismPart, Sensor, Surrounding, Tilt, several


def mechanism_of(name: str, given: MechanismPart) -> Mechanism:
    """An object of the mechanism's class.

    Raises:
        ValueError: no such mechanism, with the closest.
    """
    if given.law not in MECHANISMS:
        raise ValueError(f"mechanisms.{name}.law: no mechanism {given.law!r}; {closest(given.law, MECHANISMS)}")
    mechanism: Mechanism = MECHANISMS[given.law]()
    return mechanism


def law_of(scope: Scope, name: str, given: MechanismPart) -> Law:
    """A mechanism with its parameters, drivers and ports looked up."""
    key, mechanism = f"mechanisms.{name}", mechanism_of(name, given)
    mechanism.check_names(name, given)
    parameters = {
        s.name: scope.table.add(f"{key}.{s.name}", s, given.parameters.get(s.name), mechanism.source)
        for s in mechanism.parameters
    }
    ports = _ports(scope, key, mechanism, given)
    for p, (port, _) in mechanism.of_port.items():
        if p in given.parameters and port not in ports:
            raise ValueError(f"{key}.parameters.{p}: means nothing without at.{port}; name that place, or leave it out")
    return Law(name, mechanism, parameters, _drivers(scope, key, mechanism, given), ports)


def _drivers(scope: Scope, key: str, mechanism: Mechanism, given: MechanismPart) -> dict[str, str]:
    """Driver channels by the law's names; a law with one driver takes its bare channel name."""
    wanted, drivers = list(mechanism.drivers), given.drivers or {}
    if isinstance(drivers, str):
        drivers = {wanted[0]: drivers} if len(wanted) == 1 else {}
    if set(drivers) - set(wanted) or set(wanted) - set(drivers) - mechanism.optional_drivers:
        raise ValueError(f"{key}.drivers: {mechanism.key} needs {', '.join(wanted) or 'none'}, got {list(drivers)}")
    for role, channel in drivers.items():
        if channel not in scope.machine.channels:
            raise ValueError(
                f"{key}.drivers.{role}: no channel {channel!r}; {closest(channel, scope.machine.channels)}"
            )
        unit = scope.machine.channels[channel].unit
        if role not in mechanism.any_unit and not same_dimension(unit, mechanism.drivers[role]):
            raise ValueError(
                f"{key}.drivers.{role}: channel {channel!r} is in {unit}, {mechanism.key} needs "
                f"{mechanism.drivers[role]}; name another channel"
            )
    scope.drivers.update(drivers.values())
    return dict(drivers)


def _ports(scope: Scope, key: str, mechanism: Mechanism, given: MechanismPart) -> dict[str, Port]:
    at = given.at or {}
    if isinstance(at, str):
        at = {mechanism.ports[0]: at} if mechanism.ports else {}
    if set(at) - set(mechanism.ports) or set(mechanism.ports) - set(at) - mechanism.optional_ports:
        named = ", ".join(p + " (optional)" * (p in mechanism.optional_ports) for p in mechanism.ports)
        raise ValueError(f"{key}.at: {mechanism.key} needs {named or 'none'}, got {list(at)}")
    return {port: port_of(scope, place, f"{key}.at.{port}") for port, place in at.items()}


def port_of(scope: Scope, place: str | tuple[str, ...], key: str) -> Port:
    if not isinstance(place, str):
        return Port(np.mean([scope.cells.weights(p, key) for p in place], axis=0))
    if place in scope.surroundings:
        return Port(None, scope.surroundings[place])
    if place.partition("@")[0] not in scope.part.bodies:
        raise ValueError(
            f"{key}: no body or surrounding {place!r}; {closest(place, [*scope.part.bodies, *scope.surroundings])}"
        )
    return Port(scope.cells.weights(place, key))


def acting_on(scope: Scope, targets: Mapping[str, object], effect: str) -> dict[str, tuple[str, ...]]:
    """Names that every mechanism with this effect acts on, of those among `targets`."""
    out = {}
    for name, given in scope.part.mechanisms.items():
        if effect in scope.laws[name].mechanism.effects():
            out[name] = tuple(t for t in several(given.acts_on) if t in targets)
    return out


def acting(scope: Scope, effect: str, target: str) -> tuple[Law, ...]:
    """Laws with this effect on one target, in the file's order."""
    return tuple(
        scope.laws[name]
        for name, given in scope.part.mechanisms.items()
        if effect in scope.laws[name].mechanism.effects() and target in several(given.acts_on)
    )


def heats(scope: Scope) -> tuple[Heat, ...]:
    heats, multiplied = [], defaultdict(list)
    for name, targets in acting_on(scope, scope.part.mechanisms, "factor").items():
        for target in targets:
            multiplied[target].append(scope.laws[name])
    for name, given in scope.part.mechanisms.items():
        if "heat_W" in scope.laws[name].mechanism.effects():
            law = scope.laws[name]
            loses = law.ports.get(law.mechanism.takes_from or "")
            factors = tuple(replace(f, mechanism=f.mechanism.multiplying(given.law)) for f in multiplied[name])
            heats.append(Heat(law, _outlets(scope, name, given), factors, loses.cells if loses else None))
    return tuple(heats)


def starts(scope: Scope) -> tuple[tuple[Law, Array], ...]:
    """Laws of the start with the cells (N,) that they lift, each by all of it: temperatures are not shared."""
    lifted = []
    for name, given in scope.part.mechanisms.items():
        if "start_K" in scope.laws[name].mechanism.effects():
            key = f"mechanisms.{name}.into"
            places = [given.into] if isinstance(given.into, str) else list(given.into or ())
            if not places:
                raise ValueError(f"{key} is missing; name the body that starts warmer, e.g. into: bed")
            cells = np.zeros(len(scope.cells))
            for place in places:
                cells[np.flatnonzero(scope.cells.weights(place, key))] = 1.0
            lifted.append((scope.laws[name], cells))
    return tuple(lifted)


def _outlets(scope: Scope, name: str, given: MechanismPart) -> tuple[Outlet, ...]:
    key, into = f"mechanisms.{name}.into", given.into
    if into is None and isinstance(given.at, str):
        into = given.at
    if into is None:
        raise ValueError(f"{key} is missing; name the places that the heat goes into, e.g. {{shaft: 0.5, front: rest}}")
    if isinstance(into, str):
        into = {into: "rest"}
    rest = [place for place, share in into.items() if share == "rest"]
    if len(rest) != 1:
        raise ValueError(f"{key}: got {len(rest)} places with 'rest', expected one, so that the shares make up 1")
    outlets = []
    for place, share in into.items():
        index = None if isinstance(share, str) else scope.table.add(f"{key}.{place}", SHARE, share)
        outlets.append(Outlet(scope.cells.weights(place, key), index, place))
    if sum(scope.table.rows[o.share].value for o in outlets if o.share is not None) > 1:
        raise ValueError(f"{key}: the shares add up to more than 1; lower them, or leave one out as 'rest'")
    return tuple(outlets)


def surrounding(scope: Scope, name: str, given: Surrounding) -> CompiledSurrounding:
    key = f"surroundings.{name}"
    for channel in [given.channel] if given.channel else given.first or ():
        if channel not in scope.machine.channels:
            raise ValueError(f"{key}: no channel {channel!r}; {closest(channel, scope.machine.channels)}")
    return CompiledSurrounding(
        name,
        given.channel,
        None if given.value is None else scope.table.add(f"{key}.value", TEMPERATURE, given.value),
        given.first or (),
        None if given.follow is None else scope.table.add(f"{key}.follow", SHARE, given.follow),
        None if given.offset is None else scope.table.add(f"{key}.offset", OFFSET, given.offset),
        0.0 if given.per_batch is None else number(f"{key}.per_batch", given.per_batch, "K"),
        acting(scope, "surrounding_K", name),
    )


def reading(scope: Scope, channel: str, given: Sensor) -> Reading:
    key = f"sensors.{channel}"
    _channel(scope, key, channel, "temperature", "ambient")
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
            ports = {mechanism.ports[0]: port_of(scope, given.air, f"{key}.air")}
        index = scope.table.add(f"{key}.{attribute}", mechanism.parameters[0], value)
        effects.append(Law(f"{channel}.{attribute}", mechanism, {mechanism.parameters[0].name: index}, {}, ports))
    noise = _noise(scope, key, channel, given.noise, "K")
    return Reading(
        channel, scope.cells.weights(given.at, f"{key}.at"), (*effects, *acting(scope, "reading", channel)), noise
    )


def _channel(scope: Scope, key: str, channel: str, *roles: str) -> None:
    if channel not in scope.machine.channels:
        raise ValueError(f"{key}: no channel {channel!r} in 'channels'; {closest(channel, scope.machine.channels)}")
    if scope.machine.channels[channel].role not in roles:
        raise ValueError(f"{key}: channel {channel!r} is a {scope.machine.channels[channel].role}, expected {roles[0]}")


def _noise(scope: Scope, key: str, channel: str, given: str | float | None, unit: str) -> float:
    """Standard deviation: as given, or the rounding error of the channel's resolution."""
    if given is not None:
        return number(f"{key}.noise", given, unit)
    resolution = scope.machine.channels[channel].resolution
    if resolution is None:
        raise ValueError(f"{key}.noise is missing and channel {channel!r} states no resolution; give one of them")
    return resolution / math.sqrt(12.0)


def error(scope: Scope, channel: str, given: ErrorChain) -> ErrorRow:
    key = f"errors.{channel}"
    _channel(scope, key, channel, "error")
    unit = scope.machine.channels[channel].unit
    gain = Spec("gain", f"{unit}/K", "a displacement per kelvin", scale="linear")
    rows, gains, words = [], [], []
    for k, c in enumerate(given.chain):
        at = f"{key}.chain[{k}]"
        rows.append(scope.cells.weights(c.body, f"{at}.body"))
        gains.append(_gain(scope, at, c, c.body, gain, length=1.0))
        words.append(c.words or c.body)
    for k, t in enumerate(given.tilts):
        at = f"{key}.tilts[{k}]"
        rows.append(scope.cells.weights(t.hot, f"{at}.hot") - scope.cells.weights(t.cold, f"{at}.cold"))
        gains.append(_gain(scope, at, t, t.hot, gain, height=1.0, lever=1.0, depth=-1.0))
        words.append(t.words or f"{t.hot} - {t.cold}")
    return ErrorRow(
        channel, unit, np.array(rows).reshape(len(rows), len(scope.cells)), tuple(gains), tuple(words),
        acting(scope, "displacement", channel), acting(scope, "reading", channel),
        _noise(scope, key, channel, given.noise, unit),
    )  # fmt: skip


def _expansion(scope: Scope, at: str, given: Value | None, place: str) -> int:
    if given is not None:
        return scope.table.add(f"{at}.expansion", MATERIAL["expansion"], given)
    body = scope.part.bodies[place.partition("@")[0]]
    return scope.table.material(body.material, "expansion", f"{at}.expansion")


def _gain(scope: Scope, at: str, given: ChainLink | Tilt, place: str, gain: Spec, **lengths: float) -> Monomial:
    """A signed gain as given, or the expansion times the named lengths to their powers."""
    if given.gain is not None:
        return Monomial(float(given.sign), ((scope.table.add(f"{at}.gain", gain, given.gain), 1.0),))
    expansion = _expansion(scope, at, given.expansion, place)
    sizes = ((scope.table.add(f"{at}.{n}", LENGTH, getattr(given, n)), e) for n, e in lengths.items())
    return Monomial(float(given.sign), ((expansion, 1.0), *sizes))
