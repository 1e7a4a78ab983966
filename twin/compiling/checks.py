"""Plausibility checks of a twin part: messages with key and remedy."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

import numpy as np

from data.errors import closest
from twin.compiling.cells import several
from twin.compiling.laws import mechanism_of
from twin.network import Network
from twin.quantity import convert
from twin.schema import MechanismPart, TwinPart

CLOSED_M = 1e-6  # an error chain's lengths add up this well
TYPICAL_UM_PER_M_K = 11.0


def problems(network: Network, part: TwinPart) -> Iterator[str]:
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
    near = np.zeros((n + 1, n + 1))  # the last one stands for all surroundings
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
    for channel, error in part.errors.items():
        if not error.chain or any(c.gain is not None for c in error.chain):
            continue
        expected = convert(error.uniform_length, "m")
        got = sum(c.sign * convert(c.length.value, "m") for c in error.chain if c.length is not None)
        wrong_um = TYPICAL_UM_PER_M_K * (got - expected)
        if abs(got - expected) > CLOSED_M:
            yield (
                f"errors.{channel}.chain does not close: its signed lengths add up to {got:g} m, "
                f"expected {expected:g} m, so warming all by 1 K would give {wrong_um:.1f} um too much; "
                "correct a length or a sign, or state uniform_length"
            )


def _pointless(part: TwinPart) -> Iterator[str]:
    """Mechanisms whose `acts_on` is missing or names nothing that they can change."""
    heats = list(_heats(part))
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


def _heats(part: TwinPart) -> Iterator[str]:
    def heats(name: str, given: MechanismPart) -> bool:
        return "heat_W" in mechanism_of(name, given).effects()

    return (name for name, given in part.mechanisms.items() if heats(name, given))
