"""A machine, the computer next to it and its control in closed loop, in simulated time, under hostile streams."""

from __future__ import annotations

import ctypes
import math
import random
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from compensation import core
from compensation.contracts import Correction, Sample
from compensation.runtime import Compensator
from compensation.safety import STATES, Limits
from compensation.serving import _Line
from compensation.substitutes import GuardLimits
from tests.compensation import test_runtime as toy
from tests.compensation.test_any_order import InMemory
from tests.toys.exported import C, export_of, offset_only

PERIOD_S, EPOCH_S, ROUNDING_UM = 300.0, 1.7e9, 1e-9
JUMPS_S = (3600.0, 10800.0, 86400.0)
ODD: tuple[Any, ...] = (math.nan, math.inf, -math.inf, 1e308, -40.0, 999.0, "n.a.", None, True, [1])
TRACK = np.array([[row.values[c] for c in toy.INPUTS] for row in toy.samples(toy.TRAIN[-1])], float)
LIMITS = toy.MODEL.limits
ACTIVE = STATES.index("active")


class Receiver(Protocol):
    """What stands at the control."""

    def receive(self, elapsed_s: float, um: float, beat: int, valid: bool) -> tuple[float, int]:
        """A cycle: the offset that the control adds, µm, and the number of the state."""

    def restart(self) -> None:
        """Memory as at the first cycle."""

    def another(self, folder: Path) -> Receiver:
        """One with a memory of its own; its files are in the folder."""


class Compiled:
    """The C of the export for one axis without a slope."""

    def __init__(self, c: C) -> None:
        self.c = c
        self.got = np.zeros(1), np.zeros(1), np.zeros(1), np.zeros(1)

    def receive(self, elapsed_s: float, um: float, beat: int, valid: bool) -> tuple[float, int]:
        received, slope, offset, none = self.got
        received[0] = um
        arguments = ctypes.c_double(elapsed_s), received, slope, ctypes.c_long(beat), int(valid), offset, none
        self.c.call("receive", *arguments)
        return float(offset[0]), self.c.call("state", 0)

    def restart(self) -> None:
        self.c.restart()

    def another(self, folder: Path) -> Compiled:
        return Compiled(self.c.copy(folder))


class Reference:
    """The core in Python behind a received correction."""

    def __init__(self, limits: Limits) -> None:
        self.all, self.limits = limits, tuple(getattr(limits, name) for name in core.LIMITS)
        self.restart()

    def another(self, folder: Path) -> Reference:
        return Reference(self.all)

    def restart(self) -> None:
        self.carried, self.last_s, self.beat = tuple(core.CARRIED.values()), 0.0, None

    carried: tuple[float, ...]
    last_s: float
    beat: int | None

    def receive(self, elapsed_s: float, um: float, beat: int, valid: bool) -> tuple[float, int]:
        good = valid and abs(um) <= 1e30
        usable = good and self.beat is not None and beat != self.beat
        passed_s = elapsed_s if math.isfinite(elapsed_s) else self.last_s
        self.last_s, self.beat = passed_s if passed_s > 0.0 else self.last_s, beat
        event = passed_s, um if usable else 0.0, float(usable), float(not good), 0.0, *self.limits
        self.carried = core.run()(event, *self.carried)
        return self.carried[1], int(self.carried[0])


def receiver(limits: Limits, folder: Path) -> Receiver:
    """The compiled one where a compiler is installed, else its reference."""
    folder.mkdir(parents=True, exist_ok=True)
    export = export_of(replace(offset_only(), limits=limits))
    return Compiled(C(export, "receiver", folder)) if shutil.which("gcc") else Reference(limits)


class Control:
    """The control: it runs its receiver in cycles, and notes what must not happen."""

    def __init__(self, receiver: Receiver, limits: Limits) -> None:
        receiver.restart()
        self.receiver, self.limits = receiver, limits
        self.um, self.sent_um, self.beat, self.last_s, self.quiet_s, self.cycles = 0.0, 0.0, 0, 0.0, 0.0, 0
        self.broken: list[str] = []
        self.share = 0.0  # largest step, of what is allowed

    def must(self, holds: bool, what: str, how: str = "") -> None:
        if not holds:
            self.broken.append(f"{what}: {how}")

    def cycle(self, elapsed_s: float, um: float | None = None, valid: bool = True) -> None:
        """A cycle after `elapsed_s`; `um` arrives with it, None: nothing new does."""
        if um is not None:
            self.sent_um, self.beat = um, self.beat + 1
        fresh = um is not None and valid and self.cycles > 0 and abs(self.sent_um) <= 1e30
        was_um, (self.um, state) = self.um, self.receiver.receive(elapsed_s, self.sent_um, self.beat, valid)
        passed_s = max(elapsed_s, 0.0) if math.isfinite(elapsed_s) else self.last_s
        self.last_s, self.cycles = passed_s or self.last_s, self.cycles + 1
        self.quiet_s = 0.0 if fresh else self.quiet_s + passed_s
        most_um = min(self.limits.rate_um_per_s * min(passed_s, self.limits.stale_s), self.limits.step_um)
        moved_um = abs(self.um - was_um)
        self.share = max(self.share, moved_um / most_um if most_um > 0.0 else 0.0)
        self.must(moved_um <= most_um + ROUNDING_UM, "step", f"{was_um} to {self.um} µm in {passed_s} s")
        self.must(abs(self.um) <= self.limits.max_offset_um, "size", f"{self.um} µm")
        self.must(state != ACTIVE or self.quiet_s <= self.limits.stale_s, "dead sender", f"active {self.quiet_s} s")

    def is_left(self) -> None:
        """Nothing arrives any more: the control is at 0 when hold and fade are over."""
        limits = self.limits
        fade_s = self.limits.max_offset_um / min(limits.rate_um_per_s, limits.step_um / limits.tick_s)
        for _ in range(int((limits.stale_s + limits.hold_s + fade_s) / limits.tick_s) + 3):
            self.cycle(limits.tick_s)
        self.must(self.um == 0.0, "not at 0", f"{self.um} µm after the sender is gone")


@dataclass(frozen=True)
class Loop:
    """What was seen of a stream or a kill.

    Attributes:
        what: "stream", or how the command ended.
        number: of the stream or kill.
        samples, active: given, and answered as active.
        restarts: of the compensation.
        share: largest step at the receiver, of what its limits allow.
        moving: the correction was moving when the process ended.
        active_s: from the first sample after a restart to an active axis, s; None where that was not the end of it.
        broken: what must not happen, and how it did.
    """

    what: str
    number: int
    samples: int
    active: int
    restarts: int
    share: float
    moving: bool
    active_s: float | None
    broken: tuple[str, ...]


class Stream:
    """A machine, the computer next to it and the control, in simulated time."""

    def __init__(self, number: int, seed: int, receiver: Receiver) -> None:
        self.number, self.dice, self.control = number, random.Random(f"{seed} {number}"), Control(receiver, LIMITS)
        self.every_s = self.dice.choice((30.0, 100.0, 300.0))
        self.now_s, self.set_s, self.begun_s, self.got_s = 0.0, 0.0, 0.0, 0.0
        self.record, self.faults, self.doubted = InMemory(Path("record")), dict[str, Callable[..., None]](), False
        self.last: Sample | None = None
        self.samples = self.active = 0
        self.restarts, self.stopped, self.hurt = -1, False, False
        self.start()

    # ----- the computer and its link to the control

    def start(self) -> None:
        machine = Compensator("toy", [toy.MODEL], toy.SUBSTITUTES, PERIOD_S)
        self.line = _Line(machine, [], self.record, lambda text: None, self.deliver)
        self.line.restore()
        self.line.save(0.0)
        self.begun_s, self.moved_s, self.grid_s = self.now_s - 5.0, self.now_s, machine.as_plain()["grid_s"]
        self.restarts += 1
        self.linked = True

    def deliver(self, correction: Correction) -> None:
        """What the compensation sends passes a link that loses and damages some of it."""
        um, state, grid_s = correction.offset_um["z"], correction.state["z"], self.line.machine._grid_s
        self.moved_s, self.grid_s = (self.now_s if grid_s != self.grid_s else self.moved_s), grid_s
        still_s = self.now_s - self.moved_s
        must, limits = self.control.must, self.line.machine.axes[0].limits
        must(abs(um) <= limits.max_offset_um, "size sent", f"{um} µm")
        most_s = 2.0 * limits.stale_s + PERIOD_S  # of the delay of the last sample, of silence since, and of the grid
        must(state != "active" or still_s <= most_s, "stands still", f"active, still for {still_s} s")
        must(state != "active" or not self.stopped, "stopped", "active after the operator stopped it")
        self.active += state == "active"
        passed_s, self.got_s = self.now_s - self.got_s, self.now_s
        match self.dice.random() if self.linked else 0.0:
            case chance if chance < 0.05:
                self.control.cycle(passed_s)
            case chance if chance < 0.07:
                self.control.cycle(passed_s, self.dice.choice((math.nan, math.inf, -1e308)))
            case chance if chance < 0.09:
                self.control.cycle(passed_s, um, valid=False)
            case chance if chance < 0.11:
                self.control.cycle(self.dice.choice((math.nan, math.inf, -5.0, 0.0)), um)
            case _:
                self.control.cycle(passed_s, um)

    def give(self, off_s: float = 0.0, damage: Callable[[dict[str, Any]], None] | None = None) -> str:
        """One more sample, its stamp off by so much; the state that answers it."""
        self.now_s += self.every_s
        values: dict[str, Any] = dict(zip(toy.INPUTS, self.temperatures(), strict=True))
        for fault in self.faults.values():
            fault(values)
        if damage is not None:
            damage(values)
        readings = {self.dice.choice("zq"): self.dice.choice((*ODD[:4], 3.0, -60.0))} if off_s == 1e-3 else {}
        return self.answer(Sample(EPOCH_S + self.now_s + self.set_s + off_s, values, readings))

    def answer(self, sample: Sample | None, ends: bool = False) -> str:
        if sample is not None:
            self.last, self.samples = sample, self.samples + 1
        clock_s = self.now_s - self.begun_s
        return self.line.answer(sample, clock_s, EPOCH_S + self.now_s, ends=ends).state["z"]

    def temperatures(self) -> list[float]:
        """Along a recording and back, as often as it takes, with the noise of sensors."""
        last = len(TRACK) - 1.0
        at = abs((self.now_s / PERIOD_S + last) % (2.0 * last) - last)
        return [float(np.interp(at, np.arange(len(TRACK)), t)) + self.dice.gauss(0.0, 0.02) for t in TRACK.T]

    # ----- what happens

    def good(self) -> None:
        for _ in range(self.dice.randint(1, 6)):
            self.give()

    def late(self) -> None:
        self.give(-self.dice.uniform(0.0, 2000.0))

    def off(self) -> None:
        self.give(self.dice.choice((-1.0, 1.0)) * self.dice.choice(JUMPS_S))

    def clock_set(self) -> None:
        self.set_s += self.dice.choice((-1.0, 1.0)) * self.dice.choice((5.0, 400.0, *JUMPS_S))

    def repeated(self) -> None:
        for _ in range(self.dice.randint(1, 4)):
            self.now_s += self.dice.choice((0.0, 1.0, self.every_s))
            self.answer(self.last)

    def odd(self) -> None:
        names = self.dice.sample(toy.INPUTS, self.dice.randint(1, 2))
        self.hurt = True
        self.give(damage=lambda values: values.update({n: self.dice.choice(ODD) for n in names}))

    def missing(self) -> None:
        name = self.dice.choice(toy.INPUTS)
        self.hurt = True
        self.give(damage=lambda values: values.pop(name))

    def reading(self) -> None:
        self.give(1e-3)

    def frozen(self) -> None:
        name = self.dice.choice(toy.INPUTS)
        held = self.temperatures()[toy.INPUTS.index(name)]
        self.fails("frozen", lambda values: values.update({name: held}))

    def stepped(self) -> None:
        name, by_K = self.dice.choice(toy.INPUTS), self.dice.choice((-20.0, -5.0, 5.0, 20.0))
        self.fails("stepped", lambda values: values.update({name: values[name] + by_K}))

    def exchanged(self) -> None:
        a, b = self.dice.sample(toy.INPUTS, 2)
        self.fails("exchanged", lambda values: values.update({a: values[b], b: values[a]}))

    def fails(self, how: str, fault: Callable[..., None]) -> None:
        self.faults[how], self.doubted = fault, True
        self.good()

    def silence(self) -> None:
        step_s = self.dice.choice((1.0, 60.0, 300.0))
        for _ in range(self.dice.randint(1, 8)):
            self.now_s += step_s
            self.answer(None)

    def unlinked(self) -> None:
        self.linked = False
        self.good()
        self.linked = True

    def operator(self) -> None:
        self.stopped = not self.stopped
        (self.line.machine.stop if self.stopped else self.line.machine.start)()
        self.line.save(self.now_s - self.begun_s)

    def ends(self) -> None:
        """SIGTERM or the end of the input; a service manager may kill it while it fades."""
        for _ in range(self.dice.choice((0, 3, 60))):
            self.now_s += 1.0
            self.answer(None, ends=True)
        self.again()

    def killed(self) -> None:
        """SIGKILL, between two corrections or between the record and what is sent."""
        self.linked = self.dice.random() < 0.5
        if not self.linked:
            self.give()
        self.again()

    def again(self) -> None:
        """A restart after a pause, in which the sensors are mended; every second time the clean samples go on until
        the axis acts."""
        self.now_s += self.dice.choice((1.0, 30.0, 3600.0, 6 * 3600.0))
        self.start()
        self.faults.clear()
        if self.dice.random() < 0.5:
            return
        if self.stopped:
            self.operator()
        needed = int(LIMITS.warm_up_s / self.every_s) + 3
        needed += GuardLimits().back_samples if self.hurt else 0  # the guard first sees the sensors agree again
        self.hurt = False
        states = [self.give() for _ in range(needed)]
        if "active" not in states and self.doubted:  # the sensors contradicted each other: the operator confirms them
            self.line.machine.confirm()
            states = [self.give() for _ in range(needed)]
            self.doubted = False
        self.control.must("active" in states, "not active again", f"{states} after a restart")

    def run(self) -> Loop:
        """Events in random order, then the control alone."""
        events = (self.good, self.good, self.good, self.late, self.off, self.clock_set, self.repeated, self.odd,
                  self.missing, self.reading, self.frozen, self.stepped, self.exchanged, self.silence, self.unlinked,
                  self.operator, self.ends, self.killed)  # fmt: skip
        self.good()
        for _ in range(self.dice.randint(5, 20)):
            if self.stopped and self.dice.random() < 0.5:
                self.operator()
            self.dice.choice(events)()
        self.control.is_left()
        broken = tuple(dict.fromkeys(self.control.broken))
        return Loop("stream", self.number, self.samples, self.active, self.restarts, self.control.share, False, None,
                    broken)  # fmt: skip
