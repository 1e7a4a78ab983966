"""Units: the names that machine files use, the spellings that recordings use, and conversion through pint."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from data.errors import InputError, closest

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

# pint sees no difference between angle, rotation and ratio, which a channel must not mix
_QUANTITIES: dict[str, tuple[str, ...]] = {
    "temperature": ("degC", "K", "degF"),
    "length": ("um", "nm", "mm", "cm", "m", "in", "mil"),
    "rotation": ("rpm", "krpm", "rev/s", "rad/s"),
    "feed": ("mm/min", "m/min", "mm/s", "m/s", "in/min"),
    "time": ("s", "ms", "us", "ns", "min", "h", "d"),
    "power": ("W", "mW", "kW", "VA", "kVA"),
    "energy": ("J", "kJ", "Wh", "kWh"),
    "current": ("A", "mA"),
    "voltage": ("V", "mV", "uV"),
    "resistance": ("ohm", "mohm", "kohm"),
    "frequency": ("Hz", "kHz"),
    "force": ("N", "kN", "lbf"),
    "torque": ("Nm",),
    "mass": ("kg", "g", "mg", "lb", "oz"),
    "pressure": ("bar", "mbar", "Pa", "hPa", "kPa", "MPa", "psi"),
    "flow": ("l/min", "l/h", "l/s", "m3/h", "gpm", "cfm"),
    "angle": ("deg", "rad", "mrad", "urad", "arcsec"),
    "acceleration": ("m/s2",),
    "illuminance": ("lux",),
    "humidity": ("%RH",),
    "count": ("step", "count"),
    "ratio": ("1", "%", "ppm", "um/m", "mm/m", "m/m"),
}
_UNITS = {unit: kind for kind, units in _QUANTITIES.items() for unit in units}
_OFFSET_UNITS = ("degC", "degF")  # their zero is not that of K: a difference needs pint's delta units
_PINT = {"": "dimensionless", "1": "dimensionless", "%": "percent", "Nm": "N*m", "rev/s": "revolution/s", "mil": "thou",
         "%RH": "percent", "gpm": "gallon/min", "m3/h": "m**3/h", "m/s2": "m/s**2", "step": "count",
         "oz": "ounce"}  # fmt: skip

# spellings and words found in recordings (English, German, French, Spanish, Italian, Chinese, Japanese), as `_fold`
# leaves them: without case and accents
_SPELLINGS: dict[str, str] = {
    word: unit
    for unit, words in {
        "degC": "°c|c|celsius|grad celsius|摄氏度|攝氏度|度",
        "K": "kelvin", "degF": "°f|f|fahrenheit|deg fahrenheit",
        "um": "micron|microns|mym|mikron|micrometer|micrometers|micrometre|micrometres|mikrometer|micrometro"
        "|micrometros|micrometri|micra|micras|微米|マイクロメートル|ミクロン",
        "mm": "millimeter|millimeters|millimetre|millimetres|milimetro|milimetros|millimetri|毫米|ミリ|ミリメートル",
        "in": "inch|inches", "mil": "thou",
        "rpm": "1/min|min-1|u/min|upm|r/min|rev/min|tr/min|giri/min|转/分|轉/分|回転/分", "rev/s": "1/s|rps",
        "in/min": "ipm", "kg": "kgs|kilogram|kilogramm|kilo", "g": "gram|gramm", "lb": "lbs|pound|pounds",
        "Pa": "pascal", "psi": "psig|psia|lbf/in2", "%RH": "%rf|% rh|%r.h.|rel%|%rel", "gpm": "gal/min|us gal/min",
        "m3/h": "m³/h|m^3/h",
        "m/s2": "m/s²|m/s^2", "ohm": "ω|ohms", "lux": "lx", "cfm": "ft3/min", "um/m": "ustrain|microstrain|µε",
        "step": "steps|schritte", "count": "counts|cts|digits|digit|pulses|imp|inkr",
        "Hz": "hertz", "s": "sec|secs|sek|second|seconds|sekunde|sekunden|seconde|secondes|seg|segundo|segundos"
        "|secondo|secondi|秒|秒数|秒間", "ms": "millisecond|milliseconds|millisekunden|毫秒|ミリ秒",
        "min": "mins|minute|minutes|minuten|minuto|minutos|minuti|分|分钟|分鐘|分間",
        "h": "hr|hrs|hour|hours|std|stunde|stunden|heure|heures|hora|horas|ora|ore|小时|小時",
        "d": "day|days|tag|tage|jour|jours|dia|dias|giorno|giorni|天|日",
        "W": "watt|watts", "V": "volt|volts|vdc|vac", "mV": "millivolt|millivolts", "A": "amp|amps|ampere",
        "N": "newton", "Nm": "n*m|n·m|n m",
        "%": "percent|prozent|pourcent|百分比", "l/min": "l/m", "1": "-",
    }.items()
    for word in words.split("|")
}  # fmt: skip
TIME_UNITS_S = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}  # usual first

_CANONICAL = {"temperature": "degC", "ambient": "degC", "error": "um"}


_CASE_TELLS = ("mW", "MPa", "mohm", "VA")  # in other cases they are other units, or words


def plain(text: str) -> str:
    """A text with one form of each letter (NFKC), Latin letters without accents, µ as u."""
    plain = unicodedata.normalize("NFKC", text)
    if not plain.isascii():
        plain = "".join(c for c in unicodedata.normalize("NFD", plain) if c == "\u3099" or not unicodedata.combining(c))
        plain = unicodedata.normalize("NFC", plain)
    return plain.replace("μ", "u").replace("ß", "ss")


def _fold(text: str) -> str:
    folded = plain(text).strip().strip("[]()").strip().replace("\N{MINUS SIGN}", "-").casefold()
    return re.sub(r"^(deg(ree)?s?\.?|grad|°) ?(?=[ckf])", "deg ", folded)


_BY_FOLD = {**{_fold(u): u for u in _UNITS if u not in _CASE_TELLS}, **{_fold(k): v for k, v in _SPELLINGS.items()}}


def known_unit(text: str) -> str | None:
    """The name under which a spelling is known (``"°C"`` -> ``"degC"``, ``"µm"`` -> ``"um"``), or None."""
    stripped = text.strip()
    return stripped if stripped in _UNITS else _BY_FOLD.get(_fold(text))


@lru_cache
def stated_unit(text: str) -> str | None:
    """The same for a text that stands where a unit belongs: terms of pint count as well (``"kW/m^2"``)."""
    text = text.strip(" []()")
    if (known := known_unit(text)) or text.isalnum() or not re.search(r"[^\W\d_]", text):
        return known  # a lone word is none: pint would read "rod" and "link"
    try:
        powers = re.sub(r"(?<=[a-z])([23])", r"**\1", text)  # W/m2
        return f"{unit_registry().Unit(powers):~C}"
    except Exception:  # pint has no common base for its many parsing errors
        return None


def seconds(text: str) -> float:
    """The duration in s that a number with a unit of time stands for, such as ``"60 s"`` or ``"0.5min"``.

    Raises:
        ValueError: anything else, or no duration above 0; the message says what is expected.
    """
    match = re.fullmatch(r"\s*(\d*\.?\d+(?:[eE][-+]?\d+)?)\s*([^\d\s]+)\s*", text)
    unit_s = TIME_UNITS_S.get(known_unit(match[2]) or "") if match else None
    if match is None or unit_s is None or float(match[1]) <= 0:
        raise ValueError(f"expected a duration above 0 with its unit, such as '60 s' or '1 min', got {text!r}")
    return float(match[1]) * unit_s


def quantity(unit: str) -> str | None:
    """What a unit measures (temperature, length, …, or a dimension of pint), or None if the unit is not known."""
    known = known_unit(unit) or stated_unit(unit)
    return None if known is None else _UNITS.get(known) or str(unit_registry().Unit(known).dimensionality)


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
    names = [stated_unit(unit) for unit in (unit_from, unit_to)]
    for unit, name in zip((unit_from, unit_to), names, strict=True):
        if name is None:
            raise InputError(f"{where}: unknown unit {unit!r}; {closest(unit, _UNITS)}")
    one, other = (str(name) for name in names)
    if quantity(one) != quantity(other):
        raise InputError(
            f"{where}: {unit_from!r} is a {quantity(one)} and cannot become {unit_to!r}, a {quantity(other)};"
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
    """Temperatures are kept in degC, lengths of error channels in um; `roles_units` is name -> (role, unit).

    An error may be of any quantity whose unit is known (kg, V, mrad, …).

    Raises:
        InputError: another unit stands there, with what to write instead, or one that nobody knows.
    """
    for name, (role, unit) in roles_units.items():
        kept, kind = _CANONICAL.get(role), quantity(unit)
        here = f"{where}: channel {name!r} ({role})"
        if kept and kind is None:
            raise InputError(f"{here} has the unknown unit {unit!r}; write unit: {kept}")
        if role == "error" and unit in _OFFSET_UNITS:
            raise InputError(
                f"{here} has unit {unit!r}; expected that of a difference, such as K; correct unit or role"
            )
        if kept == "degC" and kind != "temperature":
            raise InputError(f"{here} has unit {unit!r}, expected 'degC'; correct it")
        if kept and unit != kept and kind == quantity(kept):
            raise InputError(
                f"{here} has unit {unit!r}, expected {kept!r}; write unit: {kept} and unit_in_file: {unit!r}"
            )


_SPELT = {"um": "µm", "degC": "°C", "ohm": "Ω", "**2": "²", "**3": "³", "*": "·"}


def in_error_unit(text: str, unit: str) -> str:
    """A text on errors in µm as the same on errors in `unit`, in which a result counts as in µm elsewhere."""
    return text if unit == "um" else text.replace("µm", unit_label(unit) or "1")


def error_column(name: str, unit: str) -> str:
    """The name of a column of errors: ``predicted_um`` in um, else ``predicted_error``."""
    return name if unit == "um" else f"{name.removesuffix('_um')}_error"


def unit_label(unit: str) -> str:
    """A unit as people write it: ``µm/K`` for um/K, ``N·m`` for N*m, nothing for 1."""
    if unit == "1":
        return ""
    for written, read in _SPELT.items():
        unit = unit.replace(written, read)
    return unit
