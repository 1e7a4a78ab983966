"""A proposed run on the plant of a case: read from its text, and the same as a run that is scheduled by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pytest

from data.errors import InputError
from diagnosis.next_experiment.menu import Run as MenuRun
from tests.plants.plant_cases import NONE, SEED
from thermodrift_exam.plants.drawing import draw_plant
from thermodrift_exam.plants.effects import EFFECTS
from thermodrift_exam.plants.options import stream
from thermodrift_exam.plants.planned import RIPPLE_K, execute, read_plan
from thermodrift_exam.plants.runs import Block, Run, held
from thermodrift_exam.plants.simulation import shown, simulated
from twin.compile import compile_network
from twin.run_plan import load_run_plan
from twin.run_plan.plan import Stage

OPTIONS: dict[str, Any] = {
    "noise_K": 0.0, "noise_um": 0.0, "quantisation_K": 1e-6, "solver_s": 50.0, "batches": 2, "has": ("feed", "coolant"),
}  # fmt: skip
HAS = frozenset(OPTIONS["has"])
PLAN = """
# Distinguishes: one and other. Expected: 12 nats in 1.5 h.
# Begin after 6 h at rest, then 2 h spindle_rpm 4000 and coolant 1.
# Put one more temperature sensor at shaft before.
name: a staircase
step: 300 s
stages:
- {minutes: 30, spindle_rpm: 3000}
- repeat: 2
  stages:
  - {minutes: 20, spindle_rpm: 6 krpm, coolant: 1}
  - {minutes: 10, spindle_rpm: 0}
surroundings:
  room:
  - [0, 20]
  - [0.5, 20]
  - [1, 24]
start: {bed: 20.1}
"""


def test_a_plan_is_read_as_it_is_written() -> None:
    plan = read_plan(PLAN, ["spindle_rpm", "coolant"])
    assert (plan.hours, plan.before_h, plan.sensor, plan.name) == (1.5, 8.0, "shaft", "a staircase")
    speed = [(b.from_s, b.value) for b in plan.blocks["spindle_rpm"]]
    before = [(-28800.0, 0.0), (-7200.0, 4000.0)]
    assert speed == [*before, (0.0, 3000.0), (1800.0, 6000.0), (3000.0, 0.0), (3600.0, 6000.0), (4800.0, 0.0)]
    coolant = [(b.from_s, b.value) for b in plan.blocks["coolant"]]
    assert coolant == [(-28800.0, 0.0), (-7200.0, 1.0), (0.0, 0.0), (1800.0, 1.0), (3600.0, 1.0)]
    run = plan.run(pd.Timestamp("2026-05-04 16:30"))
    assert run.batch_id == "20260504_0700"
    quiet_s = np.array([-9e4, 0.0, 2700.0, 5400.0])
    assert run.room_degC(quiet_s) == pytest.approx([20.0, 20.0, 22.0, 24.0], abs=RIPPLE_K)
    night = read_plan("stages: [{hours: 8}]\nname: a night\nsurroundings: {room: 19 degC}", [])
    assert (night.before_h, night.run(run.start).clock_h) == (24.0, 21.0)


def test_a_proposals_own_text_reads_as_its_own_plan_does(tmp_path: Any) -> None:
    """The drivers of the menu's text, by this reader and by the twin's."""
    case = execute(SEED, {}, PLAN, **OPTIONS)
    turn, stop = {"spindle_rpm": 5000.0}, {"spindle_rpm": 0.0}
    stages = (Stage(3600.0, turn), Stage(1500.0, {"feed": 2000.0}), Stage(900.0, stop))
    rest = (Stage(86400.0, {}), Stage(7200.0, turn))
    points = ((0.0, 20.0), (3600.0, 25.0))
    text = MenuRun("some hours", stages, {"room": points}, 300.0, rest).text({"bed": 20.0})
    (tmp_path / "plan.yml").write_text(text, encoding="utf-8")
    other, own = load_run_plan(tmp_path / "plan.yml", case.machine), read_plan(text, list(case.machine.names("driver")))
    run = own.run(pd.Timestamp("2026-05-04"))
    assert own.hours * 3600.0 == other.time_s[-1]
    for name, blocks in (("spindle_rpm", run.speed), ("feed", run.feed), ("coolant", run.coolant)):
        assert held(blocks, other.time_s[:-1]).tolist() == other.drivers[name].tolist()
    assert np.interp(other.time_s, *run.room) == pytest.approx(other.surroundings["room"])


def test_the_plants_own_run_with_that_schedule_is_the_same() -> None:
    done = execute(SEED, {"sun": 1.0, "speed_shift": 1.0}, PLAN.replace("[1, 24]", "[1, 20]"), **OPTIONS)
    plant = draw_plant(SEED, HAS, NONE)
    effects = [EFFECTS[key](plant, 1.0, stream(SEED, f"effect {key}")) for key in ("sun", "speed_shift")]
    run = Run(
        start=done.batch.start, hours=1.5,
        speed=(Block(-7200.0, 4000.0), Block(0.0, 3000.0), Block(1800.0, 6000.0), Block(3000.0, 0.0),
               Block(3600.0, 6000.0), Block(4800.0, 0.0)),
        feed=(), coolant=(Block(-7200.0, 1.0), Block(0.0, 0.0), Block(1800.0, 1.0)),
        room_mean_degC=20.0, day_K=0.0, warmest_h=15.0, ripple_K=RIPPLE_K, ripple_s=(2700.0, 1100.0),
        wall_K=0.0, slow_K=0.0, friction=1.0,
    )  # fmt: skip
    course = simulated(plant, [run], effects, 50.0, before_h=8.0)
    true = shown(plant, course, effects)
    for name in ("t_front", "t_head", "t_column_back", "room", "y", "z"):
        expected = np.interp(done.batch.time_s, course.time_s, true[name][:, 0])
        assert done.batch.values(name) == pytest.approx(expected, abs=0.051 if name in "yz" else 2e-6), name
    assert done.batch.simulated
    assert np.ptp(done.batch.values("t_front")) > 1.0


def test_the_new_sensor_is_in_the_file_and_shows_its_body() -> None:
    done = execute(SEED, {}, PLAN, **OPTIONS)
    without = execute(SEED, {}, PLAN.replace("# Put one more", "# No more"), **OPTIONS)
    assert set(done.batch.channels) - set(without.batch.channels) == {"t_shaft"}
    assert set(done.machine.names("temperature")) >= {"t_shaft", "t_front"}
    network = compile_network(done.machine)
    assert "t_shaft" in [r.channel for r in network.readings]
    shaft, front = done.batch.values("t_shaft"), done.batch.values("t_front")
    assert shaft.max() - shaft[0] > 0.5 * (front.max() - front[0]), "the bearings heat it as well"
    for name in ("t_front", "z"):
        assert done.batch.values(name) == pytest.approx(without.batch.values(name))


def test_a_sensor_that_the_plant_cannot_give_is_left_out() -> None:
    done = execute(SEED, {}, PLAN.replace("at shaft before", "at t_bed~near before"), **OPTIONS)
    assert not {n for n in done.batch.channels if "near" in n or n == "t_shaft"}


def test_an_idle_switch_is_recorded_and_does_nothing() -> None:
    on = execute(SEED, {}, PLAN.replace("coolant: 1}", "coolant: 1, lamp: 1}"), idle=("lamp",), **OPTIONS).batch
    off = execute(SEED, {}, PLAN, idle=("lamp",), **OPTIONS).batch
    assert set(on.values("lamp")) == {0.0, 1.0} and set(off.values("lamp")) == {0.0}
    assert on.table.drop(columns="lamp").equals(off.table.drop(columns="lamp"))


def test_it_is_another_day_with_its_own_noise_and_the_same_every_time() -> None:
    noisy = {**OPTIONS, "noise_K": 0.05, "noise_um": 1.0}
    once, again = (execute(SEED, {"sun": 1.0}, PLAN, **noisy) for _ in range(2))
    assert once.batch.table.equals(again.batch.table) and once.table.equals(again.table)
    plain = execute(SEED, {"sun": 1.0}, PLAN, **OPTIONS)
    assert 0.02 < np.std(once.batch.values("t_head") - plain.batch.values("t_head")) < 0.1


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("stages: [", "not valid YAML"),
        ("name: x", "run plan: has no list of stages; write stages:"),
        ("stages: [4]", "stage 1: got 4, expected a mapping"),
        ("stages: [{minutes: 5, spindel_rpm: 2}]", "unknown key 'spindel_rpm'; did you mean 'spindle_rpm'"),
        ("stages: [{minutes: 5, spindle_rpm: fast}]", "spindle_rpm: got 'fast', expected a number in rpm"),
        ("stages: [{spindle_rpm: 5}]", "stage 1: lasts 0 s, expected more than 0"),
        ("stages: [{hours: 1}]", "surroundings have no room"),
        ("stages: [{hours: 1}]\nsurroundings: {room: [[1, 20], [1, 21]]}", "do not rise; put the points in order"),
    ],
)
def test_a_bad_plan_is_told_in_one_line(text: str, words: str) -> None:
    with pytest.raises(InputError) as error:
        read_plan(text, ["spindle_rpm"])
    assert words in str(error.value)
    assert "\n" not in str(error.value)
