"""Checks for repeated values: dead temperature sensors, frozen channels, error channels that are held."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from data.batch import Batch, Finding
from data.checks.base import (
    EQUAL,
    THERMAL,
    Array,
    Bools,
    Check,
    constant_runs,
    in_time,
    signals,
    smallest_step,
    span_text,
    standing,
)
from data.checks.expected import movement, unexplained
from data.checks.steps import JumpNoReturn, Spike
from data.machine import Machine

_STEPS = 30.0
_FLOOR_K = 3.0
_BATCHES = 5


class Dead(Check):
    """A temperature that takes no part in the warming.

    Within one batch: constant while the median of the others moves by 3 K and 30 of its resolution steps.

    Against other batches: it moves by less than a tenth of the median batch, and not as the drivers and the other
    channels let expect from the other batches (`unexplained`).
    """

    key = "dead"
    summary = "takes no part in the machine's warming"

    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        moved = {n: self._moved_K(batch, n) for n in batch.names(*THERMAL)}
        found = []
        for name in batch.names("temperature"):
            others = [v for n, v in moved.items() if n != name and np.isfinite(v)]
            if not moved[name] <= 1e-9 or len(others) < 2 or np.isfinite(batch.masked(name)).sum() < 10:
                continue
            usual = float(np.median(others))
            if usual >= max(_FLOOR_K, _STEPS * smallest_step(batch, name)):
                level = batch.values(name)[np.isfinite(batch.values(name))][0]
                message = f"{name} stays at {level:.5g} degC all through while the others move by {usual:.1f} K"
                found.append(self.finding(name, message))
        return found

    @staticmethod
    def _moved_K(batch: Batch, name: str) -> float:
        seen = signals(batch)
        if not seen.whole(name) or batch.n_rows < 10:
            return _range_K(seen.values(name))
        low, high = seen.extremes(name)
        return high - low

    def across(self, batches: Sequence[Batch], machine: Machine) -> dict[int, list[Finding]]:
        if len(batches) < _BATCHES:
            return {}
        found: dict[int, list[Finding]] = {}
        for name in batches[0].names("temperature"):
            moved = np.array([_range_K(b.masked(name)) if name in b.channels else np.nan for b in batches])
            usual = float(np.nanmedian(moved)) if np.isfinite(moved).any() else 0.0
            least = max(_FLOOR_K, _STEPS * smallest_step(batches[0], name))
            still = np.flatnonzero(moved < 0.1 * usual).tolist() if usual > least else []
            left = np.abs(unexplained(batches, name, still)) if still else ()
            for k in [k for k, unmoved in zip(still, left, strict=True) if unmoved > usual]:
                if any(f.check == self.key and f.channel == name for f in batches[k].findings):
                    continue
                message = (
                    f"{name} moves by {moved[k]:.1f} K; by the drivers and the other channels it should move far more, "
                    f"as in the other batches ({usual:.1f} K in the median batch)"
                )
                found.setdefault(k, []).append(self.finding(name, message))
        return found


def _range_K(values: Array) -> float:
    ok = values[np.isfinite(values)]
    return float(np.ptp(ok)) if len(ok) >= 10 else float("nan")


_ROWS = 10
_SECONDS = 1200.0
_CHANCE = 1e-9
_RESTLESS = 0.75
_TURNING = 0.2
_STEP_OF_NOISE, _WIDE = 1.5, 0.1  # a tenth of the steps is wider than one step of the display
_FLAT_STEPS = 15.0  # flat to one step for L at a turning point, a smooth curve has left by 5 steps at most after L more
_FLOOR = {"um": 5.0, "degC": 1.0}
_SIGMAS = 6.0


class Frozen(Check):
    """Constant far longer than its noise and the other channels allow; either of two criteria is enough.

    Noise above the resolution (75 % of the samples differ from the one before, or half of them and often by more than
    one step of the display) makes so many equal samples impossible: chance below 1e-9 and three times the longest other
    run. A temperature that rests from the start on is left out: its noise may begin with the heating. Or the other
    temperatures, fitted outside the interval, and the channel's own slope at its ends both predict a movement of at
    least 15 resolution steps, 1 K or 5 µm, and six sigma of that fit.
    """

    key = "frozen"
    summary = "constant far longer than noise and the other channels allow"

    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        found = []
        seen = signals(batch)
        witnesses = _Witnesses(batch, machine)
        for name in in_time(batch, "temperature", "ambient", "error"):
            if not seen.rests(name, _ROWS):
                continue
            v = seen.values(name)
            runs = sorted(constant_runs(v), key=lambda r: r[0] - r[1])
            claimed: list[tuple[int, int]] = []
            for k, (a, b) in enumerate(runs[:3]):
                if b - a + 1 < _ROWS or b - a + 1 == np.isfinite(v).sum():
                    continue  # a wholly constant batch is a dead channel
                rest = [r for r in runs[:k] if r not in claimed] + runs[k + 1 : k + 2]
                others = max((d - c + 1 for c, d in rest), default=1)
                reason = self._no_flicker(batch, name, v, a, b, others) or self._should_move(
                    batch, name, witnesses, v, a, b
                )
                if reason:
                    claimed.append((a, b))
                    message = (
                        f"{name} stays at {v[a]:.5g} {batch.channels[name].unit} {span_text(batch, a, b)}: {reason}"
                    )
                    found.append(self.in_rows(batch, name, a + 1, b, message))
        return found

    def _no_flicker(self, batch: Batch, name: str, v: Array, a: int, b: int, longest_other: int) -> str:
        if b - a + 1 <= 3 * longest_other:
            return ""
        if a == 0 and batch.channels[name].role != "error":
            return ""  # a part may rest until it is heated, and its noise begin with the heating
        d = np.diff(v)
        outside = np.isfinite(d)
        outside[a:b] = False
        if outside.sum() < 20:
            return ""
        changing = float((np.abs(d[outside]) > 1e-9).mean())
        n = b - a
        # white noise turns back in two steps of three, a trend never; heating mixes both
        steps = d[outside & (np.abs(d) > 1e-9)]
        turning = float((steps[1:] * steps[:-1] < 0).mean()) if len(steps) > 10 else 0.0
        # a sensor that rounding holds for minutes may rest for an hour when the machine comes to rest
        coarse = np.abs(steps) > _STEP_OF_NOISE * (batch.channels[name].resolution or np.inf)
        there_and_back = coarse[1:] & coarse[:-1] & (steps[1:] * steps[:-1] < 0)
        noisy = changing > 0.5 and len(steps) > 10 and float(there_and_back.mean()) > _WIDE
        if (
            not (changing > _RESTLESS or noisy)
            or turning < _TURNING
            or n * np.log(max(1.0 - changing, 1e-3)) > np.log(_CHANCE)
        ):
            return ""
        return f"elsewhere {changing:.0%} of its samples change and no run is longer than {longest_other} samples"

    def _should_move(self, batch: Batch, name: str, witnesses: _Witnesses, v: Array, a: int, b: int) -> str:
        if (b - a) * batch.step_s < _SECONDS:
            return ""
        unit = batch.channels[name].unit
        least, own = max(_FLAT_STEPS * smallest_step(batch, name), _FLOOR.get(unit, 0.0)), _own_movement(v, a, b)
        if own < least:
            return ""
        if batch.time_s[max(a - 1, 0)] <= (witnesses.jumping.get(name) or -1.0) <= batch.time_s[a + 1]:
            return ""  # it rests after a jump, which has a check of its own
        moved, noise = movement(batch, name, a, b, witnesses.jumping)
        if moved < max(least, _SIGMAS * noise):
            return ""
        return f"the other temperatures predict a change of {moved:.1f} {'K' if unit == 'degC' else unit} in this time"


class _Witnesses:
    """Channels that jump or spike, which must not serve as inputs; found only when needed."""

    def __init__(self, batch: Batch, machine: Machine) -> None:
        self._batch, self._machine = batch, machine

    @cached_property
    def jumping(self) -> dict[str | None, float | None]:
        """Channel -> start of its first spike or jump, s."""
        found = (f for check in (Spike(), JumpNoReturn()) for f in check.batch(self._batch, self._machine))
        return {f.channel: f.start_s for f in found}


def _own_movement(v: Array, a: int, b: int) -> float:
    """Movement over rows a..b by the channel's slope just before or after them, or by the step that ends them."""
    length = b - a
    window = max(3, length // 4)
    moves = [0.0]
    if a >= window:
        moves.append(_slope(v[a - window : a + 1]) * length)
    if b + 1 + window < len(v):
        moves.append(_slope(v[b + 1 : b + 2 + window]) * length)
    if b + 1 < len(v):
        moves.append(abs(float(v[b + 1] - v[b])))
    return max(m for m in moves if np.isfinite(m))


def _slope(v: Array) -> float:
    """Mean step without the largest one, which may be a jump."""
    d = np.diff(v)
    return abs(float(d.sum() - d[np.argmax(np.abs(d))])) / (len(d) - 1)


_HELD_ROWS = 5
_HELD_SECONDS = 600.0
_HELD_CHANCE = 1e-6
_SHOWN = 2.0  # steps of the display: by so much the temperatures must let it move to contradict a value that rests


class ErrorHeld(Check):
    """Every error channel repeats one value, all together, while the temperatures let expect a change (`movement`).

    With p the share of rows where any error channel changes outside the stretch, n equal rows have the chance
    (1 − p)^n; below 1e-6, with an expected change above its noise and two steps of the display, nothing was measured.
    """

    key = "error_held"
    summary = "all error channels repeat one value while the temperatures change"

    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        seen = signals(batch)
        names = [n for n in in_time(batch, "error") if np.isfinite(seen.values(n)).sum() > _HELD_ROWS]
        if not names or batch.n_rows < 2 * _HELD_ROWS:
            return []
        least = max(_HELD_ROWS, int(_HELD_SECONDS / batch.step_s))
        if any(seen.whole(n) and not seen.rests(n, least) for n in names):
            return []
        together = np.zeros(batch.n_rows, bool)
        together[0] = True
        for name in names:
            v = seen.values(name)
            # a channel already masked here does not count
            change = np.abs(np.diff(v))
            together[1:] |= np.isfinite(change) & ~(change <= EQUAL * np.maximum(1.0, np.abs(v[1:])))
        code = np.cumsum(together).astype(float)
        code[~np.any([np.isfinite(seen.values(name)) for name in names], axis=0)] = np.nan
        runs = constant_runs(code, _HELD_ROWS)
        still = standing(batch)
        held = [(a, b) for a, b in runs if self._is_held(batch, names, code, a, b, runs, still)]
        found = []
        for a, b in held:
            state = (
                "while the spindle stands" if still[a + 1 : b].mean() > 0.5 else "although the spindle speed is above 0"
            )
            for name in names:
                there = np.flatnonzero(np.isfinite(seen.values(name)[a : b + 1]))
                if len(there) < 2:
                    continue
                last = a + int(there[-1])
                moved, _ = movement(batch, name, a, b)
                unit = batch.channels[name].unit
                message = (
                    f"{name} repeats {batch.values(name)[a]:.1f} {unit} {span_text(batch, a, last)} {state}, while the "
                    f"temperatures let expect a change of {moved:.1f} {unit}"
                )
                found.append(self.in_rows(batch, name, a + 1, last, message))
        return found

    def _is_held(
        self, batch: Batch, names: list[str], code: Array, a: int, b: int, runs: list[tuple[int, int]], still: Bools
    ) -> bool:
        n = b - a
        if n * batch.step_s < _HELD_SECONDS:
            return False
        outside = np.ones(batch.n_rows - 1, bool)
        for c, d in runs:
            if d - c >= n / 2:
                outside[c:d] = False
        changing = float(np.nanmean(np.diff(code)[outside] > 0)) if outside.sum() > 20 else 0.5
        if n * np.log(max(1.0 - changing, 1e-3)) > np.log(_HELD_CHANCE):
            return False
        moved = ((movement(batch, name, a, b), _SHOWN * smallest_step(batch, name)) for name in names)
        if not any(change > max(noise, shown) for (change, noise), shown in moved):
            return False
        if still[a + 1 : b].mean() > 0.5:
            return True
        others = [d - c for c, d in runs if d - c < n / 2]
        return len(names) > 1 and n > 3 * max(others, default=_HELD_ROWS)
