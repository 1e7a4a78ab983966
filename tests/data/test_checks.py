"""Every check finds its fault at the right channel and time, and says nothing about clean recordings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch, Channel, Finding
from data.checks import CHECKS, check_batch, check_machine, checked, usable_channels, why_missing
from data.checks.across_batches import Copied
from data.errors import InputError
from data.machine import Machine, Overrule, parse_machine
from tests.toys.recordings import AIR, STEP_S, STOP_S, THERMAL, toy_batch, toy_machine


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
    known = checked_year() if machine is None else {}
    machine = machine or toy_machine()
    return check_machine([known.get(id(b)) or checked(b, machine) for b in batches], machine)


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
    known = on_the_machine([toy_batch(seed, step_s) for seed in range(30)])
    assert [f.message for b in known for f in b.findings] == []


def test_the_documentation_has_every_check() -> None:
    text = (Path(__file__).parents[2] / "docs" / "method.md").read_text()
    assert all(f"| `{key}` |" in text for key in CHECKS)
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


def held(batch: Batch, name: str, first: int, last: int | None, value: float | None = None) -> Batch:
    """The channel at one value, by default that of the first row."""
    v = batch.values(name).copy()
    v[first:last] = v[first] if value is None else value
    return changed(batch, name, v)


FAULTS = [  # channel, first row, rows later with each seed, rows of the fault, its size, check, words
    ("bed", 10, 8, 6, 12.0, "jump_no_return", "comes back at"),  # a loose contact
    ("x", 20, 5, None, 40.0, "jump_no_return", "does not return"),  # a knocked probe
    ("column", 12, 8, 1, 8.0, "spike", "off the samples around it"),
    ("room", 12, 8, 1, -10.0, "spike", "off the samples around it"),
    ("z", 12, 8, 1, 40.0, "spike", "off the samples around it"),
    ("rear", 10, 9, 5, 850.0, "out_of_range", "outside -20 to 90"),
]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("name", "first", "later", "rows", "size", "check", "words"), FAULTS)
def test_a_fault_is_found_where_it_is(
    seed: int, name: str, first: int, later: int, rows: int | None, size: float, check: str, words: str
) -> None:
    row = first + later * seed
    bad = added(toy_batch(seed), name, row, None if rows is None else row + rows, size)
    found = the_one(bad, check, name)
    assert abs(row_of(bad, found) - row) <= (rows is None) and words in found.message
    assert found.end_s == (None if rows is None else (row + rows - 1) * STEP_S)


@pytest.mark.parametrize("seed", SEEDS)
def test_values_that_stand_still(seed: int) -> None:
    row, batch = 20 + 7 * seed, toy_batch(seed)
    found = the_one(held(batch, "x", row, None, 99.9998), "saturated", "x")
    assert found.start_s == row * STEP_S and "full scale 100 um" in found.message
    assert the_one(held(batch, "z", 30, 50), "frozen", "z").start_s == 31 * STEP_S
    row, v = round(STOP_S / STEP_S) + 2, batch.values("front")  # while the machine cools
    if abs(v[-1] - v[row]) > 4.0:
        assert abs(row_of(batch, the_one(held(batch, "front", row, None), "frozen", "front")) - row) <= 2


@pytest.mark.parametrize("seed", SEEDS)
def test_a_speed_shift_is_no_fault(seed: int) -> None:
    assert findings(added(toy_batch(seed), "x", round(STOP_S / STEP_S), None, 12.0)) == ()


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


@cache
def year() -> tuple[Batch, ...]:
    return tuple(toy_batch(seed) for seed in range(12))


@cache
def checked_year() -> dict[int, Batch]:
    """Each run of `year` checked on its own, by its id: most tests change one of them or leave some as they are."""
    return {id(b): checked(b, toy_machine()) for b in year()}


def test_a_sensor_that_reads_30_K_more_from_some_day_on() -> None:
    batches = [added(b, "head", 0, None, 30.0) if k >= 8 else b for k, b in enumerate(year())]
    known = on_the_machine(batches)
    assert told(known) == [(k, "offset", "head", True) for k in range(8, 12)]
    assert np.isnan(known[8].masked("head")).all()
    usable, excluded = usable_channels(known, (*THERMAL, "room"))
    assert usable == ("front", "rear", "column", "bed", "room")
    assert excluded == (
        ("head", "head has no value in 100% of b08 (offset), 100% of b09 (offset), "
                 "100% of b10 (offset) and 1 more; if the values are right, add to overrule: "
                 "- {channel: head, check: offset, reason: ...}"),
    )  # fmt: skip


def told(batches: list[Batch]) -> list[tuple[int, str, str | None, bool]]:
    return [(k, f.check, f.channel, f.masks) for k, b in enumerate(batches) for f in b.findings]


def still_rear(b: Batch) -> Batch:
    values = b.values("rear")[0] + 0.1 * np.random.default_rng(0).integers(0, 2, b.n_rows)
    return changed(b, "rear", np.round(values, 1))


def swapped(b: Batch) -> Batch:
    return changed(changed(b, "front", b.values("column")), "column", b.values("front"))


ODD: dict[str, tuple[int, Callable[[Batch], Batch], list[tuple[str, str | None, bool]], str]] = {
    "two sensors that changed places": (7, swapped, [("swapped", n, True) for n in ("front", "column")], "behaves as"),
    "a sensor dead by its own history": (4, still_rear, [("dead", "rear", True)], "rear moves by"),
    "a probe that drifts, not masked": (
        5, lambda b: changed(b, "x", np.round(b.values("x") + np.linspace(0, 150.0, b.n_rows))),
        [("unexplained", "x", False)], "a ridge model of the other batches",
    ),
    "a part that starts warm and cools": (
        4, lambda b: changed(b, "bed", np.round(b.values("bed") + 25.0 * np.exp(-b.time_s / 6000.0), 1)),
        [("offset", "bed", False), ("unexplained", "z", False)], "the part was warm or cold",
    ),
    "a run much shorter than the others": (
        6, lambda b: replace(b, table=b.table.iloc[:25].reset_index(drop=True)),
        [("short", None, False)], "lasts 2 h 00 min, the median run 8 h 00 min",
    ),
}  # fmt: skip


def cell_run(seed: int, exchanged: bool = False) -> Batch:
    """A cell that is discharged in steps of another order in each run."""
    rng, base = np.random.default_rng(seed), toy_batch(seed)
    current = -np.repeat(rng.permutation([0.0, 1.0, 2.0, 5.0, 0.0, 3.0]), 20)[: base.n_rows]
    current = np.pad(current, (0, base.n_rows - len(current)))
    voltage = 4.1 + 0.05 * current - 0.6 * np.linspace(0.0, 1.0, base.n_rows)
    series = {"current": voltage, "voltage": current} if exchanged else {"current": current, "voltage": voltage}
    drivers = {n: Channel(n, "driver", unit) for n, unit in (("current", "A"), ("voltage", "V"))}
    return replace(base, table=base.table.assign(**series), channels={**base.channels, **drivers})


def test_two_drivers_that_changed_places_in_one_run() -> None:
    runs = [cell_run(seed, exchanged=seed == 3) for seed in range(6)]
    found = CHECKS["swapped"]().across(runs, toy_machine())
    assert [(k, [f.channel for f in own]) for k, own in found.items()] == [(3, ["current", "voltage"])]
    assert "current behaves as voltage does in the other batches" in found[3][0].message
    assert not CHECKS["swapped"]().across([cell_run(seed) for seed in range(6)], toy_machine())


def test_switches_that_other_runs_used_otherwise_have_not_changed_places() -> None:
    def run(seed: int) -> Batch:
        rng, base = np.random.default_rng(seed), toy_batch(seed)
        on = {"coolant": 0 if seed in (2, 5) else 1, "mist": 1 if seed in (2, 5) else 0}
        switches = {n: np.where(rng.random(base.n_rows) < 0.6, share, 0) for n, share in on.items()}
        speeds = np.repeat(rng.choice([0, 2000, 4000, 8000], base.n_rows // 10 + 1), 10)[: base.n_rows]
        feeds = speeds * 0.8 if seed != 4 else np.zeros(base.n_rows)
        series = {**switches, "speed": speeds, "feed": feeds}
        drivers = {n: Channel(n, "driver", "1") for n in series}
        return replace(base, table=base.table.assign(**series), channels={**base.channels, **drivers})

    assert not CHECKS["swapped"]().across([run(seed) for seed in range(8)], toy_machine())


@pytest.mark.parametrize("what", ODD)
def test_one_run_that_is_unlike_the_others(what: str) -> None:
    odd, change, expected, words = ODD[what]
    known = on_the_machine([change(b) if k == odd else b for k, b in enumerate(year())])
    assert told(known) == [(odd, *found) for found in expected]
    assert words in known[odd].findings[0].message


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
    assert masks_of(on_the_machine([held(b, "z", 67, None) for b in year()])) == {("frozen", "z")}


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
    once = on_the_machine([added(toy_batch(0), "bed", 30, None, 15.0), toy_batch(1)], machine)
    assert [f.overruled for f in once[0].findings] == ["sensor was moved on purpose"]
    assert np.isfinite(once[0].masked("bed")).all()
    assert np.flatnonzero(np.isnan(once[1].masked("x"))).tolist() == [2, 3, 4]
    assert [f.check for f in once[1].findings] == ["user"]
    assert [b.findings for b in check_machine(once, machine)] == [b.findings for b in once]


def test_an_overrule_outside_its_time_leaves_the_mask() -> None:
    machine = toy_machine(overrule=[Overrule(channel="bed", end_s=600.0, reason="early only")])
    known = on_the_machine([added(toy_batch(0), "bed", 30, None, 15.0)], machine)
    assert np.isnan(known[0].masked("bed")[30:]).all()


def test_a_missing_channel_is_no_input() -> None:
    batch = toy_batch(0)
    lacking = changed(batch, "bed", np.full(batch.n_rows, np.nan))
    usable, excluded = usable_channels([batch, replace(lacking, batch_id="b77")], ("bed", "rear"))
    assert usable == ("rear",) and excluded == (("bed", "bed has no value in 100% of b77 (not recorded)"),)


ONE_SENSOR = parse_machine("{machine: toy, channels: {t0: {role: temperature, unit: degC}}}", "test")


def part(batch: Batch, rows: slice, batch_id: str) -> Batch:
    table = batch.table.iloc[rows].reset_index(drop=True)
    table["time_s"] -= table["time_s"].iloc[0]
    return replace(batch, batch_id=batch_id, table=table, start=pd.Timestamp("2026-01-01"))


@pytest.mark.parametrize(("rows", "n"), [(slice(7, None), 53), (slice(0, 30), 30), (slice(0, 60), 60)])
def test_a_part_of_another_batch_is_found(rows: slice, n: int, toy_batches: Callable[..., list[Batch]]) -> None:
    batches = toy_batches()
    found = Copied().across([*batches, part(batches[2], rows, "copy")], ONE_SENSOR)
    (finding,) = found.pop(len(batches))
    assert not found and not finding.masks and finding.channel is None
    assert finding.message.startswith(f"{n} of {n} rows, from 0 min to ") and "as batch b02:" in finding.message
    assert "`thermodrift lake withdraw toy copy --reason TEXT`" in finding.message


def test_a_run_that_is_exported_with_the_next_one(toy_batches: Callable[..., list[Batch]]) -> None:
    a, b, *others = toy_batches()
    both = replace(a, batch_id="both", table=pd.concat([a.table, b.table.assign(time_s=b.time_s + 18000)]))
    (finding,) = Copied().across([*others, b, both], ONE_SENSOR)[len(others) + 1]
    assert (finding.start_s, finding.end_s) == (18000.0, float(18000 + b.time_s[-1]))


def test_machines_at_rest_and_small_differences_are_no_copies(toy_batches: Callable[..., list[Batch]]) -> None:
    batches = toy_batches()
    at_rest = [replace(b, table=b.table.assign(**dict.fromkeys(b.channels, 20.0))) for b in batches[:2]]
    noisy = replace(batches[2], table=batches[2].table + 1e-9 * np.arange(60)[:, None])
    assert Copied().across([*batches, *at_rest, noisy], ONE_SENSOR) == {}
    assert (
        Copied().across([], ONE_SENSOR) == {}
        and Copied().across([part(batches[0], slice(0, 9), "a")], ONE_SENSOR) == {}
    )
