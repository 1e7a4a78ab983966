"""Every selector of the registry under the same rules, and each against a truth of its own."""

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import squareform

from data.batch import Batch, Channel
from data.errors import InputError
from features.design import Design
from features.grey import relational_degree
from features.selectors import SELECTORS
from features.selectors.clusters import partitions, transitive_closure
from features.selectors.statistics import training_statistics

Array = NDArray[np.float64]
LENGTHS = [30, 42, 25, 37, 33]
TRAIN = [0, 1, 3]
P = 7
ALL_N = list(range(1, P + 1))
CHOOSING = [key for key in SELECTORS if SELECTORS[key].takes_n_tsp]


def stack(x: Array, y: Array, lengths: list[int], inputs: tuple[str, ...] | None = None) -> Design:
    inputs = inputs or tuple(f"t{i}" for i in range(x.shape[1]))
    ids = tuple(f"b{k}" for k in range(len(lengths)))
    time_s = np.concatenate([300.0 * np.arange(n) for n in lengths])
    return Design(inputs, "z_um", ids, x, y, time_s, np.cumsum([0, *lengths]), 300.0)


def year() -> tuple[Array, Array]:
    """Rises of 7 sensors that share three slow modes, as a machine's do, and an error made from them."""
    rng = np.random.default_rng(11)
    modes = []
    for n in LENGTHS:
        t = 300.0 * np.arange(n)
        taus = np.array([1500.0, 6000.0, 20000.0])
        modes.append((1 - np.exp(-t[:, None] / taus)) * rng.uniform(0.3, 2.0, 3) * [1, 1, rng.choice([-1, 1])])
    m = np.concatenate(modes)
    x = m @ rng.uniform(0, 6, (3, P)) + rng.normal(0, 0.1, (len(m), P))
    return x, m @ [20.0, 9.0, -12.0] + rng.normal(0, 0.5, len(m))


def chosen(key: str, design: Design, train: list[int] | None = None) -> dict[int, tuple[str, ...]]:
    result: dict[int, tuple[str, ...]] = SELECTORS[key]().select_design(design, train or TRAIN, ALL_N)
    return result


def orthonormal(n: int, p: int, seed: int = 0) -> Array:
    """p uncorrelated sequences of mean 0 and equal length, (n, p)."""
    rng = np.random.default_rng(seed)
    raw = np.column_stack([np.ones(n), rng.normal(size=(n, p))])
    return np.linalg.qr(raw)[0][:, 1:]


@pytest.mark.parametrize("key", SELECTORS)
def test_returns_the_asked_number_of_distinct_inputs_in_the_designs_order(key: str) -> None:
    design = stack(*year(), LENGTHS)
    for n, inputs in chosen(key, design).items():
        assert len(inputs) == (n if SELECTORS[key].takes_n_tsp else P)
        assert list(inputs) == [i for i in design.inputs if i in set(inputs)]


@pytest.mark.parametrize("key", SELECTORS)
def test_left_out_batches_change_nothing(key: str) -> None:
    x, y = year()
    before = chosen(key, stack(x, y, LENGTHS))
    design = stack(x.copy(), y.copy(), LENGTHS)
    for k in set(range(len(LENGTHS))) - set(TRAIN):
        design.x[design.rows(k)] = 50 + 40 * np.random.default_rng(k).normal(size=(LENGTHS[k], P))
        design.y_um[design.rows(k)] *= -9
    design.x[design.rows(2)][3:9, 1] = np.nan
    assert chosen(key, design) == before


@pytest.mark.parametrize("key", CHOOSING)
def test_training_batches_do_change_the_choice(key: str) -> None:
    x, y = year()
    design = stack(x.copy(), y.copy(), LENGTHS)
    before = chosen(key, design)
    others = stack(x[:, ::-1].copy(), y, LENGTHS)
    assert chosen(key, others) != before


@pytest.mark.parametrize("key", SELECTORS)
def test_order_of_batches_and_repeating_do_not_matter(key: str) -> None:
    x, y = year()
    design = stack(x, y, LENGTHS)
    order = [4, 2, 0, 3, 1]
    rows = np.concatenate([np.arange(len(y))[design.rows(k)] for k in order])
    turned = stack(x[rows], y[rows], [LENGTHS[k] for k in order])
    assert chosen(key, turned, [order.index(k) for k in TRAIN]) == chosen(key, design)
    assert chosen(key, design) == chosen(key, design)
    assert chosen(key, design, TRAIN[::-1]) == chosen(key, design)


@pytest.mark.parametrize("key", SELECTORS)
def test_unit_and_sign_of_an_input_do_not_matter(key: str) -> None:
    x, y = year()
    factor = np.array([1.8, 1000.0, 1.0, 0.01, -1.0, 3.0, -0.5])
    assert chosen(key, stack(x * factor, y * 0.001, LENGTHS)) == chosen(key, stack(x, y, LENGTHS))


@pytest.mark.parametrize("key", SELECTORS)
def test_order_of_inputs_does_not_matter_without_ties(key: str) -> None:
    x, y = year()
    order = [3, 0, 6, 2, 5, 1, 4]
    names = tuple(f"t{i}" for i in range(P))
    turned = stack(x[:, order], y, LENGTHS, tuple(names[i] for i in order))
    plain = stack(x, y, LENGTHS)
    for n, inputs in chosen(key, turned).items():
        if key != "pca_elimination" or n > 1:  # the last two inputs are always tied
            assert set(inputs) == set(chosen(key, plain)[n])


@pytest.mark.parametrize("key", CHOOSING)
def test_constant_inputs_are_never_chosen_before_others(key: str) -> None:
    x, y = year()
    x[:, 0], x[:, 4] = 0.0, 3000.0
    for n, inputs in chosen(key, stack(x, y, LENGTHS)).items():
        assert len(inputs) == n
        if n <= P - 2:
            assert not {"t0", "t4"} & set(inputs)
        elif n == P - 1:
            assert "t0" in inputs and "t4" not in inputs


@pytest.mark.parametrize("key", CHOOSING)
def test_equal_inputs_are_a_tie_for_the_first(key: str) -> None:
    x, y = year()
    x[:, 5] = x[:, 1]
    x[:, 6] = x[:, 1] * 2.0
    for n, inputs in chosen(key, stack(x, y, LENGTHS)).items():
        if "t5" in inputs or "t6" in inputs:
            assert "t1" in inputs, n


@pytest.mark.parametrize("key", CHOOSING)
def test_a_target_that_stands_still_still_gives_a_choice(key: str) -> None:
    x, y = year()
    assert [len(v) for v in chosen(key, stack(x, np.zeros_like(y), LENGTHS)).values()] == ALL_N
    assert [len(v) for v in chosen(key, stack(np.zeros_like(x), y, LENGTHS)).values()] == ALL_N


@pytest.mark.parametrize("key", CHOOSING)
@pytest.mark.parametrize("n", [0, -1, 8])
def test_a_number_that_cannot_be_is_refused(key: str, n: int) -> None:
    with pytest.raises(InputError, match=rf"^selector {key}: n_tsp is {n}; expected 1 to 7, the number of inputs$"):
        SELECTORS[key]().select_design(stack(*year(), LENGTHS), TRAIN, [2, n])


@pytest.mark.parametrize("key", CHOOSING)
def test_training_without_usable_rows_is_refused_with_the_input_to_blame(key: str) -> None:
    x, y = year()
    design = stack(x, y, LENGTHS)
    x[design.rows(1), 2] = np.nan
    expected = r"0 usable rows in the training batches \(b1\), expected at least 3; 't2' is missing in 42 of 42 rows"
    with pytest.raises(InputError, match=expected):
        SELECTORS[key]().select_design(design, [1], [2])


@pytest.mark.parametrize("key", SELECTORS)
def test_batches_of_temperatures_go_in_too(key: str) -> None:
    x, y = year()
    design = stack(x, y, LENGTHS)
    channels = {f"t{i}": Channel(f"t{i}", "temperature", "degC") for i in range(P)}
    channels["z_um"] = Channel("z_um", "error", "um")
    batches = []
    for k in TRAIN:
        rows = design.rows(k)
        table = pd.DataFrame({"time_s": design.time_s[rows], **{f"t{i}": x[rows, i] + 21 for i in range(P)}})
        batches.append(Batch("vmc", f"b{k}", table.assign(z_um=y[rows]), channels))
    assert len(SELECTORS[key]().select(batches, "z_um", 3)) == (3 if SELECTORS[key].takes_n_tsp else P)


def test_correlations_from_sums_equal_numpy_on_stacked_rows() -> None:
    x, y = year()
    x[5:9, 3] = np.nan
    y[40:44] = np.nan
    design = stack(x, y, LENGTHS)
    statistics = training_statistics(design, TRAIN, "any")
    rows, target, _ = design.stacked(TRAIN)
    truth = np.corrcoef(np.column_stack([rows, target]), rowvar=False)
    assert np.allclose(statistics.between, truth[:P, :P], atol=1e-12)
    assert np.allclose(statistics.with_target, truth[:P, P], atol=1e-12)
    order = np.argsort(-np.abs(truth[:P, P]))
    for n, inputs in chosen("correlation", design).items():
        assert set(inputs) == {f"t{i}" for i in order[:n]}


@pytest.mark.parametrize("seed", range(20))
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


def test_pca_elimination_on_three_sensors_by_hand() -> None:
    q = orthonormal(40, 2)
    x = np.column_stack([0.6 * q[:, 0] + 0.8 * q[:, 1], q])
    # R = [[1 .6 .8], [.6 1 0], [.8 0 1]]: eigenvalue 0 with (1, −.6, −.8)/√2, so the first goes; then R = I, a tie
    got = SELECTORS["pca_elimination"]().select_design(stack(x, q[:, 0], [20, 20]), [0, 1], [1, 2, 3])
    assert got == {3: ("t0", "t1", "t2"), 2: ("t1", "t2"), 1: ("t1",)}


def test_pca_elimination_drops_twins_first_and_is_blind_to_the_error() -> None:
    q = orthonormal(40, 3, seed=4)
    x = np.column_stack([q[:, 0], q[:, 1], q[:, 0], q[:, 2] + 0.3 * q[:, 1], 5 * q[:, 0]])  # t2 and t4 are t0 again
    design, other = stack(x, q[:, 0], [40]), stack(x, q[:, 2], [40])
    got = SELECTORS["pca_elimination"]().select_design(design, [0], [3, 4])
    assert got == {4: ("t0", "t1", "t2", "t3"), 3: ("t0", "t1", "t3")}
    assert SELECTORS["pca_elimination"]().select_design(other, [0], [3, 4]) == got


def test_pca_elimination_breaks_the_tightest_relation_first() -> None:
    r = np.zeros((5, 5))
    r[:3, :3], r[3:, 3:] = 0.8, 0.99  # three loose neighbours and a tight pair: eigenvalues 2.6 .2 .2 and 1.99 .01
    np.fill_diagonal(r, 1.0)
    q = orthonormal(60, 5, seed=6)
    design = stack(q @ np.linalg.cholesky(r).T, q[:, 0], [60])
    got = SELECTORS["pca_elimination"]().select_design(design, [0], [1, 2, 3, 4])
    # the pair's later one; then .2 is shared by the three, whose last goes; then ties
    assert got == {4: ("t0", "t1", "t2", "t3"), 3: ("t0", "t1", "t3"), 2: ("t0", "t3"), 1: ("t0",)}


def test_pca_elimination_equals_the_last_right_singular_vector_of_the_standardised_rows() -> None:
    x, y = year()
    design = stack(x, y, LENGTHS)
    rows = design.stacked(TRAIN)[0]
    z = (rows - rows.mean(axis=0)) / rows.std(axis=0)
    left = list(range(P))
    while len(left) > 2:
        left.pop(int(np.argmax(np.abs(np.linalg.svd(z[:, left])[2][-1]))))
        assert chosen("pca_elimination", design)[len(left)] == tuple(f"t{i}" for i in left)


def chain() -> tuple[Array, Array]:
    """Two groups with correlation 0.6 (t0 t1 | t3 t4), a sensor half-way between (t2) and an odd one (t5)."""
    q = orthonormal(200, 5, seed=5)
    a, b = q[:, 0], 0.6 * q[:, 0] + 0.8 * q[:, 1]
    x = np.column_stack([a, a + 0.2 * q[:, 2], a + b, b + 0.2 * q[:, 3], b, 0.4 * a + q[:, 4]])
    return x, a - b


def test_fcgc_chains_two_groups_together_through_one_sensor_between_them() -> None:
    x, y = chain()
    design = stack(x, y, [100, 100])
    similarity = np.abs(training_statistics(design, [0, 1], "any").between)
    assert similarity[0, 4] == pytest.approx(0.6)  # below any sensible cut
    assert transitive_closure(similarity)[0, 4] == pytest.approx(np.sqrt(0.8))  # 2 steps over t2
    assert partitions(transitive_closure(similarity))[1].tolist() == [0, 0, 0, 0, 0, 5]
    two = SELECTORS["fcgc"]().select_design(design, [0, 1], [2])[2]
    assert "t5" in two and len({"t0", "t1", "t3", "t4"} & set(two)) <= 1  # y = a − b needs one of each group


@pytest.mark.parametrize("key", ["fcgc", "fuzzy_correlation"])
def test_the_best_of_every_cluster_is_taken(key: str) -> None:
    x, y = year()
    design = stack(x, y, LENGTHS)
    rows, target, _ = design.stacked(TRAIN)
    truth = np.corrcoef(np.column_stack([rows, target]), rowvar=False)
    score = relational_degree(rows, target) if key == "fcgc" else np.abs(truth[:P, P])
    tree = linkage(squareform(1 - np.abs(truth[:P, :P]), checks=False), "single")
    for n, inputs in chosen(key, design).items():
        classes = fcluster(tree, n, "maxclust")
        best = {max(np.flatnonzero(classes == c), key=lambda i: score[i]) for c in set(classes)}
        assert set(inputs) == {f"t{i}" for i in best}
