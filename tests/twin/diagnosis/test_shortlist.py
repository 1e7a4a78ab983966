"""Which candidates are refitted: the best, the best of other mechanisms, and what only sharp rows show."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from twin.diagnosis.proposals.candidate import Candidate, Kind, Where
from twin.diagnosis.rounds import refits
from twin.diagnosis.rounds.refits import KINDS as KINDS_REFITTED
from twin.diagnosis.rounds.refits import MORE, SHARP, WELL, Tried, mates, short_ones_on, shortlist, with_sharp
from twin.diagnosis.rounds.workers import Workers
from twin.diagnosis.scoring.screen import Scored


def likeness(columns: list[int]) -> NDArray[np.float64]:
    return np.equal.outer(columns, columns).astype(float)


EVIDENCE: Any = SimpleNamespace(shadow=np.arange(60.0).reshape(3, 20), likeness=likeness)


KINDS: dict[str, Kind] = {"sun": "node", "draught": "node"}
COLUMNS = {"sun": 1, "draught": 2, "radiation": 3, "floor_sink": 4, "time_skew": 5, "speed_shift": 6}


def scored(mechanism: str, gain: float, place: str = "head", alike: str = "") -> Scored:
    """`alike`: of the same signature as that mechanism."""
    column = COLUMNS[alike or mechanism] + 10 * (place != "head")
    candidate = Candidate(mechanism, Where(KINDS.get(mechanism, "error"), place), f"{mechanism}_{place}", "")
    return Scored(candidate, gain, 10, 0.0, {"size": 2.0}, 1.0, column)


FIRST = ([scored("sun", 90.0), scored("draught", 60.0), scored("sun", 50.0, "bed")], [0, 1, 0], [0, 1])


def names(done: tuple[list[Scored], list[int], list[int]]) -> list[str]:
    return [done[0][k].candidate.name for k in done[2]]


def test_what_rows_in_full_show_of_another_mechanism_is_refitted_too() -> None:
    done = with_sharp(FIRST, [scored("sun", 900.0), scored("radiation", 200.0)], EVIDENCE)
    assert names(done) == ["sun_head", "draught_head", "radiation_head"]
    assert len(set(done[1][k] for k in done[2])) == 3  # a cluster of its own
    np.testing.assert_allclose(done[0][-1].moves, -2.0 * EVIDENCE.shadow[:, 3])  # begins at the joint optimum there


def test_only_errors_send_theirs() -> None:
    sharp = [scored("sun", 900.0), scored("draught", 500.0, "bed"), scored("radiation", 200.0)]
    assert names(with_sharp(FIRST, sharp, EVIDENCE))[2:] == ["radiation_head"]
    assert with_sharp(FIRST, [scored("sun", 800.0, alike="radiation")], EVIDENCE) == FIRST


def test_what_gains_little_beside_the_best_is_not() -> None:
    sharp = [scored("sun", 900.0), scored("radiation", 0.9 * WELL * 900.0)]
    assert with_sharp(FIRST, sharp, EVIDENCE) == FIRST


def test_what_looks_like_one_that_is_refitted_is_not() -> None:
    sharp = [scored("sun", 900.0), scored("radiation", 800.0, alike="sun"), scored("floor_sink", 200.0)]
    assert names(with_sharp(FIRST, sharp, EVIDENCE)) == ["sun_head", "draught_head", "floor_sink_head"]


def test_there_are_few_of_them_and_each_candidate_stands_once() -> None:
    worth = [*FIRST[0], scored("floor_sink", 3.0)]
    sharp = [scored(m, 500.0 - k) for k, m in enumerate(["floor_sink", "radiation", "time_skew", "speed_shift"])]
    done = with_sharp((worth, [0, 1, 0, 2], [0, 1]), sharp, EVIDENCE)
    assert len(done[2]) == 2 + SHARP
    every = [s.candidate.name for s in done[0]]
    assert len(every) == len(set(every)) == len(done[1])
    assert names(done)[2] == "floor_sink_head"


@pytest.mark.parametrize(("gains", "refitted"), [((90.0, 60.0, 5.5, 4.5), 3), ((90.0, 4.5, 4.0, 3.0), 2)])
def test_beyond_the_first_two_a_refit_must_promise_something(gains: tuple[float, ...], refitted: int) -> None:
    news = [scored(m, g) for m, g in zip(("sun", "draught", "radiation", "floor_sink"), gains, strict=True)]
    worth, _, chosen = shortlist(news, EVIDENCE)
    assert [worth[k].gain for k in chosen] == list(gains[:refitted]) and len(worth) == len(gains)


def test_a_strong_effect_has_more_imitators_refitted() -> None:
    """Ten of them, where they gain a quarter of the best; seven of those that gain less."""
    names = [*COLUMNS, *(f"law{k}" for k in range(8))]
    for last, refitted in ((30.0, KINDS_REFITTED + MORE), (20.0, KINDS_REFITTED)):
        news = [many(m, 100.0 if k < 1 else last, k) for k, m in enumerate(names)]
        assert len(shortlist(news, EVIDENCE)[2]) == refitted


def many(mechanism: str, gain: float, column: int) -> Scored:
    candidate = Candidate(mechanism, Where("node", "head"), mechanism, "")
    return Scored(candidate, gain, 10, 0.0, {"size": 2.0}, 1.0, column)


def tried(s: Scored, gain: float, cluster: int) -> Tried:
    return Tried(s, gain, 10, cluster, 0.0)


def test_where_what_speaks_for_a_cluster_falls_its_mates_are_refitted() -> None:
    clock, shift, weak = scored("time_skew", 210.0), scored("speed_shift", 208.0), scored("floor_sink", 15.0)
    worth, clusters = [clock, shift, weak], [0, 0, 0]
    assert mates([tried(clock, 20.0, 0)], worth, clusters, [0]) == [1]
    assert mates([tried(clock, 150.0, 0)], worth, clusters, [0]) == []  # it speaks for them
    assert mates([tried(clock, 20.0, 0)], worth, [0, 1, 0], [0]) == []  # another cluster, and one that gains too little
    assert mates([tried(clock, 20.0, 0)], worth, clusters, [0, 1]) == []  # refitted already


def test_what_multiplies_a_heat_is_refitted_beside_what_speaks_for_it() -> None:
    """Preload that feeds itself gains far more than its linear trace says."""
    loss, feedback = scored("motor_loss", 114.0, alike="sun"), scored("preload_feedback", 107.0, alike="sun")
    assert mates([tried(loss, 156.0, 0)], [loss, feedback], [0, 0], [0]) == [1]
    assert mates([tried(feedback, 900.0, 0)], [feedback, loss], [0, 0], [0]) == []


def test_a_refit_far_short_of_its_promise_is_fitted_on(monkeypatch: pytest.MonkeyPatch) -> None:
    on: list[str] = []

    def further(now: Any, t: Tried) -> Tried:
        on.append(t.candidate.mechanism)
        return replace(t, gain=277.0)

    monkeypatch.setattr(refits, "taken_on", further)
    fit: Any = object()
    promises = {"sun": (169.0, 30.0), "draught": (90.0, 60.0), "radiation": (80.0, 10.0), "floor_sink": (70.0, 5.0)}
    every = [replace(tried(scored(m, p), g, 0), fitted=fit) for m, (p, g) in promises.items()]
    done = short_ones_on(fit, [*every, tried(scored("time_skew", 500.0), 1.0, 0)], Workers())
    assert on == ["sun", "radiation"]  # the two of the highest promise; the draught keeps its own, a clock has no fit
    assert [t.gain for t in done] == [277.0, 60.0, 277.0, 5.0, 1.0]
