"""The state machine of one axis: every transition, and what holds whatever arrives."""

from __future__ import annotations

import json
from itertools import pairwise
from math import inf, isfinite, nan

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compensation.safety import STOPPED, Axis, Limits, SampleClock, silence, step
from data.errors import InputError

LIMITS = Limits(
    max_offset_um=20.0, rate_um_per_s=0.5, step_um=2.0, hold_s=10.0, stale_s=5.0, warm_up_s=4.0
)  # 0.5 µm a second
UNIX_S = 1.7e9


def fed(axis: Axis, first_s: int, last_s: int, wanted_um: float = 10.0, fault: str | None = None) -> Axis:
    """A sample every second from first_s to last_s, both included."""
    for t in range(first_s, last_s + 1):
        axis, _, _ = step(axis, LIMITS, float(t), wanted_um, fault=fault)
    return axis


def active(wanted_um: float = 10.0) -> Axis:
    """Active at second 30, at the offset wanted."""
    axis = fed(Axis(), 0, 30, wanted_um)
    assert (axis.state, axis.sent_um, axis.reason) == ("active", wanted_um, "")
    return axis


def test_valid_input_leads_from_off_through_warm_up_to_active_and_the_output_stays_at_zero_until_then() -> None:
    axis = fed(Axis(), 0, 3)
    assert (axis.state, axis.sent_um) == ("warm-up", 0.0)
    assert axis.reason == "valid input for 3 s of 4 s"
    axis = fed(axis, 4, 4)
    assert (axis.state, axis.sent_um) == ("active", 0.5)
    assert fed(axis, 5, 8).sent_um == 2.5


def test_a_fault_in_warm_up_starts_it_again() -> None:
    axis = fed(fed(Axis(), 0, 3), 4, 4, fault="t2 lost")
    assert (axis.state, axis.reason) == ("off", "t2 lost")
    assert fed(axis, 5, 8).state == "warm-up"
    assert fed(axis, 5, 9).state == "active"


def test_trust_reduces_the_offset_and_says_so() -> None:
    axis, axes = active(), []
    for t in range(31, 61):
        axis, _, reason = step(axis, LIMITS, float(t), 10.0, trust=0.4)
        axes.append(axis)
    assert (axis.state, axis.sent_um, reason) == ("active", 4.0, "authority 40%")
    assert axes[0].sent_um == 9.5


def test_a_large_request_is_limited_and_reported() -> None:
    axis = fed(active(), 31, 90, wanted_um=-1e300)
    assert axis.sent_um == -20.0
    assert axis.reason == "request of -1e+300 µm limited to -20 µm"


def test_a_fault_holds_then_fades_out_at_the_rate_limit_then_is_off() -> None:
    axis = fed(active(), 31, 41, fault="t2 lost")
    assert (axis.state, axis.sent_um, axis.reason) == ("hold", 10.0, "t2 lost")
    axis = fed(axis, 42, 42, fault="t2 lost")
    assert (axis.state, axis.sent_um) == ("fade-out", 9.5)
    axis = fed(axis, 43, 60, fault="t2 lost")
    assert (axis.state, axis.sent_um) == ("fade-out", 0.5)
    axis = fed(axis, 61, 61, fault="t2 lost")
    assert (axis.state, axis.sent_um, axis.reason) == ("off", 0.0, "t2 lost")


def test_valid_input_during_hold_leads_back_at_once_within_the_rate_limit() -> None:
    axis = fed(fed(active(), 31, 35, fault="t2 lost"), 36, 36, wanted_um=-10.0)
    assert (axis.state, axis.sent_um) == ("active", 9.5)
    axis = fed(axis, 37, 46, fault="t2 lost")
    assert axis.state == "hold", "the time held starts again"


def test_valid_input_during_fade_out_leads_back_after_warm_up() -> None:
    axis = fed(fed(active(), 31, 42, fault="t2 lost"), 43, 46)
    assert (axis.state, axis.sent_um) == ("fade-out", 7.5)
    axis = fed(axis, 47, 47)
    assert (axis.state, axis.sent_um) == ("active", 8.0)


def test_a_fade_out_that_ends_under_valid_input_goes_on_in_warm_up() -> None:
    axis = fed(fed(active(1.0), 31, 42, fault="t2 lost"), 43, 43, wanted_um=1.0)
    assert (axis.state, axis.sent_um) == ("warm-up", 0.0)
    assert fed(axis, 44, 47, wanted_um=1.0).state == "active"


@pytest.mark.parametrize(
    ("wanted_um", "trust", "what"),
    [(nan, 1.0, "requests nan"), (inf, 1.0, "requests inf"), (10.0, nan, "trust")],
)
def test_a_model_that_gives_no_number_is_a_fault(wanted_um: float, trust: float, what: str) -> None:
    axis, sent_um, reason = step(active(), LIMITS, 31.0, wanted_um, trust)
    assert (axis.state, sent_um) == ("hold", 10.0)
    assert what in reason


def test_silence_moves_on_to_the_target_then_holds_fades_out_and_is_off() -> None:
    axis, _, _ = step(active(), LIMITS, 31.0, 12.0)
    states = []
    for t in range(32, 80):
        axis, _, reason = silence(axis, LIMITS, float(t))
        states.append((t, axis.state, axis.sent_um))
    assert states[2] == (34, "active", 12.0)
    assert states[4] == (36, "active", 12.0)
    assert states[5] == (37, "hold", 12.0)
    assert states[14] == (46, "hold", 12.0)
    assert states[15] == (47, "fade-out", 11.5)
    assert states[-1] == (79, "off", 0.0)
    assert reason == "no valid sample for more than 5 s"


def test_a_pause_of_the_runtime_counts_as_silence_and_buys_no_step() -> None:
    axis = active()
    held, sent_um, _ = step(axis, LIMITS, 38.0, 20.0)
    assert (held.state, sent_um) == ("active", 12.0), "8 s are within hold; step_um limits"
    late, sent_um, _ = step(axis, LIMITS, 3600.0, 20.0)
    assert (late.state, sent_um) == ("fade-out", 8.0)


def heard(
    clock: SampleClock, axis: Axis, clock_s: float, time_s: float, wanted_um: float = 20.0
) -> tuple[SampleClock, Axis, str]:
    """A sample whose time stamp is judged first."""
    clock, fault = clock.judged(LIMITS, clock_s, time_s)
    axis, _, reason = step(axis, LIMITS, clock_s, wanted_um, fault=fault)
    return clock, axis, reason


def known(clock_s: float = 30.0) -> SampleClock:
    """The clock after a sample."""
    clock, fault = SampleClock().judged(LIMITS, clock_s, UNIX_S + clock_s)
    assert fault is None
    return clock


def test_an_older_sample_is_not_used_and_the_next_one_is() -> None:
    clock, axis, reason = heard(known(), active(), 31.0, UNIX_S + 29)
    assert (axis.state, axis.sent_um, reason) == ("hold", 10.0, "clock: the sample is 1 s older than the newest one")
    _, axis, _ = heard(clock, axis, 32.0, UNIX_S + 32)
    assert (axis.state, axis.sent_um) == ("active", 10.5)


@pytest.mark.parametrize("jump_s", [-3600.0, 3600.0, 1e12, -1e12])
def test_a_clock_that_jumps_holds_until_samples_have_agreed_with_it_for_warm_up(jump_s: float) -> None:
    clock, axis = known(), active()
    for t in range(31, 35):
        clock, axis, reason = heard(clock, axis, float(t), UNIX_S + jump_s + t)
        assert (axis.state, axis.sent_um) == ("hold", 10.0)
        assert reason.startswith("clock: ")
    clock, axis, reason = heard(clock, axis, 35.0, UNIX_S + jump_s + 35)
    assert (axis.state, axis.sent_um, reason) == ("active", 10.5, "")
    assert UNIX_S + jump_s + 35 - clock.shift_s == pytest.approx(UNIX_S + 35, abs=1e-3)


@pytest.mark.parametrize("time_s", [nan, inf, -inf])
def test_a_time_stamp_that_is_no_number_is_not_used(time_s: float) -> None:
    clock, axis, reason = heard(known(), active(), 31.0, time_s)
    assert (axis.state, axis.sent_um) == ("hold", 10.0)
    assert "clock" in reason and clock == known()


def test_a_source_that_falls_behind_little_by_little_becomes_stale() -> None:
    clock, axis = known(), active()
    for t in range(31, 43):
        clock, axis, reason = heard(clock, axis, float(t), UNIX_S + 30 + (t - 30) / 2, 10.0)
    assert axis.state == "hold"
    assert "behind" in reason


@pytest.mark.parametrize(
    ("gap_s", "fault"),
    [
        (3.0, None),
        (-3.0, None),
        (600.0, "600 s ahead of the saved state"),
        (86400.0, "86400 s ahead of the saved state"),
        (-600.0, "600 s behind the saved"),
    ],
)
def test_the_first_sample_after_a_restart_counts_where_it_is_near_the_saved_state_else_the_second(
    gap_s: float, fault: str | None
) -> None:
    clock, got = SampleClock(UNIX_S, 7200.0).judged(LIMITS, 5.0, UNIX_S + gap_s)
    assert (got is None) if fault is None else (fault in (got or ""))
    clock, got = clock.judged(LIMITS, 6.0, UNIX_S + gap_s + 1)
    assert got is None and clock.shift_s == 7200.0 + (gap_s if -5 < gap_s < 0 else 0)


def test_a_stop_fades_out_and_stays_off_until_it_ends() -> None:
    axis, _, _ = step(active(), LIMITS, 31.0, 10.0, stop=STOPPED)
    assert (axis.state, axis.sent_um, axis.reason) == ("fade-out", 9.5, STOPPED)
    for t in range(32, 61):
        axis, _, _ = step(axis, LIMITS, float(t), 10.0, stop=STOPPED)
    assert (axis.state, axis.sent_um, axis.reason) == ("off", 0.0, STOPPED)
    assert fed(axis, 61, 64).state == "warm-up"
    assert fed(axis, 61, 65).state == "active"


def test_a_restart_continues_from_the_last_offset_through_warm_up() -> None:
    plain = json.loads(json.dumps(active().as_plain()))
    axis = Axis.from_plain(plain)
    assert (axis.state, axis.sent_um) == ("warm-up", 10.0)
    axis = fed(axis, 1000, 1003, wanted_um=0.0)
    assert (axis.state, axis.sent_um) == ("warm-up", 10.0)
    axis = fed(axis, 1004, 1004, wanted_um=0.0)
    assert (axis.state, axis.sent_um) == ("active", 9.5)


def test_a_restart_without_input_holds_and_fades_out_and_restarts_do_not_prolong_that() -> None:
    axis, states = active(), []
    for k in range(4):
        axis = Axis.from_plain(axis.as_plain())
        for t in range(10):  # 5 s are stale, so 4 s or 5 s of a life count as held
            axis, _, _ = silence(axis, LIMITS, 100.0 * k + t)
        states.append(axis.state)
    assert states[-1] in ("fade-out", "off")
    assert "active" not in states


def test_a_hold_after_a_restart_does_not_skip_warm_up() -> None:
    axis = fed(fed(Axis.from_plain(active().as_plain()), 0, 1), 2, 2, fault="t2 lost")
    assert axis.state == "hold"
    assert fed(axis, 3, 3).state == "warm-up"


def test_a_smaller_limit_after_a_restart_is_reached_at_the_rate_limit() -> None:
    axis = Axis(state="warm-up", sent_um=30.0)
    sent = []
    for t in range(30):
        axis, sent_um, _ = silence(axis, LIMITS, float(t))
        sent.append(sent_um)
    assert sent[0] == 30.0
    assert sent[10] == 25.0
    assert max(abs(a - b) for a, b in pairwise(sent)) <= 0.5
    assert abs(sent[-1]) <= 20.0


@pytest.mark.parametrize(
    "wrong", [{"rate_um_per_s": 0.0}, {"max_offset_um": inf}, {"hold_s": -1.0}, {"stale_s": nan}, {"step_um": "1"}]
)
def test_limits_that_make_no_sense_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(wrong))):
        Limits(**wrong)


@pytest.mark.parametrize("wrong", [{"state": "acitve"}, {"sent_um": nan}, {"held_s": inf}])
def test_a_stored_state_that_makes_no_sense_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(InputError, match="state of an axis"):
        Axis.from_plain({**active().as_plain(), **wrong})


ANY = st.floats(allow_nan=True, allow_infinity=True)
PACE_S = st.one_of(st.sampled_from([0.0, 1.0, 1.0, 1.0, 10.0, -1.0]), st.floats(-100.0, 1e5), ANY)
CALLS = st.lists(
    st.tuples(
        st.sampled_from(["step", "step", "step", "step", "silence", "stop", "start", "restart"]),
        PACE_S,  # of the monotonic clock
        PACE_S,  # of the samples
        st.one_of(st.floats(-50.0, 50.0), ANY),
        st.one_of(st.just(1.0), st.floats(-1.0, 2.0), ANY),
        st.sampled_from([None, None, None, "t2 lost", ""]),
    ),
    max_size=60,
)
SOME_LIMITS = st.builds(
    Limits,
    max_offset_um=st.floats(0.1, 1e3),
    rate_um_per_s=st.floats(1e-3, 1e3),
    step_um=st.floats(1e-3, 1e3),
    hold_s=st.floats(0.0, 100.0),
    stale_s=st.floats(0.1, 100.0),
    warm_up_s=st.floats(0.0, 100.0),
)


def _moved_on(now_s: float, pace_s: float) -> float:
    """A clock after a pace; one that is no number lasts for one call."""
    return now_s + pace_s if isfinite(now_s) else pace_s


@settings(max_examples=100, deadline=None)
@given(limits=SOME_LIMITS, calls=CALLS)
def test_the_output_is_finite_and_limited_in_size_and_rate_whatever_arrives(
    limits: Limits, calls: list[tuple[str, float, float, float, float, str | None]]
) -> None:
    axis, clock, stop = Axis(), SampleClock(), ""
    clock_s, time_s, last_clock_s, usual_s = 0.0, UNIX_S, None, 0.0
    for call, pace_s, sample_pace_s, wanted_um, trust, fault in calls:
        before_um = axis.sent_um
        if call == "restart":
            axis, last_clock_s, usual_s = Axis.from_plain(axis.as_plain()), None, 0.0
            assert axis.sent_um == before_um
            continue
        stop = {"stop": STOPPED, "start": ""}.get(call, stop)
        clock_s, time_s = _moved_on(clock_s, pace_s), _moved_on(time_s, sample_pace_s)
        if call == "step":
            clock, late = clock.judged(limits, clock_s, time_s)
            axis, sent_um, _ = step(axis, limits, clock_s, wanted_um, trust, late if fault is None else fault, stop)
        else:
            axis, sent_um, _ = silence(axis, limits, clock_s, stop)
        passed_s = 0.0
        if isfinite(clock_s):
            passed_s = 0.0 if last_clock_s is None else max(clock_s - last_clock_s, 0.0)
            last_clock_s, usual_s = clock_s, passed_s or usual_s
        elif last_clock_s is not None:  # counts as the time before
            last_clock_s, passed_s = last_clock_s + usual_s, usual_s
        elapsed_s = min(passed_s, limits.stale_s)
        assert sent_um == axis.sent_um
        assert isfinite(sent_um)
        assert abs(sent_um) <= limits.max_offset_um
        assert abs(sent_um - before_um) <= min(limits.rate_um_per_s * elapsed_s, limits.step_um) + 1e-9
        assert axis.state == "active" or axis.reason
        assert axis.state != "off" or sent_um == 0.0
        json.dumps(axis.as_plain(), allow_nan=False)


@settings(max_examples=50, deadline=None)
@given(calls=CALLS)
def test_lasting_silence_ends_at_zero_and_then_valid_input_is_used_again_whatever_came_before(
    calls: list[tuple[str, float, float, float, float, str | None]],
) -> None:
    axis, clock, clock_s, time_s = Axis(), SampleClock(), 0.0, UNIX_S
    for call, pace_s, sample_pace_s, wanted_um, trust, fault in calls:
        if call in ("step", "silence"):
            clock_s, time_s = _moved_on(clock_s, pace_s), _moved_on(time_s, sample_pace_s)
            clock, late = clock.judged(LIMITS, clock_s, time_s)
            axis, _, _ = step(axis, LIMITS, clock_s, wanted_um, trust, late if fault is None else fault)
    axis, _, _ = silence(axis, LIMITS, 0.0)
    for t in range(60):
        axis, _, _ = silence(axis, LIMITS, float(t))
    assert (axis.state, axis.sent_um) == ("off", 0.0)
    for t in range(60, 120):
        clock, late = clock.judged(LIMITS, float(t), UNIX_S + t)
        axis, _, _ = step(axis, LIMITS, float(t), 10.0, fault=late)
    assert (axis.state, axis.sent_um) == ("active", 10.0)
