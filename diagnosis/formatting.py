"""Numbers with units, intervals and lists as the sentences of a diagnosis show them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from data.units import unit_label


@dataclass(frozen=True)
class Estimate:
    """A value and its 90 % interval, in `unit`; nan where there is none."""

    value: float
    unit: str
    low: float = math.nan
    high: float = math.nan

    @property
    def known(self) -> bool:
        """Whether there is an interval."""
        return math.isfinite(self.low) and math.isfinite(self.high)


def with_unit(number: str, unit: str) -> str:
    """``10 W/K``, ``0.035/K`` for 1/K, ``0.4`` for a share."""
    label = unit_label(unit)
    return f"{number}{label[1:]}" if label.startswith("1/") else f"{number} {label}".strip()


def of_error(value: float, unit: str) -> str:
    """``1.4 µm``, ``0.79 K``: an error of a channel in `unit`."""
    return with_unit(few(value), "K" if unit == "degC" else unit)


def few(value: float, digits: int = 2) -> str:
    """``0.12``, ``10``, ``1300``: so many significant digits, never an exponent."""
    return "0" if value == 0 else _fixed(value, _decimals(value, digits))


def as_given(value: float) -> str:
    """``1``, ``0.95``, ``26000``: up to four digits, none of them an idle zero."""
    text = few(value, 4)
    return text.rstrip("0").rstrip(".") if "." in text else text


def amount(e: Estimate) -> str:
    """``10 W/K (90 %: 9–12)``; the ends of the interval have the value's decimals."""
    if not e.known:
        return with_unit(few(e.value), e.unit)
    half = abs(e.high - e.low) / 2
    decimals = _decimals(max(abs(e.value), half), 2)
    if half > 0:  # a narrow interval shows itself, but no value has more than four digits
        decimals = max(decimals, min(_decimals(half, 1), _decimals(e.value, 4)))
    low, high = _fixed(e.low, decimals), _fixed(e.high, decimals)
    between = " to " if min(e.low, e.high) < 0 else "–"
    return f"{with_unit(_fixed(e.value, decimals), e.unit)} (90 %: {low}{between}{high})"


def percent(share: float) -> str:
    """``8 %``, never 0 or 100."""
    if share > 0.99:
        return "over 99 %"
    return "under 1 %" if share < 0.01 else f"{100 * share:.0f} %"


def listed(items: Sequence[str], last: str = "and") -> str:
    """``a, b and c``."""
    return f"{', '.join(items[:-1])} {last} {items[-1]}" if len(items) > 1 else "".join(items)


def _decimals(value: float, digits: int) -> int:
    """Decimals that show a value with so many significant digits; below 0 before the point."""
    if value == 0 or not math.isfinite(value):
        return digits - 1
    return digits - 1 - math.floor(math.log10(abs(float(f"{value:.{digits - 1}e}"))))


def _fixed(value: float, decimals: int) -> str:
    if not math.isfinite(value):
        return "?"
    text = f"{round(value, decimals):.{max(decimals, 0)}f}"
    return text.removeprefix("-") if float(text) == 0 else text.replace("-", "−")
