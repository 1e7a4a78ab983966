"""Compilation of a machine file's twin part into a `Network`."""

from __future__ import annotations

from dataclasses import replace

from data.errors import InputError
from data.machine import Machine
from twin.compiling.cells import Scope, exposure, inside, link, number
from twin.compiling.channels import error, reading, surrounding
from twin.compiling.checks import problems
from twin.compiling.laws import acting_on, heats, law_of, mechanism_of, starts
from twin.network import Network
from twin.quantity import Value
from twin.schema import TwinPart, twin_part


def compile_network(machine: Machine, where: str = "", part: TwinPart | None = None) -> Network:
    """The network of a machine file; `part` replaces its twin part (a candidate of a diagnosis, a refined body).

    Raises:
        InputError: no twin part, or one that makes no sense; one line with file, key, remedy.
    """
    at = where or f"machine {machine.machine}"
    part = part or twin_part(machine, at)
    try:
        part = expanded(part)
        network = _network(Scope.of(machine, part))
        for problem in problems(network, part):
            raise ValueError(problem)
        return network
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


def _network(scope: Scope) -> Network:
    part, cells = scope.part, scope.cells
    scope.laws.update({name: law_of(scope, name, given) for name, given in part.mechanisms.items()})
    whole = {name: scope.table.capacity(name, body) for name, body in part.bodies.items()}
    edges = [e for name in part.bodies for e in inside(scope, name)]
    edges += [e for name in part.links for e in link(scope, name)]
    edges += [e for name in part.exposures for e in exposure(scope, name)]
    acted = {k: on for k, on in acting_on(scope, {**part.links, **part.exposures}, "factor").items() if on}
    return Network(
        machine=scope.machine.machine,
        cells=cells.names,
        bodies=cells.of,
        capacities=tuple(whole[b].times(1.0 / len(cells.of[b])) for b in part.bodies for _ in cells.of[b]),
        edges=tuple(replace(e, factors=tuple(k for k, on in enumerate(acted.values()) if e.name in on)) for e in edges),
        factors=tuple(scope.laws[name] for name in acted),
        surroundings=tuple(surrounding(scope, name, s) for name, s in part.surroundings.items()),
        heats=heats(scope),
        starts=starts(scope),
        readings=tuple(reading(scope, name, s) for name, s in part.sensors.items()),
        errors=tuple(error(scope, name, e) for name, e in part.errors.items()),
        parameters=tuple(scope.table.rows),
        drivers=tuple(n for n in scope.machine.channels if n in scope.drivers),
        start_spread_K=number("initial_spread", part.initial_spread, "K"),
    )


_MARK = "own path: "


def own_paths(machine: Machine, part: TwinPart) -> dict[str, str]:
    """By parameter of the network: ``{"exposures.bed-sink.conductance": "mechanisms.sink.conductance"}``.

    Parameters that stand under their own path are left out. Every value of a structural mechanism is marked, and the
    marks are looked for in the compiled network, so that a new mechanism needs nothing here.

    Raises:
        InputError: the part makes no sense.
    """
    marked = {}
    for name, given in part.mechanisms.items():
        mechanism = mechanism_of(name, given)
        if "expand" in mechanism.effects():
            values = {}
            for s in mechanism.parameters:
                held = given.parameters.get(s.name) or Value(value=s.value or 0.0)
                values[s.name] = held.model_copy(update={"source": f"{_MARK}mechanisms.{name}.{s.name}"})
            marked[name] = given.model_copy(update={"parameters": values})
    if not marked:
        return {}
    part = part.model_copy(update={"mechanisms": {**part.mechanisms, **marked}})
    parameters = compile_network(machine, part=part).parameters
    return {p.name: p.source.removeprefix(_MARK) for p in parameters if p.source.startswith(_MARK)}
