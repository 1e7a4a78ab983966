"""Medoids against brute force over all sets, silhouettes against scikit-learn."""

from itertools import combinations

import numpy as np
import pytest
from sklearn.metrics import silhouette_samples
from stacked_rows import LENGTHS, P, orthonormal, stack, year

from data.arrays import Array
from features.selectors.kmedoids import KMedoids, medoids_of_all, partition_around_medoids, silhouettes

TRAIN = [0, 1, 3]


def distances(seed: int) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    p = int(rng.integers(2, 11))
    raw = rng.normal(size=(40, 3)) @ rng.normal(size=(3, p + 1)) + rng.normal(size=(40, p + 1))
    r = np.corrcoef(raw, rowvar=False)
    return 1.0 - np.abs(r[1:, 1:]), np.abs(r[0, 1:])


def cost(distance: Array, medoids: tuple[int, ...]) -> float:
    return sum(min(distance[i, m] for m in medoids) for i in range(len(distance)))


@pytest.mark.parametrize("seed", range(3))
def test_all_sets_are_searched(seed: int) -> None:
    distance, relevance = distances(seed)
    p = len(distance)
    best = medoids_of_all(distance, relevance)
    for n in range(1, p + 1):
        truth = min(combinations(range(p), n), key=lambda m: (round(cost(distance, m), 9), -relevance[list(m)].sum()))
        assert tuple(best[n]) == truth


@pytest.mark.parametrize("seed", range(3))
def test_swapping_ends_where_no_swap_helps(seed: int) -> None:
    distance, relevance = distances(seed)
    p = len(distance)
    for n in range(1, p + 1):
        medoids = tuple(partition_around_medoids(distance, relevance, n))
        assert len(set(medoids)) == n and list(medoids) == sorted(medoids)
        swapped = [set(medoids) - {m} | {j} for m in medoids for j in range(p) if j not in medoids]
        assert all(cost(distance, tuple(s)) >= cost(distance, medoids) - 1e-9 for s in swapped)
        if n in (1, p - 1, p):  # here no swap is missing: the end is the best of all
            assert cost(distance, medoids) == pytest.approx(min(cost(distance, c) for c in combinations(range(p), n)))


def test_of_a_pair_the_one_that_goes_with_the_error_stands_for_it() -> None:
    q = orthonormal(60, 3, seed=1)
    x = np.column_stack([q[:, 0] + 0.2 * q[:, 2], q[:, 0], q[:, 1]])
    for error, first in ((q[:, 0], "t1"), (q[:, 0] + q[:, 2], "t0")):
        for selector in (KMedoids(), KMedoids(most_inputs=1)):
            assert selector.select_design(stack(x, error, [60]), [0], [2])[2] == (first, "t2")


def test_silhouettes_equal_scikit_learn() -> None:
    distance, _ = distances(3)
    p = len(distance)
    for n in range(2, p):
        label = np.argmin(distance[:, partition_around_medoids(distance, np.zeros(p), n)], axis=1)
        truth = silhouette_samples(distance, label, metric="precomputed")
        np.testing.assert_allclose(silhouettes(distance, label), truth, atol=1e-12)


def test_the_mean_silhouette_is_told_where_there_is_one() -> None:
    design = stack(*year(), LENGTHS)
    assert KMedoids().diagnostics(design, TRAIN, 1) == () == KMedoids().diagnostics(design, TRAIN, P)
    x = design.stacked(TRAIN)[0]
    distance = 1.0 - np.abs(np.corrcoef(x, rowvar=False))
    medoids = [int(name[1:]) for name in KMedoids().select_design(design, TRAIN, [3])[3]]
    np.fill_diagonal(distance, 0.0)
    truth = silhouette_samples(distance, np.argmin(distance[:, medoids], axis=1), metric="precomputed").mean()
    (d,) = KMedoids().diagnostics(design, TRAIN, 3)
    assert d.value == pytest.approx(truth) and d.ok == (truth >= 0.25)
