"""Sensors that fail while the machine is compensated: what is noticed, what stands in, what is reported."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from math import inf, isfinite, nan

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compensation.substitutes import Checked, Guard, GuardLimits, Substitutes, Watch
from data.batch import Batch, Finding
from data.errors import InputError

NAMES = ("t0", "t1", "t2", "t3", "t4", "room")
STEP_S = 300.0
LIMITS = GuardLimits(substitute_s=20 * STEP_S, back_samples=3)
Change = Callable[[int, float], float | None]
"""Row and true value of a channel to what arrives; None where it is absent."""


@pytest.fixture(scope="module")
def batches(toy_batches: Callable[..., list[Batch]]) -> list[Batch]:
    return toy_batches(k=8)


@pytest.fixture(scope="module")
def learned(batches: list[Batch]) -> Substitutes:
    """From all batches but the last."""
    return Substitutes.learn(batches[:-1], (*NAMES, "spindle_rpm"))


@pytest.fixture
def guard(learned: Substitutes) -> Guard:
    return Guard(learned, LIMITS)


def run(guard: Guard, batch: Batch, changes: Mapping[str, Change], restart_at: int = -1) -> list[Checked]:
    """What the guard returns for every row of a batch of which some channels are changed."""
    watch, found = guard.begin(), []
    for i in range(batch.n_rows):
        values = {}
        for name in (*NAMES, "spindle_rpm"):
            value = changes.get(name, lambda _, v: v)(i, float(batch.values(name)[i]))
            if value is not None:
                values[name] = value
        if i == restart_at:
            watch = Watch.from_plain(json.loads(json.dumps(watch.as_plain(), allow_nan=False)))
        watch, checked = guard.step(watch, float(batch.time_s[i]), values)
        found.append(checked)
    return found


def statuses(found: list[Checked], name: str) -> list[str]:
    return [c.status[name] for c in found]


def errors_K(found: list[Checked], batch: Batch, name: str) -> np.ndarray:
    return np.array([c.values[name] for c in found]) - batch.values(name)


def test_what_is_learned_is_plain_data(learned: Substitutes) -> None:
    plain = learned.as_plain()
    lists = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in plain.items()}
    for again in (Substitutes.from_plain(plain), Substitutes.from_plain(json.loads(json.dumps(lists)))):
        assert again.names == NAMES, "a driver is not guarded"
        np.testing.assert_array_equal(again.covariance_K2, learned.covariance_K2)
        np.testing.assert_array_equal(again.held_s, learned.held_s)


def test_any_subset_of_channels_predicts_the_others_and_fewer_do_so_less_well(learned: Substitutes) -> None:
    full, sd_full_K, _ = learned.changes(np.ones(6, bool))
    few, sd_few_K, _ = learned.changes(np.array([True, False, True, False, False, False]))
    np.testing.assert_allclose(sd_full_K, learned.sd_K)
    np.testing.assert_array_equal(np.diag(full), 0.0)
    assert (few[:, [1, 3, 4, 5]] == 0).all()
    assert (sd_few_K >= sd_full_K).all() and sd_few_K[4] > sd_full_K[4]
    direct = np.linalg.solve(learned.covariance_K2[np.ix_([0, 2], [0, 2])], learned.covariance_K2[[0, 2], 1])
    np.testing.assert_allclose(few[1, [0, 2]], direct)
    assert not learned.changes(np.zeros(6, bool)).weights.any()


def test_a_stretch_under_a_mask_is_not_learned_from(batches: list[Batch], learned: Substitutes) -> None:
    table = batches[0].table.copy()
    table.loc[30:35, "t1"] += 50.0
    finding = Finding("steps", "t1", "50 K off", 30 * STEP_S, 35 * STEP_S)
    spoilt = replace(batches[0], table=table, findings=(finding,))
    again = Substitutes.learn([spoilt, *batches[1:-1]], NAMES)
    np.testing.assert_allclose(again.sd_K, learned.sd_K, rtol=0.3)


def test_the_longest_constant_stretch_counts_where_the_others_moved(batches: list[Batch]) -> None:
    table = batches[3].table.copy()
    table.loc[5:15, "t1"] = table.loc[5, "t1"]
    table.loc[57:59, "room"] = table.loc[57, "room"]
    learned = Substitutes.learn([*batches[:3], replace(batches[3], table=table), *batches[4:]], NAMES)
    assert learned.held_s[1] == 10 * STEP_S
    assert learned.held_s[5] == 0.0


@pytest.mark.parametrize(("count", "channels"), [(1, NAMES), (4, ("spindle_rpm",)), (4, ()), (0, NAMES)])
def test_too_little_to_learn_from_is_refused(batches: list[Batch], count: int, channels: tuple[str, ...]) -> None:
    with pytest.raises(InputError, match="expected at least 1 channel and 2 batches"):
        Substitutes.learn(batches[:count], channels)


def test_an_unknown_channel_is_refused_with_the_closest(batches: list[Batch]) -> None:
    with pytest.raises(InputError, match="t0"):
        Substitutes.learn(batches, ("t0", "t00"))


def test_healthy_sensors_pass_unchanged(guard: Guard, batches: list[Batch]) -> None:
    for checked, row in zip(run(guard, batches[-1], {}), batches[-1].table.to_dict("records"), strict=True):
        assert (checked.fault, checked.reason, checked.sd_K) == (None, "", {})
        assert checked.values == {n: row[n] for n in (*NAMES, "spindle_rpm")}


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("gone", [None, nan])
def test_a_lost_channel_is_replaced_within_a_few_of_the_stated_sd(
    guard: Guard, batches: list[Batch], name: str, gone: float | None
) -> None:
    found = run(guard, batches[-1], {name: lambda i, v: gone if 10 <= i < 25 else v})
    assert statuses(found, name) == ["ok"] * 10 + ["lost"] * 17 + ["ok"] * 33, "back after 3 consistent samples"
    sd_K = found[12].sd_K[name]
    assert np.abs(errors_K(found, batches[-1], name)).max() < 3 * sd_K
    assert {c.fault for c in found} == {None}
    assert found[12].reason == f"{name} lost, replaced (sd {sd_K:.2g} K)"
    assert all(c.status[n] == "ok" for c in found for n in NAMES if n != name)


def test_two_lost_channels_are_replaced_by_the_others(guard: Guard, batches: list[Batch]) -> None:
    found = run(
        guard,
        batches[-1],
        {"t1": lambda i, v: nan if 10 <= i < 25 else v, "t3": lambda i, v: nan if 15 <= i < 20 else v},
    )
    for name in ("t1", "t3"):
        assert np.abs(errors_K(found, batches[-1], name)).max() < 4 * found[16].sd_K[name]
    assert found[16].sd_K["t1"] >= found[12].sd_K["t1"]


def test_the_time_of_a_substitute_is_limited_and_earned_back(guard: Guard, batches: list[Batch]) -> None:
    found = run(guard, batches[-1], {"t2": lambda i, v: nan if 5 <= i < 30 else v})
    faults = [i for i, c in enumerate(found) if c.fault]
    assert faults == list(range(25, 32)), "20 steps of substitute, and 3 samples until it is taken again"
    assert found[25].fault == "t2 lost: replaced for more than 6000 s"
    found = run(guard, batches[-1], {"t2": lambda i, v: nan if 5 <= i < 17 or 22 <= i < 40 else v})
    assert next(i for i, c in enumerate(found) if c.fault) == 22 + 20 - 14 + 3


@pytest.mark.parametrize("wrong", [500.0, -21.0, inf, -inf, 1e300])
def test_a_value_outside_its_range_is_implausible(guard: Guard, batches: list[Batch], wrong: float) -> None:
    found = run(guard, batches[-1], {"t2": lambda i, v: wrong if 10 <= i < 14 else v})
    assert statuses(found, "t2") == ["ok"] * 10 + ["implausible"] * 6 + ["ok"] * 44
    assert np.abs(errors_K(found, batches[-1], "t2")).max() < 3 * found[10].sd_K["t2"]


@pytest.mark.parametrize("step_K", [-2.0, 1.2, 30.0])
def test_a_step_of_one_channel_is_attributed_to_it_and_replaced_until_a_fault(
    guard: Guard, batches: list[Batch], step_K: float
) -> None:
    found = run(guard, batches[-1], {"t1": lambda i, v: v + step_K * (i >= 10)})
    assert statuses(found, "t1") == ["ok"] * 10 + ["stepping"] * 50, "no return at another level"
    assert all(c.status[n] == "ok" for c in found for n in NAMES if n != "t1")
    assert np.abs(errors_K(found, batches[-1], "t1")[:30]).max() < 4 * found[10].sd_K["t1"]
    assert found[30].fault == "t1 stepping: replaced for more than 6000 s"


def test_a_step_that_goes_back_is_forgiven(guard: Guard, batches: list[Batch]) -> None:
    found = run(guard, batches[-1], {"t1": lambda i, v: v + 7.0 * (10 <= i < 15)})
    assert statuses(found, "t1") == ["ok"] * 10 + ["stepping"] * 8 + ["ok"] * 42


def test_a_channel_that_returns_at_another_level_is_not_taken_again(guard: Guard, batches: list[Batch]) -> None:
    found = run(guard, batches[-1], {"t2": lambda i, v: v if i < 10 else nan if i < 15 else v + 3.0})
    assert statuses(found, "t2")[9:17] == ["ok", *["lost"] * 6, "stepping"]
    assert found[-1].status["t2"] == "stepping"


def test_a_frozen_channel_is_noticed_and_replaced_from_where_it_froze(guard: Guard, batches: list[Batch]) -> None:
    batch = batches[-1]
    stuck = float(batch.values("t2")[8])
    found = run(guard, batch, {"t2": lambda i, v: stuck if 8 <= i < 16 else v})
    seen = statuses(found, "t2")
    assert "ok" not in seen[10:18] and set(seen[:8] + seen[20:]) == {"ok"}
    assert np.abs(errors_K(found, batch, "t2")[10:]).max() < 4 * found[10].sd_K["t2"]


@pytest.mark.parametrize("name", NAMES[:5])
def test_a_sensor_that_drifts_is_named_and_replaced_and_no_other_one(
    guard: Guard, batches: list[Batch], name: str
) -> None:
    """10 K/h from row 5 on: 0.83 K a row, which is no step."""
    batch = batches[-1]
    found = run(guard, batch, {name: lambda i, v: v + 10.0 * STEP_S / 3600.0 * max(i - 5, 0)})
    named = [{n: s for n, s in c.status.items() if s != "ok"} for c in found]
    first = next(k for k, bad in enumerate(named) if bad)
    assert all(set(bad) == {name} for bad in named[first:]) and first < 20
    assert np.abs(errors_K(found, batch, name)).max() < 5.0 < 10.0 * STEP_S / 3600.0 * (batch.n_rows - 6)


def test_exchanged_plugs_are_found_and_do_not_reach_the_model(guard: Guard, batches: list[Batch]) -> None:
    batch = batches[-1]
    a, b = "t0", max(NAMES[1:5], key=lambda n: float(np.ptp(batch.values("t0") - batch.values(n))))
    swap: dict[str, Change] = {
        a: lambda i, v: float(batch.values(b)[i]), b: lambda i, v: float(batch.values(a)[i])
    }  # fmt: skip
    found = run(guard, batch, swap)
    assert {n for n, s in found[-1].status.items() if s != "ok"} >= {a} or found[-1].status[b] != "ok"
    raw = np.abs(batch.values(a) - batch.values(b)).max()
    assert np.abs(errors_K(found, batch, a)).max() < 0.6 * raw


def test_where_no_few_sensors_explain_the_levels_all_count_as_failed_until_they_are_confirmed(
    guard: Guard, batches: list[Batch]
) -> None:
    """More are wrong than can be named: the output is held and fades."""
    batch, off_K = batches[-1], dict(zip(NAMES, (9.0, -8.0, 7.0, -9.0, 8.0, -7.0), strict=True))
    rows = [{n: float(batch.values(n)[i]) + off_K[n] for n in NAMES} for i in range(batch.n_rows)]
    for levels in (True, False):
        watch = guard.begin(levels)
        for time_s, values in zip(batch.time_s.tolist(), rows, strict=True):
            watch, checked = guard.step(watch, time_s, values)
            assert ("6 of 6 temperature channels failed (t0 off" in str(checked.fault)) == levels


def test_sound_runs_raise_no_alarm(batches: list[Batch]) -> None:
    for k in range(len(batches)):
        guard = Guard(Substitutes.learn([b for j, b in enumerate(batches) if j != k], NAMES), LIMITS)
        assert {s for c in run(guard, batches[k], {}) for s in c.status.values()} == {"ok"}


def test_a_constant_channel_is_not_frozen_where_nothing_should_move(guard: Guard) -> None:
    watch = guard.begin()
    for i in range(100):
        watch, checked = guard.step(watch, i * STEP_S, dict.fromkeys(NAMES, 20.0))
        assert set(checked.status.values()) == {"ok"}


def test_a_channel_that_never_arrives_is_replaced_for_the_whole_run_where_it_may_be(
    learned: Substitutes, batches: list[Batch]
) -> None:
    known = Substitutes.from_plain(json.loads(json.dumps(plain(replace(learned, whole=("t2",))))))
    assert known.whole == ("t2",)
    guard = Guard(known, LIMITS)
    found = run(guard, batches[-1], {"t2": lambda i, v: None})
    assert {c.fault for c in found} == {None} and set(statuses(found, "t2")) == {"lost"}, "beyond 20 steps too"
    assert known.level_limit_K is not None
    assert found[0].sd_K["t2"] < known.level_limit_K[2], "of the levels at the first sample"
    off_K = errors_K(found, batches[-1], "t2")
    assert np.abs(off_K).max() < known.level_limit_K[2] and np.ptp(off_K) < 6 * known.sd_K[2]
    np.testing.assert_allclose([c.values["t2"] for c in found], known.without("t2", batches[-1]), atol=1e-9)
    assert run(guard, batches[-1], {"t3": lambda i, v: None})[0].fault == "t3 lost: never arrived"
    late = run(guard, batches[-1], {"t2": lambda i, v: None if i < 30 else v})
    assert statuses(late, "t2")[-1] == "ok" and late[-1].values["t2"] == batches[-1].values("t2")[-1]


def plain(s: Substitutes) -> dict[str, object]:
    return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in s.as_plain().items()}


def test_a_channel_that_never_arrived_is_a_fault(guard: Guard, batches: list[Batch]) -> None:
    found = run(guard, batches[-1], {"t4": lambda i, v: nan if i < 3 else v})
    assert [c.fault for c in found[:4]] == ["t4 lost: never arrived"] * 3 + [None]


def test_more_than_half_of_the_channels_failing_is_a_fault_until_they_are_back(
    guard: Guard, batches: list[Batch]
) -> None:
    batch = batches[-1]
    found = run(guard, batch, {n: lambda i, v: nan if 10 <= i < 20 else v for n in NAMES})
    assert [i for i, c in enumerate(found) if c.fault] == list(range(10, 22))
    assert str(found[10].fault).startswith("6 of 6 temperature channels failed (t0 lost, ")
    np.testing.assert_array_equal(errors_K(found, batch, "t0")[22:], 0.0)
    three = run(guard, batch, {n: lambda i, v: nan if 10 <= i < 20 else v for n in ("t0", "t2", "room")})
    assert {c.fault for c in three} == {None}


def test_a_restart_changes_nothing(guard: Guard, batches: list[Batch]) -> None:
    changes: dict[str, Change] = {"t1": lambda i, v: v + 5.0 * (i >= 10), "t3": lambda i, v: nan if 15 < i < 25 else v}
    assert run(guard, batches[-1], changes) == run(guard, batches[-1], changes, restart_at=18)


@pytest.mark.parametrize(
    ("wrong", "found"),
    [
        ({}, set()),
        ({"t0": "t4", "t4": "t0"}, {"t0", "t4"}),
        ({"t1": 15.0}, {"t1"}),
        (dict.fromkeys(NAMES, 15.0), set(NAMES)),
    ],
)
def test_the_first_sample_after_a_restart_may_come_later_than_its_stamp_says(
    guard: Guard, batches: list[Batch], wrong: Mapping[str, str | float], found: set[str]
) -> None:
    """A clock that is set back while the machine warms up unseen: what the sensors show together decides."""
    rows = [{n: float(batches[-1].values(n)[i]) for n in NAMES} for i in range(40)]
    watch, at_s = guard.begin(), 2 * STEP_S + 10.0
    for i in range(3):
        watch, _ = guard.step(watch, i * STEP_S, rows[i])
    later = {n: rows[20][w] if isinstance(w := wrong.get(n, 0.0), str) else rows[20][n] + w for n in NAMES}
    _, running = guard.step(watch, at_s, later)
    assert running.status["t0"] == "stepping", "while it runs the clock of the computer says how much time has passed"
    watch, checked = guard.step(Watch.from_plain(watch.as_plain()), at_s, later)
    assert {n for n, s in checked.status.items() if s != "ok"} >= found
    for i in () if wrong else range(21, 40):
        assert (checked.fault, {n: checked.values[n] for n in NAMES}) == (None, later)
        later = rows[i]
        watch, checked = guard.step(watch, at_s + (i - 20) * STEP_S, later)


@pytest.mark.parametrize("room", [1.0, -10.0, 50.0])
def test_a_sample_that_cannot_be_used_is_no_reference_for_those_that_follow(
    guard: Guard, batches: list[Batch], room: float
) -> None:
    """Two sensors that contradict each other do not say which one is wrong, and the others came later."""
    for first in ({"room": room}, {"room": room, "t4": float(batches[-1].values("t4")[0])}):
        watch, checked = guard.step(guard.begin(), 0.0, first)
        assert checked.fault and "t0 lost: never arrived" in checked.fault
        for i in range(1, 10):
            given = {n: float(batches[-1].values(n)[i]) for n in NAMES}
            watch, checked = guard.step(watch, i * STEP_S, given)
            assert (checked.fault, checked.values) == (None, given)


def test_after_a_long_pause_the_guard_starts_afresh(guard: Guard) -> None:
    watch, _ = guard.step(guard.begin(), 0.0, dict.fromkeys(NAMES, 20.0))
    watch, checked = guard.step(watch, 300.0, {**dict.fromkeys(NAMES, 20.0), "t1": 28.0})
    assert checked.status["t1"] == "stepping"
    _, checked = guard.step(watch, 90_000.0, {**dict.fromkeys(NAMES, 20.0), "t1": 20.5})
    assert (checked.status["t1"], checked.values["t1"]) == ("ok", 20.5)
    _, checked = guard.step(watch, 90_000.0, {**dict.fromkeys(NAMES, 20.0), "t1": 28.0})
    assert checked.status["t1"] == "off" and abs(checked.values["t1"] - 20.0) < 1.0, "still wrong after the pause"


def test_one_channel_alone_is_guarded_too(batches: list[Batch]) -> None:
    found = run(Guard(Substitutes.learn(batches, ("t1",)), LIMITS), batches[-1], {"t1": lambda i, v: v + 9 * (i == 9)})
    assert found[9].fault == "1 of 1 temperature channels failed (t1 stepping)"
    assert found[8].fault is None and found[-1].fault is None


@pytest.mark.parametrize("wrong", [{"substitute_s": 0.0}, {"step_sd": nan}, {"bad_share": inf}])
def test_limits_that_make_no_sense_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(wrong))):
        GuardLimits(**wrong)


def test_a_state_of_other_channels_is_refused(guard: Guard, batches: list[Batch]) -> None:
    other = Guard(Substitutes.learn(batches, ("t0", "t1"))).begin()
    with pytest.raises(InputError, match="got 2 channels, expected 6"):
        guard.step(other, 0.0, {})
    with pytest.raises(InputError, match="expected 2 values"):
        Watch.from_plain({**other.as_plain(), "filled": [1.0]})


VALUE = st.one_of(st.floats(15.0, 40.0), st.sampled_from([nan, inf, -inf, 1e300, 20.0]), st.floats())
SAMPLES = st.lists(
    st.tuples(
        st.one_of(st.sampled_from([0.0, 1.0, 300.0, -5.0, 1e6]), st.floats()),
        st.dictionaries(st.sampled_from(NAMES), VALUE),
        st.booleans(),
    ),
    max_size=30,
)


@settings(max_examples=60, deadline=None)
@given(samples=SAMPLES)
def test_values_are_finite_and_in_range_unless_a_fault_says_otherwise(
    learned: Substitutes, samples: list[tuple[float, dict[str, float], bool]]
) -> None:
    guard = Guard(learned, LIMITS)
    watch, time_s = guard.begin(), 0.0
    for pace_s, values, restart in samples:
        time_s = time_s + pace_s if isfinite(time_s) else pace_s
        if restart:
            watch = Watch.from_plain(json.loads(json.dumps(watch.as_plain(), allow_nan=False)))
        watch, checked = guard.step(watch, time_s, {**dict.fromkeys(NAMES, 20.0), **values})
        assert checked.fault or all(isfinite(checked.values[n]) for n in NAMES)
        for i, name in enumerate(NAMES):
            value = checked.values[name]
            assert isfinite(value) or name in str(checked.fault)
            assert not isfinite(value) or learned.low[i] <= value <= learned.high[i]
            assert (checked.status[name] == "ok") == (name not in checked.sd_K)


def _seconds(learned: Substitutes, batch: Batch, offset_K: float) -> list[str]:
    """Statuses of a fast channel that is sampled every 20 s and steps by `offset_K` after an hour."""
    fast = learned.names[int(np.argmax(learned.rate_K_per_s))]
    guard, out = Guard(learned), []
    watch = guard.begin()
    for time_s in np.arange(batch.time_s[0], batch.time_s[-1], 20.0):
        values = {n: float(np.interp(time_s, batch.time_s, batch.values(n))) for n in learned.names}
        values[fast] += offset_K * (time_s >= batch.time_s[0] + 3600.0)
        watch, checked = guard.step(watch, float(time_s), values)
        out.append(checked.status[fast])
    return out


def test_samples_closer_than_the_training_s_rows_change_in_proportion_to_their_time(
    learned: Substitutes, batches: list[Batch]
) -> None:
    loose = replace(learned, sd_K=np.full(len(learned.names), 10.0))  # a regression that notices nothing
    step_K = 0.9 * float(np.max(loose.rate_K_per_s)) * STEP_S  # usual between rows of training, not within 20 s
    assert step_K < loose.sd_K.min() * LIMITS.step_sd
    found = _seconds(loose, batches[-1], step_K)
    assert found[:180] == ["ok"] * 180 and found[180] == "stepping"
    assert set(_seconds(loose, batches[-1], 0.0)) == {"ok"}
    assert (loose.usual_K(20.0) <= loose.usual_K(STEP_S)).all()


def test_a_model_stored_without_the_noise_of_its_rows_is_read(learned: Substitutes) -> None:
    plain = {k: v for k, v in learned.as_plain().items() if k != "noise_K"}
    old = Substitutes.from_plain(plain)
    assert old.noise_K is None and "noise_K" not in old.as_plain()
    np.testing.assert_allclose(old.usual_K(20.0), old.usual_K(STEP_S))
