"""A channel in another unit than the machine file says: K or °F for °C, mm for µm."""

from __future__ import annotations

import numpy as np

from data.batch import Batch, Finding
from data.checks.base import THERMAL, Array, Check
from data.checks.signals import signals
from data.machine import Machine

_HOT_START_DEGC = 45.0  # no machine stands this warm when a run starts
_NEAR_K = 5.0  # sensors of one machine agree this well at its start
_FAR_K = 15.0
_TINY_UM = 0.5  # a machine that warms by 3 K moves by more than this


class WrongUnit(Check):
    key = "wrong_unit"
    words = "level or scale fits another unit"

    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        starts = {n: _start(batch.values(n)) for n in batch.names(*THERMAL) if batch.channels[n].unit == "degC"}
        starts = {n: v for n, v in starts.items() if np.isfinite(v)}
        kelvin = {n for n, v in starts.items() if 200.0 < v < 350.0}
        plain = [v for n, v in starts.items() if n not in kelvin]
        usual = float(np.median(plain)) if plain else float("nan")
        found = []
        for name, start in starts.items():
            if name in kelvin:
                found.append(self._told(batch, name, f"starts at {start:.1f}", "K", start - 273.15, "degC"))
            elif self._fahrenheit(start, usual):
                found.append(self._told(batch, name, f"starts at {start:.1f}", "degF", (start - 32) / 1.8, "degC"))
        return found + self._millimetres(batch, list(starts))

    def _fahrenheit(self, start: float, usual: float) -> bool:
        as_degc = (start - 32.0) / 1.8
        if start > _HOT_START_DEGC and usual > _HOT_START_DEGC:
            return -5.0 < as_degc < _HOT_START_DEGC  # every channel is in °F
        return abs(as_degc - usual) < _NEAR_K and start - usual > _FAR_K

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
                words = f"moves by only {np.ptp(v):.3g} while the temperatures move by {warmed:.1f} K"
                found.append(self._told(batch, name, words, "mm", float(np.ptp(v)) * 1000.0, "um in all"))
        return found

    def _told(self, batch: Batch, name: str, seen: str, unit: str, value: float, canonical: str) -> Finding:
        expected = batch.channels[name].unit
        return self.finding(
            name,
            f"{name} {seen}, which is no plausible {expected} but as {unit} gives {value:.1f} {canonical}: "
            f"set unit_in_file: {unit} for this channel",
        )


def _start(values: Array) -> float:
    if len(ok := _finite(values[:50])) < 5:
        ok = _finite(values)
    return float(np.median(ok[:5])) if len(ok) else float("nan")


def _finite(values: Array) -> Array:
    return values[np.isfinite(values)]
