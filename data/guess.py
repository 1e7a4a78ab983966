"""Role, unit, resolution, range and position along an axis, guessed from columns' names and values with the reason."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data.arrays import Array
from data.readers.csv import normalise
from data.rows import Rows
from data.sweeps import position_bins
from data.units import known_unit, quantity

_TIME = re.compile(r"time|zeit|时间|時間|時刻|日時|timestamp|elapsed|datum|date|^t$|^t ?[\[(]")
_SETPOINT = re.compile(r"set ?point|sollwert|\bset\b|command")
_AMBIENT = re.compile(r"amb|room|hall|umgebung|raum|环境|環境|室温|雰囲気|\bair\b|luft")
_ERROR = re.compile(r"disp|err|drift|deviat|\bweg|位移|変位|変形|误差|誤差|\bgap\b|probe|^d[xyz]\b|strain|dehnung")
_DRIVER = re.compile(
    r"rpm|speed|drehzahl|转速|轉速|回転|feed|vorschub|進給|进给|power|leistung|current|strom|load|heater|"
    r"^q\d|torque|coolant|pump|flow|volt"
)
_TEMPERATURE = re.compile(r"temp|^t[a-z]? ?\d|^pt ?\d|thermo|温")
_POSITION = re.compile(r"\bpos|axis|achse")
_LONE_LETTERS = {"W", "A", "V", "N", "C", "K", "%"}
NICE_STEPS_S = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 20, 30, 60, 120, 300, 600, 900, 1800, 3600)


@dataclass(frozen=True)
class Guess:
    """A value and why it was taken."""

    value: str
    why: str


def is_time_name(name: str) -> bool:
    return bool(_TIME.search(normalise(name)))


def unit_in_name(name: str) -> str | None:
    """A unit in brackets, or behind the last underscore or blank, by its known name: ``"ch1_um"`` -> ``um``."""
    if m := re.search(r"[\[(]\s*([^\[\]()]+?)\s*[\])]\s*$", name):
        return known_unit(m[1])
    if m := re.search(r"(?<=\w)[_ /]([^_\s]+)$", name.strip()):
        tail = m[1]
        if len(tail) > 1 or tail in _LONE_LETTERS or tail in "°℃":
            return known_unit(tail)
    return None


def role(name: str, unit: str | None, values: Array) -> Guess:
    """Role of a channel from its name and unit, else from its values."""
    folded = normalise(name.replace("_", " "))
    kind = quantity(unit) if unit else None
    if _SETPOINT.search(folded):
        return Guess("driver", "its name sounds like a set point")
    if kind == "temperature" or (kind is None and _TEMPERATURE.search(folded)):
        if _AMBIENT.search(folded):
            return Guess("ambient", "a temperature whose name sounds like the room")
        return Guess("temperature", f"its unit {unit}" if kind else "its name")
    if kind == "length":
        if _ERROR.search(folded) or unit in ("um", "nm"):
            return Guess("error", f"a length in {unit}")
        return Guess("position", f"a length in {unit}")
    if kind is not None and not _ERROR.search(folded):
        return Guess("driver", f"its unit {unit}")
    if kind is None:
        for pattern, value in ((_AMBIENT, "ambient"), (_ERROR, "error"), (_DRIVER, "driver"), (_POSITION, "position")):
            if pattern.search(folded):
                return Guess(value, "its name")
    return _role_of_values(values)


def _role_of_values(values: Array) -> Guess:
    v = values[np.isfinite(values)]
    span = float(np.ptp(v)) if len(v) else 0.0
    if span == 0.0:
        return Guess("driver", "constant; its values give no information")
    jump = np.abs(np.diff(v))
    if jump.max() >= 0.25 * span and (np.mean(jump == 0) > 0.8 or jump.max() >= 0.6 * span):
        return Guess("driver", "it jumps between levels")
    if np.median(v) >= 8 and v.min() > -40 and v.max() < 200 and abs(v[0]) > 0.3 * span:
        return Guess("temperature", f"smooth, {v.min():.3g} to {v.max():.3g}")
    if abs(v[0]) <= 0.5 * span:
        return Guess("error", "smooth, and starts near zero")
    return Guess("driver", "neither like a temperature nor like a displacement")


def unit(of_role: str, name: str, values: Array) -> Guess:
    """Unit in the file for a channel of that role."""
    written = unit_in_name(name)
    if written:
        return Guess(written, "named so in the header")
    v = values[np.isfinite(values)]
    size = float(np.max(np.abs(v))) if len(v) else 0.0
    middle = float(np.median(v)) if len(v) else 0.0
    if of_role in ("temperature", "ambient"):
        if 230.0 <= middle <= 420.0:
            return Guess("K", f"values around {middle:.4g}")
        return Guess("degC", f"values around {middle:.3g}; may be degF")
    if of_role == "error":
        if size < 0.5:
            return Guess("mm", f"never above {size:.2g}")
        return Guess("um", f"up to {size:.3g}")
    if of_role == "position":
        return Guess("mm", "usual for positions")
    folded = normalise(name)
    if re.search(r"rpm|speed|drehzahl|转速|回転", folded):
        return Guess("rpm", "usual for a speed")
    if re.search(r"feed|vorschub|進給|进给", folded):
        return Guess("mm/min", "usual for a feed")
    return Guess("1", "not in the name; enter the true unit")


def resolution(values: Array) -> float | None:
    """Smallest step of an instrument that shows multiples of one; None if the values are on no such lattice."""
    v = np.unique(values[np.isfinite(values)])[:20_000]
    if len(v) < 3:
        return None
    steps = np.diff(v)
    steps = steps[steps > 1e-9 * max(1.0, float(np.abs(v).max()))]
    if len(steps) == 0:
        return None
    smallest = float(f"{steps.min():.3g}")
    multiples = steps / smallest
    on_lattice = np.mean(np.abs(multiples - np.round(multiples)) < 0.1)
    repeated = np.mean(multiples < 1.5)
    return smallest if on_lattice > 0.95 and repeated > 0.05 else None


def plausible_range(of_role: str, low: float, high: float) -> tuple[float, float] | None:
    """A range wider than the values and at least as wide as is usual for the role; None without finite values."""
    if not np.isfinite([low, high]).all():
        return None
    span = max(high - low, abs(high), 1e-6)
    if of_role in ("temperature", "ambient"):
        return min(-20.0, _nice(low - span, False)), max(120.0, _nice(high + span, True))
    if of_role == "error":
        return _nice(-3.0 * max(abs(low), abs(high), 1e-6), False), _nice(3.0 * max(abs(low), abs(high), 1e-6), True)
    return (_nice(low - span, False) if low < 0 else min(0.0, low)), _nice(high + 0.5 * span, True)


def _nice(x: float, up: bool) -> float:
    """Rounded away from the data to one digit."""
    if x == 0.0:
        return 0.0
    unit_of_digit = 10.0 ** np.floor(np.log10(abs(x)))
    return float(f"{(np.ceil if up else np.floor)(x / unit_of_digit) * unit_of_digit:.6g}")


def time_unit(name: str, step: float, length: float) -> Guess:
    """s, min or h of a numeric time column with that median step and length."""
    written = unit_in_name(name)
    if written is None and (m := re.search(r"(?:^|[_ ])(s|min|h)$", normalise(name))):
        written = m[1]
    if written in ("s", "min", "h"):
        return Guess(written, "named so in the header")
    if step < 0.02 and length < 200:
        return Guess("h", f"steps of {step:.3g} over {length:.4g} fit hours")
    if step < 1.0 and length >= 20 and step * length > 10:
        return Guess("min", f"steps of {step:.3g} over {length:.4g} fit minutes")
    return Guess("s", f"steps of {step:.3g} over {length:.4g} fit seconds")


def grid_step_s(interval_s: float) -> float:
    """The nearest usual step that is not finer than the samples."""
    return next((s for s in NICE_STEPS_S if s >= interval_s * 0.999), float(np.ceil(interval_s)))


_LEAST_COLUMNS = 3
_SWEEP_S = 120.0  # rows of a sweep under one time stamp may spread so far: a machine then warms by a tenth of a kelvin
_NUMBER = re.compile(r"^(?P<before>[^\d]*?)(?P<mm>[-+]?\d+(?:[.,]\d+)?)(?P<after>[^\d]*)$")
_POSITION_PREFIX = re.compile(r"(=|@|:|\bat|\bpos\w*|\bp|[xyz])\s*$", re.IGNORECASE)


@dataclass(frozen=True)
class PositionGroup:
    """Columns that are one error at several positions: their pattern, places in the table, positions in mm."""

    pattern: str
    places: tuple[int, ...]
    position_mm: tuple[float, ...]

    @property
    def letter(self) -> str:
        """The axis, where the pattern begins with its letter."""
        return self.pattern[:1].lower() if re.match(r"[xyz](?![a-z])", self.pattern, re.IGNORECASE) else ""


def position_groups(columns: Sequence[str], places: Sequence[int]) -> list[PositionGroup]:
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
        explicit = "mm" in after.lower() or bool(re.search(r"[=@:]\s*$", before))
        hinted = not counted and (not before.strip() or bool(_POSITION_PREFIX.search(before)))
        if len(set(mm)) == len(mm) >= _LEAST_COLUMNS and (explicit or hinted):
            out.append(PositionGroup(pattern, tuple(i for i, _ in members), tuple(mm)))
    return out


def along_axis(errors: Sequence[str], positions: Sequence[str], rows: Rows) -> dict[str, Guess]:
    """Error channel -> the position channel that it seems to be read along, with the reason.

    A sweep shows in rows that share a time stamp while the position changes, or in error and position that stand in the
    same few rows.
    """
    out = {}
    for error in errors:
        candidates = [
            (name, why) for name in positions if (why := _why(rows.columns[error], rows.columns[name], rows.time_s))
        ]
        if candidates:
            name, why = max(candidates, key=lambda t: t[0][:1].lower() == error[:1].lower())
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


def sweep_step_s(time_s: Array, positions: Sequence[Array], n_columns: Sequence[int]) -> float:
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
