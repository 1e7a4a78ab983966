"""Mutual information against the closed form of a planted copula and against counting; mRMR against its formula."""

import numpy as np
import pytest
from stacked_rows import LENGTHS, P, orthonormal, stack, year

from features.design import decimated_rows
from features.selectors.mrmr import MRMR, incremental_order, mutual_information

TRAIN = [0, 1, 3]


@pytest.mark.parametrize("rho", [0.0, 0.5, -0.9])
def test_information_of_a_gaussian_copula_in_any_scale(rho: float) -> None:
    rng = np.random.default_rng(0)
    a, e = rng.normal(size=(2, 20_000))
    b = rho * a + np.sqrt(1 - rho**2) * e
    shared = mutual_information(np.column_stack([np.exp(3 * a), b**3]))  # monotone, far from normal
    assert shared[0, 1] == pytest.approx(-0.5 * np.log(1 - rho**2), abs=0.02)
    assert shared[0, 1] == shared[1, 0]


def test_a_constant_shares_nothing_and_a_twin_everything() -> None:
    x = np.random.default_rng(2).normal(size=50)
    shared = mutual_information(np.column_stack([x, np.full(50, 3.0), np.exp(x)]))
    assert shared[0, 1] == 0.0 and shared[0, 2] == pytest.approx(-0.5 * np.log(1e-12), rel=1e-3)


def test_the_order_follows_the_formula() -> None:
    rng = np.random.default_rng(3)
    between = rng.uniform(0, 1, (6, 6))
    between, relevance = between + between.T, rng.uniform(0, 2, 6)
    chosen = [int(np.argmax(relevance))]
    while len(chosen) < 6:
        left = [j for j in range(6) if j not in chosen]
        chosen.append(max(left, key=lambda j: relevance[j] - np.mean([between[j, i] for i in chosen])))
    assert incremental_order(between, relevance) == chosen


def test_a_second_cause_comes_before_a_copy_of_the_first() -> None:
    q = orthonormal(600, 4, seed=5)
    x = np.column_stack([q[:, 0], q[:, 0] + 0.2 * q[:, 1], q[:, 2], q[:, 3]])
    design = stack(x, q[:, 0] + 0.4 * q[:, 2], [300, 300])
    assert abs(np.corrcoef(x[:, 1], design.y_um)[0, 1]) > 2 * abs(np.corrcoef(x[:, 2], design.y_um)[0, 1])
    got = MRMR(most_rows=300).select_design(design, [0, 1], [1, 2])
    assert got == {1: ("t0",), 2: ("t0", "t2")}


def test_rows_are_thinned_evenly_in_every_batch() -> None:
    x, y = year()
    y[5:9] = np.nan
    design = stack(x, y, LENGTHS)
    first, second, third = decimated_rows(design, [3, 0, 1], 10)
    assert first[0] == 0 and first[-1] == 29 and not set(range(5, 9)) & set(first)
    assert (second[0], second[-1]) == (30, 71) and (third[0], third[-1]) == (97, 133)
    for rows in (first, second, third):
        assert len(rows) == 10 and np.ptp(np.diff(rows)) <= (5 if rows is first else 1)
    assert [len(r) for r in decimated_rows(design, [0, 2], 100)] == [26, 25]


def test_thinning_hardly_changes_the_choice() -> None:
    design = stack(*year(), LENGTHS)
    few, all_rows = (MRMR(most_rows=n).select_design(design, TRAIN, range(1, P + 1)) for n in (15, 1000))
    assert few[2] == all_rows[2] and few[3] == all_rows[3]
