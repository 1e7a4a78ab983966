"""Samples in, corrections out: equal to the batch prediction, safe whatever comes, and the same after a restart."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from compensation.contracts import Correction, Sample
from compensation.runtime import AxisModel, Compensator
from compensation.safety import Limits
from compensation.substitutes import Substitutes
from data.batch import Batch
from data.errors import InputError
from features.design import Design
from models.families import FAMILIES
from models.program import Builder, replay
from models.selection.conformal import RunBound
from models.selection.trust import Region, watched
from models.selection.updating import Updater, out_of_fold
from tests.conftest import make_toy_batches

QUICK = Limits(rate_um_per_s=10.0, step_um=1e6, warm_up_s=0.0, stale_s=1000.0, max_offset_um=500.0)
INPUTS = ("t0", "t4", "room")


def model_of(train: list[Batch], key: str = "ridge", axis: str = "z", limits: Limits = QUICK) -> AxisModel:
    family = FAMILIES[key]().fit(train, INPUTS, axis)
    region, channels, step_s = Region.of(train, INPUTS), train[0].channels, train[0].step_s
    design = Design.build(train, INPUTS, axis)
    updater = Updater.learn(out_of_fold(design, key, range(len(train))))
    return AxisModel(
        axis, family.program(channels, step_s), INPUTS, design.input_units, region, region.program(channels, step_s),
        updater=updater, limits=limits,
    )  # fmt: skip


def samples(batch: Batch, at_s: float = 1e9) -> list[Sample]:
    rows = batch.table[["t0", "t1", "t2", "t3", "t4", "room", "spindle_rpm"]].to_dict("records")
    return [
        Sample(at_s + t, {str(c): float(v) for c, v in row.items()}) for t, row in zip(batch.time_s, rows, strict=True)
    ]


def run(machine: Compensator, given: Iterable[Sample]) -> list[Correction]:
    return [machine.take(s, s.time_s - 1e9) for s in given]


@pytest.mark.parametrize("key", ["ridge", "distributed_lag", "lag_dictionary"])
def test_what_is_sent_is_the_negative_of_the_prediction(key: str) -> None:
    *train, left = make_toy_batches(8, 60)
    model = replace(model_of(train, key), updater=None)
    machine = Compensator("toy", [model], period_s=left.step_s)
    sent = [c.offset_um["z"] for c in run(machine, samples(left))]
    wanted = FAMILIES[key]().fit(train, INPUTS, "z").predict(left)
    far = model.region.row()
    trust = np.array([model.authority(far(v)[0]) for v in _watched(model, left)])
    assert np.abs(np.array(sent) + trust * wanted).max() < 1e-6


@pytest.mark.parametrize("share", [1.0, 0.6, 0.05])
def test_a_share_is_sent_and_every_record_says_why(share: float) -> None:
    train = make_toy_batches(9, 60)
    left = train.pop(4)
    t0 = left.table["t0"]
    left = replace(left, table=left.table.assign(t0=t0[0] + 3.0 * (t0 - t0[0])))  # leaves the region as it gets warm
    model = replace(model_of(train), updater=None, share=share, remark=f"provisional model: {share:g}")
    machine = Compensator("toy", [model], period_s=left.step_s)
    done = run(machine, samples(left))
    whole = [model.region.row()(v)[0] for v in _watched(model, left)]
    outside = np.array([replace(model, share=1.0).authority(d) for d in whole])
    assert outside.min() < 0.6 < outside.max()
    wanted = FAMILIES["ridge"]().fit(train, INPUTS, "z").predict(left)
    sent = np.array([c.offset_um["z"] for c in done])
    assert np.abs(sent + np.minimum(share, outside) * wanted).max() < 1e-6
    done.append(machine.silence(1e5, 1e9))
    assert all(c.reasons["z"].endswith(f"provisional model: {share:g}") for c in done)


@pytest.mark.parametrize(("tested", "kept"), [(0.0, 0.05), (0.7, 0.7), (math.nan, 0.05)])
def test_the_authority_holds_as_far_as_runs_were_left_out_and_falls_without_a_step_beyond(tested, kept) -> None:
    model = replace(model_of(make_toy_batches(4, 20)), bound=RunBound(1.0, 2.0, (0.3, 1.7), 1.0, 0.1, tested, 0.9, 8))
    assert model.authority(0.0) == model.authority(kept) == 1.0
    assert model.authority(kept + 1e-9) == pytest.approx(1.0) and model.authority(kept + 1.0) == pytest.approx(0.5)
    assert replace(model, share=0.4).authority(kept + 1.0) == 0.4
    assert replace(model, share=0.4).authority(kept + 3.0) == pytest.approx(0.25)


@pytest.mark.parametrize("share", [0.0, -0.1, 1.1, math.nan])
def test_a_share_that_makes_no_sense_is_refused(share: float) -> None:
    with pytest.raises(InputError, match=r"^axis z: got authority .*, expected above 0 up to 1; train again$"):
        replace(model_of(make_toy_batches(4, 20)), share=share)


@pytest.mark.parametrize("share", [1.0, 0.6, 0.2])
def test_one_reading_brings_the_error_to_zero_at_any_share(share: float) -> None:
    train = make_toy_batches(9, 60)
    left = train.pop(4)
    machine = Compensator("toy", [replace(model_of(train), share=share)], period_s=left.step_s)
    truth_um = left.table["z"].to_numpy() - left.table["z"][0]
    sent = []
    for k, s in enumerate(samples(left)):
        reading = {"z": float(truth_um[k] + sent[-1])} if k == 30 else {}
        sent.append(machine.take(replace(s, readings_um=reading), s.time_s - 1e9).offset_um["z"])
    left_um = truth_um + np.array(sent)
    assert machine.rejected == 0
    assert abs(left_um[25:30].mean()) > 0.8 * (1.0 - share) * abs(truth_um[25:30].mean())
    assert np.abs(left_um[30:36]).max() < 1.0 + 0.1 * (1.0 - share) * abs(truth_um[30])


def _watched(model: AxisModel, batch: Batch) -> np.ndarray:
    rows = np.column_stack([batch.masked(c) for c in model.watched.channels])
    return replay(model.watched, rows)


def test_a_row_is_as_far_outside_as_the_batch_says() -> None:
    *train, left = make_toy_batches(8, 60)
    model = model_of(train[:3])
    whole = model.region.distance(watched(left, INPUTS))
    rows = [model.region.row()(v)[0] for v in _watched(model, left)]
    assert np.abs(whole - rows).max() < 1e-9 and whole.max() > 0.1


def drifting() -> list[Batch]:
    """Batches with a drift that no input shows, of another size in each; the last is in the middle of the others."""
    batches = make_toy_batches(9, 60)
    sizes_um = [-9.0, 6.0, -3.0, 9.0, 8.0, -6.0, 3.0, -8.0, 5.0]
    out = []
    for b, size_um in zip(batches, sizes_um, strict=True):
        drift_um = size_um * -np.expm1(-b.time_s / 3600.0)
        out.append(replace(b, table=b.table.assign(z=b.table["z"] + drift_um)))
    return [*out[:4], *out[5:], out[4]]


def test_two_odd_readings_that_agree_are_a_machine_that_has_changed() -> None:
    batches = make_toy_batches(9, 60)
    left = batches.pop(4)
    lines: list[str] = []
    machine = Compensator("toy", [model_of(batches)], period_s=left.step_s, log=lines.append)
    truth_um = left.table["z"].to_numpy() - left.table["z"][0] + 30.0
    sent = []
    for k, s in enumerate(samples(left)):
        reading = {"z": float(truth_um[k] + sent[-1])} if k in (20, 25) else {}
        sent.append(machine.take(replace(s, readings_um=reading), s.time_s - 1e9).offset_um["z"])
    left_um = truth_um + np.array(sent)
    assert left_um[21:25].mean() > 25.0 and abs(left_um[26:].mean()) < 5.0
    assert machine.rejected == 1 and "the machine has changed" in lines[-1]


def test_readings_correct_what_the_model_misses_and_odd_ones_are_rejected() -> None:
    *train, left = drifting()
    lines: list[str] = []
    machine = Compensator("toy", [model_of(train)], period_s=left.step_s, log=lines.append)
    given = samples(left)
    sent = []
    for k, s in enumerate(given):
        if k in (20, 40):
            truth_um = left.table["z"][k] - left.table["z"][0]
            s = replace(s, readings_um={"z": float(truth_um + sent[-1])})
        if k == 50:
            s = replace(s, readings_um={"z": 4000.0, "w": 1.0})
        sent.append(machine.take(s, s.time_s - 1e9).offset_um["z"])
    truth = left.table["z"].to_numpy() - left.table["z"][0]
    left_um = truth + np.array(sent)
    assert abs(left_um[10:20].mean()) > 6.0 and abs(left_um[41:50].mean()) < 3.0
    assert machine.rejected == 1
    assert any("z: reading of 4000 µm rejected" in line for line in lines)
    assert any("w: reading not used: no such axis" in line for line in lines)


@pytest.mark.parametrize("hours", [1.0, 3.0, 24.0, -1.0, -3.0, -24.0])
@pytest.mark.parametrize("lasting", [False, True])
def test_a_clock_that_jumps_does_not_move_the_model(hours: float, lasting: bool) -> None:
    """One sample whose stamp is off, or a clock that is set while it runs: monotonic time decides."""
    *train, left = make_toy_batches(8, 60)
    given, off = samples(left), 30
    whole = run(Compensator("toy", [model_of(train)], Substitutes.learn(train, INPUTS), left.step_s), given)
    machine = Compensator("toy", [model_of(train)], Substitutes.learn(train, INPUTS), left.step_s)
    done = []
    for k, s in enumerate(given):
        jumps = k >= off if lasting else k == off
        stamp_s = s.time_s + 3600.0 * hours if jumps else s.time_s
        done.append(machine.take(replace(s, time_s=stamp_s, readings_um={"z": 99.0} if k == off else {}), s.time_s))
    where = "ahead of" if hours > 0 else "behind"
    assert (
        done[off].state["z"] == "hold"
        and f"{abs(3600 * hours):.0f} s {where} the clock so far" in done[off].reasons["z"]
    )
    assert {c.state["z"] for c in done[off + 1 :]} == {"active"} and machine.rejected == 0
    after = [c.offset_um["z"] for c in done[off + 1 :]]
    assert after == pytest.approx([c.offset_um["z"] for c in whole[off + 1 :]], abs=1e-4)
    assert abs(after[0]) > 10.0 and len(set(after)) == len(after)


def test_a_restart_after_the_clock_was_set_goes_on() -> None:
    *train, left = make_toy_batches(8, 60)
    given = samples(left)
    whole = run(Compensator("toy", [model_of(train)], None, left.step_s), given)
    first, lines = Compensator("toy", [model_of(train)], None, left.step_s), list[str]()
    given = [replace(s, time_s=s.time_s - 3600.0) if k >= 20 else s for k, s in enumerate(given)]
    for k, s in enumerate(given[:40]):
        first.take(s, 300.0 * k)
    again = Compensator("toy", [model_of(train)], None, left.step_s, lines.append)
    again.restore(json.loads(json.dumps(first.as_plain())))
    after = [again.take(s, 300.0 * k) for k, s in enumerate(given[40:])]
    assert [c.offset_um["z"] for c in after[1:]] == pytest.approx([c.offset_um["z"] for c in whole[41:]], abs=1e-4)
    assert not lines


@pytest.mark.parametrize("hours", [1.0, 3.0, 24.0])
def test_one_stamp_that_is_off_right_after_a_restart_moves_nothing(hours: float) -> None:
    *train, left = make_toy_batches(8, 60)
    first, lines = Compensator("toy", [model_of(train)], None, left.step_s), list[str]()
    given = samples(left)
    run(first, given[:40])
    again = Compensator("toy", [model_of(train)], None, left.step_s, lines.append)
    again.restore(json.loads(json.dumps(first.as_plain())))
    refused = again.take(replace(given[40], time_s=given[40].time_s + 3600.0 * hours), 0.0)
    assert "ahead of the saved state" in refused.reasons["z"] and abs(refused.offset_um["z"]) > 10.0
    assert again.take(given[41], 300.0).state["z"] == "active" and not lines


def test_a_repeated_sample_is_silence() -> None:
    *train, left = make_toy_batches(8, 60)
    limits = replace(QUICK, stale_s=400.0)
    machine, given = Compensator("toy", [model_of(train, limits=limits)], period_s=left.step_s), samples(left)
    run(machine, given[:20])
    states = [machine.take(given[19], given[19].time_s - 1e9 + 100.0 * k).state["z"] for k in range(1, 6)]
    assert states == ["active"] * 4 + ["hold"]


@pytest.mark.parametrize(("late_s", "states"), [(390.0, ["active"] * 5 + ["hold"]), (410.0, ["hold"] * 6)])
def test_an_active_axis_rests_on_a_sample_that_is_at_most_twice_as_old_as_a_fault(
    late_s: float, states: list[str]
) -> None:
    *train, left = make_toy_batches(8, 60)
    machine = Compensator(
        "toy", [model_of(train, limits=replace(QUICK, stale_s=400.0, hold_s=1e4))], period_s=left.step_s
    )
    given = samples(left)
    run(machine, given[:20])
    arrives_s = given[23].time_s - 1e9
    done = [machine.take(replace(given[23], time_s=given[23].time_s - late_s), arrives_s)]
    done += [machine.silence(arrives_s + 100.0 * k, 1e9 + arrives_s + 100.0 * k) for k in range(1, 6)]
    assert [c.state["z"] for c in done] == states


def test_a_restart_with_a_clock_that_was_set_back_begins_a_new_run() -> None:
    """The saved state is from the future then: without a new run the models would wait for it, as if all were well."""
    *train, left = make_toy_batches(8, 60)
    lines: list[str] = []
    first = Compensator("toy", [model_of(train)], Substitutes.learn(train, INPUTS), left.step_s)
    run(first, samples(left))
    again = Compensator("toy", [model_of(train)], Substitutes.learn(train, INPUTS), left.step_s, lines.append)
    again.restore(json.loads(json.dumps(first.as_plain())))
    early = samples(left, 1e9 - 7200.0)  # the second one agrees with the first
    first_s = early[0].time_s - left.step_s
    earlier = run(again, [replace(early[0], time_s=first_s), *early])[1:]
    whole = run(Compensator("toy", [model_of(train)], Substitutes.learn(train, INPUTS), left.step_s), samples(left))
    assert [c.offset_um["z"] for c in earlier[5:]] == pytest.approx([c.offset_um["z"] for c in whole[5:]], abs=1e-9)
    assert lines and lines[0].endswith("h behind the saved state: a new run begins")


def test_a_restart_keeps_what_was_learned_and_does_not_jump() -> None:
    *train, left = make_toy_batches(8, 60)
    given = samples(left)
    given[20] = replace(given[20], readings_um={"z": 5.0})
    whole = run(Compensator("toy", [model_of(train)], Substitutes.learn(train, INPUTS), left.step_s), given)
    first = Compensator("toy", [model_of(train)], Substitutes.learn(train, INPUTS), left.step_s)
    before = run(first, given[:30])
    again = Compensator("toy", [model_of(train)], Substitutes.learn(train, INPUTS), left.step_s)
    again.restore(json.loads(json.dumps(first.as_plain())))
    after = run(again, given[30:])
    jump = abs(after[0].offset_um["z"] - before[-1].offset_um["z"])
    assert jump < 2.0
    assert [c.offset_um["z"] for c in after[2:]] == pytest.approx([c.offset_um["z"] for c in whole[32:]], abs=1e-9)
    with pytest.raises(InputError, match=r"^state of a compensation: got .* expected .*; delete the file"):
        Compensator("other", [model_of(train)], period_s=left.step_s).restore(first.as_plain())


def test_a_lost_sensor_is_replaced_then_held_then_faded() -> None:
    *train, left = make_toy_batches(8, 120)
    limits = replace(QUICK, hold_s=600.0, stale_s=400.0, rate_um_per_s=0.01)
    machine = Compensator("toy", [model_of(train, limits=limits)], Substitutes.learn(train, INPUTS), left.step_s)
    given = samples(left)
    given[30:] = [replace(s, values={c: v for c, v in s.values.items() if c != "t0"}) for s in given[30:]]
    states = [c.state["z"] for c in run(machine, given)]
    assert states[31] == "active" and {"hold", "fade-out"} <= set(states[31:])
    assert [s for k, s in enumerate(states) if k == 0 or states[k - 1] != s][-1] in ("off", "fade-out")


@pytest.mark.parametrize(("changed", "confirmed"), [(lambda v: v + 15.0, "active"), (lambda v: 1.8 * v + 32.0, "off")])
def test_when_all_channels_jump_the_axis_fades_and_stays_off_until_it_is_confirmed(changed, confirmed) -> None:
    *train, left = make_toy_batches(8, 240)
    limits = replace(QUICK, hold_s=600.0, stale_s=400.0, rate_um_per_s=0.05)
    machine = Compensator("toy", [model_of(train, limits=limits)], Substitutes.learn(train, INPUTS), left.step_s)
    given = samples(left)
    for k in range(60, len(given)):
        values = {c: v if c == "spindle_rpm" else changed(v) for c, v in given[k].values.items()}
        given[k] = replace(given[k], values=values)
    done = run(machine, given[:200])
    assert done[59].state["z"] == "active" and {c.state["z"] for c in done[90:]} == {"off"}
    assert done[-1].state["z"] == "off" and "replaced for more than" in done[-1].reasons["z"]
    steps = np.abs(np.diff([c.offset_um["z"] for c in done]))
    assert steps.max() <= 0.05 * left.step_s + 1e-9
    machine.confirm()
    assert run(machine, given[200:])[-1].state["z"] == confirmed  # in °F two are outside their range


def test_channels_that_were_never_seen_are_named() -> None:
    *train, left = make_toy_batches(8, 20)
    machine = Compensator("toy", [model_of(train)], period_s=left.step_s)
    done = machine.take(Sample(1e9, {"t0": 20.0}), 0.0)
    assert done.offset_um == {"z": 0.0} and "not yet seen: t4, room" in done.reasons["z"]


def test_an_axis_of_another_period_is_refused() -> None:
    with pytest.raises(InputError, match=r"axis z is made for 300 s, got a period of 10 s"):
        Compensator("toy", [model_of(make_toy_batches(4, 20))], period_s=10.0)


TRAIN = make_toy_batches(6, 40)
MODEL = model_of(TRAIN, limits=Limits(rate_um_per_s=0.05, max_offset_um=20.0, stale_s=900.0))
SUBSTITUTES = Substitutes.learn(TRAIN, INPUTS)
ODD = st.one_of(st.floats(allow_nan=True, allow_infinity=True), st.floats(-50, 90), st.none())
HOSTILE = st.lists(
    st.tuples(
        st.floats(-2000.0, 20000.0), st.floats(0.0, 2000.0), st.dictionaries(st.sampled_from(INPUTS), ODD),
        st.dictionaries(st.sampled_from(["z", "q"]), ODD.filter(lambda v: v is not None), max_size=1),
        st.sampled_from(["take", "silence", "restart"]),
    ),
    max_size=30,
)  # fmt: skip


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(HOSTILE)
def test_whatever_comes_what_is_sent_is_finite_and_limited(
    stream: list[tuple[float, float, dict[str, float], dict[str, float], str]],
) -> None:
    machine, clock_s, was = Compensator("toy", [MODEL], SUBSTITUTES, 300.0), 0.0, 0.0
    for jump_s, elapsed_s, values, readings, what in stream:
        clock_s += elapsed_s
        if what == "restart":
            plain = json.loads(json.dumps(machine.as_plain()))
            machine = Compensator("toy", [MODEL], SUBSTITUTES, 300.0)
            machine.restore(plain)
            continue
        time_s = 1e9 + clock_s + jump_s
        done = machine.silence(clock_s, time_s)
        if what == "take":
            first_um = done.offset_um["z"]
            assert abs(first_um - was) <= min(0.05 * 900.0, 1.0) + 1e-9
            was = first_um
            done = machine.take(Sample(time_s, values, readings), clock_s)
        sent_um = done.offset_um["z"]
        assert math.isfinite(sent_um) and abs(sent_um) <= 20.0
        assert abs(sent_um - was) <= min(0.05 * 900.0, 1.0) + 1e-9
        was = sent_um


def test_a_lost_driver_holds() -> None:
    *train, left = make_toy_batches(8, 60)
    machine = Compensator("toy", [model_of(train, "lag_dictionary")], Substitutes.learn(train, INPUTS), left.step_s)
    given = samples(left)
    given[20:] = [replace(s, values={c: v for c, v in s.values.items() if c != "spindle_rpm"}) for s in given[20:]]
    done = run(machine, given)
    assert done[22].state["z"] == "active"
    assert any(c.state["z"] == "hold" and "lost: spindle_rpm" in c.reasons["z"] for c in done[23:])


def along_an_axis(limits: Limits) -> Compensator:
    """Error 2 µm and slope 0.05 µm/mm per K of t0, over 200 mm."""
    train = make_toy_batches(4, 40)
    b = Builder(train[0].channels, 300.0)
    x = b.since_first(b.features(["t0"]))
    program = b.program([b.affine(x, np.array([[2.0]])), b.affine(x, np.array([[0.05]]))], False, "position", 100.0)
    region = Region(  # everywhere
        {"t0": (-1e3, 1e3)}, {"t0": "K"}, (), np.empty(0), np.empty((0, 0)), np.empty(0), np.empty(0)
    )  # fmt: skip
    model = AxisModel(
        "z", program, ("t0",), ("K",), region, region.program(train[0].channels, 300.0), limits=limits, lever_mm=200.0
    )  # fmt: skip
    return Compensator("toy", [model], period_s=300.0)


def test_offset_and_slope_are_each_limited_in_size_and_rate() -> None:
    machine = along_an_axis(replace(QUICK, max_offset_um=11.0, step_um=5.0))
    rises_K = (0, 1, 1, 6, 6, 6)
    done = [machine.take(Sample(1e9 + 300.0 * k, {"t0": 20.0 + r}), 300.0 * k) for k, r in enumerate(rises_K)]
    assert done[2].offset_um["z"] == pytest.approx(-2.0)
    assert [c.slope_um_per_m["z"] for c in done[1:3]] == pytest.approx([-25.0, -50.0])  # 5 µm at 200 mm
    assert done[-1].offset_um["z"] == -11.0  # of -12 wanted
    assert done[-1].slope_um_per_m["z"] == pytest.approx(-55.0)  # 11 µm at 200 mm, of 60 wanted
    steps = np.diff([c.slope_um_per_m["z"] * 0.2 for c in done])
    assert np.abs(steps).max() <= 5.0 + 1e-9


def test_a_slope_fades_with_its_offset_and_survives_a_restart() -> None:
    machine = along_an_axis(replace(QUICK, hold_s=10.0, stale_s=400.0))
    for k in range(3):
        done = machine.take(Sample(1e9 + 300.0 * k, {"t0": 20.0 + min(k, 1)}), 300.0 * k)
    again = along_an_axis(replace(QUICK, hold_s=10.0, stale_s=400.0))
    again.restore(json.loads(json.dumps(machine.as_plain())))
    kept = again.silence(0.0, 1e9)
    assert kept.slope_um_per_m["z"] == done.slope_um_per_m["z"] == pytest.approx(-50.0)
    for k in range(1, 5):
        faded = again.silence(500.0 * k, 1e9)
    assert faded.offset_um["z"] == faded.slope_um_per_m["z"] == 0.0


def test_a_reading_is_refused_outside_its_range_and_where_no_machine_changes_so_much() -> None:
    *train, left = make_toy_batches(8, 60)
    bound = RunBound(1.0, 2.0, (0.25, 0.25), 1.0, 0.05, 1.0, 0.9, 4)
    model, lines = replace(model_of(train), bound=bound, readings_um=(-500.0, 500.0)), list[str]()
    machine = Compensator("toy", [model], period_s=left.step_s, log=lines.append)
    for k, s in enumerate(samples(left)):
        given = {20: 1e6, 21: 1e6, 25: 1e308, 26: 1e308, 30: 90.0, 31: 90.0, 32: math.nan}
        machine.take(replace(s, readings_um={"z": given[k]} if k in given else {}), s.time_s - 1e9)
    assert machine.rejected == len(given) and not any("both count" in line for line in lines)
    assert sum("outside -500 to 500" in line for line in lines) == 5


def test_silence_is_noticed_after_a_few_of_the_streams_own_intervals() -> None:
    *train, left = make_toy_batches(8, 60)
    machine = Compensator("toy", [model_of(train, limits=replace(QUICK, stale_s=900.0))], period_s=left.step_s)
    first, at_s = samples(left)[0], 1e9
    for k in range(60):
        machine.take(replace(first, time_s=at_s + k), float(k))
    assert machine.silence(59.0 + 25.0, at_s).state["z"] == "active"
    assert machine.silence(59.0 + 40.0, at_s).state["z"] == "hold"
