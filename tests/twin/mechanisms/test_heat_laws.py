"""Heat laws against hand-computed numbers, their limits and signatures, and their derivatives."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from thermodrift.testing.small_machine import machine_with
from twin.compile import compile_network
from twin.mechanisms import MECHANISMS
from twin.mechanisms.base import Mechanism, View

HEATS = (
    "bearing_viscous", "bearing_load", "motor_loss", "belt_loss", "nut_friction", "guide_friction", "screw_bearing",
    "natural_convection", "radiation", "jacket_chiller", "coolant_jacket", "cutting_fluid", "cabinet_heat",
    "hydraulic_unit", "sun", "cutting_heat", "electrical_heat", "ohmic_heat",
)  # fmt: skip
FACTORS = ("viscosity_feedback", "preload_feedback", "rotating_convection", "joint_conductance", "draught")
CALLS = [(k, "heat_W") for k in HEATS] + [(k, "factor") for k in FACTORS]
CALLS += [("draught", "surrounding_K"), ("stratification", "surrounding_K")]
DRIVEN = [k for k in HEATS if MECHANISMS[k].drivers]
EXCHANGES = ("natural_convection", "radiation", "cutting_fluid")  # heat between two places of any temperature


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


def test_load_moment_by_hand() -> None:
    """(800/26000)^0.33 = 0.31701; M1 = 0.001 * 0.31701 * 800 * 77.5 = 19.655 N mm; 12.35 W at 6000 rpm, 16 % of M0."""
    p = {"count": 1, "mean_diameter": 77.5, "preload": 800, "static_capacity": 26e3}
    assert heat("bearing_load", p=p, speed=6000) == pytest.approx(12.347, abs=0.005)


def test_other_laws_by_hand() -> None:
    # 1500 mm/min on a 10 mm lead: 150 rpm, 2 pi 150 0.5 / 60
    assert heat("nut_friction", p={"moment": 0.5, "lead": 10}, feed=1500) == pytest.approx(7.854, abs=1e-3)
    assert heat("screw_bearing", p={"moment": 0.3, "lead": 10}, feed=1500) == pytest.approx(4.712, abs=1e-3)
    assert heat("guide_friction", p={"friction": 0.01, "load": 5000}, feed=12000) == pytest.approx(10.0)
    assert heat("motor_loss", speed=6000) == pytest.approx(40 + 110 + 80)
    assert heat("motor_loss", speed=3000) == pytest.approx(40 + 55 + 20)
    assert heat("belt_loss", speed=3000) == pytest.approx(70 * 0.5**1.5)
    assert heat("cutting_heat", p={"share": 0.05}, power=4000) == pytest.approx(200)
    assert heat("electrical_heat", p={"gain": 0.02}, level=60) == pytest.approx(1.2)
    assert heat("cabinet_heat") == heat("cabinet_heat", running=1) == pytest.approx(200)


def test_radiation_and_natural_convection_by_hand() -> None:
    """1 m² at 30 in 20 degC: 0.9 5.67e-8 (303.15^4 - 293.15^4) = 54.1 W; h = 1.42 (10 / 0.5)^(1/4) = 3.003."""
    lost = heat("radiation", {"body": 30, "surrounding": 20}, {"emissivity": 0.9, "area": 1})
    assert lost == pytest.approx(-54.12, abs=0.02)
    cooled = heat("natural_convection", {"body": 30, "air": 20}, {"area": 1, "height": 0.5})
    assert cooled == pytest.approx(-30.03, abs=0.01)
    # dT L³ = 20 > 2.6: turbulent, 1.31 * 20^(1/3) * 20 * 2
    tall = heat("natural_convection", {"body": 0, "air": 20}, {"area": 2, "height": 1.0})
    assert tall == pytest.approx(142.23, abs=0.01)
    span = np.linspace(-5, 5, 2001)
    assert np.abs(np.diff(heat("natural_convection", {"body": 0, "air": span}, {"height": 1.0}))).max() < 0.02


def test_ohmic_heat_by_hand() -> None:
    p = {"resistance": 0.02, "coefficient": 0.0, "entropic": 0.0}
    assert heat("ohmic_heat", {"body": 25}, p, current=-3) == pytest.approx(0.18)
    copper = heat("ohmic_heat", {"body": 35}, p | {"coefficient": 0.004}, current=3)
    assert copper == pytest.approx(0.18 * np.exp(0.04))
    reaction = p | {"resistance": 0.0, "entropic": 1e-4}
    assert heat("ohmic_heat", {"body": 26.85}, reaction, current=-3) == pytest.approx(-0.09)  # 300 K


def test_feedbacks_by_hand() -> None:
    thin = law("viscosity_feedback").factor(seen({"oil": [40, 60]}), usual("viscosity_feedback"))
    assert thin == pytest.approx([1.0, np.exp(-2 / 3 * 0.035 * 20)])
    tight = law("preload_feedback").factor(
        seen({"shaft": [20, 30, -40], "housing": [20, 20, 20]}), usual("preload_feedback", kappa=0.05)
    )
    assert tight == pytest.approx([1.0, 1.5**1.33, 0.0])  # the last has lost its preload


@pytest.mark.parametrize("degC", [20.0, 55.0])
def test_viscosity_feedback_is_the_thinner_oil(degC: float) -> None:
    """Multiplying the heat at the reference equals the law at the viscosity of the temperature."""
    nu = 22.0 * np.exp(-0.035 * (degC - 40.0))
    factor = law("viscosity_feedback").factor(seen({"oil": degC}), usual("viscosity_feedback"))
    direct = heat("bearing_viscous", p={"viscosity": nu}, speed=4000)
    assert factor * heat("bearing_viscous", p={"viscosity": 22.0}, speed=4000) == pytest.approx(direct)


def test_preload_feedback_is_the_larger_preload() -> None:
    factor = law("preload_feedback").factor(seen({"shaft": 32.0, "housing": 20.0}), usual("preload_feedback"))
    direct = heat("bearing_load", p={"preload": 800 * 1.6}, speed=4000)
    assert factor * heat("bearing_load", p={"preload": 800}, speed=4000) == pytest.approx(direct)


def steady_rise_K(factor: str | None, speed: float, ambient_degC: float = 20.0, W_per_K: float = 20.0) -> float:
    """Rise of one body at balance, its bearing heat thinned by its own temperature."""
    rise = 0.0
    for _ in range(200):
        thin = 1.0
        if factor:
            thin = float(law(factor).factor(seen({"oil": ambient_degC + rise}), usual(factor)))
        rise = 0.5 * (rise + float(heat("bearing_viscous", p={"count": 3}, speed=speed)) * thin / W_per_K)
    return rise


def test_rise_grows_with_speed_as_the_table_says() -> None:
    """Viscous friction n^1.3 to n^1.7, with and without thinning oil; preload friction n; belt n^1.5."""
    plain, thinning = (
        np.log2(steady_rise_K(factor, 6000) / steady_rise_K(factor, 3000)) for factor in (None, "viscosity_feedback")
    )
    assert plain == pytest.approx(5 / 3)
    assert 1.3 <= thinning <= 1.5
    assert heat("bearing_load", speed=6000) / heat("bearing_load", speed=3000) == pytest.approx(2.0)
    assert heat("belt_loss", speed=6000) / heat("belt_loss", speed=3000) == pytest.approx(2**1.5)


def test_rise_in_winter_exceeds_that_in_summer() -> None:
    winter, summer = (steady_rise_K("viscosity_feedback", 4000, ambient) for ambient in (5.0, 30.0))
    assert winter > 1.1 * summer


@pytest.mark.parametrize("key", DRIVEN)
def test_no_driver_no_heat_and_more_driver_more_heat(key: str) -> None:
    """Nothing at rest, positive and rising with the driver; reverse turns and travel heat as forward ones do."""
    degC = {"body": 20.0, "tank": 30.0}
    role = next(iter(law(key).drivers))
    largest = {"rpm": 8000.0, "mm/min": 2e4, "W": 5e3, "A": 50.0}.get(law(key).drivers[role], 1.0)
    values = np.array([one_minute(key, degC, **{role: s}) for s in np.linspace(0, largest, 40)])
    assert values[0] == 0.0
    assert (np.diff(values) > 0).all()
    if key not in ("electrical_heat", "cutting_heat", "ohmic_heat"):  # it cools; braking; charging has its own heat
        assert one_minute(key, degC, **{role: -largest}) == pytest.approx(values[-1])


def one_minute(key: str, degC: Mapping[str, Any], **driver: float) -> float:
    """Heat in W over a batch's first minute."""
    view = seen({port: degC[port] for port in law(key).ports}, **driver)
    return float(np.squeeze(law(key).heat_W(View(**(vars(view) | {"step_s": 60.0})), usual(key))))


def test_factors_and_windows_take_a_driver_of_either_sign() -> None:
    for key, driver in ("rotating_convection", "speed"), ("joint_conductance", "closed"), ("supply_sag", "other"):
        forth, back = (law(key).factor(seen(**{driver: s}), usual(key)) for s in (0.7, -0.7))
        assert forth == back, key
    forth, back = (law("speed_shift").displacement(seen(speed=s), usual("speed_shift")) for s in (5e3, -5e3))
    assert forth == back > 0.0


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


def test_braking_power_is_no_cutting_heat() -> None:
    assert heat("cutting_heat", power=-2000) == 0.0


@pytest.mark.parametrize("key", EXCHANGES)
def test_exchange_never_heats_against_the_gradient(key: str) -> None:
    body, other = law(key).ports
    here, there = np.meshgrid(np.linspace(-10, 60, 29), np.linspace(-10, 60, 29))
    values = heat(key, {body: here, other: there}, flow=1.0)
    assert (np.sign(values) == np.sign(there - here)).all()
    assert vars(type(law(key)))["takes_from"] == other  # what the body gains, a body on the other side loses
    back = heat(key, {body: there, other: here}, flow=1.0)
    np.testing.assert_allclose(back, -values, rtol=1e-12)


def test_natural_convection_shortens_time_constants() -> None:
    lead = np.array([2.0, 20.0])
    for height in (0.1, 2.0):
        h = heat("natural_convection", {"body": 0.0, "air": lead}, {"height": height}) / lead
        assert h[1] > 1.5 * h[0]
        assert (h > 1.5).all() and (h < 6.5).all()


def test_rotating_convection() -> None:
    factor = law("rotating_convection").factor(seen(speed=[0, 6000, -6000, 750]), usual("rotating_convection"))
    assert factor == pytest.approx([1.0, 4.5, 4.5, 1 + 3.5 / 4])


def test_joint_conductance_never_turns_negative() -> None:
    p = usual("joint_conductance", ratio=0.2)
    assert law("joint_conductance").factor(seen(closed=[0, 1]), p) == pytest.approx([1.0, 0.2])
    assert law("joint_conductance").factor(seen(), p) == pytest.approx(0.2)
    assert (law("joint_conductance").factor(seen(closed=np.linspace(-3, 3, 13)), p) > 0).all()


def test_draught_only_within_its_window_opened_and_closed_in_one_interval() -> None:
    view = View(time_s=np.arange(3480.0, 4680.0, 60.0))
    p = usual("draught", start=1.0, duration=15.0, factor=2.5, drop=6.0)
    share = np.r_[0, 0, 0.5, np.ones(14), 0.5, 0, 0]
    assert law("draught").factor(view, p) == pytest.approx(1 + 1.5 * share)
    assert law("draught").surrounding_K(view, p) == pytest.approx(-6 * share)


def test_a_fit_can_move_the_window_of_a_draught() -> None:
    """Between two samples too the air that it takes away follows its start and its length."""
    view = View(time_s=np.arange(0.0, 7200.0, 60.0))

    def taken_K_s(start_h: float, duration_min: float) -> np.ndarray:
        p = usual("draught", start=start_h, duration=duration_min, drop=6.0)
        cold = 60.0 * -law("draught").surrounding_K(view, p)
        return np.array([cold.sum(), (cold * view.time_s).sum() / cold.sum()])

    assert taken_K_s(1.0 + 20 / 3600, 15.5) == pytest.approx([6 * 930.0, 3600.0 + 20 + 465], abs=1.0)


def test_stratification_by_height() -> None:
    p = usual("stratification", gradient=0.8, height=-1.5)
    assert law("stratification").surrounding_K(View(), p) == pytest.approx(-1.2)


def test_hydraulic_unit_keeps_its_average_at_any_sampling() -> None:
    """500 W for 40 % of 10 min: 200 W on average; sampling of 7 min sees the mean of each interval."""
    p = usual("hydraulic_unit", heat=500.0, duty=0.4, period=10.0)
    fine = law("hydraulic_unit").heat_W(View(time_s=np.arange(0, 600.0, 60.0)), p)
    assert fine == pytest.approx([500.0] * 4 + [0.0] * 6)
    coarse = law("hydraulic_unit").heat_W(View(time_s=np.arange(0, 4200.0, 420.0)), p)
    assert coarse.mean() == pytest.approx(200.0)
    assert coarse[0] == pytest.approx(500 * 4 / 7)
    slow = law("hydraulic_unit").heat_W(View(time_s=np.arange(3) * 3600.0), p)
    assert slow == pytest.approx([200.0] * 3)


def test_sun_by_the_clock() -> None:
    p = usual("sun", irradiance=200.0, area=2.0, absorptivity=0.5, rise=8.0, set=16.0)
    clock_h = np.array([7.9, 8.0, 10.0, 12.0, 16.0, 23.0, np.nan])
    at = law("sun").heat_W(View(clock_h=clock_h), p)
    assert at == pytest.approx([0.0, 0.0, 200 * np.sin(np.pi / 4), 200.0, 0.0, 0.0, 0.0])
    never = usual("sun", rise=12.0, set=12.0)
    assert (law("sun").heat_W(View(clock_h=clock_h), never) == 0.0).all()


def busy_view(key: str) -> View:
    """Temperatures, drivers and a clock at which every part of a law is at work and no switch is near."""
    n = 24
    wave = np.sin(np.arange(n) * 0.9)
    mechanism = law(key)
    degC = {port: 26.0 + 3.0 * k + 4.0 * wave for k, port in enumerate(mechanism.ports)}
    sizes = {"rpm": 3000.0, "mm/min": 1500.0, "W": 900.0, "A": 12.0, "1": 0.7}
    driver = {role: np.full(n, sizes[unit]) for role, unit in mechanism.drivers.items()}
    time_s = 3500.0 + 97.0 * np.arange(n)
    return View(degC=degC, driver=driver, time_s=time_s, clock_h=9.0 + time_s / 3600.0, step_s=97.0)


def slopes(key: str, effect: str, vary: Any, size: float) -> tuple[Any, Any]:
    """Derivatives by the complex step and by central differences; `vary(d)` gives view and parameters moved by d."""

    def call(d: Any) -> Any:
        view, p = vary(d)
        return np.asarray(getattr(law(key), effect)(view, p))

    step = 1e-5 * max(size, 0.01)
    return np.imag(call(1e-30j)) / 1e-30, (call(step) - call(-step)) / (2 * step)


@pytest.mark.parametrize("key, effect", CALLS)
def test_derivatives_by_parameters(key: str, effect: str) -> None:
    view, p = busy_view(key), usual(key)
    for name, value in p.items():
        complex_step, central = slopes(key, effect, lambda d, n=name: (view, p | {n: p[n] + d}), float(value))
        np.testing.assert_allclose(
            complex_step, central, rtol=1e-6, atol=1e-6 * (1 + np.abs(central).max()), err_msg=name
        )


@pytest.mark.parametrize("key, effect", [c for c in CALLS if MECHANISMS[c[0]].ports])
def test_derivatives_by_temperatures(key: str, effect: str) -> None:
    busy = {"ohmic_heat": {"coefficient": 0.004}, "jacket_chiller": {"follow": 0.3}, "coolant_jacket": {"follow": 0.3}}
    view, p = busy_view(key), usual(key, **busy.get(key, {}))
    for port in law(key).ports:

        def vary(d: Any, port: str = port) -> Any:
            return View(**(vars(view) | {"degC": {**view.degC, port: view.degC[port] + d}})), p

        complex_step, central = slopes(key, effect, vary, 1.0)
        assert np.abs(central).max() > 1e-3
        np.testing.assert_allclose(complex_step, central, rtol=1e-6, atol=1e-7 * np.abs(central).max(), err_msg=port)


@pytest.mark.parametrize("key, effect", CALLS)
def test_parameter_sets_and_batches_broadcast(key: str, effect: str) -> None:
    """(P, 1, 1) parameters on (B, M) temperatures give what each set and batch gives by itself."""
    view, p = busy_view(key), usual(key)
    sets = {k: v * np.array([1.0, 1.02, 0.97])[:, None, None] for k, v in p.items()}
    two = View(
        degC={k: np.stack([v, v + 2.0]) for k, v in view.degC.items()},
        driver={k: np.stack([v, v]) for k, v in view.driver.items()},
        time_s=np.stack([view.time_s] * 2),
        clock_h=np.stack([view.clock_h] * 2),
        step_s=view.step_s,
    )
    every = np.broadcast_to(getattr(law(key), effect)(two, sets), (3, 2, 24))
    one = View(**(vars(view) | {"degC": {k: v + 2.0 for k, v in view.degC.items()}}))
    alone = getattr(law(key), effect)(one, {k: v[2, 0, 0] for k, v in sets.items()})
    np.testing.assert_allclose(every[2, 1], np.broadcast_to(alone, 24), rtol=1e-13)
