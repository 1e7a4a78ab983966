"""Guesses about errors along an axis: a position column beside the error's, or a column of errors for each position."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data.arrays import Array
from data.guess import NICE_STEPS_S, Guess
from data.rows import Rows
from data.sweeps import position_bins

_LEAST_COLUMNS = 3
_SWEEP_S = 120.0  # rows of a sweep under one time stamp may spread so far: a machine then warms by a tenth of a kelvin
_NUMBER = re.compile(r"^(?P<before>[^\d]*?)(?P<mm>[-+]?\d+(?:[.,]\d+)?)(?P<after>[^\d]*)$")
_SAYS_WHERE = re.compile(r"(=|@|:|\bat|\bpos\w*|\bp|[xyz])\s*$", re.IGNORECASE)


@dataclass(frozen=True)
class Group:
    """Columns that are one error at several positions: their pattern, places in the table, positions in mm."""

    pattern: str
    places: tuple[int, ...]
    position_mm: tuple[float, ...]

    @property
    def letter(self) -> str:
        """The axis, where the pattern begins with its letter."""
        return self.pattern[:1].lower() if re.match(r"[xyz](?![a-z])", self.pattern, re.IGNORECASE) else ""


def groups(columns: Sequence[str], places: Sequence[int]) -> list[Group]:
    """Groups of three or more columns whose names differ by a number that reads as a position.

    It does behind =, @, : or an axis' letter, before mm, or alone; 1, 2, 3, … behind a letter are sensors.
    """
    found: dict[str, list[tuple[int, float]]] = {}
    for i in places:
        if match := _NUMBER.match(columns[i].strip()):
            pattern = f"{match['before']}*{match['after']}"
            found.setdefault(pattern, []).append((i, float(match["mm"].replace(",", "."))))
    out = []
    for pattern, members in found.items():
        before, _, after = pattern.partition("*")
        mm = [m for _, m in members]
        counted = mm in ([float(k + first) for k in range(len(mm))] for first in (0, 1))
        told = "mm" in after.lower() or bool(re.search(r"[=@:]\s*$", before))
        hinted = not counted and (not before.strip() or bool(_SAYS_WHERE.search(before)))
        if len(set(mm)) == len(mm) >= _LEAST_COLUMNS and (told or hinted):
            out.append(Group(pattern, tuple(i for i, _ in members), tuple(mm)))
    return out


def along(errors: Sequence[str], positions: Sequence[str], rows: Rows) -> dict[str, Guess]:
    """Error channel -> the position channel that it seems to be read along, with the reason.

    A sweep shows in rows that share a time stamp while the position changes, or in error and position that stand in the
    same few rows.
    """
    out = {}
    for error in errors:
        told = [
            (name, why) for name in positions if (why := _why(rows.columns[error], rows.columns[name], rows.time_s))
        ]
        if told:
            name, why = max(told, key=lambda t: t[0][:1].lower() == error[:1].lower())
            out[error] = Guess(name, why)
    return out


def _why(error: Array, position: Array, time_s: Array) -> str:
    read = np.isfinite(error) & np.isfinite(position)
    if read.sum() < _LEAST_COLUMNS or len(np.unique(position_bins(position[read]))) < 2:
        return ""
    stamps = time_s[read]
    again = np.diff(stamps) == 0
    if again.mean() >= 0.5 and (np.diff(position[read])[again] != 0).mean() > 0.5:
        return "rows share a time stamp while the position changes"
    if read.mean() < 0.9 and read.sum() >= 0.95 * max(np.isfinite(error).sum(), np.isfinite(position).sum()):
        return "error and position stand in the same rows"
    return ""


def step_s(time_s: Array, positions: Sequence[Array], n_columns: Sequence[int]) -> float:
    """A grid step that gives every reading of a sweep a row: position channels (n,), NaN between readings, and the
    numbers of columns that are read at once.

    Where readings have time stamps of their own it is the usual step at or below their spacing; under one stamp, one
    that spreads a sweep over two minutes at most.
    """
    steps = [_SWEEP_S / n for n in n_columns]
    for position in positions:
        read = np.isfinite(position)
        between_s = np.diff(time_s[read])
        own = between_s[between_s > 0]
        several = len(np.unique(position_bins(position[read])))
        steps.append(float(np.median(own)) if len(own) > 0.5 * len(between_s) else _SWEEP_S / several)
    return max((s for s in NICE_STEPS_S if s <= min(steps) * (1 + 1e-9)), default=NICE_STEPS_S[0])
