"""Units: spellings, what may become what, and factors that pint gives."""

from __future__ import annotations

import numpy as np
import pytest

from data.errors import InputError
from data.units import check_canonical, conversion, convert, error_column, in_error_unit, known_unit, quantity, seconds


@pytest.mark.parametrize(
    ("written", "name"),
    [("°C", "degC"), ("℃", "degC"), ("µm", "um"), ("μm", "um"), ("[U/min]", "rpm"), ("min⁻¹", "rpm"), ("MPA", None),
     ("kpa", "kPa"), ("mW", "mW"), ("-", "1"), ("furlong", None)],
)  # fmt: skip
def test_spellings_of_measuring_systems(written: str, name: str | None) -> None:
    assert known_unit(written) == name


@pytest.mark.parametrize(
    ("one", "other", "factor", "offset"),
    [("mm", "um", 1000.0, 0.0), ("in", "um", 25400.0, 0.0), ("K", "degC", 1.0, -273.15),
     ("degF", "degC", 5 / 9, -160 / 9), ("degC", "degF", 1.8, 32.0), ("rad/s", "rpm", 30 / np.pi, 0.0),
     ("m/s", "mm/min", 6e4, 0.0), ("um/m", "1", 1e-6, 0.0),
     ("arcsec", "deg", 1 / 3600, 0.0), ("l/h", "l/min", 1 / 60, 0.0),
     ("Nm", "Nm", 1.0, 0.0), ("krpm", "rev/s", 1000 / 60, 0.0), ("mil", "um", 25.4, 0.0), ("%", "1", 0.01, 0.0)],
)  # fmt: skip
def test_factors_and_offsets(one: str, other: str, factor: float, offset: float) -> None:
    assert conversion(one, other, "here") == pytest.approx((factor, offset), rel=1e-12)
    np.testing.assert_allclose(convert(np.array([0.0, 2.0]), one, other, ""), [offset, 2 * factor + offset], rtol=1e-12)


def test_what_measures_something_else_is_refused() -> None:
    with pytest.raises(InputError, match=r"z: 'deg' is a angle and cannot become '1', a ratio; correct unit"):
        conversion("deg", "1", "z")
    with pytest.raises(InputError, match=r"z: unknown unit 'umm'; did you mean 'um/m'"):
        conversion("umm", "um", "z")
    assert quantity("rpm") == "rotation" and quantity("umm") is None


@pytest.mark.parametrize(("text", "expected"), [("60 s", 60.0), ("0.5min", 30.0), ("1 h", 3600.0), ("200 ms", 0.2)])
def test_durations(text: str, expected: float) -> None:
    assert seconds(text) == pytest.approx(expected)


@pytest.mark.parametrize("text", ["60", "? s", "0 s", "-1 s", "1 K", "s", "1 2 s"])
def test_what_is_no_duration(text: str) -> None:
    with pytest.raises(ValueError, match=r"expected a duration above 0 with its unit, such as '60 s'"):
        seconds(text)


@pytest.mark.parametrize("unit", ["kg", "V", "mrad", "um/m", "K", "W/m^2"])
def test_an_error_may_be_of_any_quantity(unit: str) -> None:
    check_canonical({"z": ("error", unit)}, "machine file m")
    assert error_column("predicted_um", unit) == "predicted_error" and "\u00b5m a" not in in_error_unit(
        "5 \u00b5m a run", unit
    )


def test_lengths_keep_their_column_and_text() -> None:
    assert error_column("predicted_um", "um") == "predicted_um" and in_error_unit("5 \u00b5m", "um") == "5 \u00b5m"
    assert in_error_unit("S 5 \u00b5m", "kg") == "S 5 kg"
