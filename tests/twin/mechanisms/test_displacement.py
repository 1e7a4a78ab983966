"""What moves the tool: pieces added to error chains, and laws of speed, position and path."""

from __future__ import annotations

import numpy as np
import pytest

from data.errors import InputError
from tests.toys.small_machine import machine_with, network_with, part_with
from twin.compile import compile_network, expanded
from twin.mechanisms.base import View
from twin.mechanisms.displacement import (
    JointSlip,
    MandrelFixture,
    ScrewElongation,
    SpindleGrowth,
)


def z_um(network, **rise_K: float) -> float:
    return float(network.errors[0].matrix(network.values) @ [rise_K.get(name, 0.0) for name in network.cells])


def test_each_error_gets_its_own_gain_with_its_prior():
    machine_part = part_with(SpindleGrowth(), {"gain": {"value": -1.5, "spread": 0.4, "bounds": [-9, 9]}})
    link = expanded(machine_part).errors["z"].chain[-1]
    assert (link.gain.value, link.gain.spread, link.gain.bounds) == ("-1.5 um/K", "0.4 um/K", ("-9.0 um/K", "9.0 um/K"))
    network = network_with(SpindleGrowth(), {"gain": {"value": -1.5, "spread": 0.4}})
    gain = network.parameters[network.index("errors.z.chain[1].gain")]
    assert (gain.value, gain.spread, gain.low, gain.free) == (-1.5, 0.4, -100.0, True)


def test_a_bar_in_the_spindle_is_a_body_of_its_own():
    given = {"gain": "2.3 um/K", "capacity": "1.6 kJ/K", "conductance": "9 W/K"}
    network = network_with(MandrelFixture(), given, at="first")
    assert network.cells[-1] == "tried"
    conductance = network.conductance_W_per_K(network.values)
    assert conductance[-1].tolist() == [-9.0, 0.0, 0.0, 9.0]
    assert network.capacity_J_per_K(network.values)[-1] == 1600.0
    assert z_um(network, tried=10.0) == pytest.approx(23.0)


def test_a_bar_in_the_air_takes_its_temperature_alone_or_besides_that_of_its_seat():
    for at, conductance_W_per_K in ({"air": "room"}, 0.7), ({"seat": "first", "air": "room"}, 9.7):
        network = network_with(MandrelFixture(), {"conductance": "9 W/K", "film": "0.7 W/K"}, at=at)
        assert network.surrounding_W_per_K(network.values)[0, -1] == 0.7
        assert network.conductance_W_per_K(network.values)[-1, -1] == pytest.approx(conductance_W_per_K)


def test_the_file_may_expose_the_bar_to_more_air():
    machine = machine_with(MandrelFixture(), at="first")
    machine.twin["exposures"]["tried-room"] = "0.5 W/K"
    network = compile_network(machine)
    assert network.surrounding_W_per_K(network.values)[0, -1] == 0.5
    machine.twin["mechanisms"]["tried"]["at"] = {"air": "room"}
    with pytest.raises(InputError, match=r"exposures\.tried-room: mandrel_fixture adds this one; state it"):
        compile_network(machine)


def test_a_bar_of_a_body_s_name_is_refused():
    machine = machine_with(MandrelFixture())
    machine.twin["mechanisms"]["second"] = machine.twin["mechanisms"].pop("tried")
    with pytest.raises(InputError, match="a body is called 'second' already; give the mechanism another name"):
        compile_network(machine)


def screw(rise_K, position_mm, **p: float) -> np.ndarray:
    values = {"expansion": 11.5, "fixed_end": 100.0, "pretension": 3.0} | p
    view = View(rise_K={"screw": np.asarray(rise_K)}, driver={"position": np.asarray(position_mm)})
    return ScrewElongation().displacement(view, {k: np.array(v) for k, v in values.items()})


def test_a_stretched_screw_first_loses_its_tension_and_one_held_at_one_end_shrinks_too():
    assert screw([-5.0, 0.0, 3.0, 4.0], 1100.0) == pytest.approx([0.0, 0.0, 0.0, 11.5])
    assert screw([-2.0, 2.0], 1100.0, pretension=0.0) == pytest.approx([-23.0, 23.0])


def slip(rise_K, gain=2.0, limit=3.0) -> np.ndarray:
    view = View(rise_K={"part": np.asarray(rise_K, dtype=float)})
    return JointSlip().displacement(view, {"gain": np.array(gain), "limit": np.array(limit)})


def test_a_joint_sticks_then_slips_whatever_the_sampling():
    assert slip([0.0, 1.0, 2.0, 5.0, 4.0, 2.0, 0.0]).tolist() == [0.0, 2.0, 3.0, 3.0, 1.0, -3.0, -3.0]
    rise = np.array([0.0, 1.0, -1.0, 0.5])
    assert slip(rise, limit=1e9) == pytest.approx(2.0 * rise)
    fine = 6.0 * np.sin(2 * np.pi * np.linspace(0, 1, 1001))
    assert slip(fine)[::25] == pytest.approx(slip(fine[::25]), abs=1e-12)


def test_slip_of_many_sets_and_batches_at_once():
    rng = np.random.default_rng(0)
    rise, gain = rng.normal(0, 3, (1, 4, 50)).cumsum(-1), rng.normal(1, 1, (3, 1, 1))
    together = JointSlip().displacement(View(rise_K={"part": rise}), {"gain": gain, "limit": np.full((3, 1, 1), 2.0)})
    assert together.shape == (3, 4, 50)
    assert together[2, 3] == pytest.approx(slip(rise[0, 3], gain[2, 0, 0], 2.0))
