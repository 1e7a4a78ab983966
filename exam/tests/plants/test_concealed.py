"""Machines with one effect more than their file: the recordings show it, the file does not, and the seed draws it."""

from __future__ import annotations

import io
from collections import Counter
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from data.errors import InputError
from data.machine import parse_machine
from thermodrift_exam.plants.concealed import EFFECTS, Case, conceal, drawn, write_case

SEED, RUNS = 3, 2


@cache
def case(effect: str) -> Case:
    return conceal(SEED, effect, RUNS)


def table(effect: str, run: int) -> pd.DataFrame:
    return pd.read_csv(io.StringIO(list(case(effect).recordings.values())[run]), comment="#")


@pytest.mark.parametrize("effect", EFFECTS)
def test_an_effect_is_in_the_recordings_or_out_of_the_file(effect: str) -> None:
    """Against the same runs without it: where it acts, more than three times the noise; the file reads."""
    own, plain = case(effect), case("nothing")
    machine = parse_machine(own.machine_file, "machine file")
    assert machine.simulated and own.recordings.keys() == plain.recordings.keys()
    (term,) = own.answer["terms"]
    assert (term["effect"], term["mechanism"]) == (effect, effect)
    names = {*machine.channels, *(machine.twin or {})["bodies"]}
    assert {term["where"]["name"], *term["also"], *term["neighbours"]} <= names
    twin = parse_machine(plain.machine_file, "machine file").twin or {}
    forgotten = machine.twin != twin
    moved = 0.0
    for run in range(RUNS):
        with_it, without = table(effect, run), table("nothing", run)
        places = [term["where"]["name"], "z"] if term["where"]["name"] in with_it else ["z"]
        noise = [0.1 if p in machine.names("temperature") else 1.0 for p in places]
        moved = max([moved, *(float(np.max(np.abs(with_it[p] - without[p]))) / s
                              for p, s in zip(places, noise, strict=True))])  # fmt: skip
    assert moved > 3 or forgotten
    assert forgotten == (effect in ("floor_sink", "motor_loss", "column_bending", "speed_shift"))


def test_what_may_be_seen_says_nothing_of_the_answer(tmp_path: Path) -> None:
    for effect in (*EFFECTS, "nothing"):
        folder = tmp_path / effect
        write_case(case(effect), folder)
        files = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())
        assert files[0] == "machine.yml" and len(files) == 1 + RUNS
        for file in files[1:]:
            text = (folder / file).read_text(encoding="utf-8")
            assert text.startswith("# simulated recording") and effect not in text
    with_cabinet, plain = case("cabinet_heat"), case("nothing")
    assert with_cabinet.machine_file == plain.machine_file  # an effect that the file never had leaves no gap


def test_a_seed_draws_the_case_and_one_in_seven_conceals_nothing() -> None:
    counts = Counter(drawn(s) for s in range(2100))
    assert set(counts) == {*EFFECTS, "nothing"}
    assert 240 < counts["nothing"] < 360 and all(counts[e] > 160 for e in EFFECTS)
    again = conceal(SEED, "sun", RUNS)
    assert again.recordings == case("sun").recordings and again.answer == case("sun").answer
    assert conceal(SEED, runs=1).answer["effect"] in (drawn(SEED), None)


def test_the_laws_are_the_ones_that_are_said() -> None:
    floor = case("floor_sink")
    joint = floor.answer["terms"][0]["parameters"]["conductance"]["value"]
    assert f"{joint:.0f} W/K" in floor.answer["words"]
    swapped = case("sensor_swap").answer["terms"][0]
    one, other = swapped["where"]["name"], swapped["also"][0]
    mine, true = table("sensor_swap", 0), table("nothing", 0)
    assert (mine[one] == true[other]).all() and (mine[other] == true[one]).all()
    late = case("sensor_lag").answer["terms"][0]["where"]["name"]
    mine, turning = table("sensor_lag", 0), true["spindle_rpm"] > 0
    rise = true[late][turning] - true[late].iloc[0]
    behind = mine[late][turning] - mine[late].iloc[0]
    assert (behind.iloc[10:60] < rise.iloc[10:60]).all()


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"seed": -1}, "demonstration: seed: got -1, expected 0 or more"),
        ({"seed": 1, "effect": "moon"}, "demonstration: effect: got 'moon', expected one of floor_sink"),
    ],
)
def test_bad_input_is_one_line(given: dict[str, object], words: str) -> None:
    with pytest.raises(InputError, match=words):
        conceal(**given)  # type: ignore[arg-type]
