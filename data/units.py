"""Units: what a recording's columns are measured in, and the way to the unit that the lake keeps."""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from data.errors import InputError, closest

# unit -> (quantity, factor, offset): value in the quantity's first unit = factor * value + offset
_UNITS: dict[str, tuple[str, float, float]] = {
    "degC": ("temperature", 1.0, 0.0),
    "K": ("temperature", 1.0, -273.15),
    "degF": ("temperature", 5.0 / 9.0, -160.0 / 9.0),
    "um": ("length", 1.0, 0.0),
    "nm": ("length", 1e-3, 0.0),
    "mm": ("length", 1e3, 0.0),
    "cm": ("length", 1e4, 0.0),
    "m": ("length", 1e6, 0.0),
    "in": ("length", 25400.0, 0.0),
    "mil": ("length", 25.4, 0.0),
    "rpm": ("rotation", 1.0, 0.0),
    "krpm": ("rotation", 1e3, 0.0),
    "rev/s": ("rotation", 60.0, 0.0),
    "rad/s": ("rotation", 30.0 / math.pi, 0.0),
    "mm/min": ("feed", 1.0, 0.0),
    "m/min": ("feed", 1e3, 0.0),
    "mm/s": ("feed", 60.0, 0.0),
    "m/s": ("feed", 6e4, 0.0),
    "in/min": ("feed", 25.4, 0.0),
    "s": ("time", 1.0, 0.0),
    "ms": ("time", 1e-3, 0.0),
    "min": ("time", 60.0, 0.0),
    "h": ("time", 3600.0, 0.0),
    "W": ("power", 1.0, 0.0),
    "mW": ("power", 1e-3, 0.0),
    "kW": ("power", 1e3, 0.0),
    "A": ("current", 1.0, 0.0),
    "mA": ("current", 1e-3, 0.0),
    "V": ("voltage", 1.0, 0.0),
    "mV": ("voltage", 1e-3, 0.0),
    "N": ("force", 1.0, 0.0),
    "kN": ("force", 1e3, 0.0),
    "Nm": ("torque", 1.0, 0.0),
    "bar": ("pressure", 1.0, 0.0),
    "kPa": ("pressure", 0.01, 0.0),
    "MPa": ("pressure", 10.0, 0.0),
    "l/min": ("flow", 1.0, 0.0),
    "l/h": ("flow", 1.0 / 60.0, 0.0),
    "deg": ("angle", 1.0, 0.0),
    "rad": ("angle", 180.0 / math.pi, 0.0),
    "urad": ("angle", 180e-6 / math.pi, 0.0),
    "arcsec": ("angle", 1.0 / 3600.0, 0.0),
    "1": ("ratio", 1.0, 0.0),
    "%": ("ratio", 0.01, 0.0),
    "um/m": ("ratio", 1e-6, 0.0),
    "m/m": ("ratio", 1.0, 0.0),
}

# spellings found in recordings, folded by `_fold`
_SPELLINGS: dict[str, str] = {
    "°c": "degC", "℃": "degC", "c": "degC", "deg c": "degC", "celsius": "degC", "grad c": "degC", "kelvin": "K",
    "°f": "degF", "℉": "degF", "f": "degF", "deg f": "degF", "fahrenheit": "degF", "micron": "um", "microns": "um",
    "mym": "um", "inch": "in", "thou": "mil", "1/min": "rpm", "min-1": "rpm", "u/min": "rpm", "r/min": "rpm",
    "rev/min": "rpm", "1/s": "rev/s", "hz": "rev/s", "ipm": "in/min", "sec": "s", "second": "s", "seconds": "s",
    "minute": "min", "minutes": "min", "hour": "h", "hours": "h", "hr": "h", "watt": "W", "volt": "V", "amp": "A",
    "n*m": "Nm", "percent": "%", "l/m": "l/min", "-": "1",
}  # fmt: skip

_CANONICAL = {"temperature": "degC", "ambient": "degC", "error": "um"}


def _fold(text: str) -> str:
    folded = unicodedata.normalize("NFKC", text).strip().strip("[]()").strip()
    return folded.replace("μ", "u").replace("⁻", "-").casefold()


_BY_FOLD = {**{_fold(u): u for u in _UNITS if u not in ("mW", "MPa")}, **{_fold(k): v for k, v in _SPELLINGS.items()}}


def known_unit(text: str) -> str | None:
    """The name under which a spelling is known (``"°C"`` -> ``"degC"``, ``"µm"`` -> ``"um"``), or None."""
    stripped = text.strip()
    return stripped if stripped in _UNITS else _BY_FOLD.get(_fold(text))


def quantity(unit: str) -> str | None:
    """What a unit measures (temperature, length, …), or None if the unit is not known."""
    name = known_unit(unit)
    return _UNITS[name][0] if name else None


def conversion(unit_from: str, unit_to: str, where: str) -> tuple[float, float]:
    """(factor, offset) with value_to = factor * value_from + offset; (1, 0) for equal units, known or not.

    Raises:
        InputError: an unknown unit (with the closest), or units of different quantities; `where` opens the line.
    """
    if unit_from == unit_to:
        return 1.0, 0.0
    known: dict[str, tuple[str, float, float]] = {}
    for unit in (unit_from, unit_to):
        name = known_unit(unit)
        if name is None:
            raise InputError(f"{where}: unknown unit {unit!r}; {closest(unit, _UNITS)}")
        known[unit] = _UNITS[name]
    (kind_from, factor_from, offset_from), (kind_to, factor_to, offset_to) = known[unit_from], known[unit_to]
    if kind_from != kind_to:
        raise InputError(
            f"{where}: {unit_from!r} is a {kind_from} and cannot become {unit_to!r}, a {kind_to};"
            " correct unit or unit_in_file"
        )
    if (factor_from, offset_from) == (factor_to, offset_to):
        return 1.0, 0.0
    return factor_from / factor_to, (offset_from - offset_to) / factor_to


def convert(values: NDArray[np.float64], unit_from: str, unit_to: str, where: str) -> NDArray[np.float64]:
    """Values in another unit, same shape; the same array if nothing changes. Raises as `conversion`."""
    factor, offset = conversion(unit_from, unit_to, where)
    return values if (factor, offset) == (1.0, 0.0) else values * factor + offset


def check_canonical(roles_units: Mapping[str, tuple[str, str]], where: str) -> None:
    """Temperatures are kept in degC and lengths of error channels in um; `roles_units` is name -> (role, unit).

    Raises:
        InputError: another unit stands there, with what to write instead, or one that nobody knows.
    """
    for name, (role, unit) in roles_units.items():
        kept = _CANONICAL.get(role)
        if kept and quantity(unit) is None:
            raise InputError(f"{where}: channel {name!r} ({role}) has the unknown unit {unit!r}; write unit: {kept}")
        if kept == "degC" and quantity(unit) != "temperature":
            raise InputError(f"{where}: channel {name!r} ({role}) has unit {unit!r}, expected {kept!r}; correct it")
        if kept and unit != kept and quantity(unit) == quantity(kept):
            raise InputError(
                f"{where}: channel {name!r} ({role}) has unit {unit!r}, expected {kept!r};"
                f" write unit: {kept} and unit_in_file: {unit!r}"
            )
