"""Parsing of cells: Arrow columns of numbers, text and time stamps to float64 arrays."""

from __future__ import annotations

import datetime as dt
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from data.arrays import Array
from data.errors import InputError
from data.units import TIME_UNITS_S, conversion, known_unit, quantity

_DATES = ("%Y-%m-%d", "%Y/%m/%d", "%Y.%m.%d", "%d.%m.%Y", "%d/%m/%Y", "%m/%d/%Y", "%d-%m-%Y", "%m-%d-%Y", "%Y%m%d",
          "%d.%m.%y", "%d/%m/%y", "%m/%d/%y", "%d-%m-%y", "%m-%d-%y", "%Y年%m月%d日", "%d-%b-%Y", "%d %b %Y",
          "%d. %b %Y", "%d/%b/%Y", "%d.%b.%Y", "%d-%b-%y", "%b %d, %Y", "%Y-%b-%d")  # fmt: skip
_TIMES = ("%H:%M:%S", "%H:%M:%S.%f", "%H:%M", "%H-%M-%S", "%I:%M:%S %p", "%I:%M:%S.%f %p", "%I:%M %p", "%H%M%S",
          "%H.%M.%S", "%H时%M分%S秒", "%H時%M分%S秒")  # fmt: skip
_BETWEEN = (" ", "T", "-", "_", ", ", ":")  # date and time of day
_PATTERNS = [*(f"{d}{sep}{t}" for d in _DATES for t in _TIMES for sep in _BETWEEN), *_TIMES, *_DATES]
_ISO = "ISO8601"
MISSING = ("", "nan", "NaN", "NAN")
_ZONES_H = {
    zone: hours
    for hours, zones in {0: "Z UTC GMT WET", 1: "WEST BST CET MEZ", 2: "CEST MESZ EET", 3: "EEST MSK", 9: "JST KST",
                         -4: "EDT", -5: "EST CDT", -6: "CST MDT", -7: "MST PDT", -8: "PST"}.items()
    for zone in zones.split()
}  # fmt: skip
_ZONE = re.compile(rf"\s*\b({'|'.join(_ZONES_H)})\b|(?<=\d)\s*([+-]\d\d):?(\d\d)$")
_ABROAD = "mär mrz mai okt dez fév avr aoû déc ene abr ago dic gen mag giu lug ott"  # three letters of months
_ENGLISH = "Mar Mar May Oct Dec Feb Apr Aug Dec Jan Apr Aug Dec Jan May Jun Jul Oct"
_MONTHS = dict(zip(_ABROAD.split(), _ENGLISH.split(), strict=True))
# spellings of time stamps, in this order, and what they become
_PLAIN = (
    (re.compile(r"^(mon|tue|wed|thu|fri|sat|sun)[a-z]*[.,]?\s+", re.I), ""),
    (re.compile(r"\s*\b([ap])\.?\s?m\b\.?", re.I), lambda m: f" {m[1].upper()}M"),
    (re.compile(r"([^\W\d_]{3})[^\W\d_]*\.?(?=[ \-/.,]+\d)"), lambda m: _MONTHS.get(m[1].lower(), m[1])),
    (re.compile(r"(?<![\d:])(\d\d?:\d\d:\d\d)[:,](\d+)"), r"\1.\2"),
    (re.compile(r"^([a-z]{3}) +(\d+) +(\d\S+) +(\d{4})$", re.I), r"\2 \1 \4 \3"),  # ctime
)
_NUMERIC = (pa.types.is_floating, pa.types.is_integer, pa.types.is_decimal, pa.types.is_boolean)
_ELAPSED = re.compile(r"(\d+ ?d(ays?)?,? ?)?\d+:\d\d:\d\d([.,]\d+)?")
_QUANTITY = re.compile(r"([+-]?\s*[\d.,]+(?:[eE][+-]?\d+)?)\s*([^\d\s.,;:+-][^\d;:]{0,8})")


def to_float(column: Any, decimal: str = ".", unit: str = "") -> tuple[Array, NDArray[np.bool_] | None]:
    """Column to float64 (n,), NaN where empty or unreadable, and a mask of the unreadable cells (None: all readable).

    An empty cell and "NaN" mean missing; a number with a unit ("22.3 °C") becomes one in `unit`; anything else that is
    no finite number is unreadable.
    """
    kind = column.type
    if pa.types.is_dictionary(kind):
        column = column.cast(kind.value_type)
        kind = column.type
    if any(test(kind) for test in _NUMERIC):
        if not pa.types.is_float64(kind):
            column = column.cast(pa.int8()) if pa.types.is_boolean(kind) else column
            column = column.cast(pa.float64(), safe=False)
        values = _numpy(column)
        infinite = np.isinf(values)
        if not infinite.any():
            return values, None
        return np.where(infinite, np.nan, values), infinite
    if pa.types.is_string(kind) or pa.types.is_large_string(kind):
        return _text_to_float(column, decimal, unit)
    if pa.types.is_null(kind):
        return np.full(len(column), np.nan), None
    return np.full(len(column), np.nan), np.ones(len(column), bool)


def cell_texts(column: Any, which: NDArray[np.bool_]) -> NDArray[Any]:
    """What the cells at `which` (n,) hold, as text, one object for each distinct text."""
    distinct: dict[str, str] = {}
    cells = pc.take(column, pa.array(np.flatnonzero(which))).to_pylist()
    texts = np.empty(len(cells), object)
    texts[:] = [distinct.setdefault(text, text) for text in (str(cell).strip() for cell in cells)]
    return texts


def _numpy(column: Any) -> Array:
    """Float64 copy with nulls as NaN."""
    return np.asarray(column.to_numpy(zero_copy_only=False), dtype=np.float64)


def _text_to_float(column: Any, decimal: str, unit: str) -> tuple[Array, NDArray[np.bool_] | None]:
    text = pc.fill_null(pc.utf8_trim_whitespace(column), "")
    mark = re.escape(decimal)
    plain = pc.match_substring_regex(text, rf"^[+-]?(\d+({mark}\d*)?|{mark}\d+)([eE][+-]?\d+)?$")
    numbers = pc.if_else(plain, text, pa.scalar(None, text.type))
    if decimal != ".":
        numbers = pc.replace_substring(numbers, decimal, ".")
    values = _numpy(numbers.cast(pa.float64())).copy()
    rest = np.flatnonzero(~np.asarray(plain.to_numpy(zero_copy_only=False), bool))
    bad = np.isinf(values)  # 1e999
    values[bad] = np.nan
    if len(rest):
        cells = pc.take(text, pa.array(rest)).to_pylist()
        read = {cell: _in_unit(cell, decimal, unit) for cell in set(cells)}
        values[rest] = [np.nan if read[c] is None else read[c] for c in cells]
        bad[rest] = [read[c] is None and c not in MISSING for c in cells]
    return values, bad if bad.any() else None


_NUMBER = re.compile(r"([+-]?)\s*(\d[\d.,]*|[.,]\d+)([eE][+-]?\d+)?", re.ASCII)
_OPEN = re.compile(r"\d{1,3}[.,]\d{3}", re.ASCII)  # a thousand times more or less
_GROUPED = re.compile(r"\d{1,3}(?:([.,])\d{3}(?:\1\d{3})*(?!\1)[.,]\d+|([.,])\d{3}(?:\2\d{3})+)", re.ASCII)


def parse_number(cell: Any, decimal: str = ".") -> float | None:
    """One cell as a finite number, or None.

    Both decimal marks and thousands marks are understood where only one reading is possible ("1.234,5"); a cell such
    as "1,234" in a file with decimal points could be off by 1000 and is not read.
    """
    if isinstance(cell, bool) or cell is None:
        return None
    if isinstance(cell, int | float | np.number):
        return float(cell) if np.isfinite(cell) else None
    if not isinstance(cell, str):
        return None
    text = cell.strip().replace("\u2212", "-").replace("\u00a0", "").replace("'", "")
    if (found := _NUMBER.fullmatch(text)) is None:
        return None
    sign, digits, exponent = found[1], found[2], found[3] or ""
    if (groups := _GROUPED.fullmatch(digits)) and not exponent:
        digits = digits.replace(groups[1] or groups[2], "")
    elif digits.count(".") + digits.count(",") > 1 or (decimal not in digits and _OPEN.fullmatch(digits + exponent)):
        return None
    value = float(f"{sign}{digits.replace(',', '.')}{exponent}")
    return value if np.isfinite(value) else None


def cell_unit(cell: Any) -> str | None:
    """The unit behind the number in a cell ("22.3 °C" -> "degC"), None where there is none that is known."""
    found = _QUANTITY.fullmatch(cell.strip()) if isinstance(cell, str) else None
    return known_unit(found[2]) if found else None


def _in_unit(cell: str, decimal: str, unit: str) -> float | None:
    """A cell as a number in `unit`; None where it is none, or has a unit of another quantity."""
    value = parse_number(cell, decimal)
    if value is not None or not unit or (own := cell_unit(cell)) is None or quantity(own) != quantity(unit):
        return value
    number = parse_number(_QUANTITY.fullmatch(cell)[1], decimal)  # type: ignore[index]
    factor, offset = conversion(own, unit, "cell")
    return None if number is None else factor * number + offset


def _plain(cells: pd.Series[Any]) -> tuple[pd.Series[Any], pd.Series[Any]]:
    """Time stamps without weekday and time zone, AM and PM, months and fractions in one spelling; the zones' hours."""
    zones = cells.str.extract(_ZONE).where(cells.str.contains(":"))
    hours = zones[1].astype(float)
    offset_h = zones[0].map(_ZONES_H).fillna(hours + np.copysign(zones[2].astype(float) / 60, hours)).fillna(0.0)
    cells = cells.str.replace(_ZONE, "", regex=True).where(cells.str.contains(":"), cells)
    for spelling, becomes in _PLAIN:
        cells = cells.str.replace(spelling, becomes, regex=True)
    return cells, offset_h


def wall_clock_s(cell: Any) -> float:
    """What a time stamp's wall clock is ahead of UTC, s; 0 where it gives no zone."""
    if isinstance(cell, dt.datetime):
        return (cell.utcoffset() or dt.timedelta()).total_seconds()
    return float(_plain(pd.Series([str(cell).strip()], dtype=str))[1].iloc[0]) * 3600.0


def is_elapsed(cells: Sequence[Any]) -> bool:
    """Whether cells are durations as h:mm:ss that begin at 0 or go on beyond a day, and no times of day."""
    texts = [c.strip() for c in cells if isinstance(c, str)]
    if not texts or len(texts) < len(cells) or not all(map(_ELAPSED.fullmatch, texts)):
        return False
    spans_s = _elapsed_s(texts)
    return bool(spans_s[0] < 1.0 or (spans_s >= 86400.0).any())


def _elapsed_s(texts: Sequence[Any]) -> Array:
    plain = [re.sub(r"(\d) ?d(ays?)?,? ", r"\1 days ", str(text)).replace(",", ".") for text in texts]
    spans = pd.to_timedelta(plain, errors="coerce").to_series()
    return np.asarray(spans.dt.total_seconds(), np.float64)


def stamp_formats(samples: Sequence[str]) -> list[str]:
    """The strptime patterns (or "ISO8601") in which nearly all samples read as a time; the likeliest first."""
    cells = pd.Series([s.strip() for s in samples if s.strip()], dtype=str)
    need = max(1, int(0.8 * len(cells)))
    cells = cells[cells.str.contains(r"\d\D+\d|\d{6}")]
    if len(cells) < need:
        return []
    cells = _plain(cells)[0]
    if cells.str.match(r"\d{4}\D").mean() >= 0.8 and _strptime(cells, _ISO).notna().sum() >= need:
        return [_ISO]
    shapes = {re.sub(r"[0-9A-Za-z]+", "", cell) for cell in cells.iloc[:3]}
    patterns = [p for p in _PATTERNS if re.sub(r"%?[a-zA-Z]", "", p) in shapes]
    fits = [p for p in patterns if _strptime(cells, p).notna().sum() >= need]
    fits = [p for p in fits if _strptime(cells, p).dropna().is_monotonic_increasing] or fits
    starts: dict[Any, str] = {}
    for pattern in fits:  # equivalent patterns count once
        starts.setdefault(_strptime(cells, pattern).dropna().iloc[0], pattern)
    return list(starts.values())


def stamp_format(samples: Sequence[str], where: str) -> str:
    """The one pattern that fits; "ISO8601" where there are no samples.

    Raises:
        InputError: none fits, or day and month are ambiguous.
    """
    if not any(s.strip() for s in samples):
        return _ISO
    fits = stamp_formats(samples)
    if not fits:
        first = next(s for s in samples if s.strip())
        raise InputError(
            f"{where}: no known time format fits {first[:40]!r}; set recording.time.format to its strptime pattern"
        )
    if len(fits) > 1:
        raise InputError(
            f"{where}: time {samples[0]!r} can be {fits[0]!r} or {fits[1]!r};"
            " set recording.time.format to the right one"
        )
    return fits[0]


def _strptime(cells: pd.Series[Any], pattern: str) -> pd.Series[Any]:
    """Datetimes, naive; stamps with an offset become UTC."""
    zoned = pattern == _ISO or "%z" in pattern
    try:
        parsed = pd.to_datetime(cells, format=pattern, errors="coerce", utc=zoned)
    except (ValueError, OverflowError):
        parsed = pd.Series(pd.NaT, index=cells.index, dtype="datetime64[us]")
    return parsed.dt.tz_localize(None).dt.as_unit("us")  # in ns a damaged year, such as 2826, overflows


def _parse(cells: pd.Series[Any], pattern: str) -> pd.Series[Any]:
    """The same, also of stamps that have the pattern in another spelling (`_plain`)."""
    parsed = _strptime(cells, pattern)
    lost = parsed.isna() & cells.notna()
    if lost.any():
        text, offset_h = _plain(cells[lost].astype(str))
        parsed[lost] = _strptime(text, pattern) - pd.to_timedelta(offset_h, unit="h")
    return parsed


def to_seconds(column: Any, unit: str, pattern: str | None, decimal: str, zone: str | None = None) -> Array:
    """Time column to seconds, shape (n,), NaN where unreadable.

    unit s, min, h, …: the number in seconds, or durations as h:mm:ss. unit timestamp: seconds since 1970-01-01; stamps
    with an offset are taken to UTC, others from the time zone `zone`; numbers as `epoch_s`.
    """
    kind = column.type
    text = pa.types.is_string(kind) or pa.types.is_large_string(kind)
    if unit != "timestamp":
        values, bad = to_float(column, decimal)
        values = values * TIME_UNITS_S[unit]
        if text and bad is not None:
            values[bad] = _elapsed_s(pc.filter(column, pa.array(bad)).to_pylist())
        return values
    if pa.types.is_date(kind):
        column, kind = column.cast(pa.timestamp("us")), pa.timestamp("us")
    if pa.types.is_timestamp(kind):
        column = column.cast(pa.timestamp("us", kind.tz), safe=False).cast(pa.int64()).cast(pa.float64())
        return _utc(_numpy(column) / 1e6, None if kind.tz else zone)
    if text:
        return _text_to_seconds(column, pattern, decimal, zone)
    return epoch_s(to_float(column, decimal)[0])


def _utc(local_s: Array, zone: str | None) -> Array:
    """Seconds of a wall clock in a time zone as those of UTC; its order shows which of two equal hours it is."""
    if zone is None:
        return local_s
    naive = pd.to_datetime(pd.Series(local_s), unit="s")
    back = naive.diff() < pd.Timedelta(0)
    summer = np.asarray(~back.cummax(), bool)
    utc = naive.dt.tz_localize(zone, ambiguous=summer, nonexistent="shift_forward").dt.tz_convert("UTC")
    return np.asarray((utc.dt.tz_localize(None) - _EPOCH).dt.total_seconds(), np.float64)


def with_date(date: Any, time: Any) -> Any:
    """Columns of dates and of times of day, text or Arrow's time stamps, as one column of text with a blank between."""
    texts = [
        pc.utf8_trim_whitespace(c) if pa.types.is_string(c.type) else pc.strftime(c.cast(pa.timestamp("us")), form)
        for c, form in ((date, "%Y-%m-%d"), (time, "%H:%M:%S"))
    ]
    return pc.binary_join_element_wise(*texts, " ")


_EPOCH = pd.Timestamp(0).as_unit("us")


def _text_to_seconds(column: Any, pattern: str | None, decimal: str, zone: str | None) -> Array:
    text = pc.utf8_trim_whitespace(column)
    if (pattern is None or pattern == _ISO) and zone is None:
        try:
            return _numpy(text.cast(pa.timestamp("us")).cast(pa.int64()).cast(pa.float64())) / 1e6
        except pa.ArrowInvalid:
            pass  # another ISO spelling, or a damaged cell
    cells = pd.Series(text.to_pylist(), dtype=object)
    parsed = _parse(cells, pattern or _ISO)
    if pattern and "%S" in pattern and parsed.isna().any():
        other = pattern.replace("%S.%f", "%S") if "%f" in pattern else pattern.replace("%S", "%S.%f")
        parsed = parsed.fillna(_parse(cells, other))
    if parsed.isna().all():
        return epoch_s(to_float(column, decimal)[0])
    seconds: Array = np.asarray((parsed - _EPOCH).dt.total_seconds(), np.float64)
    own_zone = bool(_plain(cells.dropna().astype(str).iloc[:1])[1].any()) or cells.iloc[0].endswith("Z")
    return seconds if own_zone else _utc(seconds, zone)


def epoch_s(number: Array) -> Array:
    """Numbers as seconds since 1970: days of a workbook (20,000–80,000), else by size s (from 1e8), ms, µs or ns."""
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        power = np.clip(3 * np.floor((np.log10(number) - 8) / 3), 0, 9)  # 1e8..1e11 s, ..1e14 ms, ..1e17 us, ..1e20 ns
        unix = np.where((number >= 1e8) & (number < 1e20), number / 10**power, np.nan)
    return np.where((number >= 20_000) & (number <= 80_000), (number - 25569.0) * 86400.0, unix)
