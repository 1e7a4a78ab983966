"""Every check finds its fault at the right channel and time, and says nothing about clean recordings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch, Finding
from data.checks import CHECKS, check_batch, check_machine, checked, usable_channels, why_missing
from data.errors import InputError
from data.machine import Machine, Overrule
from thermodrift.testing import ContractCheck, check_check
from thermodrift.testing.recordings import AIR, STEP_S, STOP_S, THERMAL, toy_batch, toy_machine


def changed(batch: Batch, name: str, values: np.ndarray) -> Batch:
    return replace(batch, table=batch.table.assign(**{name: values}), findings=())


def added(batch: Batch, name: str, first: int, last: int | None, amount: float) -> Batch:
    v = batch.values(name).copy()
    v[first:last] += amount
    return changed(batch, name, v)


def findings(batch: Batch) -> tuple[Finding, ...]:
    return check_batch(batch, toy_machine())


def row_of(batch: Batch, finding: Finding) -> int:
    assert finding.start_s is not None
    return round(finding.start_s / batch.step_s)


def on_the_machine(batches: list[Batch], machine: Machine | None = None) -> list[Batch]:
    machine = machine or toy_machine()
    return check_machine([checked(b, machine) for b in batches], machine)


def masks_of(batches: list[Batch]) -> set[tuple[str, str | None]]:
    return {(f.check, f.channel) for b in batches for f in b.findings if f.masks and not f.overruled}


def the_one(batch: Batch, check: str, channel: str | None) -> Finding:
    """The fault is found, and nothing is claimed of other channels."""
    found = findings(batch)
    assert [f for f in found if f.masks and f.channel != channel] == [], [f.message for f in found]
    hits = [f for f in found if f.check == check and f.channel == channel]
    assert hits, [(f.check, f.message) for f in found]
    return hits[0]


SEEDS = range(6)


@pytest.mark.parametrize("step_s", [pytest.param(60.0, marks=pytest.mark.slow), 300.0])
def test_clean_batches_raise_nothing(step_s: float) -> None:
    machine = toy_machine()
    batches = [toy_batch(seed, step_s) for seed in range(30)]
    batches = [b.with_findings(check_batch(b, machine)) for b in batches]
    told = [f.message for b in check_machine(batches, machine) for f in b.findings]
    assert told == []


@pytest.mark.parametrize("check", [c for key in CHECKS for c in check_check(key, generate_only=True)], ids=str)
def test_contract(check: ContractCheck) -> None:
    check()


def test_the_documentation_has_every_check() -> None:
    text = (Path(__file__).parents[2] / "docs" / "method.md").read_text()
    assert all(check.key == key and f"| `{key}` |" in text for key, check in CHECKS.items())
    with pytest.raises(InputError, match="unknown check 'spyke': did you mean 'spike'"):
        CHECKS["spyke"]


@pytest.mark.parametrize("seed", SEEDS)
def test_a_jump_of_a_sensor_is_masked_to_the_end(seed: int) -> None:
    rng = np.random.default_rng(seed)
    row = int(rng.integers(8, 65))
    name = THERMAL[seed % 5]
    size = float(rng.uniform(5.0, 40.0) * rng.choice([-1, 1]))
    bad = added(toy_batch(seed), name, row, None, size)
    found = the_one(bad, "jump_no_return", name) if abs(size) < 20 else findings(bad)[0]
    assert found.channel == name and abs(row_of(bad, found) - row) <= 1 and found.end_s is None
    masked = bad.with_findings((found,)).masked(name)
    assert np.isnan(masked[row:]).all() and np.isfinite(masked[: row - 1]).all()


@pytest.mark.parametrize("seed", SEEDS)
def test_a_loose_contact_is_masked_until_it_comes_back(seed: int) -> None:
    row = 10 + 8 * seed
    bad = added(toy_batch(seed), "bed", row, row + 6, 12.0)
    found = the_one(bad, "jump_no_return", "bed")
    assert row_of(bad, found) == row and found.end_s == (row + 5) * STEP_S
    assert "comes back at" in found.message


@pytest.mark.parametrize("seed", SEEDS)
def test_a_knocked_probe_is_found_but_not_a_speed_shift(seed: int) -> None:
    row = 20 + 5 * seed
    bad = added(toy_batch(seed), "x", row, None, 40.0)
    assert abs(row_of(bad, the_one(bad, "jump_no_return", "x")) - row) <= 1
    shifted = added(toy_batch(seed), "x", round(STOP_S / STEP_S), None, 12.0)
    assert findings(shifted) == ()


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("name", "size"), [("column", 8.0), ("room", -10.0), ("z", 40.0)])
def test_a_spike_is_masked_alone(seed: int, name: str, size: float) -> None:
    row = 12 + 8 * seed
    bad = added(toy_batch(seed), name, row, row + 1, size)
    found = the_one(bad, "spike", name)
    assert found.start_s == found.end_s == row * STEP_S


@pytest.mark.parametrize("seed", SEEDS)
def test_samples_out_of_range(seed: int) -> None:
    row = 10 + 9 * seed
    bad = added(toy_batch(seed), "rear", row, row + 5, 850.0)
    found = the_one(bad, "out_of_range", "rear")
    assert (found.start_s, found.end_s) == (row * STEP_S, (row + 4) * STEP_S)
    assert "outside -20 to 90" in found.message


@pytest.mark.parametrize("seed", SEEDS)
def test_a_probe_at_its_full_scale(seed: int) -> None:
    row = 20 + 7 * seed
    batch = toy_batch(seed)
    v = batch.values("x").copy()
    v[row:] = 99.9998
    found = the_one(changed(batch, "x", v), "saturated", "x")
    assert found.start_s == row * STEP_S and "full scale 100 um" in found.message


@pytest.mark.parametrize("seed", SEEDS)
def test_frozen_channels(seed: int) -> None:
    batch = toy_batch(seed)
    v = batch.values("z").copy()
    v[30:50] = v[30]
    assert the_one(changed(batch, "z", v), "frozen", "z").start_s == 31 * STEP_S
    t = batch.values("front").copy()
    row = round(STOP_S / STEP_S) + 2
    t[row:] = t[row]  # while the machine cools
    if abs(batch.values("front")[-1] - t[row]) > 4.0:
        assert abs(row_of(batch, the_one(changed(batch, "front", t), "frozen", "front")) - row) <= 2


@pytest.mark.parametrize("seed", SEEDS)
def test_a_dead_sensor(seed: int) -> None:
    batch = toy_batch(seed)
    flat = changed(batch, "front", np.full(batch.n_rows, batch.values("front")[0]))
    if np.median([np.ptp(batch.values(n)) for n in ("rear", "head", "column", "bed", "room")]) > 3.0:
        assert the_one(flat, "dead", "front").start_s is None


@pytest.mark.parametrize("seed", SEEDS)
def test_an_interruption_costs_the_errors_their_zero(seed: int) -> None:
    row = 20 + 6 * seed
    rng = np.random.default_rng(seed)
    bad = toy_batch(seed)
    for name in (*THERMAL, "room"):
        bad = added(bad, name, row, None, float(rng.uniform(3.0, 6.0)))
    found = findings(bad)
    assert {(f.check, f.channel) for f in found} == {("interruption", "x"), ("interruption", "z")}
    assert all(row - 1 <= row_of(bad, f) <= row and f.end_s is None for f in found)
    assert "cannot be tied to the zero" in found[0].message


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("driver", [0.0, np.nan])
def test_errors_held_while_the_spindle_stands(seed: int, driver: float) -> None:
    batch = toy_batch(seed)
    stop = round(STOP_S / STEP_S)
    table = batch.table.copy()
    table.loc[stop:, ["x", "z"]] = table.loc[stop, ["x", "z"]].to_numpy()
    table.loc[stop:, "spindle_rpm"] = driver
    found = findings(replace(batch, table=table))
    assert {(f.check, f.channel) for f in found} == {("error_held", "x"), ("error_held", "z")}
    assert all(f.start_s == (stop + 1) * STEP_S and f.end_s == batch.time_s[-1] for f in found)
    assert "while the spindle stands" in found[0].message


@pytest.mark.parametrize("seed", SEEDS)
def test_wrong_units_name_the_right_one(seed: int) -> None:
    batch = toy_batch(seed)
    kelvin = changed(batch, "head", batch.values("head") + 273.15)
    assert "set unit_in_file: K" in the_one(kelvin, "wrong_unit", "head").message
    warm = batch
    for name in (*THERMAL, "room"):
        warm = changed(warm, name, batch.values(name) - batch.values("room")[0] + 25.0)
    fahrenheit = changed(warm, "bed", warm.values("bed") * 1.8 + 32.0)
    assert "set unit_in_file: degF" in the_one(fahrenheit, "wrong_unit", "bed").message
    exact = batch.values("z") + np.random.default_rng(seed).normal(0, 0.1, batch.n_rows)
    assert "set unit_in_file: mm" in the_one(changed(batch, "z", exact / 1000.0), "wrong_unit", "z").message


def test_gaps_and_repairs_are_told_without_a_mask() -> None:
    batch = toy_batch(0)
    v = batch.values("rear").copy()
    v[20:30] = np.nan
    table = changed(batch, "rear", v).table
    table.loc[40:44, ["x", "z", *THERMAL, "room"]] = np.nan
    found = findings(replace(batch, table=table, repairs={"duplicates": 3, "rows_in": 400}))
    assert [(f.check, f.channel, f.masks) for f in found] == [
        ("gap", None, False),
        ("gap", "rear", False),
        ("clock", None, False),
    ]
    assert "clock: 3 rows with the time of another row" in found[2].message
    assert "rear has no values from 1 h 40 min to 2 h 25 min (50 min)" in found[1].message


def year() -> list[Batch]:
    return [toy_batch(seed) for seed in range(12)]


def test_a_sensor_that_reads_30_K_more_from_some_day_on() -> None:
    batches = [added(b, "head", 0, None, 30.0) if k >= 8 else b for k, b in enumerate(year())]
    machine = toy_machine()
    known = check_machine([b.with_findings(check_batch(b, machine)) for b in batches], machine)
    told = [(k, f.check, f.channel) for k, b in enumerate(known) for f in b.findings]
    assert told == [(k, "offset", "head") for k in range(8, 12)]
    assert np.isnan(known[8].masked("head")).all()
    usable, excluded = usable_channels(known, (*THERMAL, "room"))
    assert usable == ("front", "rear", "column", "bed", "room")
    assert excluded == (
        ("head", "head has no value in 100% of b08 (offset), 100% of b09 (offset), "
                 "100% of b10 (offset) and 1 more; if the values are right, add to overrule: "
                 "- {channel: head, check: offset, reason: ...}"),
    )  # fmt: skip


def test_two_sensors_that_changed_places() -> None:
    batches = year()
    front, column = batches[7].values("front"), batches[7].values("column")
    batches[7] = changed(changed(batches[7], "front", column), "column", front)
    known = check_machine(batches, toy_machine())
    told = [(k, f.check, f.channel) for k, b in enumerate(known) for f in b.findings if f.masks]
    assert told == [(7, "swapped", "front"), (7, "swapped", "column")]


def test_an_air_sensor_is_dead_by_its_own_history() -> None:
    batches = year()
    still = batches[4].values("rear")[0] + 0.1 * np.random.default_rng(0).integers(0, 2, batches[4].n_rows)
    batches[4] = changed(batches[4], "rear", np.round(still, 1))
    known = check_machine(batches, toy_machine())
    assert ("dead", "rear") in [(f.check, f.channel) for f in known[4].findings]
    assert not any(f.masks for k, b in enumerate(known) for f in b.findings if k != 4)


def test_a_drifting_probe_is_odd_but_not_masked() -> None:
    batches = year()
    drift = np.linspace(0, 150.0, batches[5].n_rows)
    batches[5] = changed(batches[5], "x", np.round(batches[5].values("x") + drift))
    known = check_machine(batches, toy_machine())
    told = [(k, f.check, f.channel, f.masks) for k, b in enumerate(known) for f in b.findings]
    assert told == [(5, "unexplained", "x", False)]
    assert np.isfinite(known[5].masked("x")).all()


def heated(batch: Batch, name: str, first: int, level: float) -> Batch:
    """The channel held at a level by a heater from a row on, with a ripple of 0.3 K; it heats up within three rows."""
    v = batch.values(name).copy()
    rows = np.arange(batch.n_rows - first)
    share = np.clip((rows + 1) / 3.0, 0.0, 1.0)
    v[first:] = np.round(v[first:] + share * (level - v[first:]) + 0.3 * np.sin(rows / 3), 1)
    return changed(batch, name, v)


def wide_range() -> Machine:
    machine = toy_machine()
    bed = machine.channels["bed"].model_copy(update={"range": (-20.0, 150.0)})
    return machine.model_copy(update={"channels": {**machine.channels, "bed": bed}})


def test_what_most_runs_show_is_reported_and_not_masked() -> None:
    batches = [heated(b, "bed", 12 + k, 110.0) if k < 8 else b for k, b in enumerate(year())]
    batches[9] = added(batches[9], "head", 30, None, 15.0)
    batches[2] = added(batches[2], "head", 14, None, 15.0)  # as the bed begins
    batches = [replace(b, channels=wide_range().batch_channels()) for b in batches]
    known = on_the_machine(batches, wide_range())
    assert masks_of(known) == {("jump_no_return", "head")}
    (bed,) = [f for f in known[0].findings if f.channel == "bed"]
    assert (bed.check, bed.masks) == ("jump_no_return", False)
    assert "In 8 of 12 runs, so probably the time unit (recording.time.unit: s) or a normal event" in bed.message
    assert "{channel: bed, mask: true, reason: ...}" in bed.message
    assert [b.findings for b in check_machine(known, wide_range())] == [b.findings for b in known]
    # of fewer runs nothing is known in common, and the same batches mask again
    assert masks_of(check_machine(known[:2], wide_range())) == {("jump_no_return", "bed")}


def test_a_loose_contact_in_every_run_stays_a_fault() -> None:
    batches = [added(b, "bed", 20 + k, None, 15.0 if k % 2 else -15.0) for k, b in enumerate(year())]
    known = on_the_machine(batches)
    assert all(np.isnan(b.masked("bed")[40:]).all() for b in known)


def test_a_faulty_sensor_or_unit_in_every_run_stays_a_fault() -> None:
    kelvin = [changed(b, "head", b.values("head") + 273.15) for b in year()]
    assert masks_of(on_the_machine(kelvin)) == {("wrong_unit", "head")}
    tenfold = [changed(b, "head", b.values("head") * 10.0 + 100.0) for b in year()]
    tenfold = on_the_machine(tenfold)
    assert masks_of(tenfold) <= {("out_of_range", "head"), ("wrong_unit", "head")}
    assert all(np.isnan(b.masked("head")).all() for b in tenfold)
    fahrenheit = [at(b, 22.0) for b in year()]
    fahrenheit = [replace(b, table=b.table.assign(**{n: 1.8 * b.table[n] + 32 for n in AIR})) for b in fahrenheit]
    assert masks_of(on_the_machine(fahrenheit)) == {("wrong_unit", n) for n in AIR}
    held = [changed(b, "z", np.where(b.time_s > 2e4, b.values("z")[67], b.values("z"))) for b in year()]
    assert masks_of(on_the_machine(held)) == {("frozen", "z")}


def test_a_bed_that_starts_where_degF_would_put_a_cold_one_is_hot() -> None:
    # 22 degC is 71.6 degF
    batches = [added(b, "bed", 0, None, 71.6 - b.values("bed")[0]) for b in (at(b, 22.0) for b in year())]
    assert [f.check for f in findings(batches[0]) if f.masks] == ["wrong_unit"]  # of one run nobody knows
    known = on_the_machine(batches)
    assert masks_of(known) == set()
    assert "a part that is this hot, or unit_in_file is degF" in known[0].findings[0].message


def at(batch: Batch, start_degC: float) -> Batch:
    move = start_degC - batch.values("room")[0]
    return replace(batch, table=batch.table.assign(**{n: batch.values(n) + move for n in (*THERMAL, "room")}))


@pytest.mark.parametrize("hot", [{3, 7, 10}, {1, 2, 5, 6, 9}])
def test_a_part_that_is_heated_in_some_runs_has_no_offset(hot: set[int]) -> None:
    batches = [added(b, "bed", 0, None, 45.0) if k in hot else b for k, b in enumerate(year())]
    known = on_the_machine(batches)
    assert masks_of(known) == set()
    assert {k for k, b in enumerate(known) if b.findings} == hot
    assert all("not masked" in known[k].findings[-1].message for k in hot)


def test_a_permanent_offset_stays_a_fault_where_other_masks_interrupt_it() -> None:
    batches = [added(b, "head", 0, None, 30.0) if k >= 7 else b for k, b in enumerate(year())]
    for k in (8, 10):
        batches[k] = changed(batches[k], "head", np.full(batches[k].n_rows, 400.0))
    assert masks_of(on_the_machine(batches)) == {("offset", "head"), ("out_of_range", "head")}


def test_a_part_that_starts_warm_and_cools_has_no_offset() -> None:
    batches = year()
    warm = batches[4].values("bed") + 25.0 * np.exp(-batches[4].time_s / 6000.0)
    known = on_the_machine([*batches[:4], changed(batches[4], "bed", np.round(warm, 1)), *batches[5:]])
    assert masks_of(known) == set()
    assert "the part was warm or cold" in known[4].findings[0].message


def test_a_run_much_shorter_than_the_others_is_noted() -> None:
    batches = year()
    batches[6] = replace(batches[6], table=batches[6].table.iloc[:25].reset_index(drop=True))
    known = on_the_machine(batches)
    told = [(k, f.check, f.masks) for k, b in enumerate(known) for f in b.findings]
    assert told == [(6, "short", False)]
    assert "lasts 2 h 00 min, the median run 8 h 00 min" in known[6].findings[0].message


@pytest.mark.parametrize(("start", "words"), [("2199-03-01", "in the future"), ("1980-01-01", "before any logger")])
def test_a_date_that_cannot_be_is_noted(start: str, words: str) -> None:
    (found,) = findings(replace(toy_batch(0), start=pd.Timestamp(start)))
    assert (found.check, found.masks) == ("clock", False) and words in found.message
    assert findings(replace(toy_batch(0), start=pd.Timestamp("2024-03-01"))) == ()


def test_why_a_channel_is_missing_names_check_and_overrule() -> None:
    batch = checked(added(toy_batch(0), "bed", 30, None, 15.0), toy_machine())
    assert why_missing(batch, "bed") == (
        " (masked by jump_no_return; if the values are right, add to overrule: "
        "- {batch: b00, channel: bed, check: jump_no_return, reason: ...})"
    )
    assert why_missing(batch, "rear") == ""


def test_the_machine_file_overrules() -> None:
    rules = [
        Overrule(batch="b0*", channel="bed", check="jump*", reason="sensor was moved on purpose"),
        Overrule(batch="b01", channel="x", mask=True, start_s=600.0, end_s=1200.0, reason="probe touched"),
    ]
    machine = toy_machine(overrule=rules)
    bad = added(toy_batch(0), "bed", 30, None, 15.0)
    batches = [b.with_findings(check_batch(b, machine)) for b in (bad, toy_batch(1))]
    once = check_machine(batches, machine)
    assert [f.overruled for f in once[0].findings] == ["sensor was moved on purpose"]
    assert np.isfinite(once[0].masked("bed")).all()
    assert np.flatnonzero(np.isnan(once[1].masked("x"))).tolist() == [2, 3, 4]
    assert [f.check for f in once[1].findings] == ["user"]
    assert [b.findings for b in check_machine(once, machine)] == [b.findings for b in once]


def test_an_overrule_outside_its_time_leaves_the_mask() -> None:
    machine = toy_machine(overrule=[Overrule(channel="bed", end_s=600.0, reason="early only")])
    bad = added(toy_batch(0), "bed", 30, None, 15.0)
    known = check_machine([bad.with_findings(check_batch(bad, machine))], machine)
    assert np.isnan(known[0].masked("bed")[30:]).all()


def test_a_missing_channel_is_no_input() -> None:
    batch = toy_batch(0)
    lacking = changed(batch, "bed", np.full(batch.n_rows, np.nan))
    usable, excluded = usable_channels([batch, replace(lacking, batch_id="b77")], ("bed", "rear"))
    assert usable == ("rear",) and excluded == (("bed", "bed has no value in 100% of b77 (not recorded)"),)
