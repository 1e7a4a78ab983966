"""Heat laws where their equation changes: limits, windows, signs; the contract compares each with its equation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from tests.toys.small_machine import machine_with
from twin.compile import compile_network
from twin.mechanisms import MECHANISMS
from twin.mechanisms.base import Mechanism, View

# what heats alike forwards and backwards; other drivers cool, brake or discharge
EITHER_WAY = {
    "heat_W": ("bearing_viscous", "bearing_load", "motor_loss", "belt_loss", "cutting_fluid", "cabinet_heat"),
    "factor": ("rotating_convection", "joint_conductance", "supply_sag"),
    "displacement": ("speed_shift",),
}


def law(key: str) -> Mechanism:
    return MECHANISMS[key]()


def usual(key: str, **changes: Any) -> dict[str, Any]:
    """The parameters' usual values, some changed."""
    assert set(changes) <= {s.name for s in MECHANISMS[key].parameters}
    return {s.name: np.asarray(s.value) for s in MECHANISMS[key].parameters} | {
        k: np.asarray(v) for k, v in changes.items()
    }


def heat(key: str, degC: Mapping[str, Any] | None = None, p: Mapping[str, Any] | None = None, **driver: Any) -> Any:
    """Heat in W at temperatures by port and drivers, at the usual parameters or with some changed."""
    return law(key).heat_W(seen(degC, **driver), usual(key, **(p or {})))


def seen(degC: Mapping[str, Any] | None = None, **driver: Any) -> View:
    return View(
        degC={k: np.asarray(v) for k, v in (degC or {}).items()},
        driver={k: np.asarray(v, float) for k, v in driver.items()},
    )


def test_palmgren_by_hand() -> None:
    """Bore 60, dm 77.5 mm, grease f0 = 1, nu = 22 mm²/s, 6000 rpm: 132000^(2/3) = 2592.5, M0 = 120.68 N mm, 75.8 W."""
    one = heat("bearing_viscous", p={"count": 1, "mean_diameter": 77.5, "viscosity": 22}, speed=6000)
    assert one == pytest.approx(75.81, abs=0.02)
    assert heat("bearing_viscous", p={"count": 3, "mean_diameter": 77.5, "viscosity": 22}, speed=6000) == pytest.approx(
        3 * one
    )
    # nu n = 1100 < 2000: M0 = 160e-7 * 465484 = 7.448 N mm, P = 1.047e-4 * 50 * 7.448 W
    slow = heat("bearing_viscous", p={"count": 1, "mean_diameter": 77.5, "viscosity": 22}, speed=50)
    assert slow == pytest.approx(0.03899, rel=1e-3)


def test_natural_convection_is_laminar_or_turbulent_by_hand() -> None:
    """10 K on 0.5 m: h = 1.42 (10 / 0.5)^(1/4) = 3.003. 20 K on 1 m, dT L³ > 2.6: h = 1.31 20^(1/3)."""
    cooled = heat("natural_convection", {"body": 30, "air": 20}, {"area": 1, "height": 0.5})
    assert cooled == pytest.approx(-30.03, abs=0.01)
    tall = heat("natural_convection", {"body": 0, "air": 20}, {"area": 2, "height": 1.0})
    assert tall == pytest.approx(142.23, abs=0.01)
    span = np.linspace(-5, 5, 2001)
    assert np.abs(np.diff(heat("natural_convection", {"body": 0, "air": span}, {"height": 1.0}))).max() < 0.02


@pytest.mark.parametrize(("effect", "key"), [(effect, key) for effect, keys in EITHER_WAY.items() for key in keys])
def test_a_driver_counts_alike_with_either_sign(effect: str, key: str) -> None:
    mechanism = law(key)
    degC = {port: 20.0 + 10.0 * k for k, port in enumerate(mechanism.ports)}
    forth, back = (
        float(getattr(mechanism, effect)(seen(degC, **dict.fromkeys(mechanism.drivers, s)), usual(key)))
        for s in (0.7, -0.7)
    )
    assert forth == back != 0.0


def test_a_viscous_heat_follows_the_preload_less_and_keeps_some() -> None:
    """Ball bearings: rolling moment as F^0.54 (SKF 2016); a lead of 10 K at 0.05 /K is half as much preload again."""
    load, viscous = law("preload_feedback"), law("preload_feedback").multiplying("bearing_viscous")
    assert load.multiplying("bearing_load").factor(seen({"shaft": 30.0, "housing": 20.0}), usual(load.key)) == (
        pytest.approx(1.5**1.33)
    )
    at = [seen({"shaft": 20.0 + lead, "housing": 20.0}) for lead in (10.0, 0.0, -18.0, -30.0)]
    assert [float(viscous.factor(view, usual(load.key))) for view in at] == pytest.approx(
        [1.5**0.54, 1.0, 0.1**0.54, 0.1**0.54]
    )
    assert float(load.factor(at[-1], usual(load.key))) == 0.0


def test_one_preload_multiplies_each_heat_in_its_own_way() -> None:
    friction = {"drivers": "motor_rpm", "into": "first"}
    small = machine_with(load := law("preload_feedback"), acts_on=["load", "shear"])
    small.twin["mechanisms"] |= {"load": {"law": "bearing_load", **friction}}
    small.twin["mechanisms"] |= {"shear": {"law": "bearing_viscous", **friction}}
    view = seen({"shaft": 30.0, "housing": 20.0})
    heats = {h.law.name: h for h in compile_network(small).heats}
    shown = {name: float(heats[name].factors[0].mechanism.factor(view, usual(load.key))) for name in ("load", "shear")}
    assert shown == {"load": pytest.approx(1.5**1.33), "shear": pytest.approx(1.5**0.54)}


def test_a_draught_by_the_clock_is_at_the_same_time_of_every_day() -> None:
    draught, hours = law("draught"), np.arange(0.0, 40.0, 0.05)
    late = View(time_s=3600.0 * hours, clock_h=(21.0 + hours) % 24.0)
    cold = -draught.surrounding_K(late, usual("draught", start=6.0, clock=1.0)) > 2.0
    begins = hours[1:][np.diff(cold.astype(int)) == 1]
    assert begins == pytest.approx([9.0, 33.0], abs=0.06)  # six in the morning, twice
    unknown = View(time_s=3600.0 * hours)
    assert (draught.surrounding_K(unknown, usual("draught", start=6.0, clock=1.0)) == 0.0).all()
    since = draught.surrounding_K(unknown, usual("draught", start=6.0))
    assert hours[np.argmin(since)] == pytest.approx(6.0, abs=0.06)


def test_a_fit_can_move_the_window_of_a_draught() -> None:
    """Between two samples too the air that it takes away follows its start and its length."""
    view = View(time_s=np.arange(0.0, 7200.0, 60.0))

    def taken_K_s(start_h: float, duration_min: float) -> np.ndarray:
        p = usual("draught", start=start_h, duration=duration_min, drop=6.0)
        cold = 60.0 * -law("draught").surrounding_K(view, p)
        return np.array([cold.sum(), (cold * view.time_s).sum() / cold.sum()])

    assert taken_K_s(1.0 + 20 / 3600, 15.5) == pytest.approx([6 * 930.0, 3600.0 + 20 + 465], abs=1.0)


def test_a_day_without_sunlight() -> None:
    clock_h = np.array([7.9, 12.0, 16.0])
    assert (law("sun").heat_W(View(clock_h=clock_h), usual("sun", rise=12.0, set=12.0)) == 0.0).all()
