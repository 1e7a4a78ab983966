"""A law of open shape enters the comparison at the seat where its refit gains most, whatever the screen thought."""

from __future__ import annotations

from collections.abc import Sequence

from diagnosis.contracts import Candidate, Scored, Tried, Where
from diagnosis.policy import POLICY
from diagnosis.search.shortlist import at_best_placements
from twin.schema import MechanismPart

GAINS = {"bar_front": 520.0, "bar_rear": 140.0, "bar_shaft": 340.0}  # nats of a refit


def scored(name: str, gain: float, shape: tuple[str, ...] = ("capacity",)) -> Scored:
    """Of a law at one place that looks at a body: `LAW_BODY`."""
    law, body = name.split("_")
    c = Candidate(law, Where("error", "z"), name, "", MechanismPart(law=law, at=body), shape=shape)
    return Scored(c, gain, 10, 0.0, {"gain": 2.0}, 1.0, 1)


def tried(s: Scored, gain: float) -> Tried:
    return Tried(s, gain, 10, "c1", 0.0)


SHAFT, REAR, FRONT = scored("bar_shaft", 35.0), scored("bar_rear", 32.0), scored("bar_front", 29.0)
GROWTH = tried(scored("growth_shaft", 25.0, ()), 500.0)


def asked(at: Sequence[Tried], n: int, screened: Sequence[Scored]) -> tuple[list[str], list[str], list[str]]:
    """Names of the first and of the rest, and of what was refitted."""
    refitted: list[str] = []

    def refits(some: Sequence[Scored]) -> list[Tried]:
        refitted.extend(s.candidate.name for s in some)
        return [tried(s, GAINS.get(s.candidate.name, 1.0)) for s in some]

    first, rest = at_best_placements(at, n, screened, refits)
    return [t.candidate.name for t in first], [t.candidate.name for t in rest], refitted


def test_the_screens_seat_gives_way_to_one_that_fits_better() -> None:
    first, rest, refitted = asked([GROWTH, tried(SHAFT, 340.0)], 2, [SHAFT, REAR, FRONT])
    assert refitted == ["bar_rear", "bar_front"]
    assert first == ["growth_shaft", "bar_front"]
    assert sorted(rest) == ["bar_rear", "bar_shaft"]  # kept, and not the first


def test_of_two_seats_among_the_first_one_goes_on() -> None:
    first, rest, refitted = asked([tried(SHAFT, 340.0), GROWTH, tried(REAR, 140.0)], 3, [SHAFT, REAR])
    assert refitted == [] and first == ["bar_shaft", "growth_shaft"] and rest == ["bar_rear"]


def test_a_law_whose_shape_is_known_or_that_is_not_among_the_first_stays() -> None:
    other = scored("growth_head", 24.0, ())
    assert asked([GROWTH, tried(SHAFT, 9.0)], 1, [SHAFT, other, FRONT]) == (["growth_shaft"], ["bar_shaft"], [])


def test_few_are_refitted_and_none_that_the_screen_gives_nothing() -> None:
    many = [scored(f"bar_b{k}", 20.0 - k) for k in range(10)]
    assert len(asked([tried(SHAFT, 340.0)], 1, [SHAFT, *many])[2]) == POLICY.placement_refits
    assert asked([tried(SHAFT, 340.0)], 1, [SHAFT, scored("bar_head", 0.9 * POLICY.screen_min_gain_nats)])[2] == []
