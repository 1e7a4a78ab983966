"""Fuzzy c-means against its textbook loop over rows, driving coefficients against a planted grey model."""

import numpy as np
import pytest
from stacked_rows import LENGTHS, orthonormal, stack

from data.arrays import Array
from features.grey import equations, least_squares
from features.selectors.fcm_grey import FcmGrey, driving_strengths, fuzzy_c_means

TRAIN = [0, 1, 3]


def textbook(curves: Array, centres: Array, m: float) -> tuple[Array, float]:
    """Memberships (c, p) of curves (p, n) by the alternating formulas, and their objective."""
    for _ in range(500):
        distance = np.linalg.norm(centres[:, None] - curves, axis=2)
        nearer = (distance[:, None] / distance) ** (2 / (m - 1))  # (c, k, p): d_ci over d_ki
        u = 1 / nearer.sum(axis=1)
        centres = (u**m @ curves) / (u**m).sum(axis=1)[:, None]
    return u, float((u**m * np.linalg.norm(centres[:, None] - curves, axis=2) ** 2).sum())


@pytest.mark.parametrize(("c", "m"), [(2, 2.0), (3, 2.0), (3, 1.7)])
def test_memberships_equal_the_textbook_on_rows(c: int, m: float) -> None:
    rng = np.random.default_rng(c)
    curves = np.repeat(rng.normal(size=(c, 40)), 3, axis=0) + 0.4 * rng.normal(size=(3 * c, 40))
    u = fuzzy_c_means(curves @ curves.T, [c], starts=6, seed=0, fuzziness=m, tolerance=1e-10)[c]
    assert u.sum(axis=0) == pytest.approx(np.ones(3 * c))
    truth, least = textbook(curves, curves[::3] + 1e-3, m)
    order = [int(np.argmax(u[:, 3 * k])) for k in range(c)]
    np.testing.assert_allclose(u[order], truth, atol=1e-5)
    centres = (u**m @ curves) / (u**m).sum(axis=1)[:, None]
    assert (u**m * np.linalg.norm(centres[:, None] - curves, axis=2) ** 2).sum() == pytest.approx(least, rel=1e-6)


def test_more_starts_are_never_worse_and_numbers_do_not_disturb_each_other() -> None:
    rng = np.random.default_rng(4)
    curves = rng.normal(size=(9, 12))
    products = curves @ curves.T

    def objective(u: Array) -> float:
        centres = (u**2 @ curves) / (u**2).sum(axis=1)[:, None]
        return float((u**2 * np.linalg.norm(centres[:, None] - curves, axis=2) ** 2).sum())

    one, many = (fuzzy_c_means(products, [4], starts=s, seed=3)[4] for s in (1, 10))
    assert objective(many) <= objective(one) + 1e-9
    np.testing.assert_array_equal(fuzzy_c_means(products, [2, 4, 8], starts=10, seed=3)[4], many)


def grey_year() -> tuple[Array, Array]:
    """Five inputs; the error follows 0.1 z + x1⁰ = 3 x_0¹ + 0.5 x_3¹ of a grey model exactly."""
    rng = np.random.default_rng(6)
    x, y = [], []
    for n in LENGTHS:
        rises = np.cumsum(rng.uniform(0, 1, (n, 5)), axis=0)
        rises -= rises[0]
        drive = np.cumsum(rises @ [3.0, 0.0, 0.0, 0.5, 0.0], axis=0)
        error, total = np.zeros(n), 0.0
        for k in range(1, n):
            error[k] = (drive[k] - 0.1 * total) / 1.05
            total += error[k]
        x.append(rises)
        y.append(error)
    return np.vstack(x), np.concatenate(y)


def test_driving_coefficients_are_those_of_the_generating_equation() -> None:
    design = stack(*grey_year(), LENGTHS)
    rows = np.concatenate([equations(design, k) for k in TRAIN])
    fit = least_squares(rows)
    assert fit.a == pytest.approx(0.1, rel=1e-6)
    np.testing.assert_allclose(fit.b, [3.0, 0.0, 0.0, 0.5, 0.0], atol=1e-6)
    fixed = least_squares(rows, a=0.3)
    truth = np.linalg.lstsq(rows[:, 1:-1], rows[:, -1] - 0.3 * rows[:, 0], rcond=None)[0]
    assert fixed.a == 0.3 and fixed.b == pytest.approx(truth, rel=1e-4)
    strength = driving_strengths(design, TRAIN, np.arange(5))
    size = np.sqrt((rows[:, 1:-1] ** 2).sum(axis=0))
    np.testing.assert_allclose(strength, [1, 0, 0, 0.5 * size[3] / (3 * size[0]), 0], atol=1e-6)


def test_from_each_cluster_the_strongest_driver() -> None:
    q = orthonormal(sum(LENGTHS), 6, seed=2)
    x, y = grey_year()
    walk = np.cumsum(q[:, 5])
    x = np.column_stack([x[:, 0], x[:, 0] + 0.05 * q[:, 0], walk, -walk + 0.01 * q[:, 1]])  # two pairs
    design = stack(x, y, LENGTHS)
    strength = driving_strengths(design, TRAIN, np.arange(4))
    best = (f"t{0 if strength[0] > strength[1] else 1}", f"t{2 if strength[2] > strength[3] else 3}")
    assert FcmGrey().select_design(design, TRAIN, [2])[2] == best


def test_clusters_that_fall_together_are_filled_up_and_told() -> None:
    q = orthonormal(sum(LENGTHS), 5, seed=3)
    x = np.column_stack(
        [q[:, 0], q[:, 0] + 1e-5 * q[:, 1], q[:, 0] + 1e-5 * q[:, 2], q[:, 3], q[:, 3] + 1e-5 * q[:, 4]]
    )
    design = stack(np.cumsum(x, axis=0), np.cumsum(q[:, 0]), LENGTHS)
    (d,) = FcmGrey().diagnostics(design, TRAIN, 4)
    chosen = FcmGrey().select_design(design, TRAIN, [4])[4]
    assert len(chosen) == 4 and d.ok == (d.value == 0.0)
    assert FcmGrey().diagnostics(design, TRAIN, 1) == ()
    (two,) = FcmGrey().diagnostics(design, TRAIN, 2)
    assert two.ok and two.value == 0.0
