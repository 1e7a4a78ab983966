"""Simulated machines: a body by its closed form, and machines of one type that differ as stated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from plants.sample import sample_machine
from plants.sample.thermal_machine import BearingSet, SpeedHeat, ThermalMachine

ONE = ThermalMachine(
    capacity_J_per_K={"shaft": 3600.0},
    link_W_per_K={},
    room_W_per_K={"shaft": 1.0},
    floor_W_per_K={},
    bearings=(),
    heats=(SpeedHeat("shaft", ((6.0, 0.0), (8.0, 2.0))),),
    always_W={},
    um_per_K={"z": {"shaft": 2.0}},
    speed_shift_um={"z": 4.0},
)


def test_one_body_warms_by_its_closed_form() -> None:
    """6 + 8/4 W at half speed into 3600 J/K and 1 W/K: 8 K with a time constant of one hour."""
    steps = 720
    body = ONE.simulate(np.full((steps, 1), 3000.0), np.full((steps, 1), 20.0), np.zeros(1), np.full((1, 1), 20.0),
                        np.ones(1))  # fmt: skip
    time_h = np.arange(steps + 1) / 360
    np.testing.assert_allclose(body[:, 0, 0], 20 + 8 * (1 - np.exp(-time_h)), atol=1e-9)
    error_um = ONE.error_um(body - body[0], np.full((steps + 1, 1), 3000.0))["z"][:, 0]
    np.testing.assert_allclose(error_um, 2 * (body[:, 0, 0] - 20) + 4 * 0.25, atol=1e-12)


def test_a_spindle_that_stands_makes_no_heat() -> None:
    body = np.full((1, 1), 20.0)
    assert ONE.heat_W(body, np.zeros(1), np.ones(1)).item() == 0.0
    bearing = BearingSet("shaft", 2, 70.0, 600.0, 22e3)
    assert replace(ONE, bearings=(bearing,)).heat_W(body, np.zeros(1), np.ones(1)).item() == 0.0


def test_the_sample_machine_as_data_moves_as_the_sample_machine() -> None:
    rng = np.random.default_rng(3)
    rise_K, speed_rpm = rng.normal(0, 5, (7, 14)), rng.uniform(0, 6000, 7)
    told = sample_machine.displacement_um(rise_K, speed_rpm)
    for channel, error_um in sample_machine.machine().error_um(rise_K, speed_rpm).items():
        np.testing.assert_allclose(error_um, told[channel], atol=1e-9)


def test_another_machine_of_the_type_differs_within_its_share_and_by_its_seed_alone() -> None:
    plain = sample_machine.machine()
    one, same, other = (plain.scattered(np.random.default_rng(s), 0.2) for s in (1, 1, 2))
    assert one == same != other
    for name in ("capacity_J_per_K", "link_W_per_K", "room_W_per_K", "always_W", "speed_shift_um"):
        ratio = np.array(list(getattr(one, name).values())) / np.array(list(getattr(plain, name).values()))
        assert np.all((ratio >= 0.8) & (ratio <= 1.2)) and len(set(ratio.tolist())) == len(ratio)
    assert one.um_per_K == plain.um_per_K
    assert [b.gain for b in one.bearings] != [b.gain for b in plain.bearings]


def test_a_bearing_of_twice_the_gain_makes_twice_the_heat() -> None:
    plain = sample_machine.machine()
    doubled = replace(plain, bearings=tuple(replace(b, gain=2.0) for b in plain.bearings), heats=(), always_W={})
    single = replace(plain, heats=(), always_W={})
    body, speed, friction = np.full((1, 14), 20.0), np.array([4000.0]), np.ones(1)
    np.testing.assert_allclose(doubled.heat_W(body, speed, friction), 2 * single.heat_W(body, speed, friction))
    assert single.heat_W(body, speed, friction).sum() == pytest.approx(
        sum(sample_machine.heat_W(body, speed, friction)[0])
        - sample_machine.AUXILIARIES_W
        - sum(w * (2 / 3) ** e for h in sample_machine.HEATS for w, e in h.terms)
    )
