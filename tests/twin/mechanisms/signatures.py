"""How each mechanism that is seen rather than felt shows: displacement, sensors, the start; and the whole table."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from signatures_heat import HEAT, usual

from data.arrays import Numeric
from tests.toys.small_machine import network_with
from twin.mechanisms.base import Mechanism, View

TIME_S = np.arange(0.0, 4 * 3600.0, 60.0)
STOP = len(TIME_S) // 2
WARMING = 20.0 + 12.0 * (1 - np.exp(-TIME_S / 2400.0))
SINCE_S = np.maximum(TIME_S - TIME_S[STOP], 0.0)
COURSE = np.where(SINCE_S > 0, 20.0 + (WARMING[STOP] - 20.0) * np.exp(-SINCE_S / 2400.0), WARMING)
RATE = np.gradient(COURSE, TIME_S)


def residual(m: Mechanism, seen: Numeric = COURSE, degC: Mapping[str, Any] | None = None, **p: float) -> Numeric:
    view = View(time_s=TIME_S, step_s=60.0, degC=degC or {})
    return m.reading(seen, view, usual(m, **p)) - seen


def rises_of(network: Any, **rise_K: float) -> float:
    return float(network.errors[0].matrix(network.values) @ [rise_K.get(c, 0.0) for c in network.cells])


def column_bending(m: Mechanism) -> None:
    network = network_with(m, at={"hot": "second", "cold": "third"})
    assert rises_of(network, second=1.0, third=1.0) == pytest.approx(0.0, abs=1e-12)
    assert rises_of(network, second=1.0) == -rises_of(network, third=1.0) == pytest.approx(10.0)


def spindle_growth(m: Mechanism) -> None:
    network = network_with(m, at="second")
    assert rises_of(network, second=1.0) == pytest.approx(1.2) and rises_of(network, third=1.0) == 0.0


def speed_shift(m: Mechanism) -> None:
    speed = np.array([0.0, 6000.0, 6000.0, 0.0])
    assert m.ports == ()  # no temperature has a part in it
    assert m.displacement(View(driver={"speed": speed}), usual(m)).tolist() == [0.0, 3.0, 3.0, 0.0]


def screw_elongation(m: Mechanism) -> None:
    view = View(rise_K={"screw": np.full(4, 8.0)}, driver={"position": np.array([100.0, 300.0, 500.0, 700.0])})
    um = m.displacement(view, usual(m, fixed_end=100.0))
    assert um[0] == 0.0 and np.diff(um) == pytest.approx(um[1]) and um[1] == pytest.approx(11.5 * 5.0 * 0.2)


def joint_slip(m: Mechanism) -> None:
    rise = np.concatenate([np.linspace(0, 10, 50), np.linspace(10, 0, 50)])
    um = m.displacement(View(rise_K={"part": rise}), usual(m))
    assert rise[-1] == rise[0] and um[-1] == pytest.approx(-3.0)  # left over after the temperatures return
    assert um[25] != pytest.approx(um[-26])  # another path on cooling


def free_shift(m: Mechanism) -> None:
    view = View(rise_K={"body": np.array([0.0, 4.0, 4.0])}, driver={"level": np.array([2.0, 2.0, 0.0])})
    told = usual(m, linear=1.5, square=-0.5, per_K=2.0, product=0.25)
    assert m.displacement(view, told).tolist() == [1.0, 11.0, 8.0]
    beside = replace(view, driver={**view.driver, "other": np.array([0.0, 1.0, 1.0])})
    assert m.displacement(beside, usual(m, cross=3.0)).tolist() == [0.0, 6.0, 0.0]
    assert m.displacement(beside, usual(m, square_cross=3.0)).tolist() == [0.0, 12.0, 0.0]


def charge_strain(m: Mechanism) -> None:
    shape = usual(m, **{f"f{k}": 300.0 * np.sin(0.27 * k) for k in range(1, 13)})

    def strain(current_A: float, rise_K: float = 0.0) -> Numeric:
        time_s = np.linspace(0.0, 3600.0 * 2.9 / current_A, 200)
        rise = {"body": np.full(200, rise_K)}
        return m.displacement(View(driver={"current": np.full(200, -current_A)}, rise_K=rise, time_s=time_s), shape)

    assert strain(3.0) == pytest.approx(strain(12.0)) and np.ptp(strain(3.0)) > 200.0  # at every rate the same course
    assert strain(3.0, rise_K=5.0) - strain(3.0) == pytest.approx(50.0)


def mandrel_fixture(m: Mechanism) -> None:
    network = network_with(m)
    bar, nose = network.cells.index("tried"), network.cells.index("first")
    G, C = network.conductance_W_per_K(network.values), network.capacity_J_per_K(network.values)
    assert 5 <= C[bar] / -G[bar, nose] / 60 <= 30  # lag behind the nose, minutes
    assert rises_of(network, tried=1.0) == pytest.approx(2.3)


def sensor_lag(m: Mechanism) -> None:
    late = residual(m, COURSE)
    assert late[5:STOP] == pytest.approx(-40.0 * RATE[5:STOP], rel=0.05)
    settled = residual(m, np.full(len(TIME_S), 31.0))
    assert np.abs(settled).max() < 1e-12


def sensor_bonding(m: Mechanism) -> None:
    assert residual(m, degC={"air": np.array(22.0)}) == pytest.approx(-0.05 * (COURSE - 22.0))


def adds_the_same(amount_K: float, **p: float) -> Callable[[Mechanism], None]:
    def check(m: Mechanism) -> None:
        more = residual(m, **p)
        assert more == pytest.approx(amount_K) and np.ptp(more) < 1e-12  # rises are untouched

    return check


def sensor_place(m: Mechanism) -> None:
    assert residual(m, degC={"towards": COURSE + 8.0}, share=0.25) == pytest.approx(2.0)
    assert residual(m, degC={"towards": COURSE}, share=0.25) == pytest.approx(0.0)


def sensor_drift(m: Mechanism) -> None:
    assert residual(m, rate=0.1) == pytest.approx(0.1 * TIME_S / 3600)


def sensor_swap(m: Mechanism) -> None:
    network = network_with(m)
    shown = {r.channel: network.cells[int(r.cells.argmax())] for r in network.readings}
    assert shown == {"first": "second", "second": "first", "third": "third"}


def sensor_stuck(m: Mechanism) -> None:
    shown = COURSE + residual(m)
    assert len(set(shown[61:])) == 1 and (shown[:61] == COURSE[:61]).all()


def sensor_quantised(m: Mechanism) -> None:
    shown = COURSE + residual(m, step=0.5)
    assert shown == pytest.approx(0.5 * np.round(shown / 0.5)) and np.abs(shown - COURSE).max() <= 0.25
    assert len(set(np.round(shown, 6))) < 30


def time_skew(m: Mechanism) -> None:
    ahead = residual(m, delay=60.0)
    assert ahead[: STOP - 1] == pytest.approx(60.0 * RATE[: STOP - 1], rel=0.03)
    assert (ahead[: STOP - 1] > 0).all() and (ahead[STOP + 1 : -1] < 0).all()  # flips at the stop


def initial_state(m: Mechanism) -> None:
    network = network_with(m)
    _, into = network.starts[0]
    excess = m.start_K(View(), usual(m, excess=4.0)) * into
    G, C = network.conductance_W_per_K(network.values), network.capacity_J_per_K(network.values)
    course = np.array([expm(-G / C[:, None] * h * 3600) @ excess for h in (0.0, 0.5, 1.0, 4.0)])
    assert m.drivers == {} and excess.tolist() == [4.0, 0.0, 0.0]
    assert (np.diff(course.sum(axis=1)) < 0).all() and np.abs(course[-1]).max() < 0.04


SIGNATURES: Mapping[str, Callable[[Mechanism], None]] = {
    **HEAT,
    **{f.__name__: f for f in (
        column_bending, spindle_growth, speed_shift, screw_elongation, joint_slip, mandrel_fixture, sensor_lag,
        charge_strain, free_shift, sensor_place,
        sensor_bonding, sensor_drift, sensor_swap, sensor_stuck, sensor_quantised, time_skew, initial_state,
    )},
    "sensor_offset": adds_the_same(-0.3, offset=-0.3),
    "sensor_self_heat": adds_the_same(0.1),
}  # fmt: skip
