"""Values of a run plan: "4 krpm", "20 min", "0.4 K/h" as numbers in the unit that is kept."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.errors import InputError
from data.machine import Machine
from data.units import conversion

Array = NDArray[np.float64]

_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*")


def quantity(given: Any, unit: str, where: str) -> float:
    """The number in `unit` that "4 krpm" or a bare number (already in `unit`) stands for.

    Raises:
        InputError: no finite number, an unknown unit or one of another quantity; `where` opens the line.
    """
    value, written = _split(given, unit, where)
    factor, offset = conversion(written, unit, where) if written else (1.0, 0.0)
    return factor * value + offset


def difference_K(given: Any, where: str) -> float:
    """A temperature difference: "0.3 K", "0.3 degC" or "0.5 degF" in K. Raises as `quantity`."""
    value, written = _split(given, "K", where)
    return value * (conversion(written, "degC", where)[0] if written else 1.0)


def rate_K_per_s(given: Any, where: str) -> float:
    """A drift such as "0.4 K/h" in K/s; a bare number counts as K/h. Raises as `quantity`."""
    value, written = _split(given, "K/h", where)
    kelvin, slash, time = (written or "K/h").partition("/")
    if not slash:
        raise InputError(f"{where}: got {given!r}, expected a rate such as '0.4 K/h'")
    return value * conversion(kelvin.strip(), "degC", where)[0] / conversion(time.strip(), "s", where)[0]


def in_range(values: Array, name: str, machine: Machine, where: str) -> Array:
    """The values, same shape, if the channel of that name has no range or they lie in it.

    Raises:
        InputError: one lies outside.
    """
    part = machine.channels.get(name)
    if part is None or part.range is None:
        return values
    low, high = part.range
    out = np.flatnonzero((values < low) | (values > high))
    if len(out):
        raise InputError(
            f"{where}: {values[out[0]]:g} {part.unit} is outside the channel's range {low:g} to {high:g} {part.unit};"
            " correct it, or the range in the machine file"
        )
    return values


def _split(given: Any, unit: str, where: str) -> tuple[float, str]:
    """Number and unit as written; the unit is empty where none stands."""
    if isinstance(given, int | float) and not isinstance(given, bool):
        value, written = float(given), ""
    else:
        found = _NUMBER.fullmatch(given) if isinstance(given, str) else None
        if found is None:
            raise InputError(f"{where}: got {given!r}, expected a number in {unit} or with a unit, e.g. '1 {unit}'")
        value, written = float(found[1]), found[2]
    if not math.isfinite(value):
        raise InputError(f"{where}: got {given!r}, expected a finite number in {unit}")
    return value, written
