"""Checks of single steps: spikes, and jumps that do not return."""

from __future__ import annotations

import numpy as np

from data.batch import Batch, Finding
from data.checks.base import (
    SIGMAS,
    STEPS,
    Array,
    Bools,
    Check,
    Signals,
    clock,
    in_time,
    robust_sigma,
    rolling_median,
    signals,
    step_limit,
)
from data.checks.expected import Expected
from data.machine import Machine

_FLOOR = {"temperature": 1.0, "ambient": 3.0, "error": 8.0}  # K, K, µm: below, air and slip can do it
_TYPICAL = 3.0
_ROWS = 2
_HALF = 3  # rows on either side


class Spike(Check):
    """One or two samples that leave and come back: off the median of the seven rows around by 8 sigma, 5 resolution
    steps and 1 K (air 3 K) or 8 µm, which drivers and the other channels do not explain (`Expected`).
    """

    key = "spike"
    summary = "single samples far off their neighbours"

    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        seen = signals(batch)
        found = []
        for name in in_time(batch, "temperature", "ambient", "error"):
            channel, v = batch.channels[name], seen.values(name)
            least = _FLOOR[channel.role]
            # a deviation of the floor from the rows around takes at most three steps
            if seen.largest_step(name) * _HALF <= least:
                continue
            off = np.abs(v - rolling_median(v, _HALF, least=4))
            quiet = off[np.isfinite(off)]
            if len(quiet) < 12:
                continue
            limit = max(
                SIGMAS * robust_sigma(quiet, channel.resolution),
                STEPS * (channel.resolution or 0.0),
                _TYPICAL * float(np.quantile(quiet, 0.9)),
                least,
            )
            hit = set(np.flatnonzero(np.nan_to_num(off) > limit).tolist())
            rows = [r for r in sorted(hit) if self._single(r, hit) and abs(_net(seen.excess(name), r)) < 0.5 * off[r]]
            rows = [r for r in rows if off[r] > 0.5 * np.nanmax(off[max(r - 1, 0) : r + 2])]  # a slope moves the median
            expected = Expected(batch, name) if rows else None
            for r in rows:
                if expected is None or not expected.contradicts(r - 1 if r - 1 in hit else r, least):
                    continue
                unit = "K" if channel.unit == "degC" else channel.unit
                message = (
                    f"{name} reads {v[r]:.5g} {channel.unit} at {clock(batch.time_s[r])}, {off[r]:.1f} {unit} off the "
                    "samples around it"
                )
                found.append(self.in_rows(batch, name, r, r, message))
        return found

    @staticmethod
    def _single(row: int, hits: set[int]) -> bool:
        first = last = row
        while first - 1 in hits:
            first -= 1
        while last + 1 in hits:
            last += 1
        return last - first + 1 <= _ROWS


_LEAST = {"temperature": 1.0, "error": 12.0}  # K: a draught, a splash of coolant; µm: slip of a joint, a speed shift
_BACK_S = 900.0


class JumpNoReturn(Check):
    """A step beyond noise, resolution and the channel's own liveliness, not shared by others, which the drivers and the
    other channels do not explain (`Expected`). Masked from the first odd step to the batch's end, or to the step that
    brings it back. What takes longer than a sampling interval is a slope: a machine that warms has those.
    """

    key = "jump_no_return"
    summary = "a step of one channel that noise, drivers and the other channels do not explain"
    common_cause = "the time unit (recording.time.unit: {0.recording.time.unit}) or a normal event of this machine"

    def habit(self, batch: Batch, finding: Finding) -> str:
        """The direction: a machine does the same in every run, a loose contact reads up or down."""
        v = batch.values(finding.channel or "")
        row = int(np.searchsorted(batch.time_s, (finding.start_s or 0.0) - 1e-6))
        before, after = v[max(0, row - 3) : row], v[row : row + max(3, int(_BACK_S / (batch.step_s or 1.0)))]
        before, after = before[np.isfinite(before)], after[np.isfinite(after)]
        return "up" if len(before) and len(after) and np.median(after) > before[-1] else "down"

    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        seen = signals(batch)
        names = in_time(batch, *_LEAST)
        # a step less the median step around it is at most twice the largest step: the others cannot be odd
        able = [n for n in names if seen.largest_step(n) > _LEAST[batch.channels[n].role] / 2.0]
        if batch.n_rows < 12:
            return []
        odd = {n: np.abs(np.nan_to_num(seen.excess(n))) > self._limit(batch, n, seen) for n in able}
        found = []
        for name in able:
            role = batch.channels[name].role
            same = [n for n in names if n != name and batch.channels[n].role == role]
            shared = np.sum([_near(odd[n]) for n in same if n in odd], axis=0, initial=0)
            # one companion is still a pair of wires in one plug; two are the machine itself
            alone, e = odd[name] & (shared < max(2, 0.2 * len(same))), seen.excess(name)
            rows = [r for r in np.flatnonzero(alone).tolist() if abs(_net(e, r)) > 0.5 * abs(e[r])]
            expected = Expected(batch, name) if rows else None
            for row in rows:
                if expected and expected.contradicts(row, _LEAST[role]):
                    found.append(self._finding_at(batch, name, row, seen, expected))
                    break
        return found

    @staticmethod
    def _limit(batch: Batch, name: str, seen: Signals) -> float:
        channel, e = batch.channels[name], seen.excess(name)
        known = np.abs(e[np.isfinite(e)])
        lively = float(np.quantile(known, 0.9)) if len(known) else 0.0
        return max(step_limit(known, channel.resolution), _TYPICAL * lively, _LEAST[channel.role])

    def _finding_at(self, batch: Batch, name: str, row: int, seen: Signals, expected: Expected) -> Finding:
        channel, t, e = batch.channels[name], batch.time_s, seen.excess(name)
        unit = "K" if channel.unit == "degC" else channel.unit
        v = seen.values(name)
        small = step_limit(e, channel.resolution)
        earliest = max(0, row - int(_BACK_S / batch.step_s)) + 1
        with np.errstate(invalid="ignore"):
            odd = (earliest + np.flatnonzero(np.abs(e[earliest:row]) > small)).tolist()
        first = next((r for r in odd if expected.contradicts(r, small)), row)
        settled = min(len(v) - 1, row + max(3, int(_BACK_S / batch.step_s)))
        tail = v[row : settled + 1]
        size = float(tail[np.isfinite(tail)][-1] - v[first - 1])
        back = np.flatnonzero((np.sign(e) == -np.sign(size)) & (np.abs(e) > 0.6 * abs(size)))
        back = back[back > row + 1]
        end = int(back[0]) - 1 if len(back) else None
        message = (
            f"{name} steps by {size:+.1f} {unit} at {clock(t[row])}, which noise ({small / 8:.2g} {unit}), drivers and "
            "the other channels do not explain, and "
        )
        message += "does not return" if end is None else f"comes back at {clock(t[end])}"
        return self.finding(name, message, float(t[first]), None if end is None else float(t[end]))


def _net(e: Array, row: int) -> float:
    """What an odd step and the rows next to it add up to: the step where it stays, nothing where it comes back."""
    return float(np.nansum(e[max(row - 1, 0) : row + 3]))


def _near(flags: Bools) -> Bools:
    """True also in the neighbouring rows: resampling can move a step by one."""
    out = flags.copy()
    out[1:] |= flags[:-1]
    out[:-1] |= flags[1:]
    return out
