"""Scores against the definitions written out by hand."""

import numpy as np
import pytest

from models.metrics import batch_scores, residual_std_um


def test_a_batch_by_hand() -> None:
    y = np.array([0.0, 2.0, 4.0, 6.0])
    p = np.array([0.0, 1.0, 4.0, 8.0])  # e = 0, 1, 0, −2
    got = {k: v[0] for k, v in batch_scores(y, p[:, None]).items()}
    assert got["S_um"] == pytest.approx(np.sqrt(5 / 3))
    assert got["rmse_um"] == pytest.approx(np.sqrt(5 / 4))
    assert got["max_abs_um"] == 2.0
    assert got["bias_um"] == pytest.approx(-0.25)
    assert got["p95_abs_um"] == pytest.approx(np.quantile([0, 1, 0, 2], 0.95))
    assert got["compensation_effect"] == pytest.approx(1 - 3 / 6)
    assert got["eta"] == pytest.approx(1 - 0.75 / 3)
    assert got["n_rows"] == 4


def test_a_perfect_model_and_no_model() -> None:
    y = np.linspace(0, 30, 50)
    got = batch_scores(y, np.column_stack([y, np.zeros(50)]))
    assert got["S_um"][0] == 0 and got["grey_degree"][0] == pytest.approx(1.0)
    assert got["S_um"][1] == pytest.approx(np.sqrt((y**2).sum() / 49))
    assert got["compensation_effect"].tolist() == [1.0, 0.0]


def test_masked_rows_do_not_count_and_each_model_is_judged_on_its_own_rows() -> None:
    rng = np.random.default_rng(1)
    y, p = rng.normal(size=40), rng.normal(size=(40, 3))
    y[:5] = np.nan
    p[10:12, 1] = np.nan
    got = batch_scores(y, p)
    for c in range(3):
        ok = np.isfinite(y) & np.isfinite(p[:, c])
        alone = batch_scores(y[ok], p[ok, c : c + 1])
        assert got["n_rows"][c] == ok.sum()
        for name, values in got.items():
            assert values[c] == pytest.approx(alone[name][0]), name


def test_a_model_without_predictions_scores_nan() -> None:
    got = batch_scores(np.arange(5.0), np.full((5, 1), np.nan))
    assert np.isnan(got["S_um"][0]) and got["n_rows"][0] == 0
    assert np.isnan(residual_std_um(np.array([1.0])))
