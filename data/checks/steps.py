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
    load_changes,
    robust_sigma,
    rolling_median,
    signals,
    step_limit,
    thinned,
    widened,
)
from data.machine import Machine

_FLOOR = {"temperature": 1.0, "ambient": 3.0, "error": 8.0}  # K, K, µm: below, air and slip can do it
_TYPICAL = 3.0
_ROWS = 2
_HALF = 3  # rows on either side


class Spike(Check):
    """One or two samples that leave and come back: off the median of the seven rows around by 8 sigma,
    5 resolution steps, three times the liveliest tenth of the channel and 1 K (air 3 K) or 8 µm.
    """

    key = "spike"
    summary = "single samples far off their neighbours"

    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        seen = signals(batch)
        names = in_time(batch, "temperature", "ambient", "error")
        # a deviation of the floor from the rows around takes at most three steps
        names = tuple(n for n in names if seen.largest_step(n) * _HALF > _FLOOR[batch.channels[n].role])
        loaded = load_changes(batch) if names else np.zeros(0, bool)
        found = []
        for name in names:
            channel, v = batch.channels[name], seen.values(name)
            off = np.abs(v - rolling_median(v, _HALF, least=4))
            quiet = off[np.isfinite(off) & ~loaded]
            if len(quiet) < 12:
                continue
            limit = max(
                SIGMAS * robust_sigma(quiet, channel.resolution),
                STEPS * (channel.resolution or 0.0),
                _TYPICAL * float(np.quantile(quiet, 0.9)),
                _FLOOR[channel.role],
            )
            with np.errstate(invalid="ignore"):
                hit = [int(r) for r in np.flatnonzero((off > limit) & ~loaded)]
            rows = [r for r in hit if self._single(r, set(hit)) and self._comes_back(v, r, off[r])]
            for r in rows:
                unit = "K" if channel.unit == "degC" else channel.unit
                message = (
                    f"{name} reads {v[r]:.5g} {channel.unit} at {clock(batch.time_s[r])}, {off[r]:.1f} {unit} off the "
                    "samples around it"
                )
                found.append(self.finding(name, message, float(batch.time_s[r]), float(batch.time_s[r])))
        return found

    @staticmethod
    def _single(row: int, hits: set[int]) -> bool:
        first = last = row
        while first - 1 in hits:
            first -= 1
        while last + 1 in hits:
            last += 1
        return last - first + 1 <= _ROWS

    @staticmethod
    def _comes_back(v: np.ndarray, row: int, size: float) -> bool:
        """The rows on both sides agree with each other: a sample at the end of a slope is none."""
        before, after = v[max(0, row - 4) : max(0, row - 1)], v[row + 2 : row + 5]
        before, after = before[np.isfinite(before)], after[np.isfinite(after)]
        return bool(len(before) and len(after) and abs(np.median(after) - np.median(before)) < 0.5 * size)


_RATE_K_PER_MIN = 8.0  # 1 kW into the smallest instrumented body, about 7.5 kJ/K
_FLOOR_K = 1.0  # less is within what a draught or a splash of coolant does
_FLOOR_UM = 12.0  # slip of a joint and the shift of a spindle with speed stay below 10 µm
_BACK_S = 900.0
_MOST = 0.6


class JumpNoReturn(Check):
    """A step beyond noise, resolution and the channel's own liveliness, away from driver changes and not
    shared by others; or a temperature that rises faster than noise and 1 kW into 7.5 kJ/K explain. Masked from the
    first odd step to the batch's end, or to the step that brings it back. A fast recording is checked row by row and
    over 10 s, where a step spread over seconds shows.
    """

    key = "jump_no_return"
    summary = "a step of one channel that noise, load and neighbours do not explain"
    common_cause = "the time unit (recording.time.unit: {0.recording.time.unit}) or a normal event of this machine"

    def habit(self, batch: Batch, finding: Finding) -> str:
        """The direction: a machine does the same in every run, a loose contact reads up or down."""
        v = batch.values(finding.channel or "")
        row = int(np.searchsorted(batch.time_s, (finding.start_s or 0.0) - 1e-6))
        before, after = v[max(0, row - 3) : row], v[row : row + max(3, int(_BACK_S / (batch.step_s or 1.0)))]
        before, after = before[np.isfinite(before)], after[np.isfinite(after)]
        return "up" if len(before) and len(after) and np.median(after) > before[-1] else "down"

    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        found = self._at(batch)
        if thin := thinned(batch):
            reported = {f.channel for f in found}
            found += [widened(f, batch, thin) for f in self._at(thin) if f.channel not in reported]
        return found

    def _at(self, batch: Batch) -> list[Finding]:
        seen = signals(batch)
        names = in_time(batch, "temperature", "error")
        # a step less the median step around it is at most twice the largest step: the others cannot be odd
        able = [n for n in names if seen.largest_step(n) > _floor(batch, n) / 2.0]
        if batch.n_rows < 12 or not able:
            return []
        loaded = load_changes(batch)
        steps = {n: seen.excess(n) for n in able}
        odd = {n: np.abs(np.nan_to_num(steps[n])) > self._limit(batch, n, steps[n], loaded) for n in able}
        found = []
        for name in able:
            role = batch.channels[name].role
            same = [n for n in names if n != name and batch.channels[n].role == role]
            shared = np.sum([_near(odd[n]) for n in same if n in odd], axis=0, initial=0)
            # one companion is still a pair of wires in one plug; two are the machine itself
            alone = odd[name] & (shared < max(2, 0.2 * len(same)))
            alone &= ~loaded | (
                np.abs(np.nan_to_num(steps[name])) > self._loaded_limit(batch, name, steps[name], loaded)
            )
            alone &= _grows(seen.values(name))
            if role == "temperature":
                # what most sensors do together is no sensor's fault: the recording was interrupted
                alone |= self._too_fast(batch, name, seen) & (shared < max(2, _MOST * len(same)))
            row = self._staying(seen.values(name), steps[name], alone)
            if row is not None:
                found.append(self._finding_at(batch, name, row, seen))
        return found

    def _limit(self, batch: Batch, name: str, e: Array, loaded: Bools) -> float:
        channel = batch.channels[name]
        quiet = np.abs(e[~loaded & np.isfinite(e)])
        lively = float(np.quantile(quiet, 0.9)) if len(quiet) else 0.0
        floor = _floor(batch, name)
        if channel.role == "error" and not batch.names("driver"):
            floor *= 3.0  # starts and stops are then unknown
        return max(step_limit(quiet, channel.resolution), _TYPICAL * lively, floor)

    def _loaded_limit(self, batch: Batch, name: str, e: Array, loaded: Bools) -> float:
        """After a load change: three times the floor and the channel's own liveliness in such rows."""
        rows = np.abs(e[loaded & np.isfinite(e)])
        lively = float(np.quantile(rows, 0.9)) if len(rows) else 0.0
        return _TYPICAL * max(lively, _floor(batch, name))

    def _too_fast(self, batch: Batch, name: str, seen: Signals) -> Bools:
        v, resolution = seen.values(name), batch.channels[name].resolution or 0.0
        # from row to row of a fast recording the machine moves less than noise and draughts do
        limit = max(_RATE_K_PER_MIN * batch.step_s / 60.0, _FLOOR_K) + 3.0 * resolution
        limit = max(limit, SIGMAS * robust_sigma(seen.excess(name), resolution))
        with np.errstate(invalid="ignore"):
            return np.concatenate([[False], np.abs(np.diff(v)) > limit])

    def _staying(self, v: Array, e: Array, alone: Bools) -> int | None:
        """The first odd row whose step is still there two rows later; one that returns at once is a spike."""
        for row in np.flatnonzero(alone):
            after = v[row + 2 : row + 5]
            after = after[np.isfinite(after)]
            before = v[max(0, row - 4) : row]
            before = before[np.isfinite(before)]
            if len(after) and len(before) and abs(np.median(after) - np.median(before)) > 0.5 * abs(e[row]):
                return int(row)
        return None

    def _finding_at(self, batch: Batch, name: str, row: int, seen: Signals) -> Finding:
        channel, t, e = batch.channels[name], batch.time_s, seen.excess(name)
        unit = "K" if channel.unit == "degC" else channel.unit
        v = seen.values(name)
        small = step_limit(e, channel.resolution)
        earliest = max(0, row - int(_BACK_S / batch.step_s)) + 1
        with np.errstate(invalid="ignore"):
            odd = np.flatnonzero(np.abs(e[earliest : row + 1]) > small)
        first = earliest + int(odd[0]) if len(odd) else row
        settled = min(len(v) - 1, row + max(3, int(_BACK_S / batch.step_s)))
        tail = v[row : settled + 1]
        size = float(tail[np.isfinite(tail)][-1] - v[first - 1])
        back = np.flatnonzero((np.sign(e) == -np.sign(size)) & (np.abs(e) > 0.6 * abs(size)))
        back = back[back > row + 1]
        end = int(back[0]) - 1 if len(back) else None
        message = (
            f"{name} steps by {size:+.1f} {unit} at {clock(t[row])}, which noise ({small / 8:.2g} {unit}), load and "
            "the other channels do not explain, and "
        )
        message += "does not return" if end is None else f"comes back at {clock(t[end])}"
        return self.finding(name, message, float(t[first]), None if end is None else float(t[end]))


def _floor(batch: Batch, name: str) -> float:
    return _FLOOR_UM if batch.channels[name].role == "error" else _FLOOR_K


def _near(flags: Bools) -> Bools:
    """True also in the neighbouring rows: resampling can move a step by one."""
    out = flags.copy()
    out[1:] |= flags[:-1]
    out[:-1] |= flags[1:]
    return out


def _grows(v: Array) -> Bools:
    """Rows whose step is twice those of the rows before: what follows a load change only dies away."""
    step = np.abs(np.nan_to_num(np.diff(v, prepend=v[:1])))
    before = np.zeros_like(step)
    before[2:] = step[:-2]
    before[3:] = np.maximum(before[3:], step[:-3])
    return step > 2.0 * before
