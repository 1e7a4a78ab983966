"""Surroundings of a run plan: constant, drifting with a ripple, points over time, or a file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.errors import InputError, closest
from data.machine import Machine
from twin.run_plan.table import fill_short_gaps, read_plan_table
from twin.run_plan.values import difference_K, quantity, rate_K_per_s

Array = NDArray[np.float64]

_WAVE = ("start", "drift", "ripple", "period")
_FILE = ("file", "column")


def surrounding_degC(given: Any, name: str, time_s: Array, folder: Path, machine: Machine, where: str) -> Array:
    """One surrounding at the plan's borders `time_s` (n,), shape (n,), degC.

    `given` is a temperature, ``{start, drift, ripple, period}`` (start + drift t + ripple sin(2 pi t / period)), a
    list of [hours, degC] joined by straight lines, its ends held, or ``{file, column}`` with the path relative to
    `folder`. A file may end before the plan by no more than the machine's `max_gap_s`.

    Raises:
        InputError: none of these, a wrong unit, times that do not rise, a file that cannot be used or is too short.
    """
    if isinstance(given, Mapping):
        keys = [str(k) for k in given]
        allowed = _FILE if "file" in given else _WAVE
        for key in keys:
            if key not in allowed:
                raise InputError(f"{where}: unknown key {key!r}; {closest(key, (*_FILE, *_WAVE))}")
        return _file(given, name, time_s, folder, machine, where) if "file" in given else _wave(given, time_s, where)
    if isinstance(given, list):
        return _points(given, time_s, where)
    return np.full(len(time_s), quantity(given, "degC", where))


def _wave(given: Mapping[str, Any], time_s: Array, where: str) -> Array:
    if "start" not in given:
        raise InputError(f"{where}: key 'start' is missing; write e.g. start: 20 degC")
    if ("ripple" in given) != ("period" in given):
        lacking = "period" if "ripple" in given else "ripple"
        raise InputError(f"{where}: key {lacking!r} is missing; a ripple needs ripple (K) and period (min) together")
    out = quantity(given["start"], "degC", f"{where}.start") + np.zeros(len(time_s))
    if "drift" in given:
        out += rate_K_per_s(given["drift"], f"{where}.drift") * time_s
    if "ripple" in given:
        period_s = 60.0 * quantity(given["period"], "min", f"{where}.period")
        if period_s <= 0:
            raise InputError(f"{where}.period: got {given['period']!r}, expected more than 0 min")
        out += difference_K(given["ripple"], f"{where}.ripple") * np.sin(2 * np.pi * time_s / period_s)
    return out


def _points(given: Sequence[Any], time_s: Array, where: str) -> Array:
    if not given:
        raise InputError(f"{where}: got an empty list, expected points [hours, degC]")
    for k, point in enumerate(given, 1):
        if not isinstance(point, list) or len(point) != 2:
            raise InputError(f"{where} point {k}: got {point!r}, expected [hours, degC], e.g. [0, 20]")
    hours = np.array([quantity(p[0], "h", f"{where} point {k}") for k, p in enumerate(given, 1)])
    degC = np.array([quantity(p[1], "degC", f"{where} point {k}") for k, p in enumerate(given, 1)])
    back = np.flatnonzero(np.diff(hours) <= 0)
    if len(back):
        k = int(back[0]) + 1
        raise InputError(
            f"{where} point {k + 1}: {hours[k]:g} h is not after {hours[k - 1]:g} h; put the points in order"
        )
    return np.interp(time_s, hours * 3600.0, degC)


def _file(given: Mapping[str, Any], name: str, time_s: Array, folder: Path, machine: Machine, where: str) -> Array:
    column = str(given.get("column", name))
    path = folder / str(given["file"])
    here = f"{where}: file {path}"
    table = read_plan_table(path, machine, {column: "degC"}, here, others=True)
    max_gap_s = machine.recording.max_gap_s
    if (short_s := time_s[-1] - table.time_s[-1]) > max_gap_s:
        raise InputError(
            f"{here}: ends {short_s:g} s before the plan ({time_s[-1]:g} s), more than max_gap_s {max_gap_s:g};"
            " give a longer file or shorten the plan"
        )
    values = fill_short_gaps(table.columns[column], table.time_s, max_gap_s, False, f"{here}: column {column!r}")
    return np.interp(time_s, table.time_s, values)
