"""Variance inflation against its definition: each input explained by the others by least squares on the rows."""

import numpy as np
import pytest
from stacked_rows import LENGTHS, P, orthonormal, stack, year

from features.selectors.vif_pruning import VifPruning, variance_inflation

TRAIN = [0, 1, 3]


def by_rows(x: np.ndarray) -> list[float]:
    factors = []
    for j in range(x.shape[1]):
        others = np.column_stack([np.ones(len(x)), np.delete(x, j, axis=1)])
        e = x[:, j] - others @ np.linalg.lstsq(others, x[:, j], rcond=None)[0]
        factors.append(float(np.square(x[:, j] - x[:, j].mean()).sum() / (e @ e)))  # 1 / (1 − R²)
    return factors


def test_factors_equal_one_over_one_less_r_squared() -> None:
    x = stack(*year(), LENGTHS).stacked(TRAIN)[0]
    np.testing.assert_allclose(variance_inflation(np.corrcoef(x, rowvar=False)), by_rows(x), rtol=1e-6)


def test_the_largest_factor_goes_first_down_to_two() -> None:
    design = stack(*year(), LENGTHS)
    x, y, _ = design.stacked(TRAIN)
    got = VifPruning().select_design(design, TRAIN, range(1, P + 1))
    left = list(range(P))
    while len(left) > 2:
        left.pop(int(np.argmax(by_rows(x[:, left]))))
        assert got[len(left)] == tuple(f"t{i}" for i in left)
    best = max(left, key=lambda j: abs(np.corrcoef(x[:, j], y)[0, 1]))  # two have equal factors: the error decides
    assert got[1] == (f"t{best}",)


def test_an_exact_dependence_goes_before_a_strong_one() -> None:
    q = orthonormal(60, 5, seed=3)
    twin = q[:, 0] + 0.01 * q[:, 4]  # factors of about 1e4 beside infinite ones
    x = np.column_stack([q[:, 0], twin, q[:, 1], q[:, 2], 0.3 * q[:, 1] + 0.9 * q[:, 2]])
    got = VifPruning().select_design(stack(x, q[:, 2], [30, 30]), [0, 1], [3, 4])
    # t4 has most of the dependence of t2, t3 and t4; then of the pair the one less like the error, by order the later
    assert got == {4: ("t0", "t1", "t2", "t3"), 3: ("t0", "t2", "t3")}


def test_what_is_left_is_told() -> None:
    x, y = year()
    design = stack(x, y, LENGTHS)
    for n in (2, 4, P):
        kept = VifPruning().select_design(design, TRAIN, [n])[n]
        factors = by_rows(design.subset(kept).stacked(TRAIN)[0])
        truth = max(factors)
        (d,) = VifPruning().diagnostics(design, TRAIN, n)
        assert d.value == pytest.approx(truth, rel=1e-6) and d.ok == (truth <= 10.0)
        assert n == 2 or d.comment.startswith(kept[int(np.argmax(factors))] + " is")
