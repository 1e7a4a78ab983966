"""How each heat law shows in recordings, one focused assertion each; runs of one body by small explicit steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest

from data.arrays import Numeric
from tests.toys.small_machine import network_with
from twin.mechanisms.base import Mechanism, View

USUAL_RPM = np.array([1000.0, 2000.0, 4000.0, 8000.0])


def usual(m: Mechanism, **other: float) -> dict[str, Numeric]:
    return {**{s.name: np.array(s.value) for s in m.parameters}, **{k: np.array(v) for k, v in other.items()}}


def heat(
    m: Mechanism, degC: Mapping[str, Any] | None = None, p: Mapping[str, float] | None = None, **driver: Any
) -> Numeric:
    view = View(
        degC={k: np.asarray(v) for k, v in (degC or {}).items()}, driver={k: np.asarray(v) for k, v in driver.items()}
    )
    return m.heat_W(view, usual(m, **(p or {})))


def factor(m: Mechanism, degC: Mapping[str, Any] | None = None, **driver: Any) -> Numeric:
    view = View(
        degC={k: np.asarray(v) for k, v in (degC or {}).items()}, driver={k: np.asarray(v) for k, v in driver.items()}
    )
    return m.factor(view, usual(m))


def run(rate: Callable[[Numeric, float], Any], start: Any, hours: float, step_s: float = 2.0) -> Numeric:
    """Temperatures (n + 1, bodies) by explicit Euler; `rate` in K/s."""
    out = [np.asarray(start, dtype=float)]
    for k in range(int(hours * 3600 / step_s)):
        out.append(out[-1] + step_s * np.asarray(rate(out[-1], k * step_s)))
    return np.array(out)


def exponent(watts: Numeric) -> Numeric:
    return np.diff(np.log(watts)) / np.diff(np.log(USUAL_RPM))


def bearing_viscous(m: Mechanism) -> None:
    assert exponent(heat(m, speed=USUAL_RPM)) == pytest.approx(5 / 3)  # between 1.3 and 1.7


def bearing_load(m: Mechanism) -> None:
    assert exponent(heat(m, speed=USUAL_RPM)) == pytest.approx(1.0)


def viscosity_feedback(m: Mechanism) -> None:
    def rise(room: float) -> Numeric:
        return run(lambda T, t: (120.0 * factor(m, {"oil": T}) - 6.0 * (T - room)) / 8e3, room, 3.0) - room

    watts = factor(m, {"oil": rise(20.0) + 20.0})
    assert watts.argmax() == 0 and watts[-1] < 0.8 * watts[0]
    assert rise(5.0)[-1] > 1.2 * rise(30.0)[-1]


def preload_feedback(m: Mechanism) -> None:
    def rate(T: Numeric, t: float) -> Numeric:
        shaft, housing = T
        watts = 75.0 * factor(m, {"shaft": shaft, "housing": housing})  # to each of them
        across = 14.0 * (shaft - housing)
        return np.array([(watts - across - 9.0 * shaft) / 8e3, (watts + across - 20.0 * housing) / 60e3])

    shaft, housing = run(rate, [0.0, 0.0], 6.0, 10.0).T
    watts = factor(m, {"shaft": shaft, "housing": housing})
    assert 10 <= watts.argmax() / 6 <= 40 and watts[-1] < 0.95 * watts.max()


def motor_loss(m: Mechanism) -> None:
    at_once, rated = heat(m, speed=[1.0, 6000.0])
    assert at_once == pytest.approx(usual(m)["idle"], rel=1e-3) and rated == pytest.approx(230.0)


def belt_loss(m: Mechanism) -> None:
    assert exponent(heat(m, speed=USUAL_RPM)) == pytest.approx(1.5)


def feed_friction(watts_at_10_m_per_min: float) -> Callable[[Mechanism], None]:
    def check(m: Mechanism) -> None:
        stopped, there, back, half = heat(m, feed=[0.0, 10e3, -10e3, 5e3])
        assert stopped == 0.0 and there == back == 2 * half == pytest.approx(watts_at_10_m_per_min)

    return check


def rotating_convection(m: Mechanism) -> None:
    running, stopped = (5e3 / (0.8 * factor(m, speed=n)) for n in (6000.0, 0.0))
    assert running == pytest.approx(stopped / 4.5)


def natural_convection(m: Mechanism) -> None:
    each_W_per_K = heat(m, {"body": 20.0, "air": np.array([21.0, 25.0, 40.0])}) / [1.0, 5.0, 20.0]
    assert (np.diff(each_W_per_K) > 0).all() and each_W_per_K[0] >= 1.3 and each_W_per_K[2] <= 6.0


def radiation(m: Mechanism) -> None:
    room, hot_neighbour = heat(m, {"body": 20.0, "surrounding": np.array([21.0, 60.0])})
    assert 4.6 <= room <= 5.4 and hot_neighbour > 40 * room


def draught(m: Mechanism) -> None:
    p = usual(m)

    def rate(T: Numeric, t: float) -> Numeric:
        view = View(time_s=np.array([t]))
        return 5.0 * m.factor(view, p) * (20.0 + m.surrounding_K(view, p) - T) / np.array([5e3, 50e3])

    thin, thick = run(rate, [20.0, 20.0], 4.0, 10.0).T
    assert thin.min() < thick.min() < 20.0
    assert 60 <= thin.argmin() / 6 <= 60 + 15 + 1 and thin[-1] == pytest.approx(20.0, abs=0.1)


def joint_conductance(m: Mechanism) -> None:
    loose, clamped = m.factor(View(driver={"closed": np.array([0.0, 1.0])}), usual(m, ratio=4.0))
    gradient_K = 100.0 / (10.0 * np.array([loose, clamped]))
    assert gradient_K.tolist() == [10.0, 2.5]


def jacket_chiller(m: Mechanism) -> None:
    p, on, T, starts = usual(m), np.array(True), np.array(23.0), []
    for second in range(4 * 3600):
        T = T + (300.0 + np.where(on, m.flow_W(T, p), 0.0)) / 50e3
        now = m.switched(on, T, p)
        starts += [second] if now and not on else []
        assert second < 600 or 20.98 <= T <= 23.02
        on = now
    assert (np.diff(starts) > 180).all() and (np.diff(starts) < 900).all() and len(starts) > 10


def coolant_jacket(m: Mechanism) -> None:
    cold, warm = heat(m, {"jacket": 22.0, "room": np.array([15.0, 25.0])}, {"follow": 1.0})
    assert (cold, warm) == pytest.approx((150.0 * -7.0, 150.0 * 3.0))  # drawn to the room
    assert heat(m, {"jacket": 22.0}, {"follow": 1.0}) == heat(m, {"jacket": 22.0, "room": 35.0}) == -300.0


def cutting_fluid(m: Mechanism) -> None:
    warm = {"body": 20.0, "tank": 25.0}
    assert heat(m, warm, flow=[0.0, 1.0, 1.0, 0.0]).tolist() == [0.0, 1000.0, 1000.0, 0.0]


def enclosure_air(m: Mechanism) -> None:
    network = network_with(m)
    air = network.cells.index("tried")
    G, C = network.conductance_W_per_K(network.values), network.capacity_J_per_K(network.values)
    assert 5 <= C[air] / G[air, air] / 60 <= 30  # the fast mode's time constant, minutes
    assert G[air, network.cells.index("third")] < 0  # the surface that saw the room now sees the air


def stratification(m: Mechanism) -> None:
    upper, lower = (m.surrounding_K(View(), usual(m, height=h)) for h in (2.0, 0.0))
    assert lower == 0.0 and 0.3 <= (upper - lower) / 2.0 <= 2.0


def floor_sink(m: Mechanism) -> None:
    network = network_with(m)
    number = [s.name for s in network.surroundings].index("tried")
    floor, room = network.surroundings[number], np.array([5.0, 30.0])  # winter, summer
    mean, follow = network.values[[floor.value, floor.follow]]
    into_W = network.surrounding_W_per_K(network.values)[number][:, None] * (mean + follow * (room - mean) - room)
    assert floor.first == ("room",)  # as it was at the start, whatever the room does later
    assert into_W[0] == pytest.approx([65.0, -60.0]) and (into_W[1:] == 0).all()


def heat_bridge(m: Mechanism) -> None:
    network = network_with(m, at={"body": "first", "other": "third"})  # which the small machine does not link
    first, third = network.cells.index("first"), network.cells.index("third")
    G = network.conductance_W_per_K(network.values)
    warm = np.zeros(3)
    warm[third] = 10.0
    assert (-G @ warm)[first] == pytest.approx(50.0)  # the one follows the other
    assert network_with(m, at={"body": "third", "other": "first"}).values == pytest.approx(network.values)


def cabinet_heat(m: Mechanism) -> None:
    assert "speed" not in m.drivers and heat(m) == 200.0  # without a driver it runs all the time


def hydraulic_unit(m: Mechanism) -> None:
    view = View(time_s=np.arange(0.0, 6000.0, 10.0), step_s=10.0)
    watts = m.heat_W(view, usual(m))
    assert watts.mean() == pytest.approx(200.0) and set(np.round(watts, 6)) == {0.0, 500.0}
    assert (np.diff(watts) > 1.0).sum() == 9  # ten cycles of ten minutes


def sun(m: Mechanism) -> None:
    watts = m.heat_W(View(clock_h=np.array([6.0, 10.0, 12.0, 14.0, 18.0, np.nan])), usual(m))
    assert watts[[0, 4, 5]].tolist() == [0.0, 0.0, 0.0]
    assert watts[1] == pytest.approx(watts[3]) and watts[2] == pytest.approx(75.0)


def cutting_heat(m: Mechanism) -> None:
    assert set(m.drivers) == {"power"}
    assert heat(m, power=[0.0, 1000.0, 2000.0, -500.0]).tolist() == pytest.approx([0.0, 50.0, 100.0, 0.0])


def electrical_heat(m: Mechanism) -> None:
    assert heat(m, p={"gain": 0.02}, level=[0.0, 50.0, 100.0]).tolist() == [0.0, 1.0, 2.0]


def free_flux(m: Mechanism) -> None:
    warm, told = {"body": 25.0}, {"constant": 3.0, "linear": 2.0, "square": 0.5, "per_K": -1.0, "product": 0.1}
    assert heat(m, warm, told, level=[0.0, 2.0, -2.0]).tolist() == [-2.0, 5.0, -5.0]
    assert heat(m, warm, told) == heat(m, warm, told, level=0.0)
    for both, watts in (("cross", 9.0), ("square_cross", 18.0)):
        beside = heat(m, {"body": 20.0}, {both: 1.5}, level=[0.0, 2.0, 2.0], other=[3.0, 3.0, 0.0])
        assert beside.tolist() == [0.0, watts, 0.0]


def ohmic_heat(m: Mechanism) -> None:
    charge, discharge, twice = heat(m, {"body": 25.0}, {"entropic": 1e-4}, current=[10.0, -10.0, 20.0])
    assert charge - discharge == pytest.approx(2 * 1e-4 * 10 * 298.15)
    assert charge + discharge == pytest.approx(2 * 0.02 * 10**2)
    assert twice == pytest.approx(0.02 * 20**2 + 1e-4 * 20 * 298.15)


def supply_sag(m: Mechanism) -> None:
    assert factor(m, other=[0.0, 0.5, 1.0]) == pytest.approx([1.0, 0.9, 0.8])


def voltage_loss_heat(m: Mechanism) -> None:
    def loss_W(current_A: float) -> Numeric:
        """Over the same charge, on a cell whose voltage falls by 20 mohm."""
        time_s = np.linspace(0.0, 3600.0 * 2.9 / current_A, 200)
        drawn = current_A * time_s / 3600.0
        neutral_V = np.interp(drawn, np.linspace(0.0, 3.0, 8), [float(usual(m)[f"u{k}"]) for k in range(8)])
        driver = {"current": np.full(200, -current_A), "voltage": neutral_V - 0.02 * current_A}
        return m.heat_W(View(driver=driver, time_s=time_s), usual(m))

    slow, fast = loss_W(3.0), loss_W(12.0)
    assert fast.mean() == pytest.approx(0.02 * 12.0**2, rel=0.1) and fast.mean() > 10 * slow.mean()
    bent = {k: m.heat_W(_discharge(), usual(m, **{k: 4.0})) - m.heat_W(_discharge(), usual(m)) for k in ("u6", "u1")}
    assert np.abs(bent["u6"]).argmax() > 150 > 50 > np.abs(bent["u1"]).argmax()  # at its own charge


def _discharge() -> View:
    return View(
        driver={"current": np.full(200, -3.0), "voltage": np.full(200, 3.5)}, time_s=np.linspace(0.0, 3500.0, 200)
    )


HEAT: Mapping[str, Callable[[Mechanism], None]] = {
    **{f.__name__: f for f in (
        bearing_viscous, bearing_load, viscosity_feedback, preload_feedback, motor_loss, belt_loss, rotating_convection,
        natural_convection, radiation, draught, joint_conductance, heat_bridge, jacket_chiller, coolant_jacket,
        cutting_fluid,
        enclosure_air, stratification, floor_sink, cabinet_heat, hydraulic_unit, sun, cutting_heat, electrical_heat,
        ohmic_heat, supply_sag, voltage_loss_heat, free_flux,
    )},
    "nut_friction": feed_friction(1000 * 2 * np.pi * 0.5 / 60),
    "screw_bearing": feed_friction(1000 * 2 * np.pi * 0.3 / 60),
    "guide_friction": feed_friction(0.01 * 5000.0 * 10.0 / 60),
}  # fmt: skip
