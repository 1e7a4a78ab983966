"""A channel that stays at one value far longer than its own flicker and the other channels allow."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from data.batch import Batch, Finding
from data.checks.base import THERMAL, Array, Check, constant_runs, in_time, smallest_step, span_words
from data.checks.jump_no_return import JumpNoReturn
from data.checks.signals import signals
from data.checks.spike import Spike
from data.machine import Machine

_ROWS = 10
_SECONDS = 1200.0
_CHANCE = 1e-9
_RESTLESS = 0.75
_TURNING = 0.2
_STEP_OF_NOISE, _WIDE = 1.5, 0.1  # a tenth of the steps is wider than one step of the display
_STEPS = 15.0  # flat to one step for L at a turning point, a smooth curve has left by 5 steps at most after L more
_FLOOR = {"um": 5.0, "degC": 1.0}
_SIGMAS = 6.0


class Frozen(Check):
    """Two ways to tell.

    Noise above the resolution (75 % of the samples differ from the one before, or half of them and often by
    more than one step of the display) makes so many equal samples
    impossible: chance below 1e-9 and three times the longest other run. Or the other temperatures, fitted
    outside the stretch, and the channel's own slope at the stretch's ends both say that it moves in it by
    15 resolution steps, by 1 K or 5 µm, and by six sigma of that fit.
    """

    key = "frozen"
    words = "constant far longer than noise and the other channels allow"

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
                    words = (
                        f"{name} stays at {v[a]:.5g} {batch.channels[name].unit} {span_words(batch, a, b)}: {reason}"
                    )
                    found.append(self.finding(name, words, float(batch.time_s[a + 1]), float(batch.time_s[b])))
        return found

    def _no_flicker(self, batch: Batch, name: str, v: Array, a: int, b: int, longest_other: int) -> str:
        if b - a + 1 <= 3 * longest_other:
            return ""
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
        coarse = _STEP_OF_NOISE * (batch.channels[name].resolution or np.inf)
        noisy = changing > 0.5 and len(steps) > 10 and float((np.abs(steps) > coarse).mean()) > _WIDE
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
        least, own = max(_STEPS * smallest_step(batch, name), _FLOOR.get(unit, 0.0)), _own_movement(v, a, b)
        if own < least:
            return ""
        seen = signals(batch)
        inputs = [n for n in batch.names(*THERMAL) if n != name and n not in witnesses.jumping]
        x = np.column_stack([seen.values(n) for n in inputs]) if inputs else np.empty((len(v), 0))
        x = x[:, np.isfinite(x).all(axis=0) & (np.ptp(np.nan_to_num(x), axis=0) > 0)]
        out = np.isfinite(v)
        out[a : b + 1] = False
        if x.shape[1] < 2 or out.sum() < max(30, b - a):
            return ""
        centre, scale = x[out].mean(axis=0), x[out].std(axis=0) + 1e-9
        z = (x - centre) / scale
        gram = z[out].T @ z[out] + 0.01 * out.sum() * np.eye(z.shape[1])
        fit = z @ np.linalg.solve(gram, z[out].T @ (v[out] - v[out].mean()))
        sigma = float(np.std(v[out] - v[out].mean() - fit[out]))
        moved = float(np.ptp(fit[a : b + 1]))
        least = max(least, _SIGMAS * sigma)
        if moved < least or own < least:
            return ""
        return f"the other temperatures say that it moves by {moved:.1f} {'K' if unit == 'degC' else unit} in this time"


class _Witnesses:
    """Who may speak for the other channels: a sensor that jumps or spikes may not. Asked only where it matters."""

    def __init__(self, batch: Batch, machine: Machine) -> None:
        self._batch, self._machine = batch, machine

    @cached_property
    def jumping(self) -> set[str | None]:
        return {f.channel for check in (JumpNoReturn(), Spike()) for f in check.batch(self._batch, self._machine)}


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
