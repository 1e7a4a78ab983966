"""The baselines: no model, and the mean run."""

import numpy as np
import pytest

from data.errors import InputError
from features.design import Design
from models.families.baselines import MeanCurve, Zero


def make_design(runs: list[list[float]], time_s: list[list[float]] | None = None) -> Design:
    times = time_s or [[60.0 * i for i in range(len(run))] for run in runs]
    y_um = np.concatenate(runs).astype(float)
    offsets = np.concatenate([[0], np.cumsum([len(run) for run in runs])])
    return Design((), "z_um", tuple(f"K{k + 1}" for k in range(len(runs))), np.empty((len(y_um), 0)), y_um,
                  np.concatenate(times).astype(float), offsets, 60.0)  # fmt: skip


nan = float("nan")
RUNS = [[0, 2, 4, 6], [0, 4, nan, 10, 20], [0, 1, 2]]


def test_zero_predicts_zero_on_every_row():
    design = make_design(RUNS)
    out = Zero().fit_design(design, [0, 1]).predict_design(design, [2, 1])
    assert [o.tolist() for o in out] == [[0] * 3, [0] * 5]
    assert Zero().fit_design(design, [0]).n_parameters() == 0


def test_mean_curve_by_hand():
    design = make_design(RUNS)
    both, first = MeanCurve().fit_folds(design, [[0, 1], [0]])
    # 0; (2+4)/2; 4 alone, the other is masked there; (6+10)/2; 20 alone
    assert both.fitted["error_um"].tolist() == [0, 3, 4, 8, 20]
    assert first.fitted["error_um"].tolist() == [0, 2, 4, 6]
    assert first.predict_design(design, [1])[0].tolist() == [0, 2, 4, 6, 6]  # beyond the longest: its last value
    assert both.predict_design(design, [2])[0].tolist() == [0, 3, 4]
    assert both.n_parameters() == 5


def test_mean_curve_between_recorded_times_interpolates():
    model = MeanCurve().fit_design(make_design(RUNS), [0])
    other = make_design([[nan, nan, nan]], time_s=[[0.0, 30.0, 90.0]])
    assert model.predict_design(other, [0])[0].tolist() == [0, 1, 3]


def test_mean_curve_ignores_the_order_and_repetition_of_batches():
    design = make_design(RUNS)
    one, other = MeanCurve().fit_folds(design, [[2, 0, 1], [0, 1, 2, 2]])
    np.testing.assert_array_equal(one.fitted["error_um"], other.fitted["error_um"])


def test_mean_curve_without_any_error_is_told():
    design = make_design([[nan, nan], [0, 1]])
    with pytest.raises(InputError, match="family mean_curve: got 0 usable rows of z_um in K1, need"):
        MeanCurve().fit_folds(design, [[1], [0]])
    with pytest.raises(InputError, match="mean_curve: got 0 usable rows of z_um in no batch"):
        MeanCurve().fit_design(design, [])


@pytest.mark.parametrize("cls", [Zero, MeanCurve])
def test_no_input_matters_to_a_baseline(cls):
    assert cls.uses_inputs is False
    design = make_design(RUNS)
    blind = make_design([[nan] * len(run) for run in RUNS])
    model = cls().fit_design(design, [0, 1, 2])
    for a, b in zip(model.predict_design(design, [0, 1]), model.predict_design(blind, [0, 1]), strict=True):
        np.testing.assert_array_equal(a, b)
