"""One table for all performance figures: rows of own and reference CPU time, their ratio, target and growth."""

from __future__ import annotations

import math
import os
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ParamSpec, TypeVar

import numpy as np
import psutil

P = ParamSpec("P")
T = TypeVar("T")
HEAD = ("what", "ours", "reference", "its time", "ratio", "target", "met", "growth exponent")


@dataclass(frozen=True)
class Row:
    """What was measured, in CPU seconds; NaN where there is nothing to report.

    ratio: the reference's time over ours. target_ratio: the least ratio, target_s: the most seconds, that are aimed at.
    limit: a further target by name, and whether it is met. growth: how the time grows, as exponents of a size. note:
    shown after what was measured, or instead of a time.
    """

    what: str
    ours_s: float = math.nan
    reference: str = ""
    reference_s: float = math.nan
    target_ratio: float = math.nan
    target_s: float = math.nan
    limit: tuple[str, bool] | None = None
    growth: str = ""
    note: str = ""

    @property
    def ratio(self) -> float:
        return self.reference_s / self.ours_s

    @property
    def met(self) -> bool | None:
        """Whether the target is met; None without a target or a time."""
        known = [
            reached
            for reached, value, target in (
                (self.ratio >= self.target_ratio, self.ratio, self.target_ratio),
                (self.ours_s <= self.target_s, self.ours_s, self.target_s),
            )
            if math.isfinite(value) and math.isfinite(target)
        ]
        known += [self.limit[1]] if self.limit else []
        return all(known) if known else None

    def cells(self) -> tuple[str, ...]:
        """Text of the table's columns."""
        ratio = f"{float(f'{self.ratio:.3g}'):g}×" if math.isfinite(self.ratio) else ""
        target = [f"≥ {self.target_ratio:g}×"] if math.isfinite(self.target_ratio) else []
        target += [f"≤ {seconds(self.target_s)}"] if math.isfinite(self.target_s) else []
        target += [self.limit[0]] if self.limit else []
        met = {None: "", True: "yes", False: "no"}[self.met]
        what = f"{self.what} ({self.note})" if self.note and math.isfinite(self.ours_s) else self.what
        ours = seconds(self.ours_s) if math.isfinite(self.ours_s) else self.note
        return what, ours, self.reference, seconds(self.reference_s), ratio, ", ".join(target), met, self.growth


def seconds(value: float) -> str:
    """Three digits in s, ms or µs; empty for NaN."""
    if not math.isfinite(value):
        return ""
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if value >= size:
            return f"{value / size:.3g} {unit}"
    return f"{value / 1e-6:.3g} µs"


def markdown(rows: Sequence[Row]) -> str:
    """The table, a line per row."""
    lines = [HEAD, tuple("---" for _ in HEAD), *(row.cells() for row in rows)]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def cpu_s() -> float:
    """CPU seconds of this process and its children so far: other work on the machine counts little."""
    ended = os.times()
    alive = 0.0
    for child in psutil.Process().children(recursive=True):
        try:
            used = child.cpu_times()
        except psutil.Error:  # it has just ended
            continue
        alive += used.user + used.system
    return time.process_time() + ended.children_user + ended.children_system + alive


def timed(work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> tuple[float, T]:
    """CPU seconds of a call, with those of worker processes, and what it gives."""
    start = cpu_s()
    value = work(*args, **kwargs)
    return cpu_s() - start, value


def median_s(work: Callable[[], object], repeats: int) -> float:
    """CPU seconds of a call in this process, the median of several."""
    took = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        took.append(time.process_time() - start)
    return statistics.median(took)


def exponent(sizes: Sequence[float], took_s: Sequence[float]) -> float:
    """Slope of log time over log size by least squares: 1 where time grows in proportion."""
    return float(np.polyfit(np.log(sizes), np.log(took_s), 1)[0])
