"""Compilation of a machine file's twin part into a `Network`, and checks that the part makes sense."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace

import numpy as np

from data.errors import InputError, closest
from data.machine import Machine
from twin.compiling.cells import Scope, exposure, inside, link, number
from twin.compiling.laws import acting_on, error, heats, law_of, mechanism_of, reading, starts, surrounding
from twin.network import Network
from twin.quantity import Value, convert
from twin.schema import TwinPart, several, twin_part

CLOSED_M = 1e-6  # an error chain's lengths add up this well
TYPICAL_UM_PER_M_K = 11.0


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
        for problem in _problems(network, part):
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

    Parameters under their own path are left out. Every value of a structural mechanism is marked, and the
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


def _problems(network: Network, part: TwinPart) -> Iterator[str]:
    """Messages on implausible parts: islands, open chains, mechanisms without effect, idle bodies."""
    yield from _islands(network)
    yield from _open_chains(part)
    yield from _pointless(part)
    yield from _varying(network)


def _varying(network: Network) -> Iterator[str]:
    """Only a number that a heat is proportional to can differ from run to run."""
    sizes = {
        law.parameters[name]
        for law in (h.law for h in network.heats)
        for name in law.mechanism.off or {}
        if name in law.parameters and law.mechanism.spec(name).scale == "log"
    }
    for j, p in enumerate(network.parameters):
        if p.per_batch > 0 and j not in sizes:
            example = next((network.parameters[k].name for k in sorted(sizes)), "mechanisms.NAME.heat")
            only = "only the size of a heat may differ from run to run"
            yield f"{p.name}.per_batch: {only}, e.g. {example}; leave it out"


def _islands(network: Network) -> Iterator[str]:
    """Bodies without a path to a surrounding: their temperature would drift for ever."""
    from scipy.sparse.csgraph import connected_components

    n = network.n_cells
    near = np.zeros((n + 1, n + 1))  # the last one represents all surroundings
    touched = [np.flatnonzero(e.direction) for e in network.edges if e.surrounding is not None]
    for at in touched:
        near[at, n] = 1.0
    for edge in network.edges:
        at = np.flatnonzero(edge.direction)
        near[np.ix_(at, at)] = 1.0
    for heat in network.heats:  # radiation and natural convection are paths too
        if heat.taken is not None:
            near[np.ix_(np.flatnonzero(heat.direction(network.values) > 0), np.flatnonzero(heat.taken))] = 1.0
        if any(p.cells is None for p in heat.law.ports.values()):
            near[np.flatnonzero(np.sum([o.cells for o in heat.outlets], axis=0)), n] = 1.0
    _, group = connected_components(near, directed=False)
    cut_off = [b for b, cells in network.bodies.items() if group[cells[0]] != group[n]]
    if cut_off:
        who = ", ".join(cut_off)
        yield f"bodies.{cut_off[0]}: no path from {who} to a surrounding; add an exposure, or a link to what has one"


def _open_chains(part: TwinPart) -> Iterator[str]:
    for channel, given in part.errors.items():
        if not given.chain or any(c.gain is not None for c in given.chain):
            continue
        expected = convert(given.uniform_length, "m")
        got = sum(c.sign * convert(c.length.value, "m") for c in given.chain if c.length is not None)
        wrong_um = TYPICAL_UM_PER_M_K * (got - expected)
        if abs(got - expected) > CLOSED_M:
            yield (
                f"errors.{channel}.chain does not close: its signed lengths add up to {got:g} m, "
                f"expected {expected:g} m, so warming all by 1 K would give {wrong_um:.1f} um too much; "
                "correct a length or a sign, or state uniform_length"
            )


def _pointless(part: TwinPart) -> Iterator[str]:
    """Mechanisms whose `acts_on` is missing or names nothing that they can change."""
    heats = [name for name, given in part.mechanisms.items() if "heat_W" in mechanism_of(name, given).effects()]
    known: dict[frozenset[str], dict[str, None]] = {}  # of each set of effects what they can change, in order
    for name, given in part.mechanisms.items():
        effects = frozenset(mechanism_of(name, given).effects())
        if effects not in known:
            known[effects] = dict.fromkeys(_targets(part, effects, heats))
        allowed = known[effects]
        if "expand" not in effects and allowed and not several(given.acts_on):
            yield f"mechanisms.{name}.acts_on is missing; name what {given.law} changes, e.g. {next(iter(allowed))}"
        for target in several(given.acts_on):
            if "expand" not in effects and target not in allowed:
                yield f"mechanisms.{name}.acts_on: {given.law} cannot change {target!r}; {closest(target, allowed)}"


def _targets(part: TwinPart, effects: Collection[str], heats: Sequence[str]) -> Iterator[str]:
    """What mechanisms with these effects can change, by name."""
    if "factor" in effects:
        yield from (*part.links, *part.exposures, *heats)
    if "reading" in effects:
        yield from (*part.sensors, *part.errors)
    if "displacement" in effects:
        yield from part.errors
    if "surrounding_K" in effects:
        yield from part.surroundings
