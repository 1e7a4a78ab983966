"""Arrival plans of a replay, and what its runs add up to."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import pytest

from models.selection.replay import Paired, Replay, Retraining, Run, arrivals

IDS = [f"b{k:02d}" for k in range(30)]
RUN = Run("z", "b", "2025-01-01T08:00", 1, "as recorded", 1, 1, 2.0, 3.0, 9.0, 2.0, 2.5)
TRAINING = Retraining("z", 1, "2025-01-01", 8, 8, None, 1, 1, "champion", "first", 2.0, 4.0, "t", 1.0)


def test_as_recorded_is_one_arrival_a_run_in_order() -> None:
    plan = arrivals(IDS)
    assert [a.batch_id for a in plan] == IDS and [a.number for a in plan] == list(range(1, 31))
    assert {(a.how, a.first, a.new) for a in plan} == {("as recorded", True, True)}


@pytest.mark.parametrize("seed", range(20))
def test_a_disturbed_plan_brings_every_run_whole_in_the_end(seed: int) -> None:
    plan = arrivals(IDS, seed)
    assert plan == arrivals(IDS, seed) != arrivals(IDS, seed + 1)
    assert [a.number for a in plan] == list(range(1, len(plan) + 1))
    for name in IDS:
        mine = [a for a in plan if a.batch_id == name]
        assert [a.first for a in mine] == [True] + [False] * (len(mine) - 1)
        assert sum(a.new for a in mine) == 1
        assert not mine[-1].fault
    kinds = Counter(a.how for a in plan)
    assert kinds["late"] == kinds["out of order"] == kinds["again"] == kinds["faulty"] == kinds["corrected"] == 4
    assert {a.fault for a in plan if a.fault} == {"empty", "cut", "stuck", "scaled"}
    order = [a.batch_id for a in plan if a.first]
    assert order != IDS and sorted(order) == IDS


def test_pairs() -> None:
    p = Paired.of([3.0, 5.0, math.nan], [1.0, 1.0, 1.0])
    assert (p.n, p.difference_um) == (2, 3.0)
    assert p.se_um == pytest.approx(math.sqrt(2) / math.sqrt(2))  # std of 2 and 4 over the root of 2
    assert math.isnan(Paired.of([1.0], [2.0]).se_um) and Paired.of([], []).n == 0


def test_a_score_counts_what_a_champion_predicted() -> None:
    runs = (
        RUN,
        replace(RUN, batch_id="c", arrival=2, S_um=3.0, bound90_S_um=2.9),
        replace(RUN, batch_id="d", arrival=3, retraining=2, champion=2, S_um=1.0, frozen_S_um=4.0),
        replace(RUN, batch_id="e", arrival=4, retraining=2, S_um=math.nan, note="no input"),
    )
    trainings = (TRAINING, replace(TRAINING, number=2, before=1, after=2, bound90_S_um=0.5))
    r = Replay("m", True, None, 8, 4, "quick", arrivals(["b", "c", "d", "e"]), trainings, runs)
    s = r.score("z")
    assert (s.n, s.without, s.retrained) == (3, 1, 1)
    assert s.S_um == 2.0 and s.frozen_S_um == pytest.approx(10 / 3) and s.none_S_um == 9.0
    assert s.against_frozen.difference_um == pytest.approx((1 + 0 + 3) / 3)
    assert (s.covered, s.bounded) == (2, 3)  # below the run's own bound
    assert (s.covered_stated, s.bounded_stated) == (2, 3)  # below 4, 4 and 0.5 µm
    assert r.score("z", 2).n == 1 and r.score("z", 2).S_um == 1.0
    assert r.as_dict()["scores"]["z"]["2"]["frozen_S_um"] == 4.0
