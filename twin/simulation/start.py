"""Start temperatures: bodies with sensors from the first readings, the rest from the network's steady state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from data.arrays import Array
from data.errors import InputError, closest
from twin.mechanisms.base import View
from twin.network import Law, Network, Reading
from twin.simulation.air import air_of
from twin.simulation.inputs import Inputs, heat_W, parameters_of

_HOLD = 1e6  # how much stiffer a sensor holds its place than the network pulls at it
_LOOSE = 1e-9  # and the ambient what nothing else holds
_LEAST_GAIN = 0.2  # of a sensor relative to its place; below, it carries no information


def start_of(network: Network, values: Array, inputs: Inputs, steady: bool = False) -> Array:
    """Start temperatures (P, B, N), degC, at parameter values (P, n); (B, N) at values (n,).

    Cells with a sensor start at its first reading, the rest at the steady state of the network at rest (every driver 0,
    no heat) with those and the surroundings held. Without any first reading, or if `steady`, only the second part
    applies; a batch without first readings starts all at the ambient's first temperature.
    """
    single, values = values.ndim == 1, np.atleast_2d(values)
    at_rest = np.ones((len(values), len(network.factors)))
    for k, law in enumerate(network.factors):
        view = View(driver={role: np.zeros(1) for role in law.drivers})
        factor = np.asarray(law.mechanism.factor(view, parameters_of(law, values, 1)))
        at_rest[:, k] = np.broadcast_to(factor, (len(values), 1))[:, 0]
    conductance = network.conductance_W_per_K(values, at_rest)[:, None]
    first = _first_air(network, values, inputs)
    recorded = next((s for s, given in enumerate(network.surroundings) if given.channel), 0)
    ambient = first[:, :, recorded] if first.shape[2] else np.full(first.shape[:2], 20.0)
    heat = np.einsum("psn,pbs->pbn", network.surrounding_W_per_K(values, at_rest), first)
    scale = np.trace(conductance, axis1=-2, axis2=-1)[..., None, None] / network.n_cells
    system = conductance + _LOOSE * scale * np.eye(network.n_cells)
    heat = heat + _LOOSE * scale[..., 0] * ambient[..., None]
    known = np.zeros(inputs.n_batches, bool)
    for reading in network.readings if not steady else ():
        value = inputs.first.get(reading.channel, np.full(inputs.n_batches, np.nan))
        read = np.isfinite(value)
        known |= read
        hold = _HOLD * scale * read[:, None, None]
        system = system + hold * np.outer(reading.cells, reading.cells)
        place_degC = _beneath(reading, values, first, np.where(read, value, 0.0))
        heat = heat + hold[..., 0] * place_degC[..., None] * reading.cells
    out: Array = np.linalg.solve(np.broadcast_to(system, (*heat.shape, heat.shape[-1])), heat[..., None])[..., 0]
    if not steady:
        out = np.where(known[:, None], out, ambient[..., None])
    return out[0] if single else out


def _beneath(reading: Reading, values: Array, air_degC: Array, shown_degC: Array) -> Array:
    """The place's temperature (P, B) at what its sensor shows (B,), through offset and bonding, which are affine."""
    shape = (len(values), len(shown_degC), 1)
    low, high = np.zeros(shape), np.ones(shape)
    for law in reading.effects:
        if law.mechanism.along_time or any(p.cells is not None for p in law.ports.values()):
            continue  # a lag is steady, and a swapped sensor reads another place
        view = View(degC={role: air_degC[:, :, p.surrounding, None] for role, p in law.ports.items()})
        low, high = (law.mechanism.reading(seen, view, parameters_of(law, values, 2)) for seen in (low, high))
    gain = (high - low)[..., 0]
    affine = gain > _LEAST_GAIN
    return np.asarray(np.where(affine, (shown_degC - low[..., 0]) / np.where(affine, gain, 1.0), shown_degC))


def excess_K(network: Network, values: Array, inputs: Inputs) -> Array | None:
    """What the laws of the start add, (P, B, N); None where there are none."""
    if not network.starts:
        return None
    out = np.zeros((len(values), inputs.n_batches, network.n_cells), values.dtype)
    for law, cells in network.starts:
        view = View(
            driver={role: inputs.drivers[c][:, :1] for role, c in law.drivers.items()}, clock_h=inputs.clock_h[:, None]
        )
        added = law.mechanism.start_K(view, parameters_of(law, values, 2))
        out += np.broadcast_to(added, (len(values), inputs.n_batches, 1)) * cells
    return out


def checked_start(network: Network, values: Array, inputs: Inputs, start: Array | str | None) -> Array:
    """Start temperatures (P or 1, B, N) as given, "settled", or by default those of `start_of`; laws not yet added.

    Raises:
        InputError: another word, another shape, or a temperature that is not finite.
    """
    if start is None or (isinstance(start, str) and start == "settled"):
        own = inputs.with_own(inputs.times)  # the offsets act from the start on, not before
        return start_of(network, values, own, steady=start is not None)
    if isinstance(start, str):
        raise InputError(f"machine {network.machine}: start is {start!r}, expected 'settled' or temperatures")
    given = np.asarray(start, float)
    given = given[None] if given.ndim == 2 else given
    if given.ndim != 3 or given.shape[1] not in (1, inputs.n_batches) or given.shape[2] != network.n_cells:
        raise InputError(
            f"machine {network.machine}: start temperatures have shape {given.shape}, expected (sets, batches, cells) "
            f"= (…, {inputs.n_batches}, {network.n_cells})"
        )
    bad = np.argwhere(~np.isfinite(given))
    if len(bad):
        raise InputError(
            f"machine {network.machine}: start temperature of {network.cells[bad[0][2]]} is not finite in batch "
            f"{inputs.batch_ids[bad[0][1]]}; give a temperature in degC"
        )
    return np.broadcast_to(given, (len(given), inputs.n_batches, network.n_cells))


def _first_air(network: Network, values: Array, inputs: Inputs) -> Array:
    """Every surrounding at the start, (P, B, S)."""
    air = air_of(network, values, inputs)
    firsts = [air.ends(s, slice(0, 1))[..., 0, 0] for s in range(len(network.surroundings))]
    shape = (len(values), inputs.n_batches)
    out = [np.broadcast_to(f, shape) for f in firsts]
    return np.stack(out, axis=-1) if out else np.zeros((*shape, 0))


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
        InputError: a driver or surrounding of another name or without a value, or a steady state not reached.
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
        def call(law: Law, effect: str) -> Array:
            return _called(law, effect, values, drivers, degC, air)

        return np.array([heat_W(heat, call) for heat in network.heats])

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
        f"machine {network.machine}: the steady state does not converge (still {np.abs(now).max():.2g} W off after "
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


def _called(law: Law, effect: str, values: Array, drivers: Mapping[str, float], degC: Array, air: Array) -> Array:
    seen = {
        role: np.array([air[p.surrounding] if p.cells is None else p.cells @ degC]) for role, p in law.ports.items()
    }
    rise = {role: t - np.mean(air) for role, t in seen.items()}
    driver = {role: np.array([float(drivers[c])]) for role, c in law.drivers.items()}
    view = View(seen, rise, driver, np.zeros(1), np.zeros(1), 1.0)
    p = {name: v[0] for name, v in parameters_of(law, values, 1).items()}
    return np.asarray(getattr(law.mechanism, effect)(view, p)).reshape(-1)[0]
