"""Cells that hold no value: text in place of a number, and the codes by which loggers state "no value".

Both become missing before the samples are put on the grid: a code that enters a mean or an interpolation falsifies the
rows around it and can no longer be recognised.
"""

from __future__ import annotations

import re
from collections import Counter
from fnmatch import fnmatchcase

import numpy as np

from data.arrays import Array
from data.batch import Finding
from data.checks.base import Bools, Check, overrule_line
from data.machine import ChannelPart, Machine
from data.rows import Rows
from data.units import conversion

_ENDLESS = 1e30  # no quantity of a machine; loggers write the largest float (3.4e38) where they have no value
_POSSIBLE = {"degC": (-273.15, 3000.0), "um": (-1e5, 1e5)}  # absolute zero, hottest thermocouple; 100 mm
_NINES = re.compile(r"9{3,}(\.9*)?0*")  # 999, 9999, 999.9
_BINARY = (32767, 32768, 65535, 2147483647, 2147483648, 4294967295)  # ends of integers of 16 and 32 bits
_SCALES = (1.0, 10.0, 100.0)  # of integers that count tenths or hundredths
_APART = 50.0  # in the channel's unit: a code is at least this far from every reading
_TEXTS = 3  # named in a message


class TextCells(Check):
    """Found by `take_invalid` while a file is read. An empty cell and "NaN" mean missing and give no finding."""

    key = "text_cells"
    summary = "cells that hold text in place of a number"


class Sentinel(Check):
    """Found by `take_invalid` while a file is read. A value is a code where one of these holds

    1. no temperature (degC) or displacement (um) can have it;
    2. it is 999, 9999, …, or the end of a 16- or 32-bit integer, also in tenths and hundredths;
    3. it lies outside the channel's range and is repeated exactly, in fewer than half of the samples;

    and it is farther from all other samples than these are from each other, at least by 50 units; or its size exceeds
    1e30. Of drivers and positions, which can rest at any set value, only sizes above 1e30 and codes out of range count.
    """

    key = "sentinel"
    summary = "codes for no value, such as -999 or 3.4e38"


def take_invalid(
    rows: Rows, machine: Machine, batch_id: str, where: str
) -> tuple[dict[str, Bools], tuple[Finding, ...]]:
    """Set codes to NaN in `rows.columns`; the rows of text and codes (n,) by column, and a finding of each column.

    An overrule of the check for the whole channel leaves its values as they are. Rows without a time do not count.
    """
    invalid: dict[str, Bools] = {}
    findings = []
    timed = np.isfinite(rows.time_s)
    for key, values in rows.columns.items():
        name = key if key in machine.channels else key.rpartition("@")[0]  # one column for each position of an axis
        part = machine.channels.get(name)
        if part is None:
            continue
        bad = np.zeros(len(rows), bool)
        column = f"column {part.column or key!r} of {where}"
        if key in rows.texts:
            at, texts = rows.texts[key]
            at, texts = at[timed[at]], texts[timed[at]]
            if len(at):
                bad[at] = True
                findings.append(_finding(TextCells, name, Counter(texts), int(at[0]), column))
        here = f"machine file {machine.machine}: channel {name!r}"
        codes = {} if _overruled(machine, batch_id, name) else sentinels(values, part, here)
        if codes:
            is_code = np.isin(values, list(codes))
            values[is_code] = np.nan
            bad |= is_code
            counts = Counter({f"{v:.10g}": n for v, n in codes.items()})
            findings.append(_finding(Sentinel, name, counts, int(is_code.argmax()), column))
        if bad.any():
            invalid[key] = bad
    return invalid, tuple(findings)


def _finding(check: type[Check], name: str, counts: Counter[str], first: int, column: str) -> Finding:
    shown = ", ".join(f"{text[:20]!r} in {n} row{'s' * (n > 1)}" for text, n in counts.most_common(_TEXTS))
    more = f" and {len(counts) - _TEXTS} others" if len(counts) > _TEXTS else ""
    text = check is TextCells
    what = "text in place of a number" if text else "codes for no value"
    lift = "correct the export" if text else f"add to overrule: {overrule_line(name, check.key)}"
    message = (
        f"{name}: {what}: {shown}{more}, first in data row {first + 1}, {column}; treated as missing; if they are "
        f"readings, {lift}"
    )
    return check().finding(name, message, masks=False)


def _overruled(machine: Machine, batch_id: str, name: str) -> bool:
    return any(
        not r.mask and r.start_s is None and r.end_s is None and fnmatchcase(batch_id, r.batch)
        and fnmatchcase(name, r.channel) and fnmatchcase(Sentinel.key, r.check)
        for r in machine.overrule
    )  # fmt: skip


def sentinels(values: Array, part: ChannelPart, where: str) -> dict[float, int]:
    """Codes for no value among a column's values (n,) in the file's unit: code -> how often; see `Sentinel`.

    Raises:
        InputError: the file's unit cannot become the channel's; `where` opens the line.
    """
    known = values[np.isfinite(values)]
    if not len(known):
        return {}
    factor, offset = conversion(part.unit_in_file or part.unit, part.unit, where)
    measured = part.role in ("temperature", "ambient", "error")
    low, high = _POSSIBLE.get(part.unit, (-_ENDLESS, _ENDLESS)) if measured else (-_ENDLESS, _ENDLESS)
    least, most = part.range or (low, high)
    ends = np.sort(factor * np.array([known.min(), known.max()]) + offset)
    if ends[0] >= max(low, least) and ends[1] <= min(high, most) and not any(map(_is_code, (known.min(), known.max()))):
        return {}
    distinct, counts = np.unique(known, return_counts=True)
    scaled = factor * distinct + offset
    endless = np.abs(distinct) >= _ENDLESS
    impossible = (scaled < low) | (scaled > high)
    outside = (scaled < least) | (scaled > most)
    code = np.array([_is_code(v) for v in distinct]) & (outside | measured)
    repeated = outside & (counts > 1) & (counts < 0.5 * len(known)) & measured
    found = endless.copy()
    plain = scaled[~(endless | impossible | code)]
    for i in np.flatnonzero((impossible | code | repeated) & ~endless):
        others = plain[plain != scaled[i]]
        if len(others):
            found[i] = np.abs(others - scaled[i]).min() > max(_APART, float(np.ptp(others)))
        else:  # a column of one code; other impossible values mean a wrong unit
            found[i] = impossible[i] and counts[i] > 0.5 * len(known)
    return {float(v): int(n) for v, n in zip(distinct[found], counts[found], strict=True)}


def _is_code(value: float) -> bool:
    size = abs(float(value))
    binary = any(abs(size * s - b) < 1e-6 * b for s in _SCALES for b in _BINARY)
    return binary or _NINES.fullmatch(f"{size:.10g}") is not None
