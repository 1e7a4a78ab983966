"""Fuzzy clusters against max–min powers and single linkage, and the two selectors that take the best of each."""

import numpy as np
import pytest
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import squareform
from stacked_rows import LENGTHS, P, chain, stack, year

from features.grey import relational_degree
from features.selectors import SELECTORS
from features.selectors.clusters import partitions, transitive_closure
from features.selectors.statistics import training_statistics

TRAIN = [0, 1, 3]
EVERY = range(len(LENGTHS))


@pytest.mark.parametrize("seed", range(3))
def test_closure_is_the_fixed_point_of_max_min_and_equals_single_linkage(seed: int) -> None:
    rng = np.random.default_rng(seed)
    p = int(rng.integers(2, 13))
    r = np.abs(np.corrcoef(rng.normal(size=(p, 6))))
    r = (r + r.T) / 2
    np.fill_diagonal(r, 1.0)
    squared = r
    for _ in range(p):
        squared = np.maximum.reduce([np.minimum(squared[:, k, None], squared[None, k]) for k in range(p)])
    closure = transitive_closure(r)
    assert np.array_equal(closure, squared)
    tree = linkage(squareform(1 - r, checks=False), "single")
    classes = partitions(closure)
    for n in range(1, p + 1):
        truth = fcluster(tree, n, "maxclust")
        assert len(set(classes[n - 1])) == n
        assert np.array_equal(truth[:, None] == truth, classes[n - 1][:, None] == classes[n - 1])


def test_ties_in_the_closure_are_split_in_input_order() -> None:
    r = np.full((4, 4), 0.5) + 0.5 * np.eye(4)
    assert partitions(transitive_closure(r)).tolist() == [[0, 0, 0, 0], [0, 0, 0, 3], [0, 0, 2, 3], [0, 1, 2, 3]]


def test_fcgc_chains_two_groups_together_through_one_sensor_between_them() -> None:
    design = chain()
    similarity = np.abs(training_statistics(design, EVERY, "any").between)
    assert similarity[0, 4] == pytest.approx(0.6)  # below any sensible cut
    assert transitive_closure(similarity)[0, 4] == pytest.approx(np.sqrt(0.8))  # 2 steps over t2
    assert partitions(transitive_closure(similarity))[1].tolist() == [0, 0, 0, 0, 0, 5]
    two = SELECTORS["fcgc"]().select_design(design, EVERY, [2])[2]
    assert "t5" in two and len({"t0", "t1", "t3", "t4"} & set(two)) <= 1  # y = a − b needs one of each group


@pytest.mark.parametrize("key", ["fcgc", "fuzzy_correlation"])
def test_the_best_of_every_cluster_is_taken(key: str) -> None:
    x, y = year()
    design = stack(x, y, LENGTHS)
    rows, target, _ = design.stacked(TRAIN)
    truth = np.corrcoef(np.column_stack([rows, target]), rowvar=False)
    score = relational_degree(rows, target) if key == "fcgc" else np.abs(truth[:P, P])
    tree = linkage(squareform(1 - np.abs(truth[:P, :P]), checks=False), "single")
    for n, inputs in SELECTORS[key]().select_design(design, TRAIN, range(1, P + 1)).items():
        classes = fcluster(tree, n, "maxclust")
        best = {max(np.flatnonzero(classes == c), key=lambda i: score[i]) for c in set(classes)}
        assert set(inputs) == {f"t{i}" for i in best}
