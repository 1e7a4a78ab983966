"""The state machine of one axis: what is sent to the control stays finite, limited in size and in rate.

    off ──valid input──▶ warm-up ──valid for warm_up_s──▶ active ──fault or silence──▶ hold ──hold_s──▶ fade-out ──▶ off
                                                            ▲───────valid input─────────┘                  │
                                                            └──────────valid for warm_up_s─────────────────┘

Two clocks are kept apart. The monotonic clock of the runtime (`clock_s`) alone limits the rate: a step may change the
output by at most

    min(rate_um_per_s · min(max(Δclock_s, 0), stale_s), step_um),

so no time stamp of a sample can buy a larger step, and neither can a pause of the runtime. The time stamps of the
samples (`time_s`) only decide whether a sample is used. `compensation.core` has the transitions and the movement; this
module judges time stamps, and says why an axis does not act.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import inf, isfinite
from typing import Any, Literal, Self, get_args

from compensation import core
from compensation.contracts import check_limits
from data.errors import InputError, one_of

State = Literal["off", "warm-up", "active", "hold", "fade-out"]
STATES: tuple[State, ...] = get_args(State)  # the core numbers them from 0
_NUMBER = {state: float(number) for number, state in enumerate(STATES)}

STOPPED = "stopped by the operator"
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
    """What is known of the clock of the samples; a restart forgets it.

    Attributes:
        newest_s: time stamp of the newest sample used, s.
        last_s: time stamp of the sample that arrived last, used or not, s.
        lead_s: time stamp less monotonic clock of the freshest samples, s: the age of a sample is what it lacks.
        other_s: lead of samples that disagree with `lead_s`, s, None while none does.
        other_for_s: how long samples have agreed with `other_s`, s.
        last_clock_s: monotonic clock when the last sample arrived, s.
    """

    newest_s: float | None = None
    last_s: float | None = None
    lead_s: float | None = None
    other_s: float | None = None
    other_for_s: float = 0.0
    last_clock_s: float | None = None


@dataclass(frozen=True)
class Axis:
    """State of one axis between two steps.

    Attributes:
        state: one of `STATES`.
        sent_um: offset sent last, µm.
        reason: why the axis is not active, or acts with reduced authority; empty where it is and does not.
        stopped: an operator has stopped the axis; `start` ends that, a restart does not.
        held_s: time in `hold` since the axis was active, s.
        target_um: where an active axis moves to, µm, |target| ≤ max_offset_um.
        warmed: the input was valid for warm_up_s and the axis has not faded out since.
        good_s: how long the input has been valid without a break, s; None after an input that was not.
        quiet_s: time since the last valid input, s.
        clock_s: monotonic clock of the last step, s.
        samples: the clock of the samples.
    """

    state: State = "off"
    sent_um: float = 0.0
    reason: str = "no valid sample so far"
    stopped: bool = False
    held_s: float = 0.0
    target_um: float = 0.0
    warmed: bool = False
    good_s: float | None = None
    quiet_s: float = 0.0
    clock_s: float | None = None
    samples: SampleClock = field(default_factory=SampleClock)

    @property
    def behind_um(self) -> float:
        """How far what is sent is from where an active or fading axis moves to, µm: its limits hold it back."""
        goal_um = {"active": self.target_um, "fade-out": 0.0}.get(self.state, self.sent_um)
        return abs(goal_um - self.sent_um)

    def as_plain(self) -> dict[str, Any]:
        """Numbers and strings: what a restart needs."""
        return {"state": self.state, "sent_um": self.sent_um, "stopped": self.stopped, "held_s": self.held_s}

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Self:
        """The axis after a restart: it continues from the offset sent last and passes warm-up again.

        The time held counts on, so that restarts do not prolong `hold`. Both clocks are forgotten: a monotonic clock
        has another origin in another process.

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
        stopped = bool(plain["stopped"])
        reason = STOPPED if stopped else "restarted"
        if sent_um == 0.0:
            state = "off"
        elif state != "fade-out":
            state = "fade-out" if stopped else "warm-up"
        return cls(state=state, sent_um=sent_um, reason=reason, stopped=stopped, held_s=max(held_s, 0.0))


def step(
    axis: Axis,
    limits: Limits,
    clock_s: float,
    time_s: float,
    wanted_um: float,
    trust: float = 1.0,
    fault: str | None = None,
) -> tuple[Axis, float, str]:
    """One sample: the state after it, the offset to send, µm, and the reason where the axis does not act fully.

    Whatever the arguments are, the offset is finite, within ±max_offset_um, and differs from the one before by at most
    the bound in the head of this module. Where a restart brings a smaller max_offset_um, the offset returns into it at
    the limited rate, as a jump would do more harm.

    A sample is not used, and the axis holds, where `fault` is given, where `wanted_um` or `trust` is not a number, and
    where its time stamp is older than the newest one or disagrees with the monotonic clock by more than stale_s: the
    clock of the samples has jumped, or the sample is old. A new clock is accepted once samples agree with it for
    warm_up_s. A repeated time stamp is no new sample: it counts as silence.

    Args:
        axis: state before.
        limits: of this axis.
        clock_s: monotonic clock of the runtime, s, any origin.
        time_s: time stamp of the sample, s, any origin.
        wanted_um: offset that the model requests, µm.
        trust: authority of the model, clipped to [0, 1]; multiplies `wanted_um`.
        fault: why the sample or the model cannot be used; None where it can.
    """
    if fault is None and time_s == axis.samples.last_s:
        return silence(axis, limits, clock_s)
    at_s = clock_s if isfinite(clock_s) else axis.clock_s or 0.0
    samples, problem = _judged(axis.samples, limits, at_s, time_s)
    if fault is not None:
        problem = fault or "unnamed fault"
    elif problem is None and not isfinite(wanted_um):
        problem = f"the model requests {wanted_um} µm"
    elif problem is None and trust != trust:
        problem = "the trust in the model is not a number"
    axis = replace(axis, samples=samples)
    if problem is not None:
        return _moved(axis, limits, clock_s, faulty=True, reason=problem)
    return _moved(axis, limits, clock_s, wanted_um, min(max(trust, 0.0), 1.0))


def silence(axis: Axis, limits: Limits, clock_s: float) -> tuple[Axis, float, str]:
    """No sample has arrived until `clock_s`: returns as `step`.

    Within stale_s an active axis goes on towards its target; then it holds, fades out and is off.
    """
    known = axis.state not in ("active", "warm-up") and axis.reason
    reason = axis.reason if known else f"no valid sample for more than {limits.stale_s:g} s"
    return _moved(axis, limits, clock_s, reason=reason)


def stop(axis: Axis) -> Axis:
    """The operator stops the axis: it fades out from the next step on and stays off, until `start`."""
    state: State = "fade-out" if axis.sent_um else "off"
    return replace(axis, state=state, stopped=True, reason=STOPPED, warmed=False, good_s=None, held_s=0.0)


def start(axis: Axis) -> Axis:
    """The operator ends a stop: the axis becomes active after warm_up_s of valid input."""
    return replace(axis, stopped=False, reason="started by the operator") if axis.stopped else axis


def _moved(
    axis: Axis,
    limits: Limits,
    clock_s: float,
    wanted_um: float | None = None,
    trust: float = 1.0,
    faulty: bool = False,
    reason: str = "",
) -> tuple[Axis, float, str]:
    """One step of the core: with a usable sample where `wanted_um` is given, else `reason` says why there is none."""
    now_s = clock_s if isfinite(clock_s) else axis.clock_s
    elapsed_s = 0.0 if axis.clock_s is None or now_s is None else now_s - axis.clock_s
    asked_um = 0.0 if wanted_um is None else float(trust * wanted_um)
    inputs = (elapsed_s, asked_um, float(wanted_um is not None), float(faulty), float(axis.stopped),
              *(getattr(limits, name) for name in core.LIMITS))  # fmt: skip
    good_s = -1.0 if axis.good_s is None else axis.good_s
    number, sent_um, held_s, target_um, warmed, good_s, quiet_s = core.run()(
        inputs, _NUMBER[axis.state], axis.sent_um, axis.held_s, axis.target_um, float(axis.warmed), good_s, axis.quiet_s
    )
    if axis.stopped or (wanted_um is None and not faulty and quiet_s <= limits.stale_s):
        reason = axis.reason
    elif wanted_um is not None and not warmed:
        reason = f"valid input for {good_s:.0f} s of {limits.warm_up_s:.0f} s"
    elif wanted_um is not None:
        notes = [f"authority {trust:.0%}"] if trust < 1.0 else []
        if target_um != asked_um:
            notes.append(f"request of {asked_um:.4g} µm limited to {target_um:.4g} µm")
        reason = "; ".join(notes)
    axis = Axis(STATES[int(number)], sent_um, reason, axis.stopped, held_s, target_um, bool(warmed),
                None if good_s < 0.0 else good_s, quiet_s, now_s, axis.samples)  # fmt: skip
    return axis, sent_um, reason


def _judged(samples: SampleClock, limits: Limits, clock_s: float, time_s: float) -> tuple[SampleClock, str | None]:
    """The clock of the samples after one more, and why its time stamp cannot be used."""
    lead_s = time_s - clock_s
    if not isfinite(lead_s):
        return samples, f"clock: the time stamp of the sample is {time_s}"
    since_s = 0.0 if samples.last_clock_s is None else max(clock_s - samples.last_clock_s, 0.0)
    later = samples.last_s is None or time_s > samples.last_s
    seen = replace(samples, last_s=time_s, last_clock_s=clock_s)
    if samples.lead_s is None:
        return replace(seen, newest_s=time_s, lead_s=lead_s), None
    jump_s = lead_s - samples.lead_s
    behind_s = -inf if samples.newest_s is None else samples.newest_s - time_s
    if abs(jump_s) <= limits.stale_s and behind_s <= limits.stale_s:
        if behind_s >= 0:
            return seen, f"clock: the sample is {behind_s:.3g} s older than the newest one"
        # The lead follows fresher samples at once and older ones no faster than clocks drift, so that a source that
        # falls behind little by little is noticed.
        leads_s = max(lead_s, samples.lead_s - _CLOCK_DRIFT * min(since_s, limits.stale_s))
        return replace(seen, newest_s=time_s, lead_s=leads_s, other_s=None, other_for_s=0.0), None
    agrees = samples.other_s is not None and abs(lead_s - samples.other_s) <= limits.stale_s
    if not (agrees and later and since_s <= limits.stale_s):
        seen = replace(seen, other_s=lead_s, other_for_s=0.0)
    else:
        seen = replace(seen, other_for_s=samples.other_for_s + since_s)
        if seen.other_for_s >= limits.warm_up_s:
            return replace(seen, newest_s=time_s, lead_s=lead_s, other_s=None, other_for_s=0.0), None
    off_s = jump_s if abs(jump_s) > limits.stale_s else -behind_s
    return seen, f"clock: the sample is {abs(off_s):.3g} s {'ahead of' if off_s > 0 else 'behind'} the clock so far"
