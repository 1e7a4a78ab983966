"""How large an effect is, as one number that the key and a finding state alike.

Usually the mechanism's first amplitude, counted from the value at which it is off. Where several parameters multiply
(friction and load, area and emissivity) only their product shows in recordings, so the product is compared.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import pi

from twin.diagnosis.telling.findings import Finding
from twin.mechanisms import MECHANISMS
from twin.proof.scoring.answer_key import TrueTerm

RATED_RPM = 6000.0  # at which what follows the speed is compared
Values = Mapping[str, float]
Sized = tuple[float | None, float | None, float | None]  # a value, and low and high of its 90 % interval
Told = Mapping[str, tuple[float | None, tuple[float | None, float | None] | None]]  # by parameter the same


def _sun_W(p: Values) -> float:
    return p["power"] if "power" in p else p["irradiance"] * p["area"] * p["absorptivity"]


def _motor_W(p: Values) -> float:
    x = RATED_RPM / p.get("rated", RATED_RPM)
    return p["idle"] + p["linear"] * x + p["quadratic"] * x**2


def _convection(p: Values) -> float:
    return p["gain"] * (RATED_RPM / p.get("rated", RATED_RPM)) ** p.get("exponent", 2.0 / 3.0)


def _shift_um(p: Values) -> float:
    return p["shift"] * (RATED_RPM / p.get("rated", RATED_RPM)) ** 2


PRODUCTS: Mapping[str, Callable[[Values], float]] = {
    "sun": _sun_W,
    "guide_friction": lambda p: p["friction"] * p["load"],  # N, of P = F v
    "nut_friction": lambda p: 2e3 * pi * p["moment"] / p["lead"],
    "screw_bearing": lambda p: 2e3 * pi * p["moment"] / p["lead"],
    "radiation": lambda p: p["area"] * p["emissivity"],
    "rotating_convection": _convection,
    "speed_shift": _shift_um,
    "motor_loss": _motor_W,
    "draught": lambda p: p["factor"] * p["drop"],  # K: what a surface at room temperature loses, per W/K
    "stratification": lambda p: p["gradient"] * p.get("height", 1.0),
}


def amplitude(mechanism: str, values: Values) -> float | None:
    """The one number; None where these values do not tell it. Of several amplitudes one that is not told is off."""
    if mechanism not in MECHANISMS:
        return None
    off = dict(MECHANISMS[mechanism].off or {})
    try:
        if mechanism in PRODUCTS:
            return PRODUCTS[mechanism]({**(off if off.keys() & values.keys() else {}), **values})
        first = next(iter(off))
        return values[first] - off[first]
    except (KeyError, StopIteration, ZeroDivisionError):
        return None


def true_amplitude(term: TrueTerm) -> float | None:
    """Of the key's own values."""
    values = {name: value for name, (value, _) in (term.parameters or {}).items()}
    return amplitude(term.mechanism, values) if term.mechanism else None


def found_amplitude(finding: Finding, scale_of: TrueTerm) -> Sized:
    """`sized` of a finding."""
    told = {name: (p.value, p.interval90) for name, p in finding.parameters.items()}
    return sized(finding.mechanism, told, scale_of)


def sized(mechanism: str, parameters: Told, scale_of: TrueTerm) -> Sized:
    """Value, low and high of the 90 % interval, in what the key states; the interval None where none is told.

    Of the key only what sets the scale is taken (a rated speed), never a size. A product's interval is that of its
    first amplitude, the other values held; several amplitudes have none.
    """
    given = {name: v for name, (v, _) in (scale_of.parameters or {}).items()}
    told = {name: value for name, (value, _) in parameters.items() if value is not None}
    fixed = {name: v for name, v in given.items() if name in _beside(mechanism) and name not in told}
    values = {**fixed, **told}
    value = amplitude(mechanism, values)
    free = [name for name in _amplitudes(mechanism) if name in told]
    interval = parameters[free[0]][1] if len(free) == 1 else None
    if value is None or interval is None or interval[0] is None or interval[1] is None:
        return value, None, None
    ends = [amplitude(mechanism, {**values, free[0]: end}) for end in interval if end is not None]
    known = sorted(e for e in ends if e is not None)
    return (value, known[0], known[-1]) if len(known) == 2 else (value, None, None)


def _amplitudes(mechanism: str) -> tuple[str, ...]:
    return tuple(MECHANISMS[mechanism].off or {}) if mechanism in MECHANISMS else ()


def _beside(mechanism: str) -> set[str]:
    """A law's parameters beside its amplitudes."""
    if mechanism not in MECHANISMS:
        return set()
    return {s.name for s in MECHANISMS[mechanism].parameters} - set(_amplitudes(mechanism))
