"""The cell's laws by hand: where the charge stands in an interval and at a row, and the course between the points."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from twin.mechanisms.base import Mechanism, View, course
from twin.mechanisms.electrical import ChargeStrain, VoltageLossHeat

HOURS_S = 3600.0 * np.arange(5)
DRAWN = np.array([-1.0, -1.0, 0.0, 2.0, 0.0])  # A: two hours of discharge, a rest, an hour of charge


def straight(m: Mechanism, name: str, slope: float) -> dict[str, np.ndarray]:
    """Parameters that make the table `name` rise evenly from 0 to `slope` at the capacity of 4 Ah, all others 0."""
    names = [s.name for s in m.parameters if s.name[0] == name and s.name[1:].isdigit()]
    last = int(names[-1][1:])
    values = {s.name: np.array(0.0) for s in m.parameters} | {"capacity": np.array(4.0)}
    return values | {n: np.array(slope * int(n[1:]) / last) for n in names}


def test_heat_follows_the_charge_in_the_middle_of_each_interval() -> None:
    m = VoltageLossHeat()
    view = View(driver={"current": DRAWN, "voltage": np.zeros(5)}, time_s=HOURS_S)
    watts = m.heat_W(view, straight(m, "u", 4.0))  # a volt for every Ah drawn
    assert watts == pytest.approx([1 * 0.5, 1 * 1.5, 0.0, -2 * 1.0, 0.0])
    begun = m.heat_W(view, straight(m, "u", 4.0) | {"start": np.array(1.0)})
    assert begun - watts == pytest.approx(-DRAWN)


def test_heat_of_a_long_interval_is_the_mean_of_its_parts() -> None:
    m = VoltageLossHeat()
    p = straight(m, "u", 4.0)
    fine = View(driver={"current": np.repeat(DRAWN, 10), "voltage": np.full(50, 3.0)}, time_s=360.0 * np.arange(50))
    whole = m.heat_W(View(driver={"current": DRAWN, "voltage": np.full(5, 3.0)}, time_s=HOURS_S), p)
    assert m.heat_W(fine, p).reshape(5, 10).mean(axis=1) == pytest.approx(whole)


def test_strain_follows_the_charge_at_each_row() -> None:
    m = ChargeStrain()
    view = View(
        rise_K={"body": np.array([0.0, 1.0, 2.0, 3.0, 4.0])},
        driver={"current": np.array([-1.0, -1.0, 0.0, 2.0, 2.0])},
        time_s=HOURS_S,
    )
    assert m.displacement(view, straight(m, "f", 400.0)) == pytest.approx([0, 100, 200, 200, 0])
    assert m.displacement(view, straight(m, "g", 40.0)) == pytest.approx([0, 10, 40, 60, 0])


def test_the_course_is_the_natural_spline_and_holds_its_ends() -> None:
    values = np.array([3.0, -1.0, 4.0, 1.0, 5.0])
    share = np.linspace(0.0, 1.0, 41)
    spline = CubicSpline(np.linspace(0.0, 1.0, 5), values, bc_type="natural")
    assert course(share, *values) == pytest.approx(spline(share))
    assert course(np.array([-2.0, 0.0, 1.0, 7.0]), *values) == pytest.approx([3.0, 3.0, 5.0, 5.0])
    assert (course(share, *np.full(5, 0.1)) == 0.1).all()  # to the last digit
    slope = np.imag(course(share[1:-1] + 1e-30j, *values)) / 1e-30
    assert slope == pytest.approx(spline(share[1:-1], 1))
