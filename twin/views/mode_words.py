"""Thermal modes in words: how long each takes, what moves against what, and how much of a displacement it carries."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.network import Network
from twin.simulation.modes import Modes, modes_of

Array = NDArray[np.float64]

_NAMED, _MOST_NAMED = 0.10, 4  # a body is named from this share of the mode's heat on, the greatest first


@dataclass(frozen=True)
class ModeView:
    """One mode.

    `shape` has a body's mean amplitude, the greatest 1; `weight` its share of capacity × amplitude² (sum 1: the
    modes are orthogonal in this measure); `error` by channel what the mode brings to the displacement of the rise
    that was asked for, in the channel's unit, and `share` that by the sum of all modes' magnitudes.
    """

    time_constant_s: float
    words: str
    shape: dict[str, float]
    weight: dict[str, float]
    error: dict[str, float]
    share: dict[str, float]


def machine_modes(network: Network, factor: Array | None = None) -> Modes:
    """The modes of a network at its values; `factor` (n_factors,) of its factor laws, None: 1 (all at rest)."""
    values = network.values[None]
    conductance = network.conductance_W_per_K(values, None if factor is None else np.atleast_2d(factor))
    return modes_of(network.capacity_J_per_K(values), conductance[:, None])


def mode_views(network: Network, modes: Modes, rise_K: Array | None = None, regime: int = 0) -> list[ModeView]:
    """Every mode of the first parameter set, slowest first.

    Args:
        rise_K: the rise of all cells (N,) whose parts are wanted, say from the room's temperature to a steady state:
            each mode then brings ``row · shape_k (inverse_k · rise)`` with ``1 - exp(-t / tau_k)``. None: 1 K in all.
    """
    shape, inverse = modes.shape[0, regime], modes.inverse[0, regime]
    rise = np.ones(network.n_cells) if rise_K is None else np.asarray(rise_K, float)
    amplitude = inverse @ rise
    rows = np.array([e.matrix(network.values) for e in network.errors]).reshape(-1, network.n_cells)
    brought = rows @ shape * amplitude  # (errors, modes)
    size = np.maximum(np.abs(brought).sum(axis=1, keepdims=True), 1e-300)
    capacity = network.capacity_J_per_K(network.values)
    channels = [e.channel for e in network.errors]
    out = []
    for k, tau_s in enumerate(modes.time_constants_s(regime)[0]):
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
    within = [b for b in one if len(network.bodies[b]) > 1 and _changes_sign(cells[network.bodies[b]])]
    if not other and within:
        return f"{_and(within)} within"
    return f"{_and(one)} against {_and(other) if other else _around(network, cells, one)}"


def _changes_sign(cells: Array) -> bool:
    return bool(cells.min() < -0.3 * np.abs(cells).max() and cells.max() > 0.3 * np.abs(cells).max())


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
            to = _owner(network, outer[0]) if len(outer) == 1 else ""
        if to:
            watts = float(e.conductance(network.values)) * abs(float(e.direction @ cells))
            flow[to] = flow.get(to, 0.0) + watts
    return max(flow, key=lambda k: flow[k]) if flow else "what is around"


def _owner(network: Network, weights: Array) -> str:
    return max(network.bodies, key=lambda b: float(weights[network.bodies[b]].sum()))


def _and(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}" if names else ""
