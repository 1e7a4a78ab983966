"""The search on two bodies: what is concealed is found with its size, and nothing is found where nothing is."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import pytest

from data.errors import InputError, WorkError
from data.processes import Processes
from diagnosis.candidates.discretisation import never_reported, slack
from diagnosis.fitting import fitted as fitted_module
from diagnosis.fitting.fit import Fitted
from diagnosis.fitting.fitted import degraded_channels, deterministic_fit, left_out_rows
from diagnosis.policy import POLICY
from diagnosis.screening.screen import proposed
from diagnosis.search import refits as refits_module
from diagnosis.search import search as search_module
from diagnosis.search.claims import Round
from diagnosis.search.search import Search, decided, one_round, search, without
from tests.diagnosis.small_cases import DRIFT, FLOOR, SHIFT, consistent, fitted, runs, two_bodies
from tests.diagnosis.whole import diagnosed
from twin.calibration.identifiability import Interval, intervals90
from twin.calibration.least_squares import result
from twin.compile import compile_network
from twin.quantity import Value

COLD = {**FLOOR, "parameters": {"conductance": "8 W/K"}}
FAR = {**SHIFT, "parameters": {"shift": "12 um"}}


@cache
def found(case: str) -> Search:
    if case in ("nothing", "drift"):
        done = diagnosed("consistent" if case == "nothing" else "explained").search
        assert done is not None
        return done
    hidden, count = ({"a": COLD}, 6) if case == "floor" else ({"a": DRIFT, "b": FAR}, 8)
    return search(fitted(two_bodies(), runs(two_bodies(), hidden, count)))


def names(done: Search) -> list[str]:
    return [r.best.candidate.base_name for r in done.accepted if r.best is not None]


def stated(done: Search) -> dict[str, Interval]:
    """By name, numbers of where a shape began left out."""
    fit = result(done.final.problem, deterministic_fit(done.final).state, 0.01, "")
    number = {r.best.candidate.name: r.best.candidate.base_name for r in done.accepted if r.best is not None}
    out = {}
    for i in intervals90(fit, done.final.problem.unknowns):
        group, entry, value = i.name.split(".")
        head, dash, own = entry.rpartition("-")
        out[f"{group}.{head}{dash}{number.get(own, own)}.{value}"] = i
    return out


@pytest.mark.integration
def test_a_cold_floor_is_found_with_its_size() -> None:
    done = found("floor")
    assert names(done) == ["floor_sink_head_room"]
    interval = stated(done)["exposures.head-floor_sink_head_room.conductance"]
    assert interval.value == pytest.approx(8.0, rel=0.1)


@pytest.mark.integration
def test_a_claim_is_probable_and_no_channel_is_predicted_worse() -> None:
    for r in found("drift and shift").accepted:
        assert r.best is not None and r.claim_probability >= POLICY.claim_min_probability
        assert r.best.gain > 0 and float(r.best.by_run.sum()) > 0
        assert not degraded_channels(left_out_rows(r.before), left_out_rows(r.best.fitted))


def test_where_nothing_is_missing_nothing_is_accepted() -> None:
    done = found("nothing")
    assert len(done.rounds) == 1 and not done.accepted
    assert done.final.part == done.baseline.part == consistent().part
    assert done.final.noise.factor.max() < 1.3


@pytest.mark.parametrize("seed", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_nor_with_other_values_and_noise(seed: int) -> None:
    assert not search(fitted(two_bodies(), runs(two_bodies(), count=4, seed=seed))).accepted


@pytest.mark.integration
def test_a_drifting_sensor_is_the_sensors_fault() -> None:
    done = found("drift")
    assert names(done) == ["sensor_drift_t_head"]
    (r,) = done.accepted
    assert r.best is not None and r.best.candidate.fault
    interval = stated(done)["mechanisms.sensor_drift_t_head.rate"]
    assert interval.low < 0.3 < interval.high


@pytest.mark.integration
def test_of_two_effects_both_are_claimed_each_judged_with_the_other_in_the_model() -> None:
    done = found("drift and shift")
    assert set(names(done)) == {"sensor_drift_t_head", "speed_shift_z_rpm"} and len(done.accepted) == 2
    own = [r.best.candidate.name for r in done.accepted if r.best is not None]
    for r, other in zip(done.accepted, own[::-1], strict=True):
        assert set(r.before.part.mechanisms) - set(done.baseline.part.mechanisms) == {other}
        assert r.best is not None and r.best.gain > r.threshold
    assert set(done.final.part.mechanisms) - set(done.baseline.part.mechanisms) == set(own)
    assert stated(done)["mechanisms.sensor_drift_t_head.rate"].value == pytest.approx(0.3, rel=0.1)
    assert not done.rounds[-1].accepted


@pytest.mark.parametrize("case", [pytest.param("floor", marks=pytest.mark.integration), "nothing"])
def test_what_any_lumped_network_shows_is_not_tried(case: str) -> None:
    for r in found(case).rounds:
        assert not {t.candidate.name for t in r.tried} & never_reported(proposed(r.before), r.before)


@pytest.mark.integration
def test_a_baseline_stays_where_without_the_effect_no_machine_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parameters gone with heat that feeds itself may make a machine that cannot be simulated without it."""

    def stiff(*_: Any) -> None:
        raise InputError("stiff beyond the step control")

    r = found("drift").rounds[0]
    monkeypatch.setattr(search_module, "refitted", stiff)
    assert search_module._fair(r.before, r.tried).log_evidence >= r.before.log_evidence


@pytest.mark.integration
def test_what_a_refit_would_keep_without_its_effect_is_no_gain() -> None:
    """A fit before that has stopped short of its likeliest sizes and noise."""
    r = found("drift").rounds[0]
    short = replace(r.before, hyper=replace(r.before.hyper, structure=0.0))
    assert short.log_evidence < r.before.log_evidence - 10
    again = decided(replace(r, before=short))
    assert again.before.log_evidence > r.before.log_evidence - 1 and again.best is not None and r.best is not None
    assert again.best.gain == pytest.approx(r.best.gain, abs=2.0)


@pytest.mark.integration
def test_an_explanation_that_structure_drawn_anew_does_not_bear_out_is_not_claimed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    r = found("drift").rounds[0]
    assert r.best is not None and r.best.confirmed and r.accepted

    def anew(fitted: Fitted) -> Fitted:
        return r.before if fitted is r.best.fitted else fitted  # type: ignore[union-attr]

    monkeypatch.setattr(search_module, "restructured", anew)
    again = decided(r)
    assert again.best is not None and again.best.candidate != r.best.candidate
    lost = next(t for t in again.tried if t.candidate == r.best.candidate)
    assert lost.confirmed and lost.gain == pytest.approx(0.0, abs=1e-6)


@pytest.mark.integration
def test_a_further_effect_is_looked_for_after_a_claim_only(monkeypatch: pytest.MonkeyPatch) -> None:
    r = found("drift").rounds[0]
    assert r.best is not None and r.figures is not None
    given = [replace(r, figures=replace(r.figures, relative_gain=g), resolved=frozenset()) for g in (0.2, 0.03)]
    assert [g.accepted for g in given] == [True, False]
    ahead = iter(given)
    monkeypatch.setattr(search_module, "one_round", lambda *_, **__: next(ahead))
    done = search_module.search(r.before)
    assert len(done.rounds) == 2 and done.rounds[0] is given[0] and done.rounds[1] is given[1]
    assert done.final is r.best.fitted


@pytest.mark.integration
def test_what_was_not_confirmed_is_not_claimed(monkeypatch: pytest.MonkeyPatch) -> None:
    """After the last confirmation the best confirmed one stays, whatever others promise."""
    r = found("drift").rounds[0]
    monkeypatch.setattr(search_module, "restructured", lambda fitted: r.before)
    monkeypatch.setattr(search_module, "POLICY", replace(POLICY, confirmed=1))
    again = decided(r)
    assert again.best is not None and again.best.confirmed and not again.accepted
    assert any(t.gain > again.best.gain + 100.0 and not t.confirmed for t in again.tried)


@pytest.mark.integration
def test_where_no_twin_can_be_drawn_anew_a_claim_is_judged_by_its_own_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*_: Any, **__: Any) -> None:
        raise WorkError("no refined twin could be simulated")

    r = found("drift").rounds[0]
    monkeypatch.setattr(fitted_module, "structured", none)
    again = decided(r)
    assert again.accepted and again.best is not None and r.best is not None
    assert again.best.candidate == r.best.candidate and again.best.gain >= r.best.gain - 1e-6


@pytest.mark.parametrize("sd", [1.9, 2.1])
def test_what_any_sensor_or_length_may_be_off_by_is_no_effect(sd: float) -> None:
    now = found("nothing").baseline
    every = [c for c in proposed(now) if c.part is not None]
    sizes = slack(every, now)
    judged = [c for c in every if c.name in sizes]
    assert {c.mechanism for c in judged} >= {"sensor_bonding", "sensor_lag", "sensor_offset"}
    for c in judged:
        ((name, off),) = c.amplitudes.items()
        by = sd * sizes[c.name] * (-1.0 if c.mechanism == "sensor_bonding" else 1.0)
        part = c.applied(now.part, {name: Value(value=off + by)})
        network = compile_network(now.machine, part=part)
        fit = SimpleNamespace(
            machine=now.machine, part=part, problem=SimpleNamespace(network=network), values=network.values
        )
        assert refits_module._usual(c, fit, sizes) is (sd < POLICY.usual_error_sd), c.name  # type: ignore[arg-type]


@pytest.mark.integration
def test_what_was_accepted_can_be_taken_out_again() -> None:
    done = found("drift")
    best = done.accepted[0].best
    assert best is not None
    assert without(done.final.part, best.candidate, done.baseline.part) == done.baseline.part


@cache
def first_round(processes: int) -> Round:
    with Processes(processes) as workers:
        return one_round(found("drift").baseline, workers, lambda *_: None)


@pytest.mark.slow
def test_processes_do_not_matter() -> None:
    one, two = first_round(1), first_round(2)
    assert [t.candidate.name for t in one.tried] == [t.candidate.name for t in two.tried]
    assert [t.gain for t in one.tried] == pytest.approx([t.gain for t in two.tried], rel=1e-6)
    assert two.accepted and two.claim_probability == pytest.approx(one.claim_probability)
