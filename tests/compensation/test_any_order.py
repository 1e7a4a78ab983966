"""Samples, glitches of clocks, ends, kills and restarts in any order, against what must hold whatever comes."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from compensation.contracts import Correction, Sample
from compensation.runtime import _NEW_RUN_S, AxisModel, Compensator
from compensation.safety import Limits
from compensation.serving import StateFile, _Line
from data.batch import Channel
from models.program import Builder
from models.selection.trust import Region

EVERY_S, PERIOD_S, UM_PER_K, EPOCH_S = 10.0, 10.0, 2.0, 1.7e9
LIMITS = Limits(max_offset_um=30.0, rate_um_per_s=0.1, step_um=0.7, hold_s=30.0, stale_s=30.0, warm_up_s=40.0)
CHANNELS = {"t0": Channel("t0", "temperature", "degC")}
JUMPS_S = st.sampled_from([-86400.0, -10800.0, -3600.0, -20.0, -5.0, 5.0, 20.0, 3600.0, 10800.0, 86400.0])


def model() -> AxisModel:
    b = Builder(CHANNELS, PERIOD_S)
    program = b.program([b.affine(b.since_first(b.features(["t0"])), np.array([[UM_PER_K]]))], False)
    none = np.empty(0)
    region = Region({"t0": (-1e3, 1e3)}, {"t0": "K"}, (), none, np.empty((0, 0)), none, none)  # everywhere
    return AxisModel("z", program, ("t0",), ("K",), region, region.program(CHANNELS, PERIOD_S), limits=LIMITS)


MODEL = model()


class InMemory(StateFile):
    """A record that is replaced as a whole."""

    text: str | None = None

    def load(self, log: Callable[[str], None] = print) -> Mapping[str, Any] | None:
        return None if self.text is None else dict(json.loads(self.text))

    def save(self, plain: Mapping[str, Any]) -> None:
        self.text = json.dumps(plain)


class NextToTheControl(RuleBasedStateMachine):
    """A machine whose temperature swings, the computer next to it, and what the receiver at the control gets."""

    def __init__(self) -> None:
        super().__init__()
        self.now_s, self.set_s, self.begun_s = 0.0, 0.0, 0.0  # real time; of the source's clock; of the computer
        self.record, self.line = InMemory(Path("record")), None
        self.got_um, self.got_s, self.delivers = 0.0, 0.0, True
        self.grid_s, self.moved_s, self.stopped = None, 0.0, False
        self.lines: list[str] = []
        self.new_run, self.slack_s, self.since = False, 0.0, None  # may begin; set within what is tolerated

    # ----- the machine and the receiver

    def receive(self, correction: Correction) -> None:
        if not self.delivers:
            return
        um, passed_s = correction.offset_um["z"], self.now_s - self.got_s
        assert abs(um - self.got_um) <= min(LIMITS.rate_um_per_s * passed_s, LIMITS.step_um) + 1e-9
        self.got_um, self.got_s = um, self.now_s
        assert self.line is not None
        grid_s = self.line.machine.as_plain()["grid_s"]
        if grid_s != self.grid_s:
            self.grid_s, self.moved_s = grid_s, self.now_s
            self.since = self.since or (grid_s, self.now_s)
        if grid_s is not None and self.since is not None and not self.new_run:
            ahead_s = grid_s - self.since[0] - (self.now_s - self.since[1])
            assert ahead_s <= self.slack_s + LIMITS.stale_s, "the model is ahead of time"
        if correction.state["z"] == "active":
            most_s = 2.0 * LIMITS.stale_s + PERIOD_S  # delay of the last sample, silence since, and the grid
            assert self.now_s - self.moved_s <= most_s, "active, and the model stands still"
            assert not self.stopped

    def sampled(self, off_s: float = 0.0) -> Correction:
        self.now_s += EVERY_S
        values = {"t0": 20.0 + 15.0 * math.sin(self.now_s / 500.0)}
        assert self.line is not None
        return self.line.answer(Sample(EPOCH_S + self.now_s + self.set_s + off_s, values), self.now_s - self.begun_s)

    def fresh(self) -> None:
        machine = Compensator("toy", [MODEL], None, PERIOD_S, self.lines.append)
        line = _Line(machine, [], self.record, self.lines.append, self.receive)
        line.restore()
        line.save(0.0)
        self.line, self.begun_s, self.moved_s, self.delivers = line, self.now_s - 5.0, self.now_s, True
        plain = line.machine.as_plain()
        self.grid_s, self.since, self.slack_s = plain["grid_s"], None, 0.0
        gap_s = (
            0.0 if plain["grid_s"] is None else EPOCH_S + self.now_s + self.set_s - plain["grid_s"] - plain["shift_s"]
        )
        self.new_run = not -PERIOD_S < gap_s < _NEW_RUN_S - 2 * PERIOD_S

    # ----- what happens

    @initialize()
    def begin(self) -> None:
        self.fresh()

    @precondition(lambda self: self.line)
    @rule(count=st.integers(5, 40))
    def samples(self, count: int) -> None:
        for _ in range(count):
            self.sampled()

    @precondition(lambda self: self.line)
    @rule(off_s=JUMPS_S)
    def one_stamp_is_off(self, off_s: float) -> None:
        self.sampled(off_s)
        self.tolerated(off_s)

    def tolerated(self, off_s: float) -> None:
        """A stamp that is off by less than a fault may move the model by that."""
        self.slack_s += abs(off_s) if abs(off_s) <= LIMITS.stale_s else 0.0

    @rule(by_s=JUMPS_S)
    def the_clock_is_set(self, by_s: float) -> None:
        self.set_s += by_s
        self.tolerated(by_s)

    @precondition(lambda self: self.line)
    @rule(count=st.integers(1, 60))
    def silence(self, count: int) -> None:
        for _ in range(count):
            self.now_s += 1.0
            assert self.line is not None
            self.line.answer(None, self.now_s - self.begun_s, self.now_s)

    @precondition(lambda self: self.line)
    @rule(killed_after=st.integers(0, 60))
    def ends(self, killed_after: int) -> None:
        """SIGTERM or the end of the input; a service manager may kill it while it fades."""
        assert self.line is not None
        for _ in range(killed_after):
            self.now_s += 1.0
            if self.line.answer(None, self.now_s - self.begun_s, ends=True).offset_um["z"] == 0.0:
                break
        self.line = None

    @precondition(lambda self: self.line)
    @rule(recorded=st.booleans())
    def killed(self, recorded: bool) -> None:
        """SIGKILL, between two corrections or between the record and what is sent."""
        self.delivers = not recorded
        if recorded:
            self.sampled()
        self.line = None

    @precondition(lambda self: self.line)
    @rule(stops=st.booleans())
    def the_operator(self, stops: bool) -> None:
        assert self.line is not None
        (self.line.machine.stop if stops else self.line.machine.start)()
        self.stopped = stops
        self.line.save(self.now_s - self.begun_s)

    @precondition(lambda self: not self.line)
    @rule(pause_s=st.sampled_from([1.0, 30.0, 3600.0, 6 * 3600.0]))
    def restarts(self, pause_s: float) -> None:
        self.now_s += pause_s
        self.fresh()
        states = [self.sampled().state["z"] for _ in range(int(LIMITS.warm_up_s / EVERY_S) + 3)]
        assert ("active" in states) != self.stopped, states

    @invariant()
    def nothing_is_noted_but_what_has_a_reason(self) -> None:
        told, self.lines = [line for line in self.lines if not line.startswith(("goes on", "stopped by"))], []
        assert all(self.new_run and "a new run begins" in line for line in told), told

    @invariant()
    def what_is_sent_is_limited(self) -> None:
        assert math.isfinite(self.got_um) and abs(self.got_um) <= LIMITS.max_offset_um


CHECKS = [HealthCheck.too_slow, HealthCheck.filter_too_much]
TestAnyOrder = NextToTheControl.TestCase
TestAnyOrder.settings = settings(max_examples=60, stateful_step_count=20, deadline=None, suppress_health_check=CHECKS)


class ForLong(NextToTheControl):
    """The same, longer."""


TestAnyOrderForLong = pytest.mark.slow(ForLong.TestCase)
TestAnyOrderForLong.settings = settings(
    max_examples=500, stateful_step_count=50, deadline=None, suppress_health_check=CHECKS
)
