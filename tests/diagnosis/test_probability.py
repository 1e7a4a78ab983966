"""From scores to probabilities: their sum, their order, and what keeps them from being too sure."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from diagnosis.contracts import Tried
from diagnosis.policy import POLICY
from diagnosis.search.decision import Round
from diagnosis.search.null import Null
from diagnosis.search.probability import explanations, probability_cap, reported

THRESHOLD = 10.0


def tried(gain: float, cluster: int = 0, log_prior: float = 0.0) -> Tried:
    scored: Any = None
    return Tried(scored, gain, 12, f"c{cluster}", log_prior)


def done(*every: Tried, runs: int = 12, typical: float = 0.0, threshold: float = THRESHOLD) -> Round:
    shape = (10, 1)
    null = Null(np.full(shape, typical), np.zeros(shape), np.zeros((*shape, 1)), np.zeros((*shape, 0)))
    before: Any = SimpleNamespace(runs=runs, batches=())
    screen: Any = None
    return Round(before, screen, every, threshold, null, np.zeros((0, 0)), accepted=True)


def numbers(r: Round) -> tuple[list[float], float, float]:
    every, nothing, unlisted = explanations(r)
    return [e.probability for e in every], nothing, unlisted


@pytest.mark.parametrize("gains", [[30.0], [30.0, 29.0, 12.0], [11.0, 11.0], [10.5, 3.0, -4.0]])
def test_they_are_those_of_scores_in_units_of_what_structure_makes(gains: list[float]) -> None:
    every, nothing, unlisted = numbers(done(*(tried(g, k) for k, g in enumerate(gains))))
    weight = np.exp((np.array([*gains, THRESHOLD, max(gains)]) - max(gains)) / POLICY.temperature_bounds_nats[0])
    weight[-1] /= 50
    expected = weight / weight.sum()
    if expected[0] <= 0.99:
        np.testing.assert_allclose([*every, nothing, unlisted], expected)
    assert sum(every) + nothing + unlisted <= 1 + 1e-9
    assert every == sorted(every, reverse=True)


def test_what_only_just_reaches_the_threshold_is_as_likely_as_nothing() -> None:
    (p,), nothing, _ = numbers(done(tried(THRESHOLD)))
    assert p == pytest.approx(nothing)


def test_an_implausible_size_counts_against_it() -> None:
    good, bad = tried(30.0, 0), tried(31.0, 1, log_prior=-3.0)
    every, _, _ = explanations(done(good, bad))
    assert every[0].tried is good


@pytest.mark.parametrize(("runs", "most"), [*enumerate(POLICY.few_runs_max_probability, 1), (6, 0.99), (30, 0.99)])
def test_few_runs_cap_it(runs: int, most: float) -> None:
    assert probability_cap(runs) == most
    (p,), _, _ = numbers(done(tried(500.0), runs=runs))
    assert p == pytest.approx(min(most, 50 / 51))


def test_blocks_of_two_runs_count_as_two() -> None:
    r = done(tried(500.0), runs=2)
    r.before.batches = (None,) * 4  # type: ignore[assignment, misc]
    assert numbers(r)[0] == [pytest.approx(0.7)]
    r.before.runs = 0  # type: ignore[misc]
    assert numbers(r)[0] == [pytest.approx(0.9)]


def test_structure_makes_small_differences_count_less() -> None:
    calm, wild = (done(tried(30.0, 0), tried(26.0, 1), typical=t) for t in (1.0, 100.0))
    assert (
        calm.null.temperature
        == POLICY.temperature_bounds_nats[0]
        < wild.null.temperature
        == POLICY.temperature_bounds_nats[1]
    )
    odds = [np.log(p[0] / p[1]) for p in (numbers(calm)[0], numbers(wild)[0])]
    np.testing.assert_allclose(odds, 4.0 / np.array(POLICY.temperature_bounds_nats))


def test_what_cannot_be_told_from_the_best_is_alike() -> None:
    r = done(tried(30.0, 0), tried(20.0, 0), tried(29.5, 1), tried(15.0, 2))
    alike = {(e.tried.gain, e.tried.cluster): e.alike for e in explanations(r)[0]}
    assert alike == {(30.0, "c0"): True, (20.0, "c0"): True, (29.5, "c1"): True, (15.0, "c2"): False}


def test_only_alternatives_worth_a_line_are_told() -> None:
    every, _, _ = explanations(done(*(tried(90.0 - 0.1 * k, k) for k in range(9)), tried(5.0, 9)))
    assert [e.tried.gain for e in reported(every)] == [e.tried.gain for e in every[1:6]]
    assert (
        all(e.probability >= POLICY.reported_min_probability for e in reported(every, most=20))
        and len(reported(every, most=20)) == 8
    )


def test_without_candidates_nothing_is_likely() -> None:
    every, nothing, unlisted = explanations(done())
    assert every == [] and nothing > 0.95 and nothing + unlisted == pytest.approx(1.0)
