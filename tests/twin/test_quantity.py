"""Quantities: what a number with a unit means, and the coordinates that a fit moves in."""

from __future__ import annotations

import numpy as np
import pytest

from twin.quantity import Monomial, Parameter, Value, convert, same_dimension


@pytest.mark.parametrize(
    ("text", "unit", "expected"),
    [
        ("14 W/K", "W/K", 14.0),
        ("6.6 kJ/K", "J/K", 6600.0),
        ("20 degC", "degC", 20.0),
        ("68 degF", "degC", 20.0),
        ("293.15 K", "degC", 20.0),
        ("12 um/m/K", "um/m/K", 12.0),
        ("1.2e-5 1/K", "um/m/K", 12.0),
        ("0.5 min", "s", 30.0),
        ("85 %", "1", 0.85),
        (3, "W", 3.0),
        ("7", "W", 7.0),
    ],
)
def test_reads_units(text: str | float, unit: str, expected: float) -> None:
    assert convert(text, unit) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("text", "unit", "words"),
    [
        ("fast", "W", "expected a number with a unit such as '1 W', got 'fast'"),
        ("3 furlong", "W", "unit 'furlong' cannot be read as 'W'"),
        ("3 flurbs", "W", "unit 'flurbs' cannot be read as 'W'"),
        ("3 W", "degC", "unit 'W' cannot be read as 'degC'; write e.g. '1 degC'"),
        ("inf W", "W", "expected a finite number"),
    ],
)
def test_refuses_other_units(text: str, unit: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        convert(text, unit)


def test_same_dimension_knows_speeds_and_shares() -> None:
    assert same_dimension("rpm", "1/s") and same_dimension("%", "1") and not same_dimension("rpm", "W")


@pytest.mark.parametrize("scale", ["log", "linear", "logit"])
def test_coordinates_go_there_and_back_and_slope_is_their_derivative(scale: str) -> None:
    p = Parameter("a", "1", "", 0.3, 0.5, 0.0, 1.0, scale, True)  # type: ignore[arg-type]
    x, h = p.to_x(0.3), 1e-6
    assert p.from_x(x) == pytest.approx(0.3, rel=1e-14)
    assert p.slope(0.3) == pytest.approx((p.from_x(x + h) - p.from_x(x - h)) / (2 * h), rel=1e-8)


def test_a_monomial_and_its_slope() -> None:
    m = Monomial(2.0, ((0, 1.0), (1, -2.0)))
    v = np.array([[3.0, 4.0], [5.0, 2.0]])
    np.testing.assert_allclose(m(v), [2 * 3 / 16, 2 * 5 / 4])
    np.testing.assert_allclose(m.slope(v, 1), [-2 * 2 * 3 / 64, -2 * 2 * 5 / 8])
    np.testing.assert_array_equal(m.slope(v, 2), 0.0)


def test_a_scalar_in_a_file_is_a_fixed_value() -> None:
    assert Value.model_validate("14 W/K") == Value(value="14 W/K")
