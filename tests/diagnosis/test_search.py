"""The search on two bodies: what is concealed is found with its size, and nothing is found where nothing is."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from data.batch import Batch
from data.errors import InputError
from data.processes import Processes
from diagnosis.candidates.discretisation import never_reported
from diagnosis.contracts import Candidate, Fitted, Scored, Tried, Where
from diagnosis.policy import POLICY
from diagnosis.screening.screen import proposed
from diagnosis.search import decision
from diagnosis.search import search as search_module
from diagnosis.search.decision import Criteria, Round
from diagnosis.search.probability import explanations
from diagnosis.search.search import Search, one_round, search
from diagnosis.search.shortlist import Shortlist
from tests.diagnosis.small_cases import DRIFT, FLOOR, SHIFT, fitted, runs, two_bodies
from tests.twin.recordings import drawn, empty_batches, recorded
from twin.calibration.identifiability import Interval, intervals90
from twin.calibration.least_squares import result
from twin.compile import compile_network

COUNT = 8
COLD = {**FLOOR, "parameters": {"conductance": "8 W/K"}}
SCATTER = np.array([0.8, 1.25, 1.0, 0.7, 1.1, 1.4, 0.9, 1.05])


@cache
def found(case: str) -> Search:
    return search(fitted(two_bodies(), recordings(case)))


def recordings(case: str) -> list[Batch]:
    known = two_bodies()
    if case == "scatter":
        return scattered()
    hidden: dict[str, Any] = {
        "nothing": {}, "floor": {"a": COLD}, "drift": {"a": DRIFT}, "floor and shift": {"a": COLD, "b": SHIFT},
    }[case]  # fmt: skip
    return runs(known, hidden, 6 if case == "floor" else COUNT)


def scattered() -> list[Batch]:
    """Runs whose belts differ."""
    known, out = two_bodies(), []
    network = compile_network(known)
    values = drawn(network, np.random.default_rng(1))
    for k, (batch, factor) in enumerate(zip(empty_batches(known, COUNT), SCATTER, strict=True)):
        own = values.copy()
        own[network.index("mechanisms.belt.power")] *= factor
        out += recorded(known, [batch], own, seed=10 + k)
    return out


def names(done: Search) -> list[str]:
    return [r.best.candidate.plain for r in done.accepted if r.best is not None]


def told(done: Search) -> dict[str, Interval]:
    """By name, numbers of where a shape began left out."""
    fit = result(done.final.problem, done.final.state, 0.01, "")
    number = {r.best.candidate.name: r.best.candidate.plain for r in done.accepted if r.best is not None}
    out = {}
    for i in intervals90(fit, done.final.problem.unknowns):
        group, entry, value = i.name.split(".")
        head, dash, own = entry.rpartition("-")
        out[f"{group}.{head}{dash}{number.get(own, own)}.{value}"] = i
    return out


@pytest.mark.slow
def test_a_cold_floor_is_found_with_its_size() -> None:
    done = found("floor")
    assert names(done) == ["floor_sink_head_room"]
    interval = told(done)["exposures.head-floor_sink_head_room.conductance"]
    assert interval.low < 8.0 < interval.high
    assert interval.value == pytest.approx(8.0, rel=0.05)


def test_what_is_accepted_clears_every_bar() -> None:
    for r in found("floor and shift").accepted:
        assert r.best is not None
        assert r.best.gain > r.threshold >= POLICY.even_odds_gain_nats
        assert r.best.worse <= POLICY.max_worse_share * COUNT
        assert r.threshold >= (r.own_null or r.null).threshold(r.density, name=r.best.candidate.name)
        assert r.sign_p < 0.2


def test_where_nothing_is_missing_nothing_is_accepted() -> None:
    done = found("nothing")
    assert len(done.rounds) == 1 and not done.accepted
    assert done.final.part == done.baseline.part == fitted(two_bodies(), recordings("nothing")).part
    assert done.final.noise.factor.max() < 1.2


@pytest.mark.parametrize("seed", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_nor_with_other_values_and_noise(seed: int) -> None:
    done = search(fitted(two_bodies(), runs(two_bodies(), count=4, seed=seed)))
    assert not done.accepted


def test_a_drifting_sensor_is_the_sensors_fault() -> None:
    done = found("drift")
    assert names(done) == ["sensor_drift_t_head"]
    (r,) = done.accepted
    assert r.best is not None and r.best.candidate.fault
    interval = told(done)["mechanisms.sensor_drift_t_head.rate"]
    assert interval.low < 0.3 < interval.high and interval.high - interval.low < 0.03


def test_friction_that_differs_from_run_to_run_is_told_as_that() -> None:
    done = found("scatter")
    (r,) = done.accepted
    assert r.best is not None and r.best.candidate.mechanism == "varies_between_runs"
    assert r.best.candidate.label == "a value that differs from run to run: mechanisms.belt.power"
    own = done.final.problem.nuisances
    assert done.final.problem.network.parameters[own.parameters[0]].name == "mechanisms.belt.power"
    sizes = np.exp([own.deviation[0] * v[own.shared - 1] for v in done.final.state.nuisance])
    np.testing.assert_allclose(sizes / sizes[2], SCATTER, rtol=0.1)


def test_two_effects_at_once_are_both_found() -> None:
    done = found("floor and shift")
    assert sorted(names(done)) == ["floor_sink_head_room", "speed_shift_z_rpm"]
    intervals = told(done)
    assert intervals["exposures.head-floor_sink_head_room.conductance"].value == pytest.approx(8.0, rel=0.05)
    assert intervals["mechanisms.speed_shift_z_rpm.shift"].value == pytest.approx(6.0, rel=0.05)
    assert [r.accepted for r in done.rounds] == [True, True, False]
    assert done.final.noise.factor.max() < 1.2


@pytest.mark.parametrize("case", [pytest.param("floor", marks=pytest.mark.slow), "floor and shift", "scatter"])
def test_the_best_is_first_and_slack_is_no_news(case: str) -> None:
    for r in found(case).rounds:
        full = [t for t in r.tried if t.fitted is not None and t.candidate.mechanism != "coarse_network"]
        order = [t.standing(r.null.temperature) for t in full]
        assert order == sorted(order, reverse=True)
        assert not {t.candidate.name for t in r.tried} & never_reported(proposed(r.before), r.before)


def test_an_effect_is_asked_where_the_finer_network_before_it_is_not_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside a strong effect a finer network stays below what flipped residuals reach."""
    now = found("drift").baseline
    none = Scored(Candidate("coarse_network", Where("node", "head"), "finer_head", ""), 0.0, 0, 0.0, {}, 0.0, -1)
    finer, asked, real = Tried(none, 45.0, COUNT, "finer_head", 0.0, now), [], decision.evaluated

    def watched(*given: Any) -> Round:
        asked.append(real(*given))
        return asked[-1]

    monkeypatch.setattr(decision, "_independent_refinement", lambda *_: finer)
    monkeypatch.setattr(decision, "evaluated", watched)
    done = one_round(now, 0, Processes(), lambda *_: None)
    assert [(r.best.candidate.name, r.accepted) for r in asked if r.best is not None] == [
        ("finer_head", False), ("sensor_drift_t_head", True),
    ]  # fmt: skip
    assert done is asked[-1] and asked[0].threshold > finer.gain


def criteria() -> Criteria:
    r = found("drift").rounds[0]
    return Criteria(r.before, r.screen, r.null, {}, 0)


@pytest.mark.parametrize("second_gain", [150.0, 90.0])
def test_a_finer_network_that_a_second_effect_explains_does_not_go_first(
    second_gain: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A heat of two that are missing makes the network look too coarse as much as the first of them does not."""
    best = found("drift").rounds[0].best
    assert best is not None
    bare = replace(best.candidate, where=Where("node", "head"), mechanism="motor_loss", name="loss")
    second = replace(best, scored=replace(best.scored, candidate=bare), gain=second_gain, cluster="another")
    coarse = replace(best.candidate, mechanism="coarse_network", name="finer_head")
    finer = replace(best, scored=replace(best.scored, candidate=coarse), gain=60.0, cluster="finer_head")
    monkeypatch.setattr(decision, "_gains_jointly", lambda _, first, t, least=0.0: first is not second)
    monkeypatch.setattr(decision, "optimised", lambda now, t, policy: t)
    got = decision._independent_refinement(criteria(), best, [best, second, finer])
    assert got is (None if second_gain > POLICY.even_odds_gain_nats else finer)


def test_after_one_that_may_not_be_claimed_its_like_is_asked_only_if_it_gains_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Rows count as each fit remembers them: the likeliest may gain less than what looks like it."""
    best = found("drift").rounds[0].best
    assert best is not None

    def named(name: str, gain: float, cluster: str) -> Tried:
        scored = replace(best.scored, candidate=replace(best.candidate, mechanism="motor_loss", name=name))
        return replace(best, scored=scored, gain=gain, cluster=cluster)

    first, more, less = named("first", 176.0, "first"), named("more", 298.0, "first"), named("less", 150.0, "first")
    apart, weak = named("apart", 160.0, "apart"), named("weak", 100.0, "weak")
    monkeypatch.setattr(decision, "_gains_jointly", lambda _, first, t, least=0.0: True)
    assert decision.alternatives_to(criteria(), first, [first, less, more, apart, weak]) == [more, apart]
    monkeypatch.setattr(decision, "_gains_jointly", lambda _, first, t, least=0.0: False)
    assert decision.alternatives_to(criteria(), first, [first, less, more, apart, weak]) == [more]


def test_a_baseline_stays_where_without_the_effect_no_machine_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parameters gone with heat that feeds itself may make a machine that cannot be simulated without it."""

    def stiff(*_: Any) -> None:
        raise InputError("stiff beyond the step control")

    now = fitted(two_bodies(), recordings("drift"))
    monkeypatch.setattr(search_module, "refitted", stiff)
    done = search_module._round_with_fair_baseline(now, 0, Processes(), lambda *_: None, None)
    assert done.accepted and done.before is now and done.best is not None
    assert done.best.candidate.name == "sensor_drift_t_head"


def test_what_gains_by_its_own_memory_alone_is_not_claimed() -> None:
    """A lever of 240 nats with rows as it counts them, of 96 as its rivals do, against a bar of 197."""
    best = found("drift").rounds[0].best
    assert best is not None
    lever = replace(best, gain=240.0, alike=96.0)
    assert decision._less_likely_than_nothing(lever, 197.0, 10.0)  # 101 nats below, in units of 10: odds of e^10
    assert not decision._less_likely_than_nothing(replace(lever, alike=180.0), 197.0, 10.0)
    assert not decision._less_likely_than_nothing(replace(lever, alike=None), 197.0, 10.0)
    finer = replace(best.scored, candidate=replace(best.candidate, mechanism="coarse_network"))
    assert not decision._less_likely_than_nothing(replace(lever, scored=finer), 197.0, 10.0)


def test_physics_never_takes_the_place_of_a_finer_network() -> None:
    """A finer network is accepted for less than a claim is."""
    r = found("drift").rounds[0]
    assert r.best is not None
    near = replace(r.best, cluster=r.best.cluster)
    finer = replace(r.best.scored, candidate=replace(r.best.candidate, mechanism="coarse_network"))
    assert search_module._exchangeable(near, r.best) and not search_module._exchangeable(
        near, replace(r.best, scored=finer)
    )


@pytest.mark.slow
@pytest.mark.parametrize("imitates", [True, False])
def test_another_effect_is_asked_only_where_the_first_leaves_its_gain(
    imitates: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A warm fixture gains 258 nats where the floor is cold, and ten beside a cold floor."""
    now, asked, real = fitted(two_bodies(), recordings("floor and shift")), [], decision.evaluated

    def watched(*given: Any) -> Round:
        done = real(*given)
        asked.append(done if asked else replace(done, accepted=False))
        return asked[-1]

    monkeypatch.setattr(decision, "evaluated", watched)
    if not imitates:
        monkeypatch.setattr(
            decision, "_gains_jointly", lambda _, first, t, *least: t.candidate.name == "mandrel_fixture_z_shaft"
        )
    done = one_round(now, 0, Processes(), lambda *_: None)
    every_asked = [r.best.candidate.plain for r in asked if r.best is not None]
    assert every_asked == ["floor_sink_head_room", *([] if imitates else ["mandrel_fixture_z_shaft"])]
    assert done is asked[-1] and done.accepted is not imitates
    if not imitates:  # what structure may make explains nothing
        barred = {t.candidate.plain for t in done.tried if t.barred}
        assert {"floor_sink_head_room", "jacket_chiller_head"} <= barred and "mandrel_fixture_z_shaft" not in barred
        every, _, _ = explanations(done)
        assert all(e.probability == 0.0 for e in every if e.tried.barred)


def test_a_refit_that_gained_little_in_one_step_is_fitted_on_before_nothing_is_claimed() -> None:
    """Heat to a floor gained 30 nats in one step, and 731 at its optimum."""
    refused, far, finer, weak, third, fourth = (
        of(name, mechanism, gain)
        for name, mechanism, gain in (
            ("floor_sink_bed", "floor_sink", 90.0), ("sun_head", "sun", 62.0), ("finer", "coarse_network", 61.0),
            ("draught_room", "draught", POLICY.second_pass_min_finalist_gain_nats - 1.0),
            ("radiation_head", "radiation", 45.0), ("sun_bed", "sun", 44.0),
        )
    )  # fmt: skip
    begun = replace(refused.scored.candidate, name="floor_sink_bed_2", variant_of="floor_sink_bed")
    again = replace(refused, scored=replace(refused.scored, candidate=begun), gain=80.0)
    more = search_module._second_finalists([refused, again, far, finer, third, fourth, weak], [refused])
    assert more == [far, third]  # not what was refused once, wherever it begins


@pytest.mark.slow
def test_what_only_the_second_look_refits_is_claimed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The shortlist passes the floor over, and what imitates it is refused."""
    asked: list[Round] = []
    listing, real, start = search_module.shortlist, search_module.decided, found("floor").baseline

    def passing_over(*given: Any) -> Shortlist:
        listed = listing(*given)
        floor = {c for s, c in listed.work(range(len(listed.worth))) if s.candidate.mechanism == "floor_sink"}
        return replace(listed, chosen=tuple(k for k in listed.chosen if listed.clusters[k] not in floor))

    def refusing_once(bars: Any, tried: Any) -> Round:
        done = real(bars, tried)
        asked.append(done if asked else replace(done, accepted=False))
        return asked[-1]

    others = ("coolant_jacket", "jacket_chiller", "sun", "hydraulic_unit", "draught")  # that imitate the floor

    def without_imitators(fitted: Fitted) -> list[Candidate]:
        return [c for c in proposed(fitted) if c.mechanism not in others]

    monkeypatch.setattr(search_module, "proposed", without_imitators)
    monkeypatch.setattr(search_module, "shortlist", passing_over)
    monkeypatch.setattr(search_module, "decided", refusing_once)
    done = one_round(start, 0, Processes(), lambda *_: None)
    assert done is asked[1] and done.accepted and done.best is not None
    assert done.best.candidate.plain == "floor_sink_head_room"
    assert asked[0].best is not None and asked[0].best.candidate.mechanism != "floor_sink"


def test_what_is_no_better_the_second_time_is_not_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Both looks of a round come to the same best, which was refused."""
    asked: list[Round] = []
    real = search_module.decided

    def refusing(bars: Any, tried: Any) -> Round:
        asked.append(replace(real(bars, tried), accepted=False))
        return asked[-1]

    monkeypatch.setattr(search_module, "decided", refusing)
    assert one_round(found("drift").baseline, 0, Processes(), lambda *_: None) is asked[0] and len(asked) == 1


def of(name: str, mechanism: str, gain: float) -> Tried:
    scored = Scored(Candidate(mechanism, Where("node", name), name, ""), gain, 10, 0.0, {}, 1.0, 1)
    return Tried(scored, gain, 10, name, 0.0, found("floor").baseline)


@cache
def first_round(seed: int, processes: int = 1) -> Round:
    with Processes(processes) as workers:
        return one_round(found("drift").baseline, seed, workers, lambda *_: None)


def gains(r: Round) -> dict[str, float]:
    return {t.candidate.name: t.gain for t in r.tried}


def test_a_seed_draws_only_the_null() -> None:
    one, other = first_round(0), first_round(1)
    assert list(gains(one)) == list(gains(other))
    assert list(gains(one).values()) == pytest.approx(list(gains(other).values()), rel=1e-6)
    assert not np.array_equal(one.null.gain, other.null.gain)
    assert not np.array_equal(one.flipped, other.flipped)


@pytest.mark.slow
def test_processes_do_not_matter() -> None:
    one, two = first_round(0), first_round(0, processes=2)
    assert list(gains(one)) == list(gains(two))
    assert gains(one) == pytest.approx(gains(two), rel=1e-6)
    assert two.accepted and two.threshold == pytest.approx(one.threshold)
    np.testing.assert_allclose(two.null.gain, one.null.gain)
    np.testing.assert_allclose(two.flipped, one.flipped)
