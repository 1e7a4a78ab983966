"""Simulated runs: what was drawn, what was recorded, and machine types that keep their own books."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from data.errors import InputError
from thermodrift_exam.plants.types.machines import HMC, LATHE, VMC
from thermodrift_exam.plants.types.runs import MachineType, Scatter, SimulatedRun

TYPES = {"vmc": VMC, "hmc": HMC, "lathe": LATHE}
STAGES = ((300.0, 0.0), (3600.0, 2000.0), (600.0, 0.0))


def run(seed: int = 0, scatter: Scatter | None = None) -> SimulatedRun:
    return SimulatedRun.drawn("a", STAGES, 20.0, np.random.default_rng(seed), scatter)


def test_a_narrowed_scatter_changes_nothing_else() -> None:
    plain, still = run(), run(scatter=Scatter(drift_K=(0.0, 0.0), start_K=(0.0, 0.0)))
    assert still.drift_K_per_h == 0.0 and set(still.slow_start_K.values()) == {0.0}
    assert (still.ripple_period_s, still.friction) == (plain.ripple_period_s, plain.friction)
    assert -1 / 6 <= plain.drift_K_per_h <= 5 / 6 and 0.85 <= plain.friction <= 1.15
    assert all(-2 <= v <= 4 for v in plain.slow_start_K.values())


def test_speed_room_and_floor_by_hand() -> None:
    one = replace(run(), drift_K_per_h=0.6, ripple_K=0.0)
    np.testing.assert_array_equal(one.speed_rpm(np.array([0.0, 299.0, 300.0, 3899.0, 3900.0, 9999.0])),
                                  [0.0, 0.0, 2000.0, 2000.0, 0.0, 0.0])  # fmt: skip
    np.testing.assert_allclose(one.room_degC(np.array([0.0, 7200.0])), [20.0, 21.2])
    assert one.duration_s == 4500.0 and one.floor_degC == pytest.approx((20.0 + 17.65) / 2)


@pytest.mark.parametrize("name", TYPES)
def test_recordings_of_a_machine(name: str) -> None:
    kind = TYPES[name]

    def recorded(seed: int) -> list[object]:
        rng = np.random.default_rng(seed)
        rig = kind.drawn(rng, 300.0)
        return [rig, *rig.record([SimulatedRun.drawn(f"r{k}", STAGES, 20.0, rng) for k in range(2)], rng)]

    rig, batch, other = recorded(1)
    table = batch.table
    assert batch.simulated and table.equals(recorded(1)[1].table)
    assert not table.equals(recorded(2)[1].table) and not table.equals(other.table)
    assert table["time_s"].tolist() == [300.0 * k for k in range(16)]
    assert table["spindle_rpm"].tolist() == [0.0] * 2 + [2000.0] * 12 + [0.0] * 2, (
        "a row shows the step that ends there"
    )
    assert batch.names("temperature", "ambient") == tuple(kind.sensors) and batch.names("ambient") == ("room",)
    assert batch.names("error") == tuple(kind.machine.um_per_K)
    for sensor in kind.sensors:
        np.testing.assert_allclose(table[sensor] / 0.1, np.rint(table[sensor] / 0.1), atol=1e-6)
    for error in batch.names("error"):
        np.testing.assert_array_equal(table[error], np.rint(table[error]))
    assert abs(table["room"][0] - rig.offset_K["room"] - 20.0) <= 0.06, "the room's sensor: its offset and 0.1 K"
    assert rig.of.machine != kind.machine


@pytest.mark.parametrize("name", TYPES)
def test_a_machine_as_warm_as_room_and_floor_stays(name: str) -> None:
    machine = TYPES[name].machine
    rates, room, floor = machine.rates(1500.0)
    np.testing.assert_allclose(rates @ np.full(len(machine.bodies), 20.0) + 20 * room + 20 * floor, 0.0, atol=1e-15)
    assert np.linalg.eigvals(rates).real.max() < 0, "every body ends at room and floor"


@pytest.mark.parametrize("name", TYPES)
def test_what_a_type_names_is_there(name: str) -> None:
    kind: MachineType = TYPES[name]
    bodies = set(kind.machine.bodies)
    assert {b for b in kind.sensors.values() if b != "room"} <= bodies
    assert {b for part in kind.slow_bodies.values() for b in part} <= bodies
    assert set(kind.slow_bodies) == {"bed", "column", "table"}
    assert {b for moves in kind.machine.um_per_K.values() for b in moves} <= bodies
    assert {h.body for h in kind.machine.heats} | {b.housing for b in kind.machine.bearings} <= bodies


def test_uniform_warmth_of_the_horizontal_machine_leaves_the_difference_of_steel_and_iron() -> None:
    rise = np.ones(len(HMC.machine.bodies))
    error_um = HMC.machine.error_um(rise, np.zeros(()))
    assert error_um["z"] == pytest.approx(0.35 * (11.5 - 10.8))
    assert error_um["y"] == pytest.approx(-0.40 * (11.5 - 10.8))


def test_a_step_that_does_not_fit_is_told_in_one_line() -> None:
    with pytest.raises(InputError, match="sample_s 45; expected a whole number of steps of 10 s") as caught:
        VMC.drawn(np.random.default_rng(0), 45.0)
    assert "\n" not in str(caught.value)
