"""Compilation of mechanisms: parameters, drivers, ports and outlets."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from data.arrays import Array
from data.errors import closest
from twin.compiling.cells import Scope, several
from twin.compiling.parameters import SHARE
from twin.mechanisms import MECHANISMS
from twin.mechanisms.base import Mechanism
from twin.network import Heat, Law, Outlet, Port
from twin.quantity import same_dimension
from twin.schema import MechanismPart


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
    specs = {s.name: s for s in mechanism.parameters}
    for p in given.parameters:
        if p not in specs:
            raise ValueError(f"{key}.parameters: {given.law} has no parameter {p!r}; {closest(p, specs)}")
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
        number = None if isinstance(share, str) else scope.table.add(f"{key}.{place}", SHARE, share)
        outlets.append(Outlet(scope.cells.weights(place, key), number, place))
    if sum(scope.table.rows[o.share].value for o in outlets if o.share is not None) > 1:
        raise ValueError(f"{key}: the shares add up to more than 1; lower them, or leave one out as 'rest'")
    return tuple(outlets)
