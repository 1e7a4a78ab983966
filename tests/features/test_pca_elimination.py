"""PCA elimination against cases worked by hand and against the singular vectors of the rows."""

import numpy as np
from stacked_rows import LENGTHS, P, orthonormal, stack, year

from features.selectors.pca_elimination import PcaElimination

TRAIN = [0, 1, 3]


def test_on_three_sensors_by_hand() -> None:
    q = orthonormal(40, 2)
    x = np.column_stack([0.6 * q[:, 0] + 0.8 * q[:, 1], q])
    # R = [[1 .6 .8], [.6 1 0], [.8 0 1]]: eigenvalue 0 with (1, −.6, −.8)/√2, so the first goes; then R = I, a tie
    got = PcaElimination().select_design(stack(x, q[:, 0], [20, 20]), [0, 1], [1, 2, 3])
    assert got == {3: ("t0", "t1", "t2"), 2: ("t1", "t2"), 1: ("t1",)}


def test_drops_twins_first_and_is_blind_to_the_error() -> None:
    q = orthonormal(40, 3, seed=4)
    x = np.column_stack([q[:, 0], q[:, 1], q[:, 0], q[:, 2] + 0.3 * q[:, 1], 5 * q[:, 0]])  # t2 and t4 are t0 again
    design, other = stack(x, q[:, 0], [40]), stack(x, q[:, 2], [40])
    got = PcaElimination().select_design(design, [0], [3, 4])
    assert got == {4: ("t0", "t1", "t2", "t3"), 3: ("t0", "t1", "t3")}
    assert PcaElimination().select_design(other, [0], [3, 4]) == got


def test_breaks_the_tightest_relation_first() -> None:
    r = np.zeros((5, 5))
    r[:3, :3], r[3:, 3:] = 0.8, 0.99  # three loose neighbours and a tight pair: eigenvalues 2.6 .2 .2 and 1.99 .01
    np.fill_diagonal(r, 1.0)
    q = orthonormal(60, 5, seed=6)
    design = stack(q @ np.linalg.cholesky(r).T, q[:, 0], [60])
    got = PcaElimination().select_design(design, [0], [1, 2, 3, 4])
    # the pair's later one; then .2 is shared by the three, whose last goes; then ties
    assert got == {4: ("t0", "t1", "t2", "t3"), 3: ("t0", "t1", "t3"), 2: ("t0", "t3"), 1: ("t0",)}


def test_equals_the_last_right_singular_vector_of_the_standardised_rows() -> None:
    x, y = year()
    design = stack(x, y, LENGTHS)
    rows = design.stacked(TRAIN)[0]
    z = (rows - rows.mean(axis=0)) / rows.std(axis=0)
    got = PcaElimination().select_design(design, TRAIN, range(1, P + 1))
    left = list(range(P))
    while len(left) > 2:
        left.pop(int(np.argmax(np.abs(np.linalg.svd(z[:, left])[2][-1]))))
        assert got[len(left)] == tuple(f"t{i}" for i in left)
