"""Plant C: the graft is all that tells a case from its reference, it goes where its answer says, by its own size."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from data.errors import InputError
from diagnosis.candidates.library import candidates
from tests.real.recorded import DATA
from thermodrift_exam.plants.grafted import build, cases
from thermodrift_exam.plants.grafted.cases import CASES
from thermodrift_exam.plants.real import RealCase
from thermodrift_exam.proof.scoring.answer_key import AnswerKey
from thermodrift_exam.proof.spec import KINDS
from twin.compile import compile_network
from twin.schema import twin_part

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="no ../shared/data")
SEED = 7
GRAFTED = [n for n, c in CASES.items() if c.grafts]


@cache
def built(name: str) -> RealCase:
    return build(name, DATA, SEED)


@cache
def offered() -> set[tuple[str, str, str]]:
    machine = built("lathe_plain").machine
    return {(c.mechanism, c.where.kind, c.where.name) for c in candidates(machine, twin_part(machine))}


def largest_change(case: RealCase, channel: str) -> float:
    plain = built(case.answer["reference"])
    changes = [b.values(channel) - a.values(channel) for a, b in zip(plain.batches, case.batches, strict=True)]
    return max(float(np.nanmax(np.abs(c))) if np.isfinite(c).any() else 0.0 for c in changes)


def test_there_are_cases_of_both_machines_and_none_without_recordings(tmp_path: Path) -> None:
    assert set(cases(DATA)) == set(CASES) and len(GRAFTED) >= 15
    assert cases(tmp_path) == []


@pytest.mark.parametrize("name", [GRAFTED[0], *(pytest.param(n, marks=pytest.mark.slow) for n in GRAFTED[1:])])
def test_a_case_and_its_reference_differ_where_the_answer_says_and_nowhere_else(name: str) -> None:
    case, plain = built(name), built(CASES[name].reference)
    assert case.answer["reference"] == plain.answer["case"] and plain.answer["reference"] is None
    assert case.machine == plain.machine
    told = case.answer["graft"]["largest"]
    for channel in case.machine.channels:
        step = case.machine.channels[channel].resolution or 1e-4
        change = largest_change(case, channel)
        if channel not in told:
            assert change == 0.0, channel
        else:
            assert change <= told[channel] + 2.0 * step, channel
    assert [b.batch_id for b in case.batches] == [b.batch_id for b in plain.batches]


def test_values_stand_on_the_instruments_steps_in_the_reference_as_well() -> None:
    for name in ("lathe_plain", "lathe_sun"):
        for batch in built(name).batches:
            for channel, part in batch.channels.items():
                if part.resolution:
                    steps = batch.values(channel) / part.resolution
                    assert np.nanmax(np.abs(steps - np.rint(steps)), initial=0.0) < 1e-3, channel


@pytest.mark.parametrize("name", [n for n in GRAFTED if CASES[n].machine == "lathe_gv1203"])
def test_what_was_grafted_can_be_proposed_where_it_was(name: str) -> None:
    for term in built(name).answer["terms"]:
        places = [term["where"], *term["also"]]
        if term["mechanism"] is not None:
            assert any((term["mechanism"], p["kind"], p["name"]) in offered() for p in places), term["where"]


def test_the_bodies_that_are_heated_gain_most_of_all_sensors() -> None:
    case = built("lathe_belt_loss")
    body = case.answer["terms"][0]["where"]["name"]
    twin = case.machine.twin or {}
    told = {c: v for c, v in case.answer["graft"]["largest"].items() if c in twin["sensors"]}
    assert twin["sensors"][max(told, key=lambda c: told[c])]["at"] == body
    assert max(told.values()) == pytest.approx(1.5 * case.answer["terms"][0]["size"], rel=0.05)


def test_cases_are_labelled_compile_and_answer_in_plain_data() -> None:
    compile_network(built("lathe_plain").machine)
    for name in CASES:
        case = built(name)
        assert case.machine.simulated and case.answer["simulated"] and all(b.simulated for b in case.batches)
        json.dumps(case.answer, allow_nan=False)
        key = AnswerKey.from_json(case.answer)
        assert len(key.terms) == len(CASES[name].grafts) and key.kind in KINDS and key.plant == "grafted"
        assert all(0.5 <= t["size"] <= 5.0 for t in case.answer["terms"])


def test_the_same_seed_gives_the_same_case_and_another_seed_another() -> None:
    one, again, other = (build("lathe_sensor_drift", DATA, seed) for seed in (11, 11, 12))
    assert one.answer == again.answer and one.answer["terms"] != other.answer["terms"]
    for a, b in zip(one.batches, again.batches, strict=True):
        assert a.table.equals(b.table)


def test_an_unknown_case_is_told_with_the_closest() -> None:
    with pytest.raises(InputError, match=r"grafted: unknown case 'lathe_sum'; did you mean 'lathe_sun'\?"):
        build("lathe_sum", DATA, 1)
