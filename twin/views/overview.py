"""A network body by body, as a person would tell it: what the picture and the tables of a machine file show."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from twin.network import CompiledSurrounding, Network
from twin.quantity import convert
from twin.schema import ErrorChain, TwinPart
from twin.simulation.steady import Steady


@dataclass(frozen=True)
class BodyView:
    """A body; the time constant is its capacity by the conductance of all that touches it."""

    name: str
    words: str
    capacity_J_per_K: float
    time_constant_s: float
    n_cells: int
    free: int  # parameters under its own name: of the body, its links and exposures, and its sensors
    fixed: int


@dataclass(frozen=True)
class Tie:
    """A link between two bodies or, with `ground`, an exposure of a body to a surrounding or to a body as one."""

    name: str
    ends: tuple[str, str]
    conductance_W_per_K: float
    ground: bool


@dataclass(frozen=True)
class HeatView:
    """The share of a law's heat that goes into a body; watts are nan where no speed was stated."""

    law: str
    words: str
    body: str
    share: float
    watts: float


@dataclass(frozen=True)
class SurroundingView:
    """A surrounding and how its temperature is known."""

    name: str
    words: str


@dataclass(frozen=True)
class ChainView:
    """An error channel: signed parts (body, length in m or nan, gain in unit/K) and tilts (hot, cold, gain)."""

    channel: str
    unit: str
    parts: tuple[tuple[str, float, float], ...]
    tilts: tuple[tuple[str, str, float], ...]
    also: tuple[str, ...]  # laws that add to it


@dataclass(frozen=True)
class Overview:
    """Everything that the picture shows."""

    machine: str
    description: str
    simulated: bool
    bodies: tuple[BodyView, ...]
    ties: tuple[Tie, ...]
    surroundings: tuple[SurroundingView, ...]
    heats: tuple[HeatView, ...]
    sensors: tuple[tuple[str, str], ...]  # channel, body
    chains: tuple[ChainView, ...]
    free: int
    fixed: int
    stated: str = ""  # at which drivers the watts hold


def overview(
    network: Network,
    part: TwinPart,
    description: str = "",
    simulated: bool = False,
    steady: Steady | None = None,
    drivers: Mapping[str, float] | None = None,
) -> Overview:
    """Collect the bodies' view of a network.

    Args:
        part: the twin part that it was compiled from, structural mechanisms written out (`twin.compile.expanded`).
        steady: the state whose watts are shown, and the `drivers` that it holds at.
    """
    stated = ""
    if steady is not None:
        held = ", ".join(f"{n} = {v:g}" for n, v in (drivers or {}).items())
        air = f"surroundings at {steady.surrounding_degC[0]:g} °C" if len(steady.surrounding_degC) else ""
        stated = ", ".join(x for x in ("steady state", held, air) if x)
    free = [p.name for p in network.parameters if p.free]
    return Overview(
        machine=network.machine,
        description=description,
        simulated=simulated,
        bodies=tuple(_body(network, part, name) for name in network.bodies),
        ties=_ties(network, part, steady),
        surroundings=tuple(SurroundingView(s.name, surrounding_words(network, s)) for s in network.surroundings),
        heats=_heats(network, steady),
        sensors=tuple((r.channel, body_of(network, r.cells)) for r in network.readings),
        chains=tuple(_chain(network, name, given) for name, given in part.errors.items()),
        free=len(free),
        fixed=len(network.parameters) - len(free),
        stated=stated,
    )


def body_of(network: Network, weights: np.ndarray) -> str:
    """The body that weights over cells (N,) lie on; the one with the most of them."""
    share = {b: float(np.clip(weights[cells], 0, None).sum()) for b, cells in network.bodies.items()}
    return max(share, key=lambda b: share[b])


def surrounding_words(network: Network, s: CompiledSurrounding) -> str:
    """How a surrounding's temperature is known."""
    value = "" if s.value is None else f"{network.values[s.value]:g} °C"
    first = f"first reading of {', '.join(s.first)}" if s.first else ""
    if s.channel:
        words = f"recorded as {s.channel}"
    elif s.follow is not None:
        words = f"{value} + {network.values[s.follow]:g} × ({first} − {value})"
    else:
        words = value or first
    return words + (f" + {network.values[s.offset]:g} K" if s.offset is not None and network.values[s.offset] else "")


def _body(network: Network, part: TwinPart, name: str) -> BodyView:
    cells, values = network.bodies[name], network.values
    capacity = float(network.capacity_J_per_K(values)[cells].sum())
    around = 0.0
    for e in network.edges:
        share = float(e.direction[cells].sum())  # 0 inside the body
        around += float(e.conductance(values)) * share**2
    sensors = {r.channel for r in network.readings if body_of(network, r.cells) == name}
    own = [p for p in network.parameters if _belongs(p.name, name, part, sensors)]
    free = sum(p.free for p in own)
    tau_s = capacity / around if around > 0 else math.inf
    return BodyView(name, part.bodies[name].words, capacity, tau_s, len(cells), free, len(own) - free)


def _belongs(path: str, body: str, part: TwinPart, sensors: set[str]) -> bool:
    group, _, rest = path.partition(".")
    key = rest.rpartition(".")[0]
    if group == "bodies":
        return rest.startswith(f"{body}.")
    if group == "links" and key in part.links:
        return body in [p.partition("@")[0] for p in part.links[key].between]
    if group == "exposures" and key in part.exposures:
        return body in (part.exposures[key].of.partition("@")[0], part.exposures[key].to)
    return group == "sensors" and key in sensors


def _ties(network: Network, part: TwinPart, steady: Steady | None) -> tuple[Tie, ...]:
    """Links and exposures by name; an exposure of a body of several cells is several edges of one name."""
    total: dict[str, float] = {}
    for k, e in enumerate(network.edges):
        g = float(e.conductance(network.values)) if steady is None else float(steady.edge_W_per_K[k])
        total[e.name] = total.get(e.name, 0.0) + g
    links = [Tie(n, _ends(*link.between), total[n], False) for n, link in part.links.items()]
    return (*links, *(Tie(n, _ends(x.of, x.to), total[n], True) for n, x in part.exposures.items()))


def _ends(a: str, b: str) -> tuple[str, str]:
    return a.partition("@")[0], b.partition("@")[0]


def _heats(network: Network, steady: Steady | None) -> tuple[HeatView, ...]:
    out = []
    for k, heat in enumerate(network.heats):
        watts = math.nan if steady is None else float(steady.heat_W[k])
        share = heat.direction(network.values)
        for body, cells in network.bodies.items():
            part = float(share[cells].sum())
            if abs(part) > 1e-12:
                out.append(HeatView(heat.law.name, heat.law.mechanism.words, body, part, watts * part))
    return tuple(out)


def _chain(network: Network, channel: str, given: ErrorChain) -> ChainView:
    row = next(r for r in network.errors if r.channel == channel)
    gains = [float(g(network.values)) for g in row.gains]
    parts = []
    for link, gain in zip(given.chain, gains, strict=False):
        length = math.nan if link.length is None else link.sign * convert(link.length.value, "m")
        parts.append((link.body.partition("@")[0], length, gain))
    tilts = [(t.hot, t.cold, gain) for t, gain in zip(given.tilts, gains[len(given.chain) :], strict=True)]
    return ChainView(channel, row.unit, tuple(parts), tuple(tilts), tuple(law.name for law in row.effects))
