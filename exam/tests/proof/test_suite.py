"""Suites: the mix, seeds that only the secret gives, a setting that does not know the kind, eligible effects, sizes."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2_contingency, kstest

from data.errors import InputError
from thermodrift_exam.plants.effects import EFFECTS
from thermodrift_exam.plants.structure import FEATURES
from thermodrift_exam.proof.spec import KINDS, CaseSpec
from thermodrift_exam.proof.suite import small_suite, suite
from thermodrift_exam.proof.suite.setting import RANGES, setting
from thermodrift_exam.proof.suite.sizes import ALL_OR_NOTHING, SHARE, limit, most, size, table
from thermodrift_exam.proof.suite.suite import (
    AMBIGUOUS,
    FAULTS,
    LACKING,
    MIX,
    PAIRS,
    UNLISTED,
    ambiguous,
    case,
    counts,
    effects,
)

SECRET = bytes(range(32))


def many(cases: int = 2000) -> list[CaseSpec]:
    return suite(SECRET, cases, "sealed")


@pytest.mark.parametrize("cases", [1, 6, 7, 60, 100, 899])
def test_kinds_add_up_and_each_is_within_one_of_its_share(cases: int) -> None:
    found = counts(cases)
    assert sum(found.values()) == cases and list(found) == list(MIX)
    assert all(abs(n - MIX[kind] * cases) < 1.0 for kind, n in found.items())
    assert Counter(c.kind for c in suite(3, cases, "development")) == {k: n for k, n in found.items() if n}


def test_320_cases_give_every_question_its_number() -> None:
    expected = {"nothing": 51, "decoy": 50, "one": 120, "two": 40, "three": 6, "confounded": 10, "unlisted": 40}
    assert counts(320) == expected | {"invisible": 3}
    assert set(expected) | {"invisible"} == set(KINDS)


def test_the_same_secret_gives_the_same_suite_and_another_shares_no_seed() -> None:
    one, again, other = suite(SECRET, 50, "sealed"), suite(SECRET, 50, "sealed"), suite(SECRET[::-1], 50, "sealed")
    development = suite(SECRET, 50, "development")
    assert one == again
    seeds = [{c.seed for c in s} for s in (one, other, development)]
    assert len(set.union(*seeds)) == 150
    assert min(min(s) for s in seeds) > 2**200  # no small number gives a case again


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ((7, 10, "sealed"), "seed: got the number 7, expected 128 bits or more; draw a secret"),
        ((b"short", 10, "sealed"), "seed: got 40 bits, expected 128 bits or more"),
        ((7, 0, "development"), "cases: got 0, expected 1 or more"),
        ((7, 9, "development", ()), "plants: got none, expected elements, volumes, lathe"),
        ((7, 9, "development", ("grafted",)), "plants: got grafted, expected elements, volumes, lathe"),
    ],
)
def test_what_is_asked_wrongly_is_told_in_one_line(given: tuple[Any, ...], words: str) -> None:
    with pytest.raises(InputError) as error:
        suite(*given)
    assert words in str(error.value) and "\n" not in str(error.value)


def test_names_say_nothing_and_kinds_come_by_lot() -> None:
    cases = many(400)
    assert [c.name for c in cases] == [f"case_{k:04d}" for k in range(1, 401)]
    number = {kind: k for k, kind in enumerate(KINDS)}
    order = np.array([number[c.kind] for c in cases])
    assert abs(np.corrcoef(order, np.arange(400))[0, 1]) < 0.15
    for kind in KINDS:
        here = Counter(c.plant for c in cases if c.kind == kind)
        assert abs(here["elements"] - here["volumes"]) <= 1


def test_the_setting_does_not_know_the_kind() -> None:
    """For one seed every kind has the same recorder, shop and engineer; a pair only imposes its habit and features."""
    imposed = ("habit", "has", "lacks")
    for seed in range(2**130, 2**130 + 20):
        drawn = [case("case_0001", kind, "volumes", seed, "sealed").options for kind in KINDS]
        plain = {k: v for k, v in setting(seed, "sealed").items() if k not in imposed}
        assert all({k: v for k, v in options.items() if k not in imposed} == plain for options in drawn)


def test_habits_and_features_are_as_frequent_with_and_without_physics_left_out() -> None:
    cases = many()
    lacking = [c for c in cases if c.kind in LACKING]
    whole = [c for c in cases if c.kind not in LACKING]

    def p_value(of: Any) -> float:
        seen = [Counter(of(c) for c in group) for group in (lacking, whole)]
        values = sorted({v for s in seen for v in s})
        return float(chi2_contingency([[s[v] for v in values] for s in seen]).pvalue)

    assert p_value(lambda c: c.options["habit"]) > 1e-3
    for feature in FEATURES:
        assert p_value(lambda c, f=feature: f in c.options["has"]) > 1e-3
    assert {c.options["habit"] for c in whole} == {pair.habit for pair in PAIRS.values() if pair.habit} | {"ordinary"}


def test_a_case_has_only_what_its_plant_can_have_and_its_file_does_not_state() -> None:
    for c in many():
        stated = set(c.options["has"])
        assert stated | set(c.options["lacks"]) == set(FEATURES) and not stated & set(c.options["lacks"])
        for key in (*c.effects, *c.decoys):
            kind = EFFECTS[key]
            assert kind.withholds not in stated
            assert kind.has - {kind.withholds} <= stated
        told = {"one": 1, "two": 2, "three": 3, "confounded": 1, "unlisted": 1, "invisible": 1}.get(c.kind, 0)
        assert len(c.effects) == told and len(c.decoys) <= (c.kind == "decoy")
        assert set(c.decoys) <= set(FAULTS)
        if c.kind in ("one", "two", "three", "invisible"):
            assert not set(c.effects) & {*FAULTS, *UNLISTED, *AMBIGUOUS, *ambiguous(c.options)}


def test_effects_are_drawn_evenly_among_those_that_a_plant_can_have() -> None:
    expected: Counter[str] = Counter()
    found: Counter[str] = Counter()
    for c in (c for c in many(4000) if c.kind == "one"):
        among = effects(c.options, ambiguous(c.options))
        for key in among:
            expected[key] += 1.0 / len(among)  # type: ignore[assignment]
        found.update(c.effects.keys())
    off = sum((found[k] - e) ** 2 / e for k, e in expected.items())
    assert off < 3 * len(expected)


def test_every_effect_has_a_limit_on_every_simulated_plant() -> None:
    for plant in ("elements", "volumes"):
        assert set(table()["limits"][plant]) == set(EFFECTS)
        assert all(0.0 < limit(key, plant) <= 40.0 for key in EFFECTS)
    assert "quantile" in table()["how"]


def test_sizes_are_even_by_logarithm_from_below_to_ten_times_the_limit() -> None:
    rng = np.random.default_rng(1)
    key = "sun"
    shares = np.array([size(key, "volumes", "one", rng) for _ in range(2000)]) / limit(key, "volumes")
    low, high = SHARE["one"]
    assert (low, high) == (0.3, 10.0)
    assert kstest(np.log(shares / low) / np.log(high / low), "uniform").pvalue > 1e-3
    for kind in ("invisible", "two"):
        drawn = np.array([size(key, "volumes", kind, rng) for _ in range(200)]) / limit(key, "volumes")
        assert SHARE[kind][0] * 0.999 <= drawn.min() and drawn.max() <= SHARE[kind][1] * 1.001
    assert all(size(key, "volumes", "decoy", rng) == 1.0 for key in ALL_OR_NOTHING)
    assert max(size("time_skew", "volumes", "decoy", rng) for _ in range(200)) <= most("time_skew") < 900.0 / 480.0


def test_sealed_settings_reach_beyond_the_development_ones() -> None:
    one, other = RANGES["development"], RANGES["sealed"]
    assert other.spread > one.spread == 1.0
    for name in ("noise_K", "noise_um", "file_error", "coldest_degC", "season_K", "day_h"):
        inner, outer = getattr(one, name), getattr(other, name)
        assert outer[0] <= inner[0] and outer[1] >= inner[1] and outer != inner


def test_the_small_suite_has_one_of_each_that_it_says() -> None:
    cases = small_suite()
    assert [(c.kind, c.plant) for c in cases] == [
        ("nothing", "volumes"), ("decoy", "volumes"), ("one", "elements"), ("one", "volumes"), ("two", "volumes"),
        ("unlisted", "volumes"),
    ]  # fmt: skip
    assert cases == small_suite()
    for c in cases:
        assert CaseSpec(**c.plain()) == c
