"""Role, unit, resolution, range and position along an axis, guessed from columns' names and values with the reason."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from data.arrays import Array
from data.readers.csv import normalise
from data.rows import Rows
from data.sweeps import position_bins
from data.units import TIME_UNITS_S, known_unit, quantity, stated_unit

_TIME = re.compile(
    r"time|\bclock$|zeit|时间|時間|时刻|時刻|日時|日期|elapsed|datum|date|^t$|^t ?[\[(/]|\btemps\b(?! ?\d)|heure|"
    r"horodat|tiempo|fecha|\bhora\b|\btempo\b|\bora\b|\bdata\b"
)
_COUNTER = re.compile(
    r"^(unnamed: 0|#|no|nr|n°|nº|num|number|nummer|numero|numéro|número|index|idx|indice|índice|id|row|zeile|ligne|"
    r"fila|riga|lfd|count|counter|zähler|record|sample|scan|point|序号|序號|编号|編號|番号|行)?[ ._]*(no|nr)?\.?$"
)
_SERIES = re.compile(
    r"entity|sensor|channel|^ch\b|kanal|canal|\btag|variable|\bname|series|field|item|signal|device|node|point|metric|topic|"
    r"quantity|param|object|messstelle|通道|传感器"
)
_VALUE = re.compile(r"^_?(value|val|state|wert|messwert|reading|data|v|valeur|valor|valore|值|値)([ _\[(].*)?$")
_SETPOINT = re.compile(r"set ?point|sollwert|\bset\b|command")
_AMBIENT = re.compile(r"amb|room|hall|umgebung|raum|环境|環境|室温|雰囲気|\bair\b|luft")
_ERROR = re.compile(r"disp|err|drift|deviat|\bweg|位移|変位|変形|误差|誤差|\bgap\b|probe|^d[xyz]\b|strain|dehnung")
_DRIVER = re.compile(
    r"rpm|speed|drehzahl|转速|轉速|回転|feed|vorschub|進給|进给|power|leistung|current|strom|load|heater|"
    r"^q\d|torque|pump|flow|volt|humid|feucht|press|druck"
)
_TEMPERATURE = re.compile(r"temp|^t[a-z]? ?\d|^pt ?\d|\bt$|thermo|温")
_ALARM = re.compile(r"alarm|warning|fault|störung")
_POSITION = re.compile(r"\bpos|axis|achse")
_LONE_LETTERS = {"W", "A", "V", "N", "C", "K", "%", "°", "℃"}
_LABELS = ("A", "W", "N")  # letters of sensors rather than units where the name is one of a temperature
_TIME_OF_DAY = {"ora", "hora", "heure"}  # also the word for an hour
_LONE_TIMES = {"s", "h", "d"}  # as the unit of a clock only
_BRACKETS = re.compile(r"[\[(]\s*([^\[\]()]+?)\s*[\])]")
_STATISTIC = re.compile(r"[_ ](avg|average|mean|smp|std|raw|last|tot|med)$", re.IGNORECASE)
# where else a header holds its unit, the likeliest first: behind "in", a separator or CJK text; all of it
_UNIT_PLACES = tuple(
    re.compile(pattern)
    for pattern in (
        r"\b(?:in|en)\s+(\S.*)$",
        r"(?<=\w)[_ /,;:]\s*([^_\s]+)$",
        r"(?<=[\u3040-\u30ff\u3400-\u9fff])([^\u3040-\u9fff\s_]{2,})$",
        r"(?<=[\u3040-\u9fff])([\u3040-\u9fff]{2})$",
        r"(?<=[\u3040-\u9fff])([\u3040-\u9fff]{3})$",
        r"^(\D{3,}|[\u3040-\u9fff]+)$",
    )
)
_ERROR_KINDS = ("length", "voltage", "angle", "ratio", "count", "force", "resistance", "frequency")  # can be measured
_LENGTH_S = (500.0, 30 * 86400.0)  # a thermal test lasts ten minutes to weeks
_SAMPLE_S = (0.01, 600.0)  # slower than 10 min misses a warm-up, faster than 100 Hz is no temperature record
_RATE_K_PER_MIN = 8.0  # 1 kW into the smallest instrumented body, about 7.5 kJ/K
NICE_STEPS_S = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 20, 30, 60, 120, 300, 600, 900, 1800, 3600)
_FAR_SPANS = 3.0  # times the span of the others: a lone value there is no reading


@dataclass(frozen=True)
class Guess:
    """A value and why it was taken."""

    value: str
    why: str


def is_time_name(name: str) -> bool:
    """Whether a header says that the column is a clock: a word for time, or a unit of time."""
    if quantity(unit_in_name(name) or "s") != "time":
        return False
    return bool(_TIME.search(normalise(name))) or time_unit_in_name(name) is not None


def is_counter_name(name: str) -> bool:
    """Whether a header is one of a column that numbers the rows (also none, or the one that pandas gives)."""
    return bool(_COUNTER.match(normalise(name)))


def is_series_name(name: str) -> bool:
    """Whether a header is one of a column that says of what a row's reading is."""
    return bool(_SERIES.search(normalise(name)))


def is_value_name(name: str) -> bool:
    """Whether a header is one of a column of readings of any kind."""
    return bool(_VALUE.match(normalise(name)))


def no_quantity(name: str) -> str:
    """What a header names that is no quantity: an alarm, or the fraction of a clock by its unit alone; else nothing."""
    if _ALARM.search(normalise(name)):
        return "an alarm"
    return "a part of the clock" if known_unit(name) in ("ms", "us", "ns") else ""


def without_unit(name: str) -> str:
    """A header without the brackets that hold its unit."""
    return _BRACKETS.sub(lambda found: "" if stated_unit(found[1]) else found[0], name)


def is_other_name(name: str) -> bool:
    """Whether a header says that the column is a channel and no clock."""
    folded = normalise(name.replace("_", " "))
    names = any(p.search(folded) for p in (_SETPOINT, _AMBIENT, _ERROR, _DRIVER, _TEMPERATURE, _POSITION))
    return names or quantity(unit_in_name(name) or "s") != "time"


def unit_in_name(name: str, lone: Collection[str] = _LONE_LETTERS) -> str | None:
    """A unit in a header, by its known name: ``"ch1_um"`` and ``"Weg in Mikrometer"`` -> ``um``.

    Brackets come first, then what stands in front of them (``"Temp, °F (S/N 12)"``). `lone` are the single letters that
    count as a unit outside brackets.
    """
    text = unicodedata.normalize("NFKC", name).strip()
    inside = (unit for content in reversed(_BRACKETS.findall(text)) if (unit := stated_unit(content)))
    if unit := next(inside, None):
        return unit
    text = _STATISTIC.sub("", _BRACKETS.sub("", text).strip())
    for pattern in _UNIT_PLACES:
        found = pattern.search(text)
        if found is not None and (len(found[1]) > 1 or found[1] in lone) and (unit := known_unit(found[1])):
            return unit
    return None


def unknown_unit_in_name(name: str) -> str | None:
    """What square brackets hold, if it is written like a unit and is not known as one."""
    found = re.search(r"\[\s*([^\[\]]+?)\s*\]\s*$", name)
    looks = found and re.fullmatch(r"[^\W\d_]{1,4}|\S*[/%²³°µ^·]\S*", found[1]) and not _STATISTIC.match(f"_{found[1]}")
    return found[1] if found and looks and stated_unit(found[1]) is None else None


def channel_unit_in_name(name: str) -> str | None:
    """The unit in a channel's header, which is none of time: the "min" of "T_min" is a minimum."""
    unit = unit_in_name(name)
    label = unit in _LABELS and _TEMPERATURE.search(normalise(name.replace("_", " ")))
    return None if label or quantity(unit or "") == "time" else unit


def time_unit_in_name(name: str) -> str | None:
    """The unit of time in a clock's header: as `unit_in_name`, or any word of it ("Minuten seit Start")."""
    words = re.findall(r"[^\W\d_]{3,}", normalise(name))
    if set(words) & _TIME_OF_DAY and len(words) == 1:
        return None
    texts = (unit_in_name(name, _LONE_TIMES), *(known_unit(w) for w in words))
    return next((u for u in texts if u in TIME_UNITS_S), None)


def role(name: str, unit: str | None, values: Array) -> Guess:
    """Role of a channel from its name and unit, else from its values. A unit that is not known is none of kelvins."""
    folded = normalise(name.replace("_", " "))
    kind = quantity(unit) if unit else None
    if _SETPOINT.search(folded):
        return Guess("driver", "its name sounds like a set point")
    if kind == "temperature" or (unit is None and _TEMPERATURE.search(folded)):
        if _AMBIENT.search(folded):
            return Guess("ambient", "a temperature whose name sounds like the room")
        return Guess("temperature", f"its unit {unit}" if kind else "its name")
    if kind == "length":
        if _ERROR.search(folded) or unit in ("um", "nm"):
            return Guess("error", f"a length in {unit}")
        return Guess("position", f"a length in {unit}")
    if unit is not None and not _ERROR.search(folded):
        return Guess("driver", f"its unit {unit}" if kind else f"its unit {unit}, which is not known")
    for pattern, value in ((_AMBIENT, "ambient"), (_ERROR, "error"), (_DRIVER, "driver"), (_POSITION, "position")):
        if pattern.search(folded):
            return Guess(value, "its name")
    return _role_of_values(values)


def may_be_error(name: str, unit: str | None) -> bool:
    """Whether a channel of another role can be the measured error by its unit, and is not named as something else."""
    folded = normalise(name.replace("_", " "))
    kind = quantity(unit or "")
    named = (_SETPOINT, _AMBIENT, _TEMPERATURE, *([_DRIVER] if kind in _ERROR_KINDS else []))
    return unit is not None and not any(p.search(folded) for p in named) and kind in (*_ERROR_KINDS, "mass", None)


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
    """Unit in the file for a channel of that role whose unit is not stated."""
    v = values[np.isfinite(values)]
    size = float(np.max(np.abs(v))) if len(v) else 0.0
    middle = float(np.median(v)) if len(v) else 0.0
    if of_role in ("temperature", "ambient"):
        if 230.0 <= middle <= 420.0:
            return Guess("K", f"values around {middle:.4g}")
        return Guess("degC", f"values around {middle:.3g}; may be degF")
    if of_role == "error":
        if size < 0.002:  # in mm it would never exceed 2 µm
            return Guess("m", f"never above {size:.2g}; may be a strain")
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
    steps = steps[steps > 1e-9 * max(1.0, float(np.median(np.abs(v))))]
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


def time_unit(written: str | None, step: float, length: float, rate_K: float) -> tuple[Guess, str]:
    """Unit of a numeric clock, and what speaks against it or leaves it open ("" where nothing does).

    `written` is the unit in the header; `step` and `length` are the median step and the length in the file's unit,
    `rate_K` the fastest sustained change of a temperature in K per that unit. The unit must make a length, a step and
    a rate that a thermal test of a machine can have; without a written one the first of s, min, h, d, ms does.
    """
    doubts = {u: _doubts(step * s, length * s, rate_K / s) for u, s in TIME_UNITS_S.items()}
    fits = [u for u, d in doubts.items() if not d]
    if written is not None:
        if not doubts[written] or not fits:
            return Guess(written, "named so in the header"), ""
        return Guess(written, "named so in the header, but implausible"), (
            f"the header's unit of time {written} gives {' and '.join(doubts[written])}, unusual for a machine; "
            f"{fits[0]} would be plausible"
        )
    value = min(doubts, key=lambda u: len(doubts[u]))
    seen = f"steps of {step:.3g} over {length:.4g}"
    note = f"no header gives the unit of time; {seen} are taken for {value}"
    if doubts[value]:
        note += f", although that gives {' and '.join(doubts[value])}, unusual for a machine"
    elif doubts["s"]:
        note += f"; s would give {' and '.join(doubts['s'])}, unusual for a machine"
    if len(fits) > 1:
        note += f"; {' and '.join(fits[1:])} would be plausible as well"
    return Guess(value, f"{seen} fit {value}"), note


def unit_doubt(unit: str, step_s: float, length_s: float, rate_K_per_s: float) -> str:
    """What speaks against the unit of a clock that gave these, where two things do and nothing against another unit."""
    factors = {u: s / TIME_UNITS_S[unit] for u, s in TIME_UNITS_S.items()}
    doubts = {u: _doubts(step_s * f, length_s * f, rate_K_per_s / f) for u, f in factors.items()}
    fits = [u for u, d in doubts.items() if not d]
    return f"{unit} gives {' and '.join(doubts[unit])}; {fits[0]} would not" if len(doubts[unit]) > 1 and fits else ""


def _doubts(step_s: float, length_s: float, rate_K_per_s: float) -> list[str]:
    """What no thermal test of a machine would have."""
    out = []
    if not _SAMPLE_S[0] <= step_s <= _SAMPLE_S[1]:
        out.append(f"samples {step_s:.3g} s apart")
    if not _LENGTH_S[0] <= length_s <= _LENGTH_S[1]:
        out.append(f"a recording of {length_s / 3600:.3g} h")
    if rate_K_per_s * 60 > _RATE_K_PER_MIN:
        out.append(f"temperatures that change by {rate_K_per_s * 60:.3g} K/min")
    return out


def sustained_rate(time: Array, values: Array) -> float:
    """The 95th percentile of |change| per unit of time over a fiftieth of the recording (5 samples at least)."""
    there = np.isfinite(values) & np.isfinite(time)
    t, v = time[there], values[there]
    lag = max(5, len(v) // 50)
    if len(v) <= 2 * lag:
        return 0.0
    change, between = np.abs(v[lag:] - v[:-lag]), t[lag:] - t[:-lag]
    return float(np.quantile(change[between > 0] / between[between > 0], 0.95)) if (between > 0).any() else 0.0


def seen_range(values: Array) -> tuple[float, float]:
    """Smallest and largest value (n,), without outermost ones (a thousandth) far from all others; NaN without any."""
    v = np.sort(values[np.isfinite(values)])
    k = max(1, len(v) // 1000)
    if len(v) <= 2 * k:
        return (float(v[0]), float(v[-1])) if len(v) else (np.nan, np.nan)
    far = _FAR_SPANS * (v[-1 - k] - v[k]) or np.inf
    inside = v[(v >= v[k] - far) & (v <= v[-1 - k] + far)]
    return float(inside[0]), float(inside[-1])


def grid_step_s(interval_s: float) -> float:
    """The nearest usual step that is not finer than the samples, or whole minutes as they are."""
    if interval_s >= 60.0 and abs(interval_s - 60.0 * round(interval_s / 60.0)) < 1e-3 * interval_s:
        return 60.0 * round(interval_s / 60.0)
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
