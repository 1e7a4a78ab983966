"""How probable a claim is: by figures free of scale, shared among what recordings cannot distinguish."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from diagnosis.contracts import Candidate, Scored, Where
from diagnosis.policy import POLICY
from diagnosis.search.claims import (
    Figures,
    Round,
    Tried,
    differs,
    explanations,
    figures,
    indistinguishable,
    least_relative_gain,
    probability_cap,
)

SCREEN: Any = None
RUNS = 8


def before(log_evidence: float = -1000.0, runs: int = RUNS) -> Any:
    return SimpleNamespace(log_evidence=log_evidence, runs=runs, batches=())


def tried(
    mechanism: str, place: str, gain: float, cluster: str = "", improved: int = RUNS, log_prior: float = 0.0
) -> Tried:
    """A refit that predicts so many of the runs better; its own cluster if none is given."""
    name = f"{mechanism}_{place}"
    scored = Scored(Candidate(mechanism, Where("node", place), name, name))
    by_run = np.where(np.arange(RUNS) < improved, 1.0, -1.0)
    return Tried(scored, before(), gain, by_run, cluster or name, log_prior)


def judged(*every: Tried, log_evidence: float = -1000.0, runs: int = RUNS, resolved: str = "") -> Round:
    now = before(log_evidence, runs)
    return Round(now, SCREEN, every, figures(now, every), frozenset({resolved} if resolved else ()))


SINK = tried("floor_sink", "bed", 300.0)


# Figures


def test_figures_say_by_how_much_how_alone_and_how_often() -> None:
    rival = tried("radiation", "head", 75.0)
    got = figures(before(-1200.0), [tried("floor_sink", "bed", 300.0, improved=6, log_prior=-2.0), rival])
    assert (got.relative_gain, got.log_odds, got.lead, got.agreeing) == pytest.approx((0.25, -2.0, 0.75, 0.75))


@pytest.mark.parametrize(
    "other",
    [
        tried("floor_sink", "head", 290.0),  # the same law at another place
        tried("radiation", "bed", 290.0),  # another law at the same place
        tried("radiation", "head", 290.0, cluster="floor_sink_bed"),  # of the same signature
    ],
)
def test_what_shares_mechanism_place_or_signature_takes_no_lead(other: Tried) -> None:
    assert not differs(SINK, other)
    assert figures(before(), [SINK, other]).lead == 1.0


def test_a_lead_is_between_minus_and_plus_one() -> None:
    assert figures(before(), [SINK]).lead == 1.0
    assert figures(before(), [SINK, tried("radiation", "head", -50.0)]).lead == 1.0
    assert figures(before(), [SINK, tried("radiation", "head", 3e4)]).lead == -1.0


def test_figures_do_not_depend_on_how_long_was_recorded() -> None:
    """Twice the rows: twice the log evidence and twice every gain."""
    once = figures(before(-1000.0), [SINK, tried("radiation", "head", 100.0)])
    twice = figures(before(-2000.0), [tried("floor_sink", "bed", 600.0), tried("radiation", "head", 200.0)])
    assert once == twice


def test_a_claim_is_more_probable_with_a_larger_gain_alone() -> None:
    gains = np.geomspace(1e-4, 10.0, 12)
    probabilities = [Figures(gain, -1.0, 0.3, 0.7).probability for gain in gains]
    assert 0.0 < probabilities[0] < 0.05 and 0.95 < probabilities[-1] < 1.0 and (np.diff(probabilities) > 0).all()
    assert probabilities == [Figures(gain, -9.0, -1.0, 0.0).probability for gain in gains]


def test_from_the_least_relative_gain_on_a_claim_is_made() -> None:
    at = Figures(least_relative_gain(), 0.0, 1.0, 1.0)
    assert at.probability == pytest.approx(POLICY.claim_min_probability)
    assert replace(at, relative_gain=0.99 * at.relative_gain).probability < POLICY.claim_min_probability
    assert replace(at, relative_gain=1.01 * at.relative_gain).probability > POLICY.claim_min_probability


def test_what_gains_nothing_is_not_claimed() -> None:
    for gain in (0.0, -20.0):
        assert figures(before(), [tried("floor_sink", "bed", gain)]).probability < 0.05


# Rounds


def test_a_round_claims_what_is_probable_or_alone_possible() -> None:
    assert judged(SINK).accepted and judged(SINK).claim_probability == judged(SINK).figures.probability  # type: ignore[union-attr]
    weak = tried("floor_sink", "bed", 0.1)
    assert not judged(weak).accepted
    assert judged(weak, resolved="t_bed").claim_probability == POLICY.max_probability
    assert judged(weak, resolved="t_bed").accepted
    bare = Round(before(), SCREEN, ())
    assert bare.claim_probability == 0.0 and not bare.accepted and bare.best is None


def test_the_threshold_in_nats_grows_with_the_log_evidence() -> None:
    small, large = judged(SINK), judged(SINK, log_evidence=-5000.0)
    assert large.threshold == pytest.approx(5.0 * small.threshold) and small.threshold > 0
    for done in (small, large):
        at = tried("floor_sink", "bed", 1.001 * done.threshold)
        assert judged(at, log_evidence=done.before.log_evidence).accepted


# Explanations


def test_alike_is_what_recordings_or_a_user_do_not_distinguish() -> None:
    assert indistinguishable(SINK, tried("radiation", "head", 10.0, cluster=SINK.cluster))
    near = 0.9 * POLICY.decisive_nats
    assert indistinguishable(SINK, tried("radiation", "bed", SINK.gain - near))
    assert not indistinguishable(SINK, tried("radiation", "bed", SINK.gain - 2.0 * near))
    assert not indistinguishable(SINK, tried("radiation", "head", SINK.gain - near))


@pytest.mark.parametrize("resolved", ["", "t_bed"])
@pytest.mark.parametrize("runs", [1, 3, 12])
def test_probabilities_add_to_one_and_the_claim_shares_its_own_with_what_is_indistinguishable(
    runs: int, resolved: str
) -> None:
    same = tried("radiation", "bed", 299.0, cluster=SINK.cluster)
    rival, weak = tried("draught", "head", 280.0), tried("sun", "head", 3.0)
    done = judged(SINK, same, rival, weak, runs=runs, resolved=resolved)
    every, nothing, unlisted = explanations(done)
    assert sum(e.probability for e in every) + nothing + unlisted == pytest.approx(1.0)
    assert every[0].tried is SINK and {e.tried.candidate.name for e in every if e.indistinguishable} == {
        "floor_sink_bed", "radiation_bed",
    }  # fmt: skip
    own = sum(e.probability for e in every if e.indistinguishable)
    assert own == pytest.approx(min(done.claim_probability, probability_cap(runs)))
    assert all(0.0 <= e.probability <= 1.0 for e in every) and unlisted > 0.0
    assert (nothing == 0.0) == bool(resolved)
    rest = [e.probability for e in every[1:]]
    assert rest == sorted(rest, reverse=True)


def test_without_anything_tried_nothing_is_likelier_than_something_unlisted() -> None:
    every, nothing, unlisted = explanations(Round(before(), SCREEN, ()))
    assert every == [] and nothing + unlisted == pytest.approx(1.0) and nothing > unlisted > 0.0


def test_a_claim_that_alone_is_possible_keeps_its_probability_however_much_others_gain() -> None:
    """Another one gains more, and leaves unexplained what the recordings show and the twin cannot do."""
    done = judged(tried("heat_bridge", "head", 60.0), tried("sensor_drift", "t_head", 9e4), resolved="t_head")
    every, nothing, unlisted = explanations(done)
    assert every[0].probability == pytest.approx(min(done.claim_probability, probability_cap(RUNS)))
    assert sum(e.probability for e in every) + nothing + unlisted == pytest.approx(1.0)
