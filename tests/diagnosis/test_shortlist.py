"""Which candidates are refitted: the best, the best of other mechanisms, and what only sharp rows show."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from data.processes import Processes
from diagnosis.contracts import Candidate, Kind, Scored, Tried, Where
from diagnosis.policy import POLICY
from diagnosis.search import refits
from diagnosis.search.refits import continued
from diagnosis.search.shortlist import Shortlist, cluster_mates, neighbours, not_refitted, shortlist, with_sharp


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


FIRST = Shortlist(
    (scored("sun", 90.0), scored("draught", 60.0), scored("sun", 50.0, "bed")), ("c0", "c1", "c0"), (0, 1)
)


def names(done: Shortlist) -> list[str]:
    return [done.worth[k].candidate.name for k in done.chosen]


def test_what_rows_in_full_show_of_another_mechanism_is_refitted_too() -> None:
    done = with_sharp(FIRST, [scored("sun", 900.0), scored("radiation", 200.0)], EVIDENCE)
    assert names(done) == ["sun_head", "draught_head", "radiation_head"]
    assert len(set(done.clusters[k] for k in done.chosen)) == 3  # a cluster of its own
    np.testing.assert_allclose(done.worth[-1].moves, -2.0 * EVIDENCE.shadow[:, 3])  # begins at the joint optimum there


def test_only_errors_send_theirs() -> None:
    sharp = [scored("sun", 900.0), scored("draught", 500.0, "bed"), scored("radiation", 200.0)]
    assert names(with_sharp(FIRST, sharp, EVIDENCE))[2:] == ["radiation_head"]
    assert with_sharp(FIRST, [scored("sun", 800.0, alike="radiation")], EVIDENCE) == FIRST


def test_what_gains_little_beside_the_best_is_not() -> None:
    sharp = [scored("sun", 900.0), scored("radiation", 0.9 * POLICY.sharp_gain_share * 900.0)]
    assert with_sharp(FIRST, sharp, EVIDENCE) == FIRST


def test_what_looks_like_one_that_is_refitted_is_not() -> None:
    sharp = [scored("sun", 900.0), scored("radiation", 800.0, alike="sun"), scored("floor_sink", 200.0)]
    assert names(with_sharp(FIRST, sharp, EVIDENCE)) == ["sun_head", "draught_head", "floor_sink_head"]


def test_there_are_few_of_them_and_each_candidate_stands_once() -> None:
    worth = (*FIRST.worth, scored("floor_sink", 3.0))
    sharp = [scored(m, 500.0 - k) for k, m in enumerate(["floor_sink", "radiation", "time_skew", "speed_shift"])]
    done = with_sharp(Shortlist(worth, (0, 1, 0, 2), (0, 1)), sharp, EVIDENCE)
    assert len(done.chosen) == 2 + POLICY.sharp_refits
    every = [s.candidate.name for s in done.worth]
    assert len(every) == len(set(every)) == len(done.clusters)
    assert names(done)[2] == "floor_sink_head"


@pytest.mark.parametrize(("gains", "refitted"), [((90.0, 60.0, 5.5, 4.5), 3), ((90.0, 4.5, 4.0, 3.0), 2)])
def test_beyond_the_first_two_a_refit_must_promise_something(gains: tuple[float, ...], refitted: int) -> None:
    news = [scored(m, g) for m, g in zip(("sun", "draught", "radiation", "floor_sink"), gains, strict=True)]
    listed = shortlist(news, EVIDENCE)
    assert [listed.worth[k].gain for k in listed.chosen] == list(gains[:refitted]) and len(listed.worth) == len(gains)


def test_a_strong_effect_has_more_imitators_refitted() -> None:
    """Ten of them, where they gain a quarter of the best; seven of those that gain less."""
    names = [*COLUMNS, *(f"law{k}" for k in range(8))]
    for last, refitted in (
        (30.0, POLICY.refits_with_other_mechanisms + POLICY.refits_of_strong_mechanisms),
        (20.0, POLICY.refits_with_other_mechanisms),
    ):
        news = [many(m, 100.0 if k < 1 else last, k) for k, m in enumerate(names)]
        assert len(shortlist(news, EVIDENCE).chosen) == refitted


def many(mechanism: str, gain: float, column: int) -> Scored:
    candidate = Candidate(mechanism, Where("node", "head"), mechanism, "")
    return Scored(candidate, gain, 10, 0.0, {"size": 2.0}, 1.0, column)


def tried(s: Scored, gain: float, cluster: str) -> Tried:
    return Tried(s, gain, 10, cluster, 0.0)


def test_where_what_speaks_for_a_cluster_falls_its_mates_are_refitted() -> None:
    clock, shift, weak = scored("time_skew", 210.0), scored("speed_shift", 208.0), scored("floor_sink", 15.0)
    listed = Shortlist((clock, shift, weak), ("c0", "c0", "c0"), (0,))
    assert cluster_mates(listed, [tried(clock, 20.0, "c0")]) == [(shift, "c0")]
    assert cluster_mates(listed, [tried(clock, 150.0, "c0")]) == []  # it speaks for them
    apart = replace(listed, clusters=("c0", "c1", "c0"))
    assert cluster_mates(apart, [tried(clock, 20.0, "c0")]) == []  # another cluster, and one that gains too little
    assert cluster_mates(replace(listed, chosen=(0, 1)), [tried(clock, 20.0, "c0")]) == []  # refitted already


def test_what_multiplies_a_heat_is_refitted_beside_what_speaks_for_it() -> None:
    """Preload that feeds itself gains far more than its linear trace says."""
    loss, feedback = scored("motor_loss", 114.0, alike="sun"), scored("preload_feedback", 107.0, alike="sun")
    assert cluster_mates(Shortlist((loss, feedback), ("c0", "c0"), (0,)), [tried(loss, 156.0, "c0")]) == [
        (feedback, "c0")
    ]
    assert cluster_mates(Shortlist((feedback, loss), ("c0", "c0"), (0,)), [tried(feedback, 900.0, "c0")]) == []


def test_before_nothing_is_claimed_the_places_of_the_best_are_looked_at_again() -> None:
    """Natural convection at a motor showed 2 nats of its 349 in the screen, where radiation there showed 56."""
    first, convection = scored("sun", 56.0, "motor"), scored("draught", 2.0, "motor")
    like, other, far = scored("sun", 1.5, "head"), scored("draught", 9.0, "bed"), scored("sun", 20.0, "table")
    listed = Shortlist((first, far, other, convection, like), ("c0", "c1", "c2", "c3", "c0"), (0, 1))
    best, second = tried(first, 55.0, "c0"), tried(far, 12.0, "c1")
    finer = replace(first, candidate=replace(first.candidate, mechanism="coarse_network", where=other.candidate.where))
    asked = {first.candidate.name, far.candidate.name}
    assert neighbours(listed, [tried(finer, 90.0, "c9"), best, second], asked) == [(convection, "c3")]
    assert neighbours(listed, [best, second], asked | {convection.candidate.name}) == []


def test_each_place_sends_few_and_each_cluster_one() -> None:
    laws = [many(f"law{k}", 9.0 - k, k) for k in range(POLICY.refits_per_revisited_place + 3)]
    ids = [f"c{k}" for k in range(POLICY.refits_per_revisited_place + 2)]
    listed = Shortlist(tuple(laws), (*ids[:2], *ids[1:]), (0,))
    done = neighbours(listed, [tried(laws[0], 30.0, ids[0])], {laws[0].candidate.name})
    assert [cluster for _, cluster in done] == ids[1 : POLICY.refits_per_revisited_place + 1]
    assert POLICY.revisited_places > 1


def test_what_was_never_refitted_is_as_much_worse_than_its_cluster_as_the_screen_says() -> None:
    clock, shift, bar = scored("time_skew", 210.0), scored("speed_shift", 198.0), scored("floor_sink", 150.0)
    listed = Shortlist((clock, shift, bar), ("c0", "c0", "c1"), (0,))
    best = replace(tried(clock, 320.0, "c0"), alike=300.0)
    (like,) = not_refitted(listed, {clock.candidate.name}, [best])  # none of the bar's cluster was refitted
    assert (like.scored, like.gain, like.alike, like.fitted) == (shift, 308.0, 288.0, None)
    assert not_refitted(listed, {s.candidate.name for s in listed.worth}, [best]) == []  # or could not be simulated


def test_a_refit_far_short_of_its_promise_is_fitted_on(monkeypatch: pytest.MonkeyPatch) -> None:
    on: list[str] = []

    def further(now: Any, t: Tried) -> Tried:
        on.append(t.candidate.mechanism)
        return replace(t, gain=277.0)

    monkeypatch.setattr(refits, "optimised", further)
    fit: Any = object()
    promises = {"sun": (169.0, 30.0), "draught": (90.0, 60.0), "radiation": (80.0, 10.0), "floor_sink": (70.0, 5.0)}
    every = [replace(tried(scored(m, p), g, 0), fitted=fit) for m, (p, g) in promises.items()]
    done = continued(fit, [*every, tried(scored("time_skew", 500.0), 1.0, "c0")], Processes())
    assert on == ["sun", "radiation"]  # the two of the highest promise; the draught keeps its own, a clock has no fit
    assert [t.gain for t in done] == [277.0, 60.0, 277.0, 5.0, 1.0]
