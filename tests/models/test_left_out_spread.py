"""The stated standard deviation of linear models and transfer functions: refits, planted scatter of batches, holes."""

from dataclasses import replace

import numpy as np
import pytest

from data.errors import InputError
from features.design import Design
from models.base import Family
from models.families import FAMILIES
from models.families.linear import mean_square
from models.families.mlr import MLR
from models.families.pcr import PCR
from models.families.ridge import Ridge
from tests.toys.runs import NOISE_UM, warm_ups

FAMILIES_THAT_TELL = ("mlr", "ridge", "transfer_function", "gaussian_process")


def refitted(design: Design, train: list[int], penalty: float) -> tuple[float, float]:
    """(a, b) by refitting ridge without each batch, its penalty per row kept, and a fine search over both."""
    squared, grows = [], []
    for k in train:
        rest, rows = [j for j in train if j != k], design.rows(k)
        x, y, _ = design.stacked(rest)
        matrix = x.T @ x
        coef = np.linalg.solve(matrix + penalty * np.trace(matrix) / 2 * np.eye(2), x.T @ y)
        error = design.y_um[rows] - design.x[rows] @ coef
        squared.append(error**2)
        grows.append(((design.x[rows] / 10) ** 2).mean(axis=1))
    s, q = np.concatenate(squared), np.concatenate(grows)
    (a, b), *_ = np.linalg.lstsq(np.column_stack([np.ones(len(q)), q]), s, rcond=None)
    assert a > 0.01 * s.mean() and b > 0  # the plain least squares is the answer here
    ratio = s / (a + b * q)
    size = max(ratio.mean(), np.quantile(ratio, 0.9) / 1.6449**2)
    return a * size, b * size


@pytest.mark.parametrize("family", [Ridge(least=1e-3, most=1e-3, n_penalties=1), MLR()])
def test_the_spread_is_that_of_refits_done_one_by_one(family: Family) -> None:
    design = warm_ups(own_slope=0.05)
    folds = [[j for j in range(8) if j != k] for k in range(8)]
    for fold, model in zip(folds, family.fit_folds(design, folds), strict=True):
        a, b = refitted(design, fold, 1e-3 if family.key == "ridge" else 0.0)
        assert model.fitted["variance_um2"] == pytest.approx(a, rel=1e-6)
        assert model.fitted["variance_growth_um2"] == pytest.approx(b, rel=1e-6)
        want = np.sqrt(a + b * ((design.x[:30] / 10) ** 2).mean(axis=1))
        np.testing.assert_allclose(model.sd_um(design, [0])[0], want, rtol=1e-6)


@pytest.mark.parametrize("own_slope", [0.0, 0.25])
@pytest.mark.parametrize("key", FAMILIES_THAT_TELL)
def test_the_stated_interval_holds_on_batches_that_it_never_saw(key: str, own_slope: float) -> None:
    inside, sd_um = [], []
    for seed in range(6):
        design = warm_ups(20, 24, seed, own_slope)
        model = FAMILIES[key]().fit_design(design, range(12))
        for k in range(12, 20):
            error = design.y_um[design.rows(k)] - model.predict_design(design, [k])[0]
            sd = model.sd_um(design, [k])[0]
            inside.append(np.mean(np.abs(error) <= 1.6449 * sd))
            sd_um.append(sd)
    assert 0.85 <= np.mean(inside) <= 0.96
    if own_slope:
        assert np.mean([sd[-1] / sd[0] for sd in sd_um]) > 1.5
    else:
        assert np.mean(sd_um) == pytest.approx(NOISE_UM, rel=0.15)


@pytest.mark.parametrize("key", FAMILIES_THAT_TELL)
def test_two_batches_tell_nothing_of_how_batches_differ(key: str) -> None:
    design = warm_ups(4)
    two, three = FAMILIES[key]().fit_folds(design, [[0, 1], [0, 1, 2]])
    assert np.isnan(two.sd_um(design, [3])[0]).all()
    assert np.isfinite(three.sd_um(design, [3])[0]).all()


def test_inputs_count_in_the_scale_of_their_unit_and_holes_stay_holes() -> None:
    design = warm_ups(units=("rpm", "K"))
    x = np.array([[500.0, 20.0], [np.nan, 0.0]])
    np.testing.assert_allclose(mean_square(x, design), [(0.25 + 4.0) / 2, np.nan])


def test_an_exact_model_states_none_and_a_silent_family_says_so() -> None:
    design = warm_ups()
    exact = replace(design, y_um=3 * design.x[:, 0])
    assert MLR().fit_design(exact, range(8)).sd_um(exact, [0])[0].max() < 1e-6
    with pytest.raises(InputError, match="family pcr: has no predictive standard deviation; choose one that has"):
        PCR().fit_design(design, range(8)).sd_um(design, [0])
