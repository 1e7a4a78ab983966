"""Cases of other kinds of machines: drawn by lot, built under names that say nothing, executed, and counted apart."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.stats import kstest

from tests.proof.answered import answer, finding, stored, term, truth
from tests.proof.test_scoring_parts import AnswerKey
from tests.proof.toy_proof import toy_proof
from thermodrift_exam.plants.kinds import effects_of, unlisted_of
from thermodrift_exam.plants.plant import machine_text
from thermodrift_exam.proof.judging import _add
from thermodrift_exam.proof.report.labels import plant_label, plant_origin
from thermodrift_exam.proof.report.markdown import proof_markdown
from thermodrift_exam.proof.scoring.goal_table import goal_table
from thermodrift_exam.proof.scoring.matching import means
from thermodrift_exam.proof.scoring.outcomes import outcomes
from thermodrift_exam.proof.spec import DEVELOPED_ON, KIND_PLANTS, KINDS, UNSEEN, CaseSpec, is_unseen
from thermodrift_exam.proof.suite import Built, build, suite, write_built
from thermodrift_exam.proof.suite.other_kinds import (
    AMBIGUOUS,
    FAULTS,
    INVISIBLE_SIGMA,
    SIGMA,
    kind_case,
    kind_effects,
    sigma,
)
from thermodrift_exam.proof.suite.suite import case, possible

SEED = 2**140 + 9
PLAN = """name: warm_up
stages:
- {hours: 0.5, heater_1: 0.5}
surroundings: {room: 21 degC}
"""


def short(kind: str, plant: str, seed: int = SEED, **effects: float) -> CaseSpec:
    spec = case("case_0003", kind, plant, seed, "sealed")  # type: ignore[arg-type]
    return replace(spec, effects=effects or spec.effects, options={**spec.options, "runs": 3})


@cache
def board() -> Built:
    return build(short("one", "board", supply_sag=6.0))


def test_a_suite_takes_every_kind_of_machine_and_the_shares_of_the_cases_stay() -> None:
    specs = suite(bytes(range(32)), 120, "sealed", KIND_PLANTS)
    assert Counter(s.plant for s in specs) == dict.fromkeys(KIND_PLANTS, 20)
    assert {s.kind for s in specs} == set(KINDS)
    for s in specs:
        wanted = {"one": 1, "two": 2, "three": 3, "confounded": 1, "unlisted": 1, "invisible": 1}.get(s.kind, 0)
        assert len(s.effects) == wanted and len(s.decoys) == (s.kind == "decoy")
        assert set(s.decoys) <= set(FAULTS)
        known = {"unlisted": unlisted_of(s.plant), "confounded": AMBIGUOUS}.get(s.kind, kind_effects(s.plant))
        assert set(s.effects) <= set(known)
        assert all(possible(e, s.options) for e in (*s.effects, *s.decoys))
        assert CaseSpec(**json.loads(json.dumps(s.plain()))) == s


def test_what_a_case_looks_like_does_not_depend_on_what_it_lacks() -> None:
    for plant in KIND_PLANTS:
        drawn = [case("case_0001", kind, plant, SEED, "sealed").options for kind in KINDS]
        assert all(options == drawn[0] for options in drawn)


def test_sigmas_are_even_by_logarithm() -> None:
    rng = np.random.default_rng(2)
    low, high = SIGMA
    drawn = np.array([sigma(rng, SIGMA) for _ in range(2000)])
    assert (low, high) == (1.5, 25.0)
    assert kstest(np.log(drawn / low) / np.log(high / low), "uniform").pvalue > 1e-3
    assert INVISIBLE_SIGMA[1] < low


def test_nothing_on_disk_names_the_effect_or_holds_the_seed(tmp_path: Path) -> None:
    built = board()
    write_built(built, tmp_path)
    text = "\n".join(p.read_text(encoding="utf-8") + p.name for p in tmp_path.rglob("*") if p.is_file())
    (one,) = built.answer["terms"]
    assert one["effect"] == one["mechanism"] == "supply_sag" and one["effect"] not in text
    assert str(SEED) not in text and built.answer["case"] not in text
    assert built.machine.machine == built.answer["options"]["name"] == built.answer["machine"]


def test_a_sealed_suite_has_seeds_of_256_bits() -> None:
    built = build(kind_case("case_0001", "nothing", "board", 2**256 - 1, "sealed"))
    assert str(2**256 - 1) not in "".join(built.recordings) and len(built.machine.machine) < 20


def test_the_key_has_the_sigma_and_draws_the_case_again() -> None:
    built = board()
    (one,) = built.answer["terms"]
    assert one["sigma"] == pytest.approx(6.0, rel=0.15) and one["limit_share"] is None and not one["decoy"]
    again = build(CaseSpec(**json.loads(json.dumps(built.answer["redraw"], allow_nan=False))))
    assert again.recordings == built.recordings and again.answer == built.answer
    key = AnswerKey.from_json(built.answer)
    assert key.physics[0].where.name == one["where"]["name"]


def test_a_fault_is_a_decoy_and_a_stated_partner_is_no_false_claim() -> None:
    fault = build(short("decoy", "battery"))
    assert [t["decoy"] for t in fault.answer["terms"]] == [True]
    alike = build(short("confounded", "battery"))
    (one,) = alike.answer["terms"]
    (partner,) = [p for p in one["same_as"] if p["mechanism"] == "radiation"]
    said = finding("radiation", partner["where"]["name"], partner["where"]["kind"], parameters={})
    table = outcomes({"case_0003": alike.answer}, {"case_0003": stored("explained", said)}, {})[0]
    assert table["false_claims"].tolist() == [0]


def test_one_jacket_is_as_good_as_the_other() -> None:
    jacket = AnswerKey.from_json(answer("one", term("jacket_chiller"))).terms[0]
    assert means("coolant_jacket", jacket) and not means("cutting_fluid", jacket)


def test_a_proposed_run_is_done_on_the_same_machine(tmp_path: Path) -> None:
    built = board()
    write_built(built, tmp_path)
    _add(tmp_path, PLAN, built.answer)
    files = {p.name for p in (tmp_path / "recordings").iterdir()}
    (new,) = files - set(built.recordings)
    table = pd.read_csv(tmp_path / "recordings" / new, comment="#")
    assert table["heater_1"].max() == 0.5 and (tmp_path / "machine.yml").read_text() == machine_text(built.machine)


def test_unseen_kinds_have_a_column_of_goals_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("goals", "goal_table"):  # no interval is looked at
        monkeypatch.setattr(f"thermodrift_exam.proof.scoring.{module}.DRAWS", 50)
    assert [p for p in KIND_PLANTS if is_unseen(p)] == [p for p in KIND_PLANTS if p not in DEVELOPED_ON]
    assert not any(map(is_unseen, ("elements", "volumes", "grafted", "withheld")))
    keys = {f"case_{k:04d}": answer(case=f"case_{k:04d}", plant=p) | {"kind": "nothing"}
            for k, p in enumerate(("volumes", "lathe", "bench", "gantry"), 1)}  # fmt: skip
    replies = {n: stored("consistent") if n < "case_0004" else stored("explained", finding()) for n in keys}
    goals = goal_table(*outcomes(keys, replies, {n: truth() for n in keys}))
    alarms = goals[goals["measure"].str.startswith("false alarms")].set_index("plant")
    assert list(alarms.index) == ["all", UNSEEN, "bench", "gantry", "lathe", "volumes"]
    assert alarms["n"].tolist() == [4, 3, 1, 1, 1, 1]
    assert alarms["value"].tolist() == pytest.approx([0.25, 1 / 3, 0.0, 1.0, 0.0, 0.0])


def test_the_published_table_has_that_column() -> None:
    run = toy_proof(60, plants=("volumes", "bench"))
    goals = run.table("goals")
    unseen = goals[goals["plant"] == "bench"].assign(plant=UNSEEN)
    run = replace(run, tables={**run.tables, "goals": pd.concat([goals, unseen], ignore_index=True)})
    assert run.goal_columns == (UNSEEN, "volumes", "bench") and run.plants == ("volumes", "bench")
    head = next(line for line in proof_markdown(run).splitlines() if line.startswith("| measure"))
    assert head.index(plant_label(UNSEEN)) < head.index(plant_label("volumes")) < head.index(plant_label("bench"))
    assert {plant_origin(p) for p in (*KIND_PLANTS, UNSEEN)} == {"SIMULATED"}
    assert all(effects_of(p) for p in KIND_PLANTS)
