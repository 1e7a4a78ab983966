"""Where a network settles under drivers and surroundings that hold: temperatures, and the watts of every law there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.errors import InputError, closest
from twin.mechanisms.base import View
from twin.network import Law, Network
from twin.simulation.law_calls import heat_W, parameters_of

Array = NDArray[np.float64]

_STEPS, _CLOSE_K, _SINGULAR, _TINY = 60, 1e-9, 1e-13, 1e-30


@dataclass(frozen=True)
class Steady:
    """A network at rest: temperatures of the cells (N,) and surroundings (S,), degC; watts of the heats (H,);
    values of the factor laws (F,), and the edges' conductances (E,) with them, W/K."""

    degC: Array
    surrounding_degC: Array
    heat_W: Array
    factor: Array
    edge_W_per_K: Array


def steady_state(
    network: Network, drivers: Mapping[str, float], surroundings_degC: float | Mapping[str, float]
) -> Steady:
    """The steady state at held drivers, with every surrounding at a temperature; laws of time see time 0.

    Newton steps with derivatives by the complex step, shortened where they would not help, to 1e-9 K.

    Raises:
        InputError: a driver or surrounding of another name or without a value, or a state that does not settle.
    """
    values = network.values[None]
    air = _surroundings(network, surroundings_degC)
    for name in network.drivers:
        if name not in drivers:
            raise InputError(f"machine {network.machine}: no value for driver {name!r}; add it, e.g. {name}=0")
    for name in drivers:
        if name not in network.drivers:
            raise InputError(
                f"machine {network.machine}: no driver {name!r} in the twin; {closest(name, network.drivers)}"
            )
    degC = np.full(network.n_cells, float(np.mean(air)) if len(air) else 20.0)
    factor = np.array([np.real(_called(law, "factor", values, drivers, degC, air)) for law in network.factors])
    conductance = network.conductance_W_per_K(values, factor[None])[0]
    known = air @ network.surrounding_W_per_K(values, factor[None])[0]
    direction = np.array([h.direction(values)[0] for h in network.heats]).reshape(-1, network.n_cells)

    def watts(degC: Array) -> Array:
        return np.array([_watts(network, k, values, drivers, degC, air) for k in range(len(network.heats))])

    def excess_W(degC: Array) -> Array:
        return known - conductance @ degC + watts(degC) @ direction

    now = excess_W(degC)
    for _ in range(_STEPS):
        slope = np.stack([np.imag(excess_W(degC + 1j * _TINY * e)) / _TINY for e in np.eye(network.n_cells)], axis=1)
        if np.linalg.cond(slope) > 1.0 / _SINGULAR:
            raise InputError(
                f"machine {network.machine}: no steady state: some body has no path to a surrounding; add an exposure"
            )
        step = np.linalg.solve(slope, -now)
        for share in 0.5 ** np.arange(20):
            after = excess_W(degC + share * step)
            if np.linalg.norm(after) < np.linalg.norm(now) or np.abs(share * step).max() < _CLOSE_K:
                break
        degC, now = degC + share * step, after
        if np.abs(share * step).max() < _CLOSE_K:
            edges = np.array([float(network.edge_W_per_K(e, values, factor[None])[0]) for e in network.edges])
            return Steady(degC, air, np.real(watts(degC)), factor, edges)
    raise InputError(
        f"machine {network.machine}: the steady state does not settle (still {np.abs(now).max():.2g} W off after "
        f"{_STEPS} steps); look for heat that grows with temperature"
    )


def _surroundings(network: Network, given: float | Mapping[str, float]) -> Array:
    if not isinstance(given, Mapping):
        return np.full(len(network.surroundings), float(given))
    names = [s.name for s in network.surroundings]
    for name in names:
        if name not in given:
            raise InputError(f"machine {network.machine}: no temperature for surrounding {name!r}; give one in degC")
    return np.array([float(given[n]) for n in names])


def _watts(network: Network, k: int, values: Array, drivers: Mapping[str, float], degC: Array, air: Array) -> Any:
    def call(law: Law, effect: str) -> Array:
        return _called(law, effect, values, drivers, degC, air)

    return heat_W(network.heats[k], call)


def _called(law: Law, effect: str, values: Array, drivers: Mapping[str, float], degC: Array, air: Array) -> Array:
    seen = {
        role: np.array([air[p.surrounding] if p.cells is None else p.cells @ degC]) for role, p in law.ports.items()
    }
    rise = {role: t - np.mean(air) for role, t in seen.items()}
    driver = {role: np.array([float(drivers[c])]) for role, c in law.drivers.items()}
    view = View(seen, rise, driver, np.zeros(1), np.zeros(1), 1.0)
    p = {name: v[0] for name, v in parameters_of(law, values, 1).items()}
    return np.asarray(getattr(law.mechanism, effect)(view, p)).reshape(-1)[0]
