"""Checks of level and scale: plausible range, full scale of an instrument, wrong unit."""

from __future__ import annotations

import numpy as np

from data.batch import Batch, Finding
from data.checks.base import (
    EQUAL,
    THERMAL,
    Array,
    Check,
    clock,
    constant_runs,
    signals,
    smallest_step,
    span_text,
    step_limit,
    stretches,
)
from data.machine import Machine


class OutOfRange(Check):
    key = "out_of_range"
    summary = "outside the plausible range of the machine file"

    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        found = []
        seen = signals(batch)
        for name, channel in batch.channels.items():
            if channel.low is None or channel.high is None:
                continue
            least, most = seen.extremes(name)
            if least >= channel.low and most <= channel.high:
                continue
            v = batch.masked(name)  # an infinite value is out of range as well
            rounded = _rounded(v)
            with np.errstate(invalid="ignore"):
                out = (v < channel.low - rounded) | (v > channel.high + rounded)
            for a, b in stretches(out):
                worst = v[a : b + 1][np.argmax(np.abs(v[a : b + 1] - 0.5 * (channel.low + channel.high)))]
                message = (
                    f"{name} reads {worst:.5g} {channel.unit} {span_text(batch, a, b)}, outside "
                    f"{channel.low:g} to {channel.high:g}"
                )
                found.append(self.in_rows(batch, name, a, b, message))
        return found


def _rounded(values: Array) -> float:
    """What rounding to the decimals that all values have can add to one of them; 0 for more than three decimals."""
    known = values[np.isfinite(values)]
    decimals = next((k for k in range(4) if np.abs(known - np.round(known, k)).max(initial=0.0) < EQUAL), None)
    return 0.0 if decimals is None else 0.5 * 10.0**-decimals


_ROWS = 5


class Saturated(Check):
    """Five or more equal samples at the batch's extreme, at a full-scale value, reached by a jump.

    Full scale is 1, 2, 2.5 or 5 times a power of ten, or an end of the machine file's range. The jump
    keeps a quiet channel that happens to sit at a round value out of it.
    """

    key = "saturated"
    summary = "pinned at a full-scale value"

    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        found = []
        seen = signals(batch)
        for name in batch.names("error", "temperature", "ambient"):
            if not seen.rests(name, _ROWS):
                continue
            channel, v = batch.channels[name], seen.values(name)
            ends = seen.extremes(name)
            rails = [_rail(e, smallest_step(batch, name), channel.low, channel.high, slack=1e-5) for e in ends]
            if all(r is None or (channel.role != "error" and abs(r) < 100.0) for r in rails):
                continue
            for a, b in constant_runs(v, _ROWS):
                if min(abs(v[a] - e) for e in ends) > 1e-6:
                    continue
                rail = _rail(float(v[a]), smallest_step(batch, name), channel.low, channel.high)
                if rail is None or (channel.role != "error" and abs(rail) < 100.0):
                    continue
                arrived = _jump(v, a)
                if arrived > 0.05 * abs(rail) and arrived > step_limit(seen.excess(name), channel.resolution):
                    message = (
                        f"{name} jumps by {arrived:.1f} {channel.unit} at {clock(batch.time_s[a])} to its "
                        f"full scale {rail:g} {channel.unit} and stays there {span_text(batch, a, b)}"
                    )
                    found.append(self.in_rows(batch, name, a, b, message))
        return found


def _jump(v: np.ndarray, row: int) -> float:
    """Step up to the run from the last good rows before it; a resampled row may stand half-way."""
    before = v[max(0, row - 3) : row]
    before = before[np.isfinite(before)]
    return float(np.max(np.abs(v[row] - before))) if len(before) else 0.0


def _rail(value: float, resolution: float, low: float | None, high: float | None, slack: float = 0.0) -> float | None:
    size = abs(value)
    if size < 5.0 - slack:
        return None
    near = max(resolution, 1e-4 * size) + slack
    decade = 10.0 ** np.floor(np.log10(size * 1.0001))
    rails = [np.sign(value) * decade * k for k in (1.0, 2.0, 2.5, 5.0, 10.0)]
    for rail in [*rails, low, high]:
        if rail is not None and abs(value - rail) <= near:
            return float(rail)
    return None


_HOT_START_DEGC = 45.0  # no machine stands this warm when a run starts
_COLD_START_DEGC = -10.0
_KELVIN = (250.0, 330.0)  # starts of a machine in K
_NEAR_K = 2.0  # a sensor starts this near to the range of the others
_FAR_K = 15.0
_TINY_UM = 0.5  # a machine that warms by 3 K moves by more than this


class WrongUnit(Check):
    """A temperature whose start is far from the others' and, read in K or degF, lies among them; or all temperatures,
    where each start is plausible only in that unit. An error channel that does not move while the machine warms.
    """

    key = "wrong_unit"
    summary = "level or scale fits another unit"
    common_cause = "a part that is this hot, or unit_in_file is degF in all recordings"

    def habit(self, batch: Batch, finding: Finding) -> str:
        """A heated part can start where degF would put a cold one; no room is so hot, and no part exactly 273.15 K."""
        name = finding.channel or ""
        if batch.channels[name].unit != "degC" or _start(batch.values(name)) > _KELVIN[0]:
            return ""
        rooms = [_start(batch.values(n)) for n in batch.names("ambient") if n in batch.table.columns]
        return "" if any(r > _HOT_START_DEGC for r in rooms) else "level"

    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        starts = {n: _start(batch.values(n)) for n in batch.names(*THERMAL) if batch.channels[n].unit == "degC"}
        starts = {n: v for n, v in starts.items() if np.isfinite(v)}
        plain = [v for v in starts.values() if _COLD_START_DEGC < v < _HOT_START_DEGC]
        found = []
        for name, start in starts.items():
            for unit, value in (("K", start - 273.15), ("degF", (start - 32.0) / 1.8)):
                if self._fits(start, value, plain, _KELVIN if unit == "K" else (_HOT_START_DEGC, _KELVIN[0])):
                    found.append(self._unit_finding(batch, name, f"starts at {start:.1f}", unit, value, "degC"))
        return found + self._millimetres(batch, list(starts))

    @staticmethod
    def _fits(start: float, value: float, plain: list[float], ends: tuple[float, float]) -> bool:
        """`ends`: the starts in this unit of a cold machine; `plain` are those that are plausible in degC."""
        if not plain:
            return ends[0] < start < ends[1] and _COLD_START_DEGC < value < _HOT_START_DEGC
        near = min(plain) - _NEAR_K <= value <= max(plain) + _NEAR_K
        return near and start - float(np.median(plain)) > _FAR_K

    def _millimetres(self, batch: Batch, temperatures: list[str]) -> list[Finding]:
        seen = signals(batch)
        ends = [seen.extremes(n) for n in temperatures]
        warmed = max((high - low for low, high in ends), default=0.0)
        found = []
        for name in batch.names("error"):
            low, high = seen.extremes(name)
            if batch.channels[name].unit != "um" or warmed < 3.0 or not high - low < _TINY_UM:
                continue
            v = _finite(batch.values(name))
            if len(v) < 10:
                continue
            steps = np.abs(np.diff(v))
            fine = (batch.channels[name].resolution or np.inf) / 10.0
            if 0 < np.ptp(v) < _TINY_UM and (steps[steps > 0].min() < fine):
                observed = f"moves by only {np.ptp(v):.3g} while the temperatures move by {warmed:.1f} K"
                found.append(self._unit_finding(batch, name, observed, "mm", float(np.ptp(v)) * 1000.0, "um in all"))
        return found

    def _unit_finding(self, batch: Batch, name: str, observed: str, unit: str, value: float, canonical: str) -> Finding:
        expected = batch.channels[name].unit
        return self.finding(
            name,
            f"{name} {observed}, which is not plausible in {expected} and in {unit} is {value:.1f} {canonical}: "
            f"if so, set unit_in_file: {unit} for this channel",
        )


def _start(values: Array) -> float:
    """The least of the first five values: a part that is heated at once starts where it was."""
    return float(_finite(values)[:5].min(initial=np.inf)) if np.isfinite(values).any() else float("nan")


def _finite(values: Array) -> Array:
    return values[np.isfinite(values)]
