"""The true model: at the noise where the twin can be the plant, and what can be seen is what was planted large."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import pytest

import thermodrift_exam.proof.scoring.true_model as module
from data.errors import InputError
from diagnosis.contracts import Scored
from diagnosis.fitting.fitted import baseline
from diagnosis.screening.screen import proposed, screen
from tests.diagnosis.concealed import case, flux
from tests.diagnosis.small_cases import FLOOR, SHIFT, runs, two_bodies
from tests.proof.answered import answer, term
from thermodrift_exam.plants.plant import draw
from thermodrift_exam.proof.scoring.answer_key import AnswerKey
from thermodrift_exam.proof.scoring.true_model import (
    VISIBLE_NATS,
    TrueModel,
    best_candidates,
    true_candidates,
    true_model,
)
from twin.schema import twin_part

pytestmark = pytest.mark.slow

SHORT: dict[str, Any] = {"batches": 4, "hours": 5.0, "before_h": 5.0, "solver_s": 50.0}


def floor(conductance: float, **changes: Any) -> dict[str, Any]:
    values = {"conductance": {"value": conductance, "unit": "W/K"}}
    return term("floor_sink", where={"kind": "node", "name": "head"}, parameters=values, **changes)


@cache
def cold(conductance: float) -> TrueModel:
    known = two_bodies()
    hidden = {"floor": {**FLOOR, "parameters": {"conductance": f"{conductance} W/K"}}}
    return true_model(known, runs(known, hidden), answer("one", floor(conductance)))


def test_a_floor_of_the_twins_own_law_is_explained_down_to_the_noise() -> None:
    got = cold(8.0)
    assert got.visible == (True,)
    assert got.error_before > 2.0 * got.error_true
    assert 0.7 < got.error_true < 1.3
    assert got.error_floor == 1.0
    assert got.gain_nats[0] > got.bar_nats[0] == VISIBLE_NATS
    ((size, low, high),) = got.sizes
    assert size == pytest.approx(8.0, rel=0.1) and low is not None and high is not None and low < 8.0 < high


def test_a_floor_that_hardly_conducts_cannot_be_seen() -> None:
    got = cold(0.02)
    assert got.visible == (False,)
    assert got.error_before == pytest.approx(got.error_true, rel=0.05)
    assert got.gain_nats[0] < VISIBLE_NATS <= got.bar_nats[0]


def test_where_the_file_has_no_twin_it_stands_in_the_draft() -> None:
    known = two_bodies()
    values = {"shift": {"value": 6.0, "unit": "um"}, "rated": {"value": 6000.0, "unit": "rpm"}}
    z = term("speed_shift", where={"kind": "error", "name": "z"}, parameters=values)
    bare = known.model_copy(update={"twin": None})
    got = true_model(bare, runs(known, {"shift": SHIFT}), answer("one", z))
    assert got.visible == (True,) and got.error_true < got.error_before


def test_where_nothing_is_missing_the_baseline_is_the_true_model() -> None:
    known = two_bodies()
    got = true_model(known, runs(known), answer("nothing"))
    assert got.error_before == got.error_true
    assert got.visible == got.gain_nats == ()


def test_of_a_mechanism_of_no_candidate_nothing_is_known() -> None:
    known = two_bodies()
    hidden = {"floor": {**FLOOR, "parameters": {"conductance": "8 W/K"}}}
    key = answer("unlisted", floor(8.0, mechanism=None))
    assert true_model(known, runs(known, hidden), key).visible == (None,)


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [{"square_cross": "6e-6 W"}, {"square": "6e-6 W"}])
def test_what_no_list_has_is_fitted_by_its_own_law(hidden: dict[str, str]) -> None:
    """Heat by the speed squared while coolant flows; where it always flows, by the speed squared alone."""
    given = case(flux("bed", "rpm", "coolant" if "square_cross" in hidden else None, **hidden))
    batches = given.batches
    if "square" in hidden:
        batches = [replace(b, table=b.table.assign(coolant=1.0)) for b in batches]
    where = {"kind": "node", "name": "bed"}
    own = term("unlisted", mechanism=None, where=where, form=["square_cross", "rpm", "coolant"])
    got = true_model(given.machine, batches, answer("unlisted", own))
    assert got.visible == (True,)
    assert 0.7 < got.error_true < 1.3 < got.error_before
    assert got.gain_nats[0] > got.bar_nats[0] >= VISIBLE_NATS
    unrecorded = term("unlisted", mechanism=None, where=where, form=["linear", "vacuum"])
    assert true_model(given.machine, batches, answer("unlisted", unrecorded)).visible == (None,)


@pytest.mark.slow
def test_a_plant_of_other_numerics_has_a_true_model_too() -> None:
    drawn = draw(2, "sun", 2.0, **SHORT)
    key = answer("one", *({**t, "size": 2.0, "decoy": False, "active": "always"} for t in drawn.truth["terms"]))
    got = true_model(drawn.machine, drawn.batches, key)
    assert got.visible == (True,)
    assert got.error_true < 0.7 * got.error_before


@pytest.mark.slow
def test_of_a_shape_that_no_key_states_the_refits_choose_the_place() -> None:
    """A bar sits at the spindle and all that the key says is which error it moves; the screen sees usual bars only."""
    bar = {"law": "mandrel_fixture", "acts_on": "z", "at": {"seat": "spindle"},
           "parameters": {"gain": "15 um/K", "capacity": "6000 J/K", "conductance": "1.5 W/K"}}  # fmt: skip
    given = case({"bar": bar})
    values = {"gain": {"value": 15.0, "unit": "um/K"}}
    z = term("mandrel", mechanism="mandrel_fixture", where={"kind": "error", "name": "z"}, parameters=values)
    key = AnswerKey.from_json(answer("one", z))
    fit = baseline(given.machine, twin_part(given.machine), given.batches, None, len(given.batches))
    own = true_candidates(key.terms[0], screen(fit, proposed(fit)), [])
    last = sorted(own, key=lambda s: _place(s) == "spindle")  # as if the screen had seen it least
    (picked,), full = best_candidates(fit, key.terms, [last])
    assert len(own) > 3 and picked is not None and _place(picked) == "spindle"
    assert full is not None and picked.candidate.name in full.part.mechanisms


@pytest.mark.slow
def test_two_heats_of_one_mechanism_at_one_body_are_two_terms() -> None:
    """A cabinet that is always on, and one that a driver switches: each is fitted by a candidate of its own."""
    heat = {"law": "cabinet_heat", "into": "bed"}
    given = case({
        "always": {**heat, "parameters": {"heat": "60 W"}},
        "pump": {**heat, "drivers": {"running": "coolant"}, "parameters": {"heat": "90 W"}},
    })  # fmt: skip
    place = {"kind": "node", "name": "bed"}
    always = term(where=place, parameters={"heat": {"value": 60.0, "unit": "W"}})
    pump = term("pump_heat", mechanism="cabinet_heat", where=place, driver="coolant",
                parameters={"heat": {"value": 90.0, "unit": "W"}})  # fmt: skip
    got = true_model(given.machine, given.batches, answer("two", always, pump))
    assert got.visible == (True, True)
    assert [size for size, *_ in got.sizes] == [pytest.approx(60.0, rel=0.2), pytest.approx(90.0, rel=0.2)]


def test_what_cannot_be_simulated_is_neither_visible_nor_not(monkeypatch: pytest.MonkeyPatch) -> None:
    def stiff(*_: Any, **_given: Any) -> None:
        raise InputError("stiff beyond the step control")

    known = two_bodies()
    hidden = {"floor": {**FLOOR, "parameters": {"conductance": "8 W/K"}}}
    monkeypatch.setattr(module, "refitted", stiff)
    assert true_model(known, runs(known, hidden), answer("one", floor(8.0))).visible == (None,)


def _place(s: Scored) -> str:
    assert s.candidate.part is not None and isinstance(s.candidate.part.at, dict)
    return str(s.candidate.part.at.get("seat"))
