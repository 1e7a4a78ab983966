"""Every mechanism in a simulation of the small machine: it runs, it shows, and no energy is lost or made."""

from __future__ import annotations

import numpy as np
import pytest
from points import DRIVER, Point
from small_machine import BODIES, machine_with

from data.machine import Machine
from twin.compile import compile_network
from twin.mechanisms import MECHANISMS
from twin.mechanisms.base import Mechanism
from twin.network import Network
from twin.simulation import Simulation, simulate
from twin.simulation.inputs import Inputs

N_INTERVALS, STEP_S = 120, 60.0
OPEN = ("enclosure_air", "floor_sink", "initial_state")  # these exchange with a surrounding, or start elsewhere
every = pytest.mark.parametrize("key", list(MECHANISMS))


def machine_at_point(m: Mechanism) -> Machine:
    """The mechanism with parameters beside the usual ones, so that none is 0."""
    point = Point.of(m).values if m.effects() != ("expand",) else {}
    return machine_with(m, {s.name: f"{float(point.get(s.name, s.value))} {s.unit}" for s in m.parameters})


def inputs_for(network: Network, machine: Machine) -> Inputs:
    """Two batches: drivers half of the time on, a room that warms by a kelvin, bodies that start a little apart."""
    time_s = np.tile(STEP_S * np.arange(N_INTERVALS + 1), (2, 1))
    on = np.where(np.arange(N_INTERVALS) < N_INTERVALS // 2, 1.0, 0.0) * np.array([[1.0], [0.5]])
    return Inputs(
        batch_ids=("a", "b"),
        time_s=time_s,
        n_intervals=np.full(2, N_INTERVALS),
        drivers={n: on * DRIVER[machine.channels[n].unit] for n in network.drivers},
        recorded={"room": 20.0 + time_s / time_s.max() + np.array([[0.0], [5.0]])},
        clock_h=np.array([8.0, 11.0]),
        first={b: np.array([20.0, 25.0]) + k for k, b in enumerate((*BODIES, "room"))},
    )


def simulated(machine: Machine) -> Simulation:
    network = compile_network(machine)
    return simulate(network, network.values, inputs_for(network, machine), keep_cells=True)


@every
def test_it_runs_and_changes_what_is_seen(key):
    with_it = machine_at_point(MECHANISMS[key]())
    out = simulated(with_it)
    assert np.isfinite(out.readings).all() and np.isfinite(out.errors).all()
    with_it.twin["mechanisms"].pop("tried")
    bare = simulated(with_it)
    moved_K, moved_um = np.abs(out.readings - bare.readings).max(), np.abs(out.errors - bare.errors).max()
    effects = set(MECHANISMS[key]().effects())
    if "error" in MECHANISMS[key].acts_at and "reading" not in effects:
        assert moved_um > 0.05
        assert moved_K < 1e-9 or key == "mandrel_fixture"  # temperatures are perfect; the bar itself takes some heat
    else:
        assert moved_K > 0.005


@every
def test_a_closed_network_keeps_its_energy(key):
    m = MECHANISMS[key]()
    machine = machine_at_point(m)
    for exposure in machine.twin["exposures"]:
        machine.twin["exposures"][exposure] = "1e-9 W/K"
    if key in OPEN:
        machine.twin["mechanisms"].pop("tried")
    out = simulated(machine)
    network = out.network
    stored_J = ((out.cells_degC - out.cells_degC[:, :, :1]) * network.capacity_J_per_K(network.values)).sum(axis=-1)
    exchanged = "tried" if m.takes_from else ""
    supplied_J = sum(J for name, J in out.heat_J.items() if name != exchanged)
    # heat that follows a temperature is told as if it were linear within an interval
    assert stored_J == pytest.approx(supplied_J, rel=1e-3 if m.ports and not exchanged else 1e-9, abs=0.05)


@every
def test_parameter_sets_together_are_those_apart(key):
    machine = machine_at_point(MECHANISMS[key]())
    network = compile_network(machine)
    inputs = inputs_for(network, machine)
    sets = network.values * np.array([[1.0], [0.97], [0.9]])
    together = simulate(network, sets, inputs)
    for p, values in enumerate(sets):
        alone = simulate(network, values, inputs)
        assert together.readings[p] == pytest.approx(alone.readings[0], abs=2e-3)
        assert together.errors[p] == pytest.approx(alone.errors[0], abs=2e-2)
