"""Parsing of cells: Arrow columns of numbers, text and time stamps to float64 arrays."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from data.arrays import Array
from data.errors import InputError
from data.units import TIME_UNITS_S

_DATES = ("%Y-%m-%d", "%Y/%m/%d", "%Y.%m.%d", "%d.%m.%Y", "%d/%m/%Y", "%m/%d/%Y", "%d-%m-%Y", "%Y%m%d",
          "%d.%m.%y", "%d/%m/%y", "%m/%d/%y", "%Y年%m月%d日")  # fmt: skip
_TIMES = ("%H:%M:%S", "%H:%M:%S.%f", "%H:%M", "%H-%M-%S", "%I:%M:%S %p", "%I:%M %p", "%H%M%S", "%H时%M分%S秒",
          "%H時%M分%S秒")  # fmt: skip
_BETWEEN = (" ", "T", "-", "_", ", ")  # date and time of day
_ISO = "ISO8601"
_MISSING = ("", "nan", "NaN", "NAN")


def to_float(column: Any, decimal: str = ".") -> tuple[Array, NDArray[np.bool_] | None]:
    """Column to float64 (n,), NaN where empty or unreadable, and a mask of the unreadable cells (None: all readable).

    An empty cell and "NaN" mean missing; anything else that is no finite number is unreadable.
    """
    kind = column.type
    if pa.types.is_dictionary(kind):
        column = column.cast(kind.value_type)
        kind = column.type
    if (
        pa.types.is_floating(kind)
        or pa.types.is_integer(kind)
        or pa.types.is_decimal(kind)
        or pa.types.is_boolean(kind)
    ):
        if not pa.types.is_float64(kind):
            column = column.cast(pa.int8()) if pa.types.is_boolean(kind) else column
            column = column.cast(pa.float64(), safe=False)
        values = _numpy(column)
        infinite = np.isinf(values)
        if not infinite.any():
            return values, None
        return np.where(infinite, np.nan, values), infinite
    if pa.types.is_string(kind) or pa.types.is_large_string(kind):
        return _text_to_float(column, decimal)
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
    values = column.to_numpy(zero_copy_only=False) if isinstance(column, pa.Array) else column.to_numpy()
    return np.asarray(values, dtype=np.float64)


def _text_to_float(column: Any, decimal: str) -> tuple[Array, NDArray[np.bool_] | None]:
    text = pc.fill_null(pc.utf8_trim_whitespace(column), "")
    mark = re.escape(decimal)
    plain = pc.match_substring_regex(text, rf"^[+-]?(\d+({mark}\d*)?|{mark}\d+)([eE][+-]?\d+)?$")
    numbers = pc.if_else(plain, text, pa.scalar(None, text.type))
    if decimal != ".":
        numbers = pc.replace_substring(numbers, decimal, ".")
    values = _numpy(numbers.cast(pa.float64())).copy()
    rest = np.flatnonzero(~np.asarray(plain.to_numpy(**_copying(plain)), bool))
    bad = np.isinf(values)  # 1e999
    values[bad] = np.nan
    if len(rest):
        cells = pc.take(text, pa.array(rest)).to_pylist()
        read = {cell: parse_number(cell, decimal) for cell in set(cells)}
        values[rest] = [np.nan if read[c] is None else read[c] for c in cells]
        bad[rest] = [read[c] is None and c not in _MISSING for c in cells]
    return values, bad if bad.any() else None


def _copying(column: Any) -> dict[str, bool]:
    return {"zero_copy_only": False} if isinstance(column, pa.Array) else {}


@lru_cache(maxsize=8)
def _patterns(decimal: str) -> tuple[re.Pattern[str], re.Pattern[str], re.Pattern[str], re.Pattern[str]]:
    d, o = re.escape(decimal), re.escape("," if decimal == "." else ".")
    exponent = r"([eE][+-]?\d+)?"
    return (
        re.compile(rf"[+-]?(\d+({d}\d*)?|{d}\d+){exponent}", re.ASCII),
        re.compile(rf"[+-]?\d{{1,3}}(({o}\d{{3}})+{d}\d+|({o}\d{{3}}){{2,}})", re.ASCII),
        re.compile(rf"[+-]?\d{{1,3}}(({d}\d{{3}})+{o}\d+|({d}\d{{3}}){{2,}})", re.ASCII),
        re.compile(rf"[+-]?(?!\d{{1,3}}{o}\d{{3}}$)(\d+{o}\d*|{o}\d+){exponent}", re.ASCII),
    )


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
    other = "," if decimal == "." else "."
    plain, grouped, grouped_other, foreign = _patterns(decimal)
    if plain.fullmatch(text):
        text = text.replace(decimal, ".")
    elif grouped.fullmatch(text):
        text = text.replace(other, "").replace(decimal, ".")
    elif grouped_other.fullmatch(text):
        text = text.replace(decimal, "").replace(other, ".")
    elif foreign.fullmatch(text):
        text = text.replace(other, ".")
    else:
        return None
    value = float(text)
    return value if np.isfinite(value) else None


def stamp_formats(samples: Sequence[str]) -> list[str]:
    """The strptime patterns (or "ISO8601") in which nearly all samples read as a time; the likeliest first."""
    cells = pd.Series([s.strip() for s in samples if s.strip()], dtype=str)
    if len(cells) == 0:
        return []
    need = max(1, int(0.8 * len(cells)))
    if cells.str.match(r"\d{4}\D").all() and _parse(cells, _ISO).notna().sum() >= need:
        return [_ISO]
    patterns = [f"{d}{sep}{t}" for d in _DATES for t in _TIMES for sep in _BETWEEN] + list(_TIMES) + list(_DATES)
    fits = [p for p in patterns if _parse(cells.iloc[:3], p).notna().any() and _parse(cells, p).notna().sum() >= need]
    fits = [p for p in fits if _parse(cells, p).dropna().is_monotonic_increasing] or fits
    starts: dict[Any, str] = {}
    for pattern in fits:  # equivalent patterns count once
        starts.setdefault(_parse(cells, pattern).dropna().iloc[0], pattern)
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


def _parse(cells: pd.Series[Any], pattern: str) -> pd.Series[Any]:
    """Datetimes, naive; stamps with an offset become UTC."""
    zoned = pattern == _ISO or "%z" in pattern
    try:
        parsed = pd.to_datetime(cells, format=pattern, errors="coerce", utc=zoned)
    except (ValueError, OverflowError):
        return pd.Series(pd.NaT, index=cells.index)
    return parsed.dt.tz_localize(None) if zoned else parsed


def to_seconds(column: Any, unit: str, pattern: str | None, decimal: str) -> Array:
    """Time column to seconds, shape (n,), NaN where unreadable.

    unit s, min, h, d, ms: the number in seconds. unit timestamp: seconds since 1970-01-01; stamps with an offset are
    taken to UTC; numbers count as Excel days (20,000–80,000), Unix seconds (from 1e8) or Unix milliseconds (from 1e11).
    """
    if unit != "timestamp":
        values, _ = to_float(column, decimal)
        return values * TIME_UNITS_S[unit]
    kind = column.type
    if pa.types.is_date(kind):
        column, kind = column.cast(pa.timestamp("us")), pa.timestamp("us")
    if pa.types.is_timestamp(kind):
        return _numpy(column.cast(pa.timestamp("us", kind.tz), safe=False).cast(pa.int64()).cast(pa.float64())) / 1e6
    if pa.types.is_string(kind) or pa.types.is_large_string(kind):
        return _text_to_seconds(column, pattern, decimal)
    return _serial_to_seconds(to_float(column, decimal)[0])


def with_date(date: Any, time: Any) -> Any:
    """Columns of dates and of times of day, text or Arrow's time stamps, as one column of text with a blank between."""
    texts = [
        pc.utf8_trim_whitespace(c) if pa.types.is_string(c.type) else pc.strftime(c.cast(pa.timestamp("us")), form)
        for c, form in ((date, "%Y-%m-%d"), (time, "%H:%M:%S"))
    ]
    return pc.binary_join_element_wise(*texts, " ")


_EPOCH = pd.Timestamp(0).as_unit("us")  # in ns a damaged year, such as 2826, overflows


def _text_to_seconds(column: Any, pattern: str | None, decimal: str) -> Array:
    text = pc.utf8_trim_whitespace(column)
    if pattern is None or pattern == _ISO:
        try:
            return _numpy(text.cast(pa.timestamp("us")).cast(pa.int64()).cast(pa.float64())) / 1e6
        except pa.ArrowInvalid:
            pass  # another ISO spelling, or a damaged cell
    cells = pd.Series(text.to_pylist(), dtype=object)
    parsed = _parse(cells, pattern or _ISO)
    if pattern and "%S" in pattern and parsed.isna().any():
        other = pattern.replace("%S.%f", "%S") if "%f" in pattern else pattern.replace("%S", "%S.%f")
        parsed = parsed.fillna(_parse(cells, other))
    seconds: Array = np.asarray((parsed - _EPOCH).dt.total_seconds(), np.float64)
    if np.isnan(seconds).all():
        seconds = _serial_to_seconds(to_float(column, decimal)[0])
    return seconds


def _serial_to_seconds(number: Array) -> Array:
    excel = (number >= 20_000) & (number <= 80_000)
    with np.errstate(over="ignore"):
        milli = np.where((number >= 1e11) & (number < 1e14), number / 1e3, np.nan)
        unix = np.where((number >= 1e8) & (number < 1e11), number, milli)
        return np.where(excel, (number - 25569.0) * 86400.0, unix)
