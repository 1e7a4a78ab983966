"""Run plans: stages and tables to a time grid, and every mistake told in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from data.errors import InputError
from data.machine import Machine, load_machine, parse_machine
from twin.run_plan import RunPlan, load_run_plan

ROOT = Path(__file__).parents[2]
MACHINE = """
machine: m1
recording: {time: {column: stamp, unit: timestamp}, max_gap_s: 300}
channels:
  bed: {role: temperature, unit: degC}
  room: {role: ambient, unit: degC, range: [-20, 50]}
  spindle_rpm: {role: driver, unit: rpm, column: "S 1", range: [0, 8000]}
  coolant: {role: driver, unit: "1", range: [0, 1]}
  pos_x: {role: position, unit: mm, range: [-500, 500]}
twin: {surroundings: {room: {channel: room}, floor: {value: 17 degC}}, bodies: {bed: {}, column: {}}}
"""
GOOD = "stages: [{hours: 1, spindle_rpm: 4000}]\nsurroundings: {room: 20 degC}\n"


@pytest.fixture(scope="module")
def machine() -> Machine:
    return parse_machine(MACHINE, "m1.yml")


def plan(tmp_path: Path, machine: Machine, text: str, name: str = "plan.yml") -> RunPlan:
    (tmp_path / name).write_text(text, encoding="utf-8")
    return load_run_plan(tmp_path / name, machine)


def fault(tmp_path: Path, machine: Machine, text: str, name: str = "plan.yml") -> str:
    with pytest.raises(InputError) as caught:
        plan(tmp_path, machine, text, name)
    said = str(caught.value)
    assert said.startswith("run plan ") and name in said and "\n" not in said
    return said


def test_stages_hold_and_a_driver_keeps_its_value(tmp_path: Path, machine: Machine) -> None:
    p = plan(
        tmp_path, machine,
        "step: 1 min\nstages:\n  - {minutes: 5, spindle_rpm: 0}\n"
        "  - repeat: 2\n    stages:\n      - {hours: 1, spindle_rpm: 4 krpm, coolant: on}\n"
        "      - {minutes: 30, spindle_rpm: 0}\nsurroundings: {room: 68 degF, floor: 290.15 K}\n",
    )  # fmt: skip
    assert p.name == "plan" and p.step_s == 60 and p.time_s[-1] == 60 * 185
    assert np.array_equal(p.time_s, 60.0 * np.arange(186)) and p.on_step.all()
    rpm, coolant = p.drivers["spindle_rpm"], p.drivers["coolant"]
    assert np.array_equal(np.flatnonzero(rpm == 4000), np.r_[5:65, 95:155]) and set(rpm) == {0, 4000}
    assert np.array_equal(np.flatnonzero(coolant), np.arange(5, 185)) and not p.drivers["pos_x"].any()
    assert np.allclose(p.surroundings["room"], 20.0, atol=1e-12) and p.surroundings["room"].shape == (186,)
    assert np.allclose(p.surroundings["floor"], 17.0, atol=1e-12)
    assert p.start_degC("bed") == p.initial_degC == pytest.approx(20.0)


def test_borders_stand_on_the_grid_and_the_regular_rows_are_told(tmp_path: Path, machine: Machine) -> None:
    stages = "[{seconds: 25, spindle_rpm: 1000}, {seconds: 0.5, spindle_rpm: 2000}, {hours: 0, minutes: 1}]"
    assert "hours: got 0, expected more than 0" in fault(
        tmp_path, machine, GOOD.replace(GOOD.split("\n")[0], f"stages: {stages}")
    )
    p = plan(tmp_path, machine, f"stages: {stages.replace('hours: 0, ', '')}\nsurroundings: {{room: 20}}")
    assert p.time_s.tolist() == [0, 10, 20, 25, 25.5, 30, 40, 50, 60, 70, 80, 85.5]
    assert p.drivers["spindle_rpm"].tolist() == [1000] * 3 + [2000] * 8
    assert p.time_s[p.on_step].tolist() == list(range(0, 90, 10))
    assert p.time_s[-1] - p.time_s[0] == pytest.approx(85.5)


def test_durations_of_one_stage_add_up(tmp_path: Path, machine: Machine) -> None:
    p = plan(tmp_path, machine, "stages: [{hours: 1, minutes: 30, seconds: 5}]\nsurroundings: {room: 20}")
    assert p.time_s[-1] == 5405 and not p.drivers["spindle_rpm"].any()


def test_surroundings_drift_ripple_points_and_a_file(tmp_path: Path, machine: Machine) -> None:
    (tmp_path / "room.csv").write_text("time_min,note,room [degF]\n0,a,50\n60,b,\n60.5,b,59\n119,c,68\n")
    p = plan(
        tmp_path, machine,
        "step: 5 min\nstages: [{hours: 2, spindle_rpm: 0}]\nsurroundings:\n"
        "  room: {start: 20 degC, drift: 0.4 K/h, ripple: 0.3 K, period: 20 min}\n"
        "  floor: [[0, 15], [1 h, 16 degC], [1.5, 14]]\n",
    )  # fmt: skip
    t = p.time_s
    assert np.allclose(p.surroundings["room"], 20 + 0.4 * t / 3600 + 0.3 * np.sin(2 * np.pi * t / 1200))
    assert p.surroundings["floor"][[0, 6, 12, 15, 18, 24]] == pytest.approx([15, 15.5, 16, 15, 14, 14])
    p = plan(tmp_path, machine, "stages: [{hours: 2}]\nsurroundings: {room: {file: room.csv}}")
    at = np.searchsorted(p.time_s, [0, 1815, 3630, 7140, 7200])
    assert p.surroundings["room"][at] == pytest.approx([10, 12.5, 15, 20, 20], abs=0.02)


def test_start_of_bodies(tmp_path: Path, machine: Machine) -> None:
    p = plan(tmp_path, machine, GOOD + "start: {bed: 64.4 degF}")
    assert p.start_degC("bed") == pytest.approx(18.0) and p.start_degC("column") == 20.0
    assert plan(tmp_path, machine, GOOD + "start: 21.5").start_degC("column") == 21.5
    no_room = "stages: [{hours: 1}]\n"
    assert plan(tmp_path, machine, no_room + "start: 19 degC").initial_degC == 19.0
    assert "start: bodies are at the room's first value, and no surrounding is given; add" in fault(
        tmp_path, machine, no_room
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("stags: []\n" + GOOD, "unknown key 'stags'; did you mean 'stages'?"),
        (GOOD.replace("spindle_rpm", "spindel_rpm"), "stage 1: unknown key 'spindel_rpm'; did you mean 'spindle_rpm'?"),
        (GOOD.replace("4000", "4 kW"), "stage 1: spindle_rpm: 'kW' is a power and cannot become 'rpm', a rotation"),
        (GOOD.replace("4000", "4 krmp"), "stage 1: spindle_rpm: unknown unit 'krmp'; did you mean 'krpm'?"),
        (GOOD.replace("4000", "9 krpm"), "9000 rpm is outside the channel's range 0 to 8000 rpm; correct"),
        (GOOD.replace("4000", "fast"), "got 'fast', expected a number in rpm or with a unit, e.g. '1 rpm'"),
        (GOOD.replace("4000", ".nan"), "got nan, expected a finite number in rpm"),
        (GOOD.replace("4000", "true"), "spindle_rpm: got True, expected a number in rpm"),
        (GOOD.replace("hours: 1", "hours: -1"), "stage 1: hours: got -1, expected more than 0"),
        (GOOD.replace("hours: 1, ", ""), "stage 1: no duration; add hours, minutes or seconds"),
        (GOOD.replace("hours: 1", "hours: 9000"), "lasts 375 days, expected at most a year; split the plan"),
        ("step: 1 ms\n" + GOOD.replace("hours: 1", "hours: 2"), "7.2e+06 steps of 0.001 s, expected at most 5,000,000"),
        ("step: 0 s\n" + GOOD, "step: got '0 s', expected more than 0 s"),
        ("step: 3 K\n" + GOOD, "step: 'K' is a temperature and cannot become 's', a time"),
        ("stages: []", "key 'stages': got []; List should have at least 1 item"),
        ("stages: [{repeat: 0, stages: [{hours: 1}]}]", "stage 1: repeat: got 0, expected a whole number from 1"),
        ("stages: [{repeat: 2}]", "stage 1: repeat needs a list of stages"),
        ("stages: [{repeat: 2, hours: 1, stages: [{hours: 1}]}]", "unknown key 'hours' next to repeat"),
        ("stages: [{repeat: 2, stages: [{hours: 1}, {hour: 1}]}]", "stage 1.2: unknown key 'hour'; did you mean"),
        ("stages: [{repeat: 999999999, stages: [{seconds: 1}]}]", "expected at most a year"),
        ("stages: &a [{repeat: 2, stages: *a}]", "line 1: not valid YAML (alias *a contains itself; write its values"),
        ("stages: " + 9 * "[{repeat: 1, stages: " + "[]" + 9 * "}]", "more than 8 levels or 100000 stages"),
        (GOOD.replace("room", "rom"), "unknown surrounding 'rom'; did you mean 'room'? Allowed: floor, room"),
        (GOOD.replace("20 degC", "20 bar"), "surroundings.room: 'bar' is a pressure and cannot become 'degC'"),
        (GOOD.replace("20 degC", "60 degC"), "60 degC is outside the channel's range -20 to 50 degC"),
        (GOOD.replace("20 degC", "{start: 20, drfit: 1}"), "room: unknown key 'drfit'; did you mean 'drift'?"),
        (GOOD.replace("20 degC", "{drift: 1 K/h}"), "key 'start' is missing; write e.g. start: 20 degC"),
        (GOOD.replace("20 degC", "{start: 20, ripple: 1 K}"), "key 'period' is missing; a ripple needs"),
        (GOOD.replace("20 degC", "{start: 20, ripple: 1 K, period: 0}"), "period: got 0, expected more than 0 min"),
        (GOOD.replace("20 degC", "{start: 20, drift: 1 K}"), "drift: got '1 K', expected a rate such as '0.4 K/h'"),
        (GOOD.replace("20 degC", "[[0, 20], [2, 21], [2, 22]]"), "room point 3: 2 h is not after 2 h; put the points"),
        (GOOD.replace("20 degC", "[[0, 20], 5]"), "room point 2: got 5, expected [hours, degC], e.g. [0, 20]"),
        (GOOD.replace("20 degC", "[]"), "got an empty list"),
        (GOOD.replace("20 degC", "{file: none.csv}"), "none.csv: no such file; give the path of a CSV file"),
        (GOOD + "start: {bde: 3}", "start: unknown body 'bde'; did you mean 'bed'? Allowed: bed, column"),
        (GOOD + "start: setled", "start: got 'setled', expected 'settled', a temperature or a mapping of bodies"),
        (GOOD + "start: 4 mm", "start: 'mm' is a length and cannot become 'degC', a temperature"),
    ],
)  # fmt: skip
def test_mistakes_in_a_yaml_plan(tmp_path: Path, machine: Machine, text: str, words: str) -> None:
    assert words in fault(tmp_path, machine, text)


def test_a_table_holds_drivers_and_joins_surroundings(tmp_path: Path, machine: Machine) -> None:
    p = plan(
        tmp_path, machine, "time [min],spindle_rpm [krpm],room,bed\n5,0,20,1\n5.25,4,,\n7,4,22,\n8,0,21,3\n", "p.csv"
    )
    assert p.time_s.tolist() == [0, 10, 15, *range(20, 190, 10)]
    assert p.drivers["spindle_rpm"].tolist() == [0, 0] + [4000] * 17  # the last row only ends the plan
    assert not p.drivers["coolant"].any()
    at = np.searchsorted(p.time_s, [0, 60, 120, 150])
    assert p.surroundings["room"][at] == pytest.approx([20, 21, 22, 21.5]) and p.initial_degC == 20


def test_a_recording_serves_as_a_plan(tmp_path: Path, machine: Machine) -> None:
    rows = ["00:00,0,20,20", "01:00,3000,20,20", "02:00,0,20.5,21"]
    text = "\n".join(["# preamble", "stamp,S 1,room,bed", *(f"2025-01-01 08:{r}" for r in rows)]) + "\n"
    p = plan(tmp_path, machine, text, "r.csv")
    assert p.time_s[-1] == 120 and p.drivers["spindle_rpm"].tolist() == [0] * 6 + [3000] * 6


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ("time_s,spindle_rpm,room\n0,1,20\n60,1,20\n60,1,20\n", "data row 3: time goes +0 s from the row before"),
        ("time_s,spindle_rpm,room\n0,1,20\n60,1,20\n50,1,20\n", "data row 3: time goes -10 s from the row before; put"),
        ("time_s,spindel,room\n0,1,20\n60,1,20\n", "unknown column 'spindel'; did you mean 'spindle_rpm'?"),
        ("t,spindle_rpm,room\n0,1,20\n60,1,20\n", "no time column among 't', 'spindle_rpm', 'room'; name it time_s"),
        ("time_s,spindle_rpm,room\n0,1,20\n", "1 data rows, expected at least 2; the last one ends the plan"),
        ("time_s,spindle_rpm,room\n0,1,20\n60,1\n120,1,20\n", "1 rows have too many or too few cells"),
        ("time_s,spindle_rpm,room\n0,1,20\nx,1,20\n", "data row 2: column 'time_s' holds no readable time"),
        ("time_s,spindle_rpm,room\n0,1,20\n60,on,20\n", "'spindle_rpm' data row 2: got 'on', expected a number in rpm"),
        ("time_s,spindle_rpm [kg],room\n0,1,20\n60,2,20\n", "column 'spindle_rpm': 'kg' is a mass and cannot become"),
        ("time_s,spindle_rpm,room\n0,1,20\n60,9000,20\n", "9000 rpm is outside the channel's range 0 to 8000 rpm"),
        ("time_s,spindle_rpm,room\n0,1,20\n60,,20\n400,,20\n500,1,20\n",
         "no value for 440 s from data row 2 (t = 60 s), more than the 300 s"),
        ("time_s,spindle_rpm,room\n0,1,20\n60,1,\n400,1,\n", "column 'room': no value for 340 s from data row 2"),
        ("time_s,spindle_rpm,room\n0,,20\n60,,20\n", "column 'spindle_rpm': has no value at all"),
        ("time_s,spindle_rpm\n0,1\n60,1\n", "no surrounding is given; add a column for it"),
        ("time_s,room\n0,1\n60,1\n", "no column of a driver, spindle_rpm or coolant or pos_x; add one, 0 for"),
        ("time_s,spindle_rpm,S 1,room\n0,1,1,20\n60,1,1,20\n", "column 'spindle_rpm' is given twice"),
        ("time_h,spindle_rpm,room\n0,1,20\n9000,1,20\n", "lasts 375 days"),
        ("time_s,bed\n0,1\n60,2\n", "no column 'spindle_rpm' or 'coolant' or"),
    ],
)  # fmt: skip
def test_mistakes_in_a_table(tmp_path: Path, machine: Machine, rows: str, words: str) -> None:
    assert words in fault(tmp_path, machine, rows, "p.csv")


def test_short_gaps_are_held_and_a_room_file_must_reach(tmp_path: Path, machine: Machine) -> None:
    p = plan(tmp_path, machine, "time_s,spindle_rpm,room\n0,,20\n60,3000,\n200,,24\n300,0,24\n", "p.csv")
    assert (p.drivers["spindle_rpm"] == 3000).all() and p.surroundings["room"][6] == pytest.approx(21.2)
    (tmp_path / "room.csv").write_text("time_s,room\n0,20\n3000,21\n")
    said = fault(tmp_path, machine, "stages: [{hours: 1}]\nsurroundings: {room: {file: room.csv}}")
    assert "room.csv: ends 600 s before the plan (3600 s), more than max_gap_s 300" in said
    assert "no column 'hall' among" in fault(
        tmp_path, machine, "stages: [{hours: 1}]\nsurroundings: {room: {file: room.csv, column: hall}}"
    )


def test_other_files_and_missing_ones(tmp_path: Path, machine: Machine) -> None:
    assert "unsupported file extension '.json'" in str(_raised(tmp_path / "p.json", machine, "{}"))
    assert "no such file" in str(_raised(tmp_path / "p.csv", machine, None))
    assert "cannot be read" in str(_raised(tmp_path / "p.yml", machine, None))


def _raised(path: Path, machine: Machine, text: str | None) -> InputError:
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError) as caught:
        load_run_plan(path, machine)
    return caught.value


@pytest.mark.parametrize(
    ("name", "hours", "highest"), [("iso_spindle_test", 61 / 12, 4000), ("spectrum_day", 59 / 6, 6000)]
)
def test_the_ready_plans_fit_the_sample_machine(name: str, hours: float, highest: float) -> None:
    p = load_run_plan(ROOT / "docs" / "plans" / f"{name}.yml", load_machine(ROOT / "machines" / "sample_vmc.yml"))
    assert p.time_s[-1] / 3600 == pytest.approx(hours) and p.on_step.all()
    assert p.drivers["spindle_rpm"].max() == highest and p.drivers["spindle_rpm"][-1] == 0
    assert 15 < p.surroundings["room"].min() < p.surroundings["room"].max() < 25
