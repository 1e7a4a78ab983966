"""Grey layers against fits by hand, honest to the row; and the corrector."""

from dataclasses import replace

import numpy as np
import pytest

from features.design import Design
from models.families.gm1n import GM1N, response
from models.families.gm_lssvm import GMLSSVM
from models.families.grey_models import grey_layers, layer_design
from tests.toys.grey import literal_run, rises
from tests.toys.runs import stack

SIZES = (70, 55, 62, 58, 66)


def make_design(bend=0.0, noise_um=0.0, seed=0, step_s=300.0) -> Design:
    """Errors of a grey model, y + bend · y²/50."""
    rng = np.random.default_rng(seed)
    x = [rises(n, 2, rng) for n in SIZES]
    x = [part - part[0] for part in x]
    y = [literal_run(part, 0.4, np.array([0.8, -0.3])) for part in x]
    error = np.concatenate([v + bend * v**2 / 50 for v in y]) + rng.normal(0, noise_um, sum(SIZES))
    return stack(np.vstack(x), error, SIZES, ("a", "b"), step_s)


def with_other_errors(design, rows) -> Design:
    y = design.y_um.copy()
    y[rows] = 99.0 - 3 * y[rows]
    return replace(design, y_um=y)


def test_the_outputs_for_a_training_batch_are_of_models_of_the_others():
    design = make_design(noise_um=0.5)
    grey = [GM1N(recent_rows=n) for n in (25, 40)]
    folds = [[0, 1, 2, 3], [1, 2, 4]]
    for fold, layer in zip(folds, grey_layers(design, folds, grey), strict=True):
        for g, family in enumerate(grey):
            own = family.fit_design(design, fold).fitted["b"]
            np.testing.assert_allclose(layer.models[g].fitted["b"], own, rtol=1e-9)
            for k in range(5):
                told = layer.outputs_um[design.rows(k), g]
                if k not in fold:
                    assert np.isnan(told).all()
                    continue
                rest = family.fit_design(design, [j for j in fold if j != k])
                np.testing.assert_allclose(told, rest.predict_design(design, [k])[0], atol=1e-8)


@pytest.mark.parametrize("fold", [[0, 1, 2], [1, 3], [2]])
def test_no_error_of_a_row_reaches_its_own_output(fold):
    design = make_design(noise_um=0.5, seed=1)
    before = grey_layers(design, [fold], [GM1N()])[0].outputs_um
    k = fold[0]
    rows = np.arange(design.offsets[k], design.offsets[k + 1])
    if len(fold) < 3:  # contiguous quarters stand in for batches
        rows = rows[(np.arange(len(rows)) * 4) // len(rows) == 2]
    after = grey_layers(with_other_errors(design, rows), [fold], [GM1N()])[0].outputs_um
    np.testing.assert_allclose(after[rows], before[rows], rtol=0, atol=1e-9)
    others = np.setdiff1d(np.flatnonzero(np.isin(design.group, fold)), rows)
    assert np.abs(after[others] - before[others]).max() > 0.1


def test_a_sequence_is_the_most_recent_rows_and_its_sums_begin_with_it():
    design = make_design(noise_um=1.0, seed=2)
    model = GM1N(recent_rows=20).fit_design(design, [0, 3])
    left, right = [], []
    for k in (0, 3):
        x, y = design.x[design.rows(k)][-20:], design.y_um[design.rows(k)][-20:]
        sums = np.cumsum(y)
        left.append(np.column_stack([-(sums[1:] + sums[:-1]) / 2, np.cumsum(x, axis=0)[1:]]))
        right.append(y[1:])
    want = np.linalg.lstsq(np.vstack(left), np.concatenate(right), rcond=None)[0]
    assert model.fitted["a"] == pytest.approx(want[0], rel=1e-8)
    np.testing.assert_allclose(model.fitted["b"], want[1:], rtol=1e-8)


@pytest.mark.parametrize("a", [0.05, 0.6, 1.9])
def test_a_run_from_a_measured_value_is_the_recursion_on_sums(a):
    x, b = np.random.default_rng(3).normal(2, 1, (40, 2)), np.array([1.0, -0.4])
    np.testing.assert_allclose(response((x @ b)[None], a, first_um=7.5)[0], literal_run(x, a, b, 7.5), atol=1e-9)
    k, s = np.arange(40), np.cumsum(x @ b)
    sums = (7.5 - s / a) * np.exp(-a * k) + s / a  # the published whitening response
    sums[0] = 7.5
    np.testing.assert_allclose(response((x @ b)[None], a, "whitening", 7.5)[0], np.diff(sums, prepend=0), atol=1e-9)


def test_the_corrector_bends_what_grey_models_leave_straight():
    design = make_design(bend=1.0, noise_um=0.1, seed=4)
    y = design.y_um[design.rows(4)]
    grey = GM1N().fit_design(design, [0, 1, 2, 3]).predict_design(design, [4])[0] - y
    both = GMLSSVM().fit_design(design, [0, 1, 2, 3]).predict_design(design, [4])[0] - y
    assert np.sqrt(np.mean(both**2)) < 0.65 * np.sqrt(np.mean(grey**2))


def test_lengths_in_minutes_follow_the_step_and_are_never_too_short():
    design = make_design()
    fit = [0, 1, 2]
    assert GMLSSVM((100, 150), "min").fit_design(design, fit).fitted["rows"] == [20, 30]
    slow = make_design(step_s=600.0)
    assert GMLSSVM((100, 150), "min").fit_design(slow, fit).fitted["rows"] == [10, 15]
    assert GMLSSVM((5, 150), "min").fit_design(slow, fit).fitted["rows"] == [4, 15]
    assert GMLSSVM().fit_design(slow, fit).fitted["rows"] == [25, 30, 35, 40]


def test_the_swarm_tunes_the_same_layer():
    design = make_design(bend=1.0, noise_um=0.3, seed=5)
    grid, swarm = (
        GMLSSVM(tuning=t, max_rows=60).fit_design(design, [0, 1, 2]) for t in ("closed_form", "particle_swarm")
    )
    np.testing.assert_array_equal(grid.fitted["support"], swarm.fitted["support"])
    assert swarm.fitted["inner_rms_um"] < grid.fitted["inner_rms_um"] * 1.001


def test_rows_of_the_corrector_are_shared_among_the_training_batches():
    design = make_design()
    for fold in ([0, 1, 2], [0, 1, 2, 3]):
        assert len(GMLSSVM(max_rows=60).fit_design(design, fold).fitted["alpha"]) == 60 + 1  # and the start


# --- inside one batch, as published


def test_a_layer_is_a_design_of_its_own():
    design = make_design()
    outputs = np.where(design.group[:, None] == 1, design.x, np.nan)
    layer = layer_design(design, outputs)
    assert layer.inputs == ("grey1", "grey2") and layer.input_units == ("um", "um")
    np.testing.assert_array_equal(layer.usable, design.group == 1)
