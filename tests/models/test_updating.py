"""Updating by rare readings: planted drifts and gains are followed, no row sees a later reading, stream equals run."""

import json
from dataclasses import replace

import numpy as np
import pytest

from data.errors import InputError
from features.design import Design
from models.selection.crossing import Plan, cross_family, prepare
from models.selection.trust import left_out_runs
from models.selection.updating import (
    COLUMNS,
    COUNTS,
    SCHEDULES,
    Readings,
    Schedule,
    Track,
    Updater,
    held_um,
    left_out_tracks,
    out_of_fold,
    scores,
    updated_scores,
)

TIME_S = np.arange(0.0, 6 * 3600 + 1, 300.0)
HOURS = TIME_S / 3600


def tracks(seed: int, runs: int, drift: float = 0.0, gain: float = 0.0, noise: float = 0.1) -> list[Track]:
    """Runs whose residual is a drift (µm/h) and a gain of the first of two inputs, both drawn once a run."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(runs):
        inputs = np.column_stack([1 - np.exp(-HOURS / rng.uniform(0.5, 3)), 0.1 * np.sin(HOURS * rng.uniform(1, 2))])
        predicted_um = 20 * inputs[:, 0]
        residual_um = drift * rng.normal() * HOURS + gain * rng.normal() * inputs[:, 0] + noise * rng.normal(size=73)
        out.append(Track(TIME_S, predicted_um, predicted_um + residual_um - residual_um[0], inputs))
    return out


def rms_um(updater: Updater, judged: list[Track], readings: Readings) -> tuple[float, float]:
    """Without and with readings, over all rows of all runs."""
    done = [t.recorded_um - updater.run(t, readings.rows(TIME_S, TIME_S >= 0), updater.begin()).corrected_um
            for t in judged]  # fmt: skip
    free = np.concatenate([t.residual_um for t in judged])
    return float(np.sqrt(np.mean(free**2))), float(np.sqrt(np.mean(np.concatenate(done) ** 2)))


@pytest.mark.parametrize("plant", [{"drift": 3.0}, {"gain": 8.0}])
def test_one_reading_tells_a_planted_drift_or_gain_for_the_hours_to_come(plant) -> None:
    updater = Updater.learn(tracks(1, 20, **plant))
    free_um, updated_um = rms_um(updater, tracks(2, 20, **plant), SCHEDULES["one a shift"])
    assert updated_um < 0.25 * free_um


def heavy_tailed(seed: int, runs: int, back: float = 0.0) -> list[Track]:
    """Runs whose residual saturates or, by `back`, returns to 0; its size is of heavy tails."""
    rng = np.random.default_rng(seed)
    out = []
    for track in tracks(seed, runs):
        shape = -np.expm1(-HOURS / rng.uniform(0.3, 2.0)) * np.exp(-back * HOURS)
        residual_um = 2 * rng.standard_t(3) * shape + np.cumsum(0.1 * rng.normal(size=73))
        out.append(replace(track, recorded_um=track.predicted_um + residual_um - residual_um[0]))
    return out


@pytest.mark.parametrize("schedule", [Readings(), 2, Readings(3600.0, 3600.0), 8])
def test_readings_serve_as_well_as_none_and_as_the_last_one_held(schedule: Schedule) -> None:
    done = [serving(schedule, seed) for seed in range(8)]
    _, S_um, held_S_um, free_S_um, inside = np.concatenate(done, axis=1)
    for other_um in (held_S_um, free_S_um):
        more_um = S_um - other_um
        assert more_um.mean() <= more_um.std(ddof=1) / np.sqrt(len(more_um))
    assert 0.85 <= inside.mean() <= 0.95


def test_one_reading_of_a_residual_that_returns_to_0_does_not_harm() -> None:
    _, S_um, held_S_um, free_S_um, _ = np.concatenate([serving(Readings(), s, 1.0) for s in range(8)], axis=1)
    more_um = S_um - free_S_um
    assert S_um.mean() < held_S_um.mean() and more_um.mean() <= more_um.std(ddof=1) / np.sqrt(len(more_um))


@pytest.mark.parametrize("minutes", [0.0, 10.0])
@pytest.mark.parametrize("schedule", [Readings(), Readings(3600.0, 3600.0)])
def test_readings_of_a_residual_that_does_not_last_change_nothing(minutes: float, schedule: Schedule) -> None:
    """A residual that is forgotten within minutes says nothing of the hours after it."""
    keep = np.exp(-5.0 / minutes) if minutes else 0.0

    def run(rng: np.random.Generator) -> Track:
        residual_um = np.zeros(73)
        for k in range(1, 73):
            residual_um[k] = keep * residual_um[k - 1] + 3.0 * np.sqrt(1 - keep**2) * rng.normal()
        return Track(TIME_S, 10 * HOURS, 10 * HOURS + residual_um, HOURS[:, None] / 6)

    rng, done = np.random.default_rng(7), []
    for _ in range(8):
        updater = Updater.learn([run(rng) for _ in range(12)])
        done += [scores(updater, run(rng), schedule) for _ in range(8)]
    _, S_um, held_S_um, free_S_um, _ = np.array(done).T
    more_um = S_um - free_S_um
    assert held_S_um.mean() > 1.2 * free_S_um.mean(), "the residual lasts"
    assert more_um.mean() <= max(more_um.std(ddof=1) / np.sqrt(len(more_um)), 1e-3 * free_S_um.mean())


def serving(schedule: Schedule, seed: int, back: float = 0.0) -> np.ndarray:
    """`scores` (5, 8) of eight runs by an updater of sixteen others."""
    updater = Updater.learn(heavy_tailed(100 + seed, 16, back))
    return np.array([scores(updater, track, schedule) for track in heavy_tailed(200 + seed, 8, back)]).T


def test_two_training_runs_leave_it_near_the_last_residual_held() -> None:
    updater, judged = Updater.learn(tracks(1, 2)), heavy_tailed(2, 50)
    S_um, held_S_um = np.array([scores(updater, track, 2)[1:3] for track in judged]).mean(axis=0)
    assert S_um < 1.05 * held_S_um


def test_the_wider_of_all_runs_and_the_latest_sets_the_band() -> None:
    calm, wild = tracks(1, 12, noise=0.1), tracks(2, 4, noise=1.0)
    sd_um = [Updater.learn(some).variance_um2["noise"] for some in ([*wild, *calm], [*calm, *wild])]
    assert sd_um[1] > 1.5 * sd_um[0]


def test_a_row_uses_only_readings_before_it() -> None:
    updater, track = Updater.learn(tracks(1, 10, 2.0)), tracks(2, 1, 2.0)[0]
    rows = SCHEDULES["one reading an hour"].rows(TIME_S, TIME_S >= 0)
    corrected_um = updater.run(track, rows, updater.begin()).corrected_um
    np.testing.assert_array_equal(corrected_um[: rows[0] + 1], track.predicted_um[: rows[0] + 1])
    assert (corrected_um[rows[0] + 1 :] != track.predicted_um[rows[0] + 1 :]).all()
    later = track.recorded_um.copy()
    later[rows[1] :] += 50.0
    later[np.setdiff1d(np.arange(73), rows)] = np.nan
    other_um = updater.run(replace(track, recorded_um=later), rows, updater.begin()).corrected_um
    np.testing.assert_array_equal(other_um[: rows[1] + 1], corrected_um[: rows[1] + 1])


def test_row_by_row_equals_the_run_also_with_holes() -> None:
    updater, track = Updater.learn(tracks(1, 10, 2.0, 4.0)), tracks(2, 1, 2.0, 4.0)[0]
    predicted_um, inputs = track.predicted_um.copy(), track.inputs.copy()
    predicted_um[[0, 1, 30]], inputs[40, 1] = np.nan, np.nan
    track = replace(track, predicted_um=predicted_um, inputs=inputs)
    rows = np.array([12, 30, 50, 72])  # nothing was predicted at row 30
    whole, state, done = updater.run(track, rows, updater.begin()), updater.begin(), []
    for i in range(73):
        read_um = track.recorded_um[i] if i in rows else np.nan
        corrected_um, sd_um, state = updater.step(state, TIME_S[i], predicted_um[i], inputs[i], read_um)
        done.append((corrected_um, sd_um))
    np.testing.assert_allclose(np.array(done), np.column_stack([whole.corrected_um, whole.sd_um]), atol=1e-9)
    np.testing.assert_allclose(state.cov, whole.state.cov, atol=1e-9)
    assert np.isnan(done[30]).all() and whole.corrected_um[2] == predicted_um[2]


def test_a_reading_due_in_a_hole_is_taken_behind_it_unless_the_next_is_due() -> None:
    known = np.ones(73, bool)
    known[11:15] = False
    known[23:40] = False
    rows = SCHEDULES["one reading an hour"].rows(TIME_S, known)
    assert rows.tolist() == [15, 40, 48, 60]
    assert SCHEDULES["one a shift"].rows(TIME_S, known).tolist() == [15]
    assert SCHEDULES["one a shift"].rows(TIME_S[:10], known[:10]).tolist() == []
    assert Readings.evenly(2, TIME_S[-1]).rows(TIME_S, TIME_S >= 0).tolist() == [24, 48]


def test_plain_and_back() -> None:
    updater = Updater.learn(tracks(1, 5, 2.0))
    assert Updater.from_plain(json.loads(json.dumps(updater.as_plain()))) == updater
    earlier = {"n_inputs": 2, "variance_um2": {"drift": 4, "gain": 1, "walk": 0.3, "offset": 0.1, "noise": 0.02}}
    assert Updater.from_plain(earlier).as_plain() == earlier


def drifting(toy_batches, k: int):
    """Batches whose z drifts away by a rate of its own in each."""
    rng = np.random.default_rng(5)
    out = []
    for batch in toy_batches(k):
        table = batch.table.assign(z=batch.table["z"] + 4.0 * rng.normal() * batch.time_s / 3600)
        out.append(replace(batch, table=table))
    return out


def test_scores_of_a_cell_by_schedule(toy_batches) -> None:
    crossing = prepare(
        drifting(toy_batches, 10), "z", Plan(("correlation",), ("ridge", "zero"), ("forward",), n_tsps=(3,))
    )
    scored = cross_family(crossing, "ridge")
    curves = left_out_runs(crossing, ("correlation", "ridge", 3), scored.predictions).curves
    found = updated_scores(crossing, "correlation", "ridge", 3, curves)
    assert list(found) == COLUMNS and set(found["schedule"]) == {*SCHEDULES, *(f"{n} evenly" for n in COUNTS)}
    curve = found[~found["schedule"].isin(SCHEDULES)].groupby("n_readings")["S_um"].mean()
    assert curve.index.tolist() == [0, 1, 2, 4, 8] and (np.diff(curve) < 0).all()
    found = found[found["schedule"].isin(SCHEDULES)]
    assert found.groupby("schedule")["n_readings"].first().to_dict() == {"one reading an hour": 4, "one a shift": 1}
    free = scored.scores.set_index("batch_id")["S_um"]
    hourly = found[found["schedule"] == "one reading an hour"].set_index("batch_id")
    np.testing.assert_allclose(hourly["free_S_um"], free[hourly.index], rtol=1e-6)  # kept as float32
    assert hourly["S_um"].mean() < 0.5 * hourly["free_S_um"].mean()
    assert hourly["coverage90"].between(0.5, 1.0).all()


def test_the_last_residual_is_held_until_the_next_reading() -> None:
    time_s = np.arange(6) * 60.0
    track = Track(time_s, np.zeros(6), np.array([0.0, 1.0, 2.0, 3.0, 4.0, 5.0]), np.zeros((6, 1)))
    np.testing.assert_array_equal(held_um(track, np.array([1, 4])), [0, 0, 1, 1, 1, 4])


def test_training_runs_are_predicted_from_the_runs_before_them(toy_batches) -> None:
    batches = toy_batches(7)
    design = Design.build(batches, ("t0", "t4"), "z")
    changed = Design.build([*batches[:-1], drifting(toy_batches, 7)[-1]], ("t0", "t4"), "z")
    one, other = (out_of_fold(d, "ridge", range(7)) for d in (design, changed))
    assert len(one) == len(other) == 4
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.predicted_um, b.predicted_um)


def test_what_cannot_be_learned_is_refused_in_one_line(toy_batches) -> None:
    with pytest.raises(InputError, match=r"got 1 run\(s\) with known residuals, need at least 2"):
        Updater.learn(tracks(1, 1))
    with pytest.raises(InputError, match=r"readings: got first_s=0\.0"):
        Readings(0.0)


def test_the_updater_for_runs_to_come_knows_all_left_out_runs(toy_batches) -> None:
    crossing = prepare(drifting(toy_batches, 8), "z", Plan(("correlation",), ("ridge",), ("forward",), n_tsps=(3,)))
    scored = cross_family(crossing, "ridge")
    curves = left_out_runs(crossing, ("correlation", "ridge", 3), scored.predictions).curves
    known = left_out_tracks(crossing.subset(crossing.inputs("correlation", crossing.everything, 3)), curves)
    assert len(known) == sum(len(f.test) for f in crossing.folds["forward"])
    updater = Updater.learn(known)
    assert updater.variance_um2["drift"] > updater.variance_um2["noise"] and updater.n_inputs == 3
