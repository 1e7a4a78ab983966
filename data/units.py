"""Units: the names that machine files use, the spellings that recordings use, and conversion through pint."""

from __future__ import annotations

import unicodedata
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.errors import InputError, closest

# pint sees no difference between angle, rotation and ratio, which a channel must not mix
_QUANTITIES: dict[str, tuple[str, ...]] = {
    "temperature": ("degC", "K", "degF"),
    "length": ("um", "nm", "mm", "cm", "m", "in", "mil"),
    "rotation": ("rpm", "krpm", "rev/s", "rad/s"),
    "feed": ("mm/min", "m/min", "mm/s", "m/s", "in/min"),
    "time": ("s", "ms", "min", "h"),
    "power": ("W", "mW", "kW"),
    "current": ("A", "mA"),
    "voltage": ("V", "mV"),
    "force": ("N", "kN"),
    "torque": ("Nm",),
    "pressure": ("bar", "kPa", "MPa"),
    "flow": ("l/min", "l/h"),
    "angle": ("deg", "rad", "urad", "arcsec"),
    "ratio": ("1", "%", "um/m", "m/m"),
}
_UNITS = {unit: kind for kind, units in _QUANTITIES.items() for unit in units}
_OFFSET_UNITS = ("degC", "degF")  # their zero is not that of K: a difference needs pint's delta units
_PINT = {"": "dimensionless", "1": "dimensionless", "%": "percent", "Nm": "N*m", "rev/s": "revolution/s", "mil": "thou"}

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
    return folded.replace("μ", "u").replace("\N{MINUS SIGN}", "-").casefold()


_BY_FOLD = {**{_fold(u): u for u in _UNITS if u not in ("mW", "MPa")}, **{_fold(k): v for k, v in _SPELLINGS.items()}}


def known_unit(text: str) -> str | None:
    """The name under which a spelling is known (``"°C"`` -> ``"degC"``, ``"µm"`` -> ``"um"``), or None."""
    stripped = text.strip()
    return stripped if stripped in _UNITS else _BY_FOLD.get(_fold(text))


def quantity(unit: str) -> str | None:
    """What a unit measures (temperature, length, …), or None if the unit is not known."""
    return _UNITS.get(known_unit(unit) or "")


@lru_cache(maxsize=1)
def unit_registry() -> Any:
    """The one pint registry, made at its first use: importing pint takes a third of a second."""
    import pint

    registry: Any = pint.UnitRegistry(cache_folder=None)
    return registry


def pint_name(unit: str) -> str:
    """How pint spells a unit that has another name here."""
    return _PINT.get(unit, unit)


def conversion(unit_from: str, unit_to: str, where: str) -> tuple[float, float]:
    """(factor, offset) with value_to = factor * value_from + offset; (1, 0) for equal units, known or not.

    Raises:
        InputError: an unknown unit (with the closest), or units of different quantities; `where` opens the line.
    """
    if unit_from == unit_to:
        return 1.0, 0.0
    names = [known_unit(unit) for unit in (unit_from, unit_to)]
    for unit, name in zip((unit_from, unit_to), names, strict=True):
        if name is None:
            raise InputError(f"{where}: unknown unit {unit!r}; {closest(unit, _UNITS)}")
    one, other = (str(name) for name in names)
    if _UNITS[one] != _UNITS[other]:
        raise InputError(
            f"{where}: {unit_from!r} is a {_UNITS[one]} and cannot become {unit_to!r}, a {_UNITS[other]};"
            " correct unit or unit_in_file"
        )
    return _factor_offset(one, other)


@lru_cache
def _factor_offset(one: str, other: str) -> tuple[float, float]:
    if one == other:
        return 1.0, 0.0
    deltas = [f"delta_{name}" if name in _OFFSET_UNITS else pint_name(name) for name in (one, other)]
    registry = unit_registry()
    factor = float(registry.Quantity(1.0, deltas[0]).to(deltas[1]).magnitude)
    return factor, float(registry.Quantity(0.0, pint_name(one)).to(pint_name(other)).magnitude)


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
