"""Description of a network by bodies, links, surroundings and chains, for pictures and tables of a machine file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from data.arrays import Array
from twin.network import CompiledSurrounding, Network
from twin.quantity import convert
from twin.schema import ErrorChain, TwinPart
from twin.simulation.modes import Modes, modes_of
from twin.simulation.start import Steady


@dataclass(frozen=True)
class BodyView:
    """A body; the time constant is its capacity by the conductance of all that touches it."""

    name: str
    label: str
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
    label: str
    body: str
    share: float
    watts: float


@dataclass(frozen=True)
class SurroundingView:
    """A surrounding and how its temperature is known."""

    name: str
    label: str


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
                out.append(HeatView(heat.law.name, heat.law.mechanism.summary, body, part, watts * part))
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


_NAMED, _MOST_NAMED = 0.10, 4  # a body is named from this share of the mode's heat on, the greatest first


@dataclass(frozen=True)
class ModeView:
    """One mode.

    `shape` has a body's mean amplitude, the greatest 1; `weight` its share of capacity × amplitude² (sum 1: the
    modes are orthogonal in this measure); `error` by channel what the mode brings to the displacement of the rise
    that was requested, in the channel's unit, and `share` that by the sum of all modes' magnitudes.
    """

    time_constant_s: float
    label: str
    shape: dict[str, float]
    weight: dict[str, float]
    error: dict[str, float]
    share: dict[str, float]


def machine_modes(network: Network, factor: Array | None = None) -> Modes:
    """The modes of a network at its values; `factor` (n_factors,) of its factor laws, None: 1 (all at rest)."""
    values = network.values[None]
    conductance = network.conductance_W_per_K(values, None if factor is None else np.atleast_2d(factor))
    return modes_of(network.capacity_J_per_K(values), conductance[:, None])


def mode_views(network: Network, modes: Modes, rise_K: Array | None = None) -> list[ModeView]:
    """Every mode of the first parameter set, slowest first.

    Args:
        rise_K: the rise of all cells (N,) whose parts are wanted, say from the room's temperature to a steady state:
            each mode then brings ``row · shape_k (inverse_k · rise)`` with ``1 - exp(-t / tau_k)``. None: 1 K in all.
    """
    shape, inverse = modes.shape[0, 0], modes.inverse[0, 0]
    rise = np.ones(network.n_cells) if rise_K is None else np.asarray(rise_K, float)
    amplitude = inverse @ rise
    rows = np.array([e.matrix(network.values) for e in network.errors]).reshape(-1, network.n_cells)
    brought = rows @ shape * amplitude  # (errors, modes)
    size = np.maximum(np.abs(brought).sum(axis=1, keepdims=True), 1e-300)
    capacity = network.capacity_J_per_K(network.values)
    channels = [e.channel for e in network.errors]
    out = []
    for k, tau_s in enumerate(modes.time_constants_s()[0, 0]):
        own = shape[:, k]
        own = own / own[np.abs(own).argmax()]
        weight = capacity * own**2 / (capacity * own**2).sum()
        bodies = {b: float((capacity[c] * own[c]).sum() / capacity[c].sum()) for b, c in network.bodies.items()}
        weights = {b: float(weight[c].sum()) for b, c in network.bodies.items()}
        out.append(
            ModeView(
                float(tau_s), _words(network, own, bodies, weights), bodies, weights,
                dict(zip(channels, brought[:, k].tolist(), strict=True)),
                dict(zip(channels, (np.abs(brought[:, k]) / size[:, 0]).tolist(), strict=True)),
            )
        )  # fmt: skip
    return out


def time_words(time_s: float) -> str:
    """``7.7 h`` from 90 minutes on, ``49 min``, ``8.7 min`` below ten, ``35 s`` below one."""
    if not math.isfinite(time_s):
        return "for ever"
    minutes = time_s / 60.0
    if minutes >= 89.95:
        return f"{minutes / 60:.1f} h"
    if minutes >= 9.95:
        return f"{minutes:.0f} min"
    return f"{minutes:.1f} min" if minutes >= 1.0 else f"{time_s:.0f} s"


def _words(network: Network, cells: Array, bodies: dict[str, float], weight: dict[str, float]) -> str:
    """``bed and table against the room``: who carries the mode's heat, against whom."""
    named = [b for b in sorted(weight, key=lambda b: -weight[b]) if weight[b] >= _NAMED][:_MOST_NAMED]
    lead = bodies[named[0]] >= 0 if named else True
    one = [b for b in named if (bodies[b] >= 0) == lead]
    other = [b for b in named if (bodies[b] >= 0) != lead]
    shapes = {b: cells[network.bodies[b]] for b in one if len(network.bodies[b]) > 1}
    within = [b for b, c in shapes.items() if min(-c.min(), c.max()) > 0.3 * np.abs(c).max()]
    if not other and within:
        return f"{_and(within)} within"
    return f"{_and(one)} against {_and(other) if other else _around(network, cells, one)}"


def _around(network: Network, cells: Array, named: Sequence[str]) -> str:
    """Where most of the named bodies' heat goes in this mode: a surrounding, or a body that hardly moves."""
    inside = np.zeros(network.n_cells)
    for b in named:
        inside[network.bodies[b]] = 1.0
    flow: dict[str, float] = {}
    for e in network.edges:
        ends = np.clip(e.direction, 0, None), np.clip(-e.direction, 0, None)
        held = [float(end @ inside) for end in ends]
        if e.surrounding is not None:
            to = f"the {network.surroundings[e.surrounding].name}" if held[0] > 0.5 else ""
        else:
            outer = [end for end, h in zip(ends, held, strict=True) if h <= 0.5]
            to = body_of(network, outer[0]) if len(outer) == 1 else ""
        if to:
            watts = float(e.conductance(network.values)) * abs(float(e.direction @ cells))
            flow[to] = flow.get(to, 0.0) + watts
    return max(flow, key=lambda k: flow[k]) if flow else "what is around"


def _and(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}" if names else ""
