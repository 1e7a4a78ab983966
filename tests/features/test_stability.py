"""Stability of chosen sets against pairs counted by hand."""

from itertools import combinations

import numpy as np
import pytest

from data.errors import InputError
from features.stability import tsp_frequency, tsp_stability


def test_stability_by_hand() -> None:
    assert tsp_stability([("a", "b")]) == 1.0
    assert tsp_stability([("a", "b"), ("a", "b")]) == 1.0
    assert tsp_stability([("a", "b"), ("c", "d")]) == 0.0
    # pairs: 1/3, 1/3, 1
    assert tsp_stability([("a", "b"), ("b", "c"), ("c", "b")]) == pytest.approx(5 / 9)


def test_stability_equals_the_mean_over_all_pairs() -> None:
    rng = np.random.default_rng(0)
    sets = [tuple(rng.choice(list("abcde"), size=3, replace=False).tolist()) for _ in range(20)]
    pairs = [len({*a} & {*b}) / len({*a} | {*b}) for a, b in combinations(sets, 2)]
    assert tsp_stability(sets) == pytest.approx(np.mean(pairs))


def test_frequency_counts_and_sorts() -> None:
    frequency = tsp_frequency([("b", "a"), ("b", "c"), ("b", "a"), ("b", "d")])
    assert list(frequency.items()) == [("b", 1.0), ("a", 0.5), ("c", 0.25), ("d", 0.25)]


def test_no_set_is_refused() -> None:
    for function in (tsp_stability, tsp_frequency):
        with pytest.raises(InputError, match="got no set; expected one per fold"):
            function([])
