"""The state machine of one axis: what is sent to the control stays finite, limited in size and in rate.

    off ──valid input──▶ warm-up ──valid for warm_up_s──▶ active ──fault or silence──▶ hold ──hold_s──▶ fade-out ──▶ off
                                                            ▲───────valid input─────────┘                  │
                                                            └──────────valid for warm_up_s─────────────────┘

Two clocks are kept apart. The monotonic clock of the runtime (`clock_s`) alone limits the rate: a step may change the
output by at most

    min(rate_um_per_s · min(max(Δclock_s, 0), stale_s), step_um),

so no time stamp of a sample can buy a larger step, and neither can a pause of the runtime. The time stamps of the
samples (`time_s`) only decide whether a sample is used, and when it was taken (`SampleClock`). `compensation.core` has
the transitions and the movement; this module says why an axis does not act.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import isfinite
from typing import Any, Literal, Self, get_args

from compensation import core
from compensation.contracts import check_limits
from data.errors import InputError, one_of

State = Literal["off", "warm-up", "active", "hold", "fade-out"]
STATES: tuple[State, ...] = get_args(State)  # the core numbers them from 0
_NUMBER = {state: float(number) for number, state in enumerate(STATES)}

STOPPED = "stopped by the operator"
ENDS = "the compensation ends"
_CLOCK_DRIFT = 1e-3  # s per s that two healthy clocks may differ: a quartz stays below 1e-4


ROOM = 1.25  # of the largest error of the training: a correction beyond is a failure of the model


@dataclass(frozen=True)
class Limits:
    """Limits of one axis.

    Attributes:
        max_offset_um: largest |offset| sent, µm. 100 µm covers the thermal error of most machining centres; a larger
            request is a failure of the model rather than an error of the machine.
        rate_um_per_s: largest rate of what is sent, µm/s. 0.1 µm/s follows a spindle that grows by 30 µm with a time
            constant of a quarter of an hour (0.03 µm/s at the start) and stays far below the 1 µm/s that older
            Heidenhain controls accept.
        step_um: largest change from one transmission to the next, µm. A jump marks the surface that is being finished;
            1 µm stays near its roughness. SINUMERIK further limits the change per interpolation cycle (MD32760).
        hold_s: how long the last offset is held after a fault, s. In two minutes the thermal error moves by a few µm
            at most, and a reconnection or a change of the machine's clock passes without a trace.
        stale_s: age of a sample, or time without one, beyond which the input is stale, s; also the longest time that
            the rate limit credits to one step. At least three sampling intervals, so that a lost sample is no fault.
        warm_up_s: how long the input must have been valid before the axis becomes active, s; a minute shows several
            samples of every sensor.
    """

    max_offset_um: float = 100.0
    rate_um_per_s: float = 0.1
    step_um: float = 1.0
    hold_s: float = 120.0
    stale_s: float = 30.0
    warm_up_s: float = 60.0

    @property
    def tick_s(self) -> float:
        """How often what is sent must be looked at so that it moves at its rate, s: a step may be no larger."""
        return self.step_um / self.rate_um_per_s

    def __post_init__(self) -> None:
        """Raises InputError where a limit is not finite, negative, or 0 where that makes no sense."""
        check_limits("safety limits", self, ("hold_s", "warm_up_s"))


@dataclass(frozen=True)
class SampleClock:
    """The clock of the samples against the monotonic one, which alone decides about age and order.

    Attributes:
        newest_s: time stamp of the newest sample used, s; after a restart that of the saved state.
        shift_s: how far this clock was set since the run began, s: `time_s - shift_s` goes on where it was set.
        last_s: time stamp of the sample that arrived last, used or not, s.
        lead_s: time stamp less monotonic clock of the freshest samples, s: the age of a sample is what it lacks. A
            restart forgets it, since a monotonic clock has another origin in another process.
        other_s: lead of samples that disagree with `lead_s`, s, None while none does.
        other_for_s: how long samples have agreed with `other_s`, s.
        last_clock_s: monotonic clock when the last sample arrived, s.
    """

    newest_s: float | None = None
    shift_s: float = 0.0
    last_s: float | None = None
    lead_s: float | None = None
    other_s: float | None = None
    other_for_s: float = 0.0
    last_clock_s: float | None = None

    def judged(self, limits: Limits, clock_s: float, time_s: float) -> tuple[Self, str | None]:
        """The clock after one more sample, and why its time stamp cannot be used; None where it can.

        A stamp is not used where it is older than the newest one or disagrees with the monotonic clock by more than
        stale_s: the clock of the samples has jumped, or the sample is old. Another clock is accepted once samples agree
        with it for warm_up_s; after a restart it is accepted with the second sample, within stale_s of the saved state
        with the first.
        """
        lead_s = time_s - clock_s
        if not isfinite(lead_s):
            return self, f"clock: the time stamp of the sample is {time_s}"
        since_s = 0.0 if self.last_clock_s is None else max(clock_s - self.last_clock_s, 0.0)
        later = self.last_s is None or time_s > self.last_s
        seen = replace(self, last_s=time_s, last_clock_s=clock_s)
        since_newest_s = 0.0 if self.newest_s is None else time_s - self.newest_s
        taken = replace(seen, newest_s=time_s, lead_s=lead_s, other_s=None, other_for_s=0.0)
        if self.lead_s is None:
            if abs(since_newest_s) <= limits.stale_s:  # what is behind goes on from the saved state
                return replace(taken, shift_s=self.shift_s + min(since_newest_s, 0.0)), None
            jump_s, agree_s, whose = since_newest_s, 0.0, "saved state"
        else:
            jump_s, agree_s, whose = lead_s - self.lead_s, limits.warm_up_s, "clock so far"
            if abs(jump_s) <= limits.stale_s and since_newest_s >= -limits.stale_s:
                if since_newest_s <= 0.0:
                    return seen, f"clock: the sample is {-since_newest_s:.3g} s older than the newest one"
                # The lead follows fresher samples at once and older ones no faster than clocks drift, so that a source
                # that falls behind little by little is noticed.
                leads_s = max(lead_s, self.lead_s - _CLOCK_DRIFT * min(since_s, limits.stale_s))
                return replace(taken, lead_s=leads_s), None
        agrees = self.other_s is not None and abs(lead_s - self.other_s) <= limits.stale_s
        again = agrees and later and since_s <= limits.stale_s
        other_for_s = self.other_for_s + since_s if again else 0.0
        if again and other_for_s >= agree_s:
            set_s = 0.0 if self.lead_s is None else lead_s - self.lead_s
            return replace(taken, shift_s=self.shift_s + set_s), None
        seen = replace(seen, other_s=self.other_s if again else lead_s, other_for_s=other_for_s)
        off_s = jump_s if abs(jump_s) > limits.stale_s else since_newest_s
        return seen, f"clock: the sample is {abs(off_s):.0f} s {'ahead of' if off_s > 0 else 'behind'} the {whose}"


@dataclass(frozen=True)
class Axis:
    """State of one axis between two steps.

    Attributes:
        state: one of `STATES`.
        sent_um: offset sent last, µm.
        reason: why the axis is not active, or acts with reduced authority; empty where it is and does not.
        held_s: time in `hold` since the axis was active, s.
        target_um: where an active axis moves to, µm, |target| ≤ max_offset_um.
        warmed: the input was valid for warm_up_s and the axis has not faded out since.
        good_s: how long the input has been valid without a break, s; None after an input that was not.
        quiet_s: time since the last valid input, s.
        clock_s: monotonic clock of the last step, s.
        elapsed_s: time that passed with the last step that had one, s; a clock that is no number counts as that.
    """

    state: State = "off"
    sent_um: float = 0.0
    reason: str = "no valid sample so far"
    held_s: float = 0.0
    target_um: float = 0.0
    warmed: bool = False
    good_s: float | None = None
    quiet_s: float = 0.0
    clock_s: float | None = None
    elapsed_s: float = 0.0

    @property
    def behind_um(self) -> float:
        """How far what is sent is from where an active or fading axis moves to, µm: its limits hold it back."""
        goal_um = {"active": self.target_um, "fade-out": 0.0}.get(self.state, self.sent_um)
        return abs(goal_um - self.sent_um)

    def as_plain(self) -> dict[str, Any]:
        """Numbers and strings: what a restart needs."""
        return {"state": self.state, "sent_um": self.sent_um, "held_s": self.held_s}

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Self:
        """The axis after a restart: it continues from the offset sent last and passes warm-up again.

        The time held counts on, so that restarts do not prolong `hold`.

        Raises:
            InputError: an unknown state, or a number that is not finite.
        """
        state = one_of(str(plain["state"]), STATES, "state of an axis")
        sent_um, held_s = float(plain["sent_um"]), float(plain["held_s"])
        if not (isfinite(sent_um) and isfinite(held_s)):
            raise InputError(
                f"state of an axis: got sent_um={sent_um!r}, held_s={held_s!r}, expected finite numbers; delete the "
                "stored state and set the offset of the control to 0"
            )
        if sent_um == 0.0:
            state = "off"
        elif state != "fade-out":
            state = "warm-up"
        return cls(state=state, sent_um=sent_um, reason="restarted", held_s=max(held_s, 0.0))


def step(
    axis: Axis,
    limits: Limits,
    clock_s: float,
    wanted_um: float,
    trust: float = 1.0,
    fault: str | None = None,
    stop: str = "",
) -> tuple[Axis, float, str]:
    """One sample: the state after it, the offset to send, µm, and the reason where the axis does not act fully.

    Whatever the arguments are, the offset is finite, within ±max_offset_um, and differs from the one before by at most
    the bound in the head of this module. Where a restart brings a smaller max_offset_um, the offset returns into it at
    the limited rate, as a jump would do more harm.

    A sample is not used, and the axis holds, where `fault` is given, and where `wanted_um` or `trust` is not a number.

    Args:
        axis: state before.
        limits: of this axis.
        clock_s: monotonic clock of the runtime, s, any origin.
        wanted_um: offset that the model requests, µm.
        trust: authority of the model, clipped to [0, 1]; multiplies `wanted_um`.
        fault: why the sample or the model cannot be used; None where it can.
        stop: why the axis fades out and stays off; empty where it does not.
    """
    problem = None if fault is None else fault or "unnamed fault"
    if problem is None and not isfinite(wanted_um):
        problem = f"the model requests {wanted_um} µm"
    elif problem is None and trust != trust:
        problem = "the trust in the model is not a number"
    if problem is not None:
        return _moved(axis, limits, clock_s, faulty=True, reason=problem, stop=stop)
    return _moved(axis, limits, clock_s, wanted_um, min(max(trust, 0.0), 1.0), stop=stop)


def silence(axis: Axis, limits: Limits, clock_s: float, stop: str = "") -> tuple[Axis, float, str]:
    """No sample has arrived until `clock_s`: returns as `step`.

    Within stale_s an active axis goes on towards its target; then it holds, fades out and is off.
    """
    known = axis.state not in ("active", "warm-up") and axis.reason
    reason = axis.reason if known else f"no valid sample for more than {limits.stale_s:g} s"
    return _moved(axis, limits, clock_s, reason=reason, stop=stop)


def _moved(
    axis: Axis,
    limits: Limits,
    clock_s: float,
    wanted_um: float | None = None,
    trust: float = 1.0,
    faulty: bool = False,
    reason: str = "",
    stop: str = "",
) -> tuple[Axis, float, str]:
    """One step of the core: with a usable sample where `wanted_um` is given, else `reason` says why there is none."""
    before_s = clock_s if axis.clock_s is None else axis.clock_s
    now_s = clock_s if isfinite(clock_s) else before_s + axis.elapsed_s
    elapsed_s = now_s - before_s if isfinite(before_s) else 0.0
    asked_um = 0.0 if wanted_um is None else float(trust * wanted_um)
    inputs = (elapsed_s, asked_um, float(wanted_um is not None), float(faulty), float(bool(stop)),
              *(getattr(limits, name) for name in core.LIMITS))  # fmt: skip
    good_s = -1.0 if axis.good_s is None else axis.good_s
    number, sent_um, held_s, target_um, warmed, good_s, quiet_s = core.run()(
        inputs, _NUMBER[axis.state], axis.sent_um, axis.held_s, axis.target_um, float(axis.warmed), good_s, axis.quiet_s
    )
    if stop:
        reason = stop
    elif wanted_um is None and not faulty and quiet_s <= limits.stale_s:
        reason = axis.reason
    elif wanted_um is not None and not warmed:
        reason = f"valid input for {good_s:.0f} s of {limits.warm_up_s:.0f} s"
    elif wanted_um is not None:
        notes = [f"authority {trust:.0%}"] if trust < 1.0 else []
        if target_um != asked_um:
            notes.append(f"request of {asked_um:.4g} µm limited to {target_um:.4g} µm")
        reason = "; ".join(notes)
    axis = Axis(STATES[int(number)], sent_um, reason, held_s, target_um, bool(warmed),
                None if good_s < 0.0 else good_s, quiet_s, now_s if isfinite(now_s) else None,
                elapsed_s if elapsed_s > 0.0 else axis.elapsed_s)  # fmt: skip
    return axis, sent_um, reason
