"""Grey degrees against numbers worked out by hand."""

import numpy as np
import pytest

from data.errors import InputError
from features.grey import absolute_degree, relational_degree, relative_degree, synthetic_degree


def test_relational_degree_by_hand_with_interval_scaling() -> None:
    y = np.array([0.0, 1, 2, 4])
    x = np.column_stack([[0.0, 2, 4, 8], [0.0, 4, 8, 8]])
    # scaled: y 0 .25 .5 1; x1 the same; x2 0 .5 1 1; distances of x2: 0 .25 .5 0; ρ·max = .25
    assert relational_degree(x, y) == pytest.approx([1.0, (1 + 1 / 2 + 1 / 3 + 1) / 4])


def test_relational_degree_by_hand_with_mean_scaling() -> None:
    y = np.array([1.0, 2, 3])
    # scaled: y 1/2 1 3/2; x 2/3 2/3 5/3; distances 1/6 1/3 1/6; ρ·max = 1/6: coefficients 1, 2/3, 1
    assert relational_degree(np.array([[2.0], [2], [5]]), y, scaling="mean") == pytest.approx([8 / 9])
    # runs against y: mirrored, 2 − (5/3 2/3 2/3) = 1/3 4/3 4/3, the same distances
    assert relational_degree(np.array([[5.0], [2], [2]]), y, scaling="mean") == pytest.approx([8 / 9])


def test_rho_moves_the_degree_as_the_formula_says() -> None:
    y = np.array([0.0, 1, 2, 4])
    x = np.array([[0.0], [4], [8], [8]])
    assert relational_degree(x, y, rho=1.0) == pytest.approx([(1 + 0.5 / 0.75 + 0.5 / 1.0 + 1) / 4])


def test_units_and_sign_of_a_sequence_do_not_matter() -> None:
    rng = np.random.default_rng(1)
    y = rng.normal(size=50).cumsum()
    x = y[:, None] * [1.0, 2, 3, 1] + rng.normal(size=(50, 4)).cumsum(axis=0)
    other = x * [1.0, -1.8, 1000, 0.01] + [0.0, 32, -7, 5]
    assert relational_degree(other, 3 * y + 8) == pytest.approx(relational_degree(x, y))


def test_a_constant_sequence_has_degree_0_and_leaves_the_others_alone() -> None:
    rng = np.random.default_rng(2)
    x, y = rng.normal(size=(30, 3)), rng.normal(size=30)
    with_constant = np.column_stack([x, np.full(30, 7.0)])
    assert relational_degree(with_constant, y) == pytest.approx([*relational_degree(x, y), 0.0])
    assert relational_degree(with_constant[:, 3:], y) == pytest.approx([0.0])
    assert np.isfinite(relational_degree(x, np.zeros(30))).all()


def test_distances_are_compared_over_all_sequences() -> None:
    y = np.array([0.0, 1, 2, 4])
    near = np.array([0.0, 1.2, 2, 4])
    far = np.array([0.0, 4, 4, 4])
    alone = relational_degree(near[:, None], y)[0]
    assert relational_degree(np.column_stack([near, far]), y)[0] > alone  # a larger max Δ lifts every other one


def test_relational_degree_refuses_in_one_line() -> None:
    x, y = np.ones((3, 2)), np.array([0.0, np.nan, 2])
    with pytest.raises(InputError, match=r"row 1 is not finite; leave such rows out"):
        relational_degree(x, y)
    with pytest.raises(InputError, match=r"got x \(3, 2\) and y \(4,\); expected \(n, p\) and \(n,\)"):
        relational_degree(x, np.zeros(4))
    centred = np.array([[-1.0], [0], [1]])
    with pytest.raises(InputError, match=r"mean of column 0 of x is 0.*use interval scaling"):
        relational_degree(centred, np.array([1.0, 2, 3]), scaling="mean")


A = np.array([10.0, 9, 15, 14, 14, 16])  # zero-start 0 −1 5 4 4 6: s = −1+5+4+4+3 = 15
B = np.array([20.0, 22, 26, 24, 28, 32])  # zero-start 0 2 6 4 8 12: s = 2+6+4+8+6 = 26


def test_area_degrees_by_hand() -> None:
    assert absolute_degree(B[:, None], A) == pytest.approx([42 / 53])
    # on x/x(1): s = 1.5 and 1.3
    assert relative_degree(B[:, None], A, shift=0.0) == pytest.approx([3.8 / 4.0])
    # after the stated shift of 100: s = 15/110 and 26/120
    s, t = 15 / 110, 26 / 120
    shifted = (1 + s + t) / (1 + s + t + (t - s))
    assert relative_degree(B[:, None], A) == pytest.approx([shifted])
    assert synthetic_degree(A, B) == pytest.approx(0.5 * 42 / 53 + 0.5 * shifted)
    assert synthetic_degree(A, B, theta=1.0) == pytest.approx(42 / 53)


def test_synthetic_degree_is_symmetric_one_for_equal_curves_and_falls_with_distance() -> None:
    y = np.array([0.0, 5, 9, 12, 14])
    assert synthetic_degree(y, y) == 1.0
    assert synthetic_degree(A, B) == pytest.approx(synthetic_degree(B, A))
    near, far = synthetic_degree(y, y * 1.1), synthetic_degree(y, y * 2)
    assert 0 < far < near < 1


def test_many_curves_at_once_equal_one_by_one() -> None:
    rng = np.random.default_rng(3)
    y, many = rng.normal(size=40), rng.normal(size=(40, 6))
    assert synthetic_degree(y, many) == pytest.approx([float(synthetic_degree(y, c)) for c in many.T])


def test_a_curve_without_a_degree_gives_nan_and_not_a_number_that_looks_right() -> None:
    assert np.isnan(synthetic_degree(np.array([0.0, 1]), np.array([np.inf, 1])))
    assert np.isnan(synthetic_degree(np.array([0.0, 1]), np.array([-100.0, 1])))
    with pytest.raises(InputError, match=r"got shapes \(2,\) and \(3,\)"):
        synthetic_degree(np.zeros(2), np.zeros(3))
