"""What moves the tool: pieces added to error chains, and laws of speed, position and path."""

from __future__ import annotations

import numpy as np
import pytest

from data.errors import InputError
from thermodrift.testing.small_machine import machine_with, network_with, part_with
from twin.compile import compile_network, expanded
from twin.mechanisms.base import View
from twin.mechanisms.displacement import (
    ColumnBending,
    JointSlip,
    MandrelFixture,
    ScrewElongation,
    SpeedShift,
    SpindleGrowth,
)

OWN_UM_PER_K = 11.5 * 0.2  # of the chain that the small machine has anyway


def z_um(network, **rise_K: float) -> float:
    return float(network.errors[0].matrix(network.values) @ [rise_K.get(name, 0.0) for name in network.cells])


def test_bending_adds_gain_times_the_difference_of_the_sides():
    network = network_with(ColumnBending(), {"gain": "-12 um/K"}, at={"hot": "second", "cold": "third"})
    assert z_um(network, second=3.0, third=1.0) == pytest.approx(-24.0)


def test_bending_of_a_uniform_warm_up_is_nothing():
    network = network_with(ColumnBending(), {"gain": "-12 um/K"})
    assert z_um(network, first=1.0, second=1.0, third=1.0) == pytest.approx(OWN_UM_PER_K)


def test_growth_of_200_mm_of_steel_by_10_K_is_23_um():
    network = network_with(SpindleGrowth(), {"gain": "2.3 um/K"}, at="second")
    assert z_um(network, second=10.0) == pytest.approx(23.0)


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


@pytest.mark.parametrize(
    ("at", "told"),
    [
        (None, r"tried\.at: mandrel_fixture needs seat or air, got \[\]"),
        ({"nest": "first"}, r"tried\.at: mandrel_fixture needs seat or air, got \['nest'\]"),
        ({"air": "rom"}, r"tried\.at\.air: no body or surrounding 'rom'; did you mean 'room'\?"),
        ({"seat": "room"}, r"tried\.at\.seat: no body 'room'"),
    ],
)
def test_a_bar_that_is_nowhere(at, told):
    with pytest.raises(InputError, match=told):
        network_with(MandrelFixture(), at=at)


def test_a_bar_of_a_body_s_name_is_refused():
    machine = machine_with(MandrelFixture())
    machine.twin["mechanisms"]["second"] = machine.twin["mechanisms"].pop("tried")
    with pytest.raises(InputError, match="a body is called 'second' already; give the mechanism another name"):
        compile_network(machine)


@pytest.mark.parametrize(
    ("instance", "told"),
    [
        ({"acts_on": "q"}, r"tried\.acts_on: no error 'q'; Allowed: z"),
        ({"acts_on": None}, r"tried\.acts_on is missing; name the errors that column_bending moves"),
        ({"at": {"hot": "first"}}, r"tried\.at: column_bending needs hot, cold, got \['hot'\]"),
        ({"at": {"hot": "frist", "cold": "third"}}, r"tried\.at\.hot: no body 'frist'; did you mean 'first'\?"),
        ({"at": {"hot": ["first", "second"], "cold": "third"}}, r"tried\.at\.hot: got 2 places, expected one"),
        (
            {"parameters": {"gian": 1}},
            r"tried\.parameters: column_bending has no parameter 'gian'; did you mean 'gain'",
        ),
        ({"parameters": {"gain": "1 W/K"}}, r"gain: unit 'W/K' cannot be read as 'um/K'"),
    ],
)
def test_mistakes_in_one_line(instance, told):
    with pytest.raises(InputError, match=told):
        network_with(ColumnBending(), **instance)


def test_speed_shift_is_4_um_at_6000_and_a_ninth_at_2000():
    view = View(driver={"speed": np.array([0.0, 2000.0, -6000.0])})
    shift = SpeedShift().displacement(view, {"shift": np.array(4.0), "rated": np.array(6000.0)})
    assert shift == pytest.approx([0.0, 4.0 / 9.0, 4.0])


def screw(rise_K, position_mm, **p: float) -> np.ndarray:
    values = {"expansion": 11.5, "fixed_end": 100.0, "pretension": 3.0} | p
    view = View(rise_K={"screw": np.asarray(rise_K)}, driver={"position": np.asarray(position_mm)})
    return ScrewElongation().displacement(view, {k: np.array(v) for k, v in values.items()})


def test_a_screw_grows_with_the_distance_from_its_fixed_end():
    assert screw(8.0, [100.0, 600.0, -400.0]) == pytest.approx([0.0, 28.75, -28.75])


def test_a_stretched_screw_first_loses_its_tension():
    assert screw([-5.0, 0.0, 3.0, 4.0], 1100.0) == pytest.approx([0.0, 0.0, 0.0, 11.5])


def test_a_screw_held_at_one_end_shrinks_too():
    assert screw([-2.0, 2.0], 1100.0, pretension=0.0) == pytest.approx([-23.0, 23.0])


def slip(rise_K, gain=2.0, limit=3.0) -> np.ndarray:
    view = View(rise_K={"part": np.asarray(rise_K, dtype=float)})
    return JointSlip().displacement(view, {"gain": np.array(gain), "limit": np.array(limit)})


def test_a_joint_sticks_then_slips_then_takes_another_way_back():
    assert slip([0.0, 1.0, 2.0, 5.0, 4.0, 2.0, 0.0]).tolist() == [0.0, 2.0, 3.0, 3.0, 1.0, -3.0, -3.0]


def test_a_joint_that_never_slips_is_elastic():
    rise = np.array([0.0, 1.0, -1.0, 0.5])
    assert slip(rise, limit=1e9) == pytest.approx(2.0 * rise)


def test_slip_does_not_depend_on_the_sampling():
    time = np.linspace(0, 1, 1001)
    rise = 6.0 * np.sin(2 * np.pi * time)
    assert slip(rise)[::25] == pytest.approx(slip(rise[::25]), abs=1e-12)


def test_slip_of_many_sets_and_batches_at_once():
    rng = np.random.default_rng(0)
    rise, gain = rng.normal(0, 3, (1, 4, 50)).cumsum(-1), rng.normal(1, 1, (3, 1, 1))
    together = JointSlip().displacement(View(rise_K={"part": rise}), {"gain": gain, "limit": np.full((3, 1, 1), 2.0)})
    assert together.shape == (3, 4, 50)
    assert together[2, 3] == pytest.approx(slip(rise[0, 3], gain[2, 0, 0], 2.0))
