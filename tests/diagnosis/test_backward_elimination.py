"""What a search changes once all effects are in, and what it puts before an effect."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from diagnosis.contracts import Candidate, Scored, Tried, Where
from diagnosis.search import decision
from diagnosis.search.decision import Criteria
from diagnosis.search.search import Revision, best_change

TEMPERATURE, BATCHES = 8.0, 12
FITTED: Any = object()
NOW: Any = SimpleNamespace(batches=[None] * BATCHES)
NONE: Any = None
CRITERIA = Criteria(NOW, NONE, NONE, {}, 0)


def tried(mechanism: str, gain: float, log_prior: float = 0.0, worse: int = 0) -> Tried:
    c = Candidate(mechanism, Where("node", "head"), f"{mechanism}_head", "")
    better = BATCHES - worse
    return Tried(Scored(c, gain, better, 0.0, {}, 0.0, -1), gain, better, c.name, log_prior, FITTED, worse=worse)


def test_an_effect_goes_that_the_others_make_needless() -> None:
    effects = [tried("cabinet_heat", 300.0), tried("sun", 200.0)]
    dear, cheap, cheaper = (Revision(k, None, loss, FITTED) for k, loss in ((0, 150.0), (1, 60.0), (0, 20.0)))
    assert best_change([dear], effects, TEMPERATURE) is None
    assert best_change([dear, cheap, cheaper], effects, TEMPERATURE) is cheaper


def test_a_small_effect_that_nothing_made_needless_stays() -> None:
    effects = [tried("coarse_network", 105.0), tried("viscosity_feedback", 149.0)]
    assert best_change([Revision(1, None, 93.0, FITTED)], effects, TEMPERATURE) is None
    needless = Revision(1, None, 60.0, FITTED)
    assert best_change([needless], effects, TEMPERATURE) is needless


@pytest.mark.parametrize(("gains", "changes"), [(2.0, False), (10.0, False), (15.0, False), (30.0, True)])
def test_a_less_plausible_rival_must_gain_what_it_is_less_plausible(gains: float, changes: bool) -> None:
    effects, rival = [tried("nut_friction", 900.0, -1.0)], tried("guide_friction", 900.0, -3.0)
    swap = Revision(0, rival, -gains, FITTED)
    assert (best_change([swap], effects, TEMPERATURE) is swap) is changes


def test_a_more_plausible_rival_need_not_even_fit_better() -> None:
    effects, rival = [tried("guide_friction", 900.0, -3.0)], tried("nut_friction", 900.0, -1.0)
    swap = Revision(0, rival, 5.0, FITTED)
    assert best_change([swap], effects, TEMPERATURE) is swap


@pytest.mark.parametrize(("joint", "first"), [(95.0, True), (45.0, True), (35.0, False), (-4.0, False), (None, False)])
def test_a_finer_network_that_an_effect_does_not_explain_comes_first(
    joint: float | None, first: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It gains nearly as much with the effect in as without."""
    best, finer = tried("belt_loss", 160.0), tried("coarse_network", 100.0)
    monkeypatch.setattr(decision, "refit", lambda *_: None if joint is None else tried("coarse_network", joint))
    monkeypatch.setattr(decision, "optimised", lambda now, t, policy: t)
    assert decision._independent_refinement(CRITERIA, best, [best, finer]) is (finer if first else None)


def test_one_that_gains_little_or_makes_many_batches_worse_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decision, "refit", lambda *_: tried("coarse_network", 100.0))
    monkeypatch.setattr(decision, "optimised", lambda now, t, policy: t)
    for finer in (tried("coarse_network", 39.0), tried("coarse_network", 100.0, worse=6)):
        assert decision._independent_refinement(CRITERIA, tried("belt_loss", 160.0), [finer]) is None
