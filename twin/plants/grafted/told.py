"""Numbers of a machine file's twin part, read as plain data."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.batch import Batch
from data.errors import InputError, closest

Array = NDArray[np.float64]
FACTORS = {
    "J/K": 1.0, "kJ/K": 1e3, "W/K": 1.0, "mW/K": 1e-3, "kW/K": 1e3, "um/K": 1.0, "K": 1.0, "1": 1.0, "": 1.0,
}  # fmt: skip
ROOM = "room"


def told(entry: Any, where: str) -> float:
    """The value that "537 kJ/K", 0.94 or {value: …} stands for, in J/K, W/K, um/K, K or 1.

    Raises:
        InputError: no number, or a unit that is none of these.
    """
    given = entry["value"] if isinstance(entry, Mapping) else entry
    number, _, unit = str(given).strip().partition(" ")
    if unit.strip() not in FACTORS:
        raise InputError(f"grafted: {where}: unit {unit!r} is not known here; {closest(unit, FACTORS)}")
    try:
        return float(number) * FACTORS[unit.strip()]
    except ValueError:
        raise InputError(f"grafted: {where}: got {given!r}, expected a number with a unit such as '14 W/K'") from None


def ends(key: str) -> tuple[str, str]:
    """Both places of a link or exposure by its name: ``"bed-room"``."""
    one, _, other = key.partition("-")
    return one, other


def room_degC(twin: Mapping[str, Any], batch: Batch) -> Array:
    """The room's air as the twin part takes it: its channel and its offset, (rows,)."""
    room = twin["surroundings"][ROOM]
    offset_K = told(room["offset"], "surroundings.room.offset") if "offset" in room else 0.0
    return np.asarray(batch.values(room["channel"]) + offset_K)
