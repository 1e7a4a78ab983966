"""Built cases: what a diagnosis sees says nothing of the answer, reads back, and is the same again."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from data.errors import InputError
from data.machine import load_machine
from data.recording import read_batches
from thermodrift_exam.plants.plant import draw
from thermodrift_exam.proof.spec import CaseSpec
from thermodrift_exam.proof.suite import Built, batches_of, build, small_suite, without, write_built
from thermodrift_exam.proof.suite.build import HOTTEST_DEGC, WEAKER
from thermodrift_exam.proof.suite.setting import setting
from thermodrift_exam.proof.suite.suite import case
from twin.quantity import convert

SEED = 2**140 + 5
SHORT: dict[str, Any] = {"batches": 3, "hours": 1.5, "before_h": 2.0, "solver_s": 60.0, "step_s": 300.0}


def short(seed: int = SEED, plant: str = "volumes", effects: dict[str, float] | None = None, **more: Any) -> CaseSpec:
    options = {**setting(seed, "sealed"), **SHORT, **more}
    return CaseSpec("case_0007", "one", plant, seed, effects or {}, {}, options, "sealed")  # type: ignore[arg-type]


@cache
def small(number: int) -> Built:
    return build(small_suite()[number])


def test_a_case_on_disk_is_a_machine_file_and_recordings_and_nothing_else(tmp_path: Path) -> None:
    built = small(4)
    write_built(built, tmp_path)
    files = sorted(p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*") if p.is_file())
    assert files == ["machine.yml", *(f"recordings/{name}" for name in sorted(built.recordings))]
    assert load_machine(tmp_path / "machine.yml") == built.machine


@pytest.mark.parametrize("number", [1, 3, 4])
def test_nothing_in_the_folder_names_an_effect(tmp_path: Path, number: int) -> None:
    built = small(number)
    write_built(built, tmp_path)
    text = "\n".join(p.read_text(encoding="utf-8") + p.name for p in tmp_path.rglob("*") if p.is_file())
    for term in built.answer["terms"]:
        assert term["effect"] not in text and str(term["mechanism"]) not in text
    assert str(built.answer["seed"]) not in text and built.answer["case"] not in text
    heads = {recording.splitlines()[0] for recording in built.recordings.values()}
    assert heads == {f"# simulated recording, machine {built.machine.machine}"}


def test_the_answer_has_every_key_of_the_contract_and_draws_the_case_again() -> None:
    spec, built = small_suite()[4], small(4)
    answer = built.answer
    assert json.loads(json.dumps(answer, allow_nan=False)) == answer
    assert set(answer) >= {
        "schema", "case", "kind", "plant", "suite", "simulated", "words", "machine", "seed", "terms", "idle_channels",
        "options", "redraw",
    }  # fmt: skip
    assert answer["schema"] == "thermodrift.proof_answer/1" and answer["kind"] == "two"
    for term in answer["terms"]:
        assert set(term) >= {
            "effect", "mechanism", "where", "also", "neighbours", "parameters", "words", "size", "limit_share", "decoy",
            "active", "driver", "same_as",
        }  # fmt: skip
        assert term["size"] == spec.effects[term["effect"]] and not term["decoy"]
    again = build(CaseSpec(**json.loads(json.dumps(answer["redraw"]))))
    assert again.recordings == built.recordings and again.machine == built.machine and again.answer == answer


def test_a_decoy_is_a_term_that_says_so_and_nothing_has_none() -> None:
    (term,) = small(1).answer["terms"]
    assert term["decoy"] and term["mechanism"] == "sensor_drift"
    assert small(0).answer["terms"] == [] and small(0).answer["words"] == "nothing is missing"


def test_recordings_read_back_whole() -> None:
    built = small(3)
    batches = batches_of(built)
    assert [f"{b.batch_id}.csv" for b in batches] == sorted(built.recordings)
    for batch in batches:
        assert batch.simulated and batch.start is not None
        assert not any(np.isnan(batch.values(c)).any() for c in built.machine.names("driver"))


@pytest.mark.parametrize(
    "key",
    ["motor_loss", *(pytest.param(k, marks=pytest.mark.slow) for k in ("column_bending", "spindle_growth")), "mandrel"],
)
def test_without_a_withheld_effect_the_machine_file_is_the_same(key: str) -> None:
    """What a file leaves out cannot be told from what the machine does not have."""
    lacks = ["coolant", "walls", "layers", "motor_loss", "bending", "growth", "mandrel"]
    spec = short(effects={key: 1.0}, has=["feed"], lacks=lacks)
    one, other = build(spec), build(without(spec))
    assert one.recordings != other.recordings
    assert one.machine == other.machine


def test_the_same_case_with_one_effect_less() -> None:
    spec = short(effects={"sun": 1.0, "cabinet_heat": 1.0})
    whole, less = build(spec), build(without(spec, "sun"))
    assert [t["effect"] for t in less.answer["terms"]] == ["cabinet_heat"]
    assert less.machine == whole.machine and less.recordings != whole.recordings
    assert less.recordings == build(replace(spec, effects={"cabinet_heat": 1.0})).recordings


@pytest.mark.parametrize("early_s", [0.0, 20.0])
def test_batches_of_a_case_are_what_a_reader_makes_of_its_rows(tmp_path: Path, early_s: float) -> None:
    spec = short(early_s=early_s, gaps=1.0, missing=0.05, absent=0.3, hours=3.0)
    drawn = draw(spec.seed, sizes={}, plant=spec.plant, **spec.options)
    write_built(build(spec), tmp_path)
    lost = 0
    for batch in drawn.batches:
        rows = pd.read_csv(tmp_path / "recordings" / f"{batch.batch_id}.csv", comment="#")
        (back,) = read_batches(tmp_path / "recordings" / f"{batch.batch_id}.csv", drawn.machine)
        assert list(back.table) == list(batch.table) and back.n_rows == batch.n_rows
        pd.testing.assert_frame_equal(back.table, batch.table, atol=1e-8)
        late = rows["time_s"] % 300.0
        assert (late.max() > 250.0) == (early_s > 0)
        assert rows["time_s"].iloc[0] == 0.0 and rows["time_s"].diff().max() <= 900.0 + early_s
        lost += len(batch.table.columns) - len(rows.columns)
    assert lost > 0  # a sensor was not there in some run


def test_a_driver_changes_on_the_row_that_shows_it_however_early_rows_come() -> None:
    """Read back, an early recorder's drivers are the prompt one's: the plan is moved by as much."""
    prompt, early = (draw(SEED, sizes={}, **short(early_s=e, gaps=0.0).options) for e in (0.0, 25.0))
    for one, other in zip(prompt.batches, early.batches, strict=True):
        for channel in prompt.machine.names("driver"):
            np.testing.assert_array_equal(one.values(channel), other.values(channel))


def test_idle_switches_are_recorded_and_drive_nothing() -> None:
    spec = short(idle=["mist", "lamp"], gaps=0.0)
    with_, none = (draw(SEED, sizes={}, **{**spec.options, "idle": idle}) for idle in (["mist", "lamp"], []))
    pump = replace(spec, effects={"pump_heat": 1.0}, options={**spec.options, "has": ["coolant"], "lacks": []})
    assert build(replace(pump, effects={})).answer["idle_channels"] == ["coolant", "mist", "lamp"]
    assert build(pump).answer["idle_channels"] == ["mist", "lamp"]
    assert {"mist", "lamp"} == set(with_.machine.names("driver")) - set(none.machine.names("driver"))
    assert any(b.values("mist").any() for b in with_.batches)
    for one, other in zip(with_.batches, none.batches, strict=True):
        assert one.table[list(other.table)].equals(other.table)


def test_a_wrong_value_differs_by_its_factor_alone() -> None:
    spec = case("case_0001", "decoy", "volumes", SEED, "development")
    spec = replace(spec, effects={}, decoys={"wrong_parameter": 1.5}, options={**spec.options, **SHORT})
    one, other = build(spec), build(without(spec))
    (term,) = one.answer["terms"]
    told, right = ((b.machine.twin or {})["links"] for b in (one, other))
    differing = [k for k in told if told[k] != right[k]]
    assert differing == [term["where"]["name"]]
    value = [convert(links[differing[0]]["value"], "W/K") for links in (right, told)]
    assert value[0] / value[1] == pytest.approx(term["parameters"]["factor"]["value"], rel=2e-3)
    assert one.recordings == other.recordings


def test_real_recordings_need_their_folder() -> None:
    spec = CaseSpec("case_0003", "one", "grafted", SEED, options={"case": "lathe_sun"})
    with pytest.raises(InputError, match="case_0003: plant grafted needs real recordings; give their folder"):
        build(spec)


@pytest.mark.parametrize("plant", [pytest.param("elements", marks=pytest.mark.slow), "volumes"])
def test_a_bearing_that_would_seize_is_drawn_weaker_and_the_answer_says_so(plant: str) -> None:
    """Preload that tightens with its own heat runs away: recordings of 300 degC are of no machine."""
    built = build(short(plant=plant, effects={"preload_feedback": 12.0}, hours=5.0))
    (term,) = built.answer["terms"]
    assert term["size"] < 12.0
    assert term["size"] == built.answer["redraw"]["effects"]["preload_feedback"]
    hottest = max(float(np.nanmax(b.values(c))) for b in batches_of(built) for c in b.names("temperature"))
    assert 40.0 < hottest <= HOTTEST_DEGC


def test_convection_that_the_plants_step_does_not_take_is_drawn_weaker() -> None:
    """A shaft that drags 80 times the air's exchange along ended the simulation: all recordings were empty."""
    built = build(short(plant="elements", effects={"rotating_convection": 20.0}, hours=2.0))
    (term,) = built.answer["terms"]
    assert term["size"] == built.answer["redraw"]["effects"]["rotating_convection"] < 20.0
    last = [[b.values(c)[-1] for c in b.names("temperature")] for b in batches_of(built)]
    assert not any(np.isnan(degC).all() for degC in last)


def test_a_machine_that_is_too_hot_by_itself_is_drawn_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    own = sys.modules["thermodrift_exam.proof.suite.build"]  # the package has a function of this name
    monkeypatch.setattr(own, "_seized", lambda _: True)
    monkeypatch.setattr(own, "TIMES", 3)
    built = build(short(effects={"preload_feedback": 1.0}, hours=2.0))
    assert built.answer["terms"][0]["size"] == pytest.approx(WEAKER**3)
    assert built.answer["redraw"]["effects"]["preload_feedback"] == built.answer["terms"][0]["size"]


def test_a_sensor_that_is_absent_is_no_seized_bearing() -> None:
    built = build(short(effects={"preload_feedback": 0.5}, absent=0.5))
    assert any(np.isnan(b.values(c)).all() for b in batches_of(built) for c in b.names("temperature"))
    assert built.answer["terms"][0]["size"] == 0.5
