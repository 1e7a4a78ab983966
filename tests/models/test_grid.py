"""The grid against fits done one by one, and its honesty: nothing of a left-out batch reaches its prediction."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from data.errors import InputError
from features.selectors import SELECTORS
from models.families import FAMILIES
from models.metrics import residual_std_um
from models.selection.crossing import Plan, prepare, refit
from models.selection.grid import run_grid
from models.selection.result import CELL_KEYS, GridResult

QUICK = Plan(families=("zero", "mlr", "ridge"), selectors=("none", "correlation", "pca_elimination"))


@pytest.fixture(scope="module")
def grid(toy_batches):
    batches = toy_batches(6)
    return batches, run_grid(batches, ["z", "x"], QUICK)


def test_a_cell_equals_selecting_and_fitting_by_hand(grid) -> None:
    batches, results = grid
    result = results["z"][1]
    for selector, family, n in [("correlation", "mlr", 2), ("pca_elimination", "ridge", 3), ("none", "mlr", 6)]:
        by_hand = []
        for i, left_out in enumerate(batches):
            train = [b for j, b in enumerate(batches) if j != i]
            inputs = SELECTORS[selector]().select(train, "z", n)
            model = FAMILIES[family]().fit(train, inputs, "z")
            recorded = left_out.values("z") - left_out.values("z")[0]
            predicted = model.predict(left_out)
            by_hand.append(residual_std_um(recorded - predicted))
            column = result.predictions.query("batch_id == @left_out.batch_id")[f"{selector}|{family}|{n}"]
            np.testing.assert_allclose(column, predicted, rtol=1e-5, atol=1e-5)
        cell = result.cells.query(
            "protocol == 'leave-batch-out' and selector == @selector and family == @family and n_tsp == @n"
        )
        assert cell["S_mean_um"].item() == pytest.approx(np.mean(by_hand), rel=1e-8)
        assert cell["S_std_um"].item() == pytest.approx(np.std(by_hand, ddof=1), rel=1e-8)


def test_train_on_one_averages_over_the_models(grid) -> None:
    batches, results = grid
    means, stds = [], []
    for i, one in enumerate(batches):
        model = FAMILIES["mlr"]().fit([one], SELECTORS["correlation"]().select([one], "z", 1), "z")
        s = [
            residual_std_um(b.values("z") - b.values("z")[0] - model.predict(b))
            for j, b in enumerate(batches)
            if j != i
        ]
        means.append(np.mean(s))
        stds.append(np.std(s, ddof=1))
    cell = results["z"][1].cells.query(
        "protocol == 'train-on-one' and selector == 'correlation' and family == 'mlr' and n_tsp == 1"
    )
    assert cell["S_mean_um"].item() == pytest.approx(np.mean(means), rel=1e-7)
    assert cell["S_std_um"].item() == pytest.approx(np.mean(stds), rel=1e-7)


def test_the_left_out_batch_cannot_reach_its_own_prediction(grid) -> None:
    batches, results = grid
    spoiled = list(batches)
    table = batches[2].table.copy()
    table["z"] = 1000.0 - 7.0 * table["z"]
    spoiled[2] = replace(batches[2], table=table)
    again = run_grid(spoiled, ["z"], QUICK)["z"][1].predictions
    before = results["z"][1].predictions
    mine = before["batch_id"] == "b02"
    cells = [c for c in before if "|" in c]
    pd.testing.assert_frame_equal(before.loc[mine, cells], again.loc[mine, cells])
    assert not np.allclose(before.loc[~mine, "correlation|mlr|2"], again.loc[~mine, "correlation|mlr|2"])


def test_every_cell_once_and_baselines_once(grid) -> None:
    _, results = grid
    cells = results["z"][1].cells
    assert not cells.duplicated(CELL_KEYS).any()
    lbo = cells[cells["protocol"] == "leave-batch-out"]
    assert (lbo["family"] == "zero").sum() == 1
    assert (lbo["family"] == "mlr").sum() == 1 + 6 + 6  # none, and 1 to 6 points of two selectors


@pytest.mark.integration
def test_results_do_not_depend_on_the_number_of_processes(grid) -> None:
    batches, results = grid
    two = run_grid(batches, ["z", "x"], QUICK, workers=2)
    for target in ("z", "x"):
        pd.testing.assert_frame_equal(two[target][1].scores, results[target][1].scores)
        pd.testing.assert_frame_equal(two[target][1].predictions, results[target][1].predictions)


def test_a_result_survives_its_files(grid, tmp_path) -> None:
    _, results = grid
    result = results["x"][1]
    result.save(tmp_path)
    again = GridResult.load(tmp_path)
    assert (again.machine, again.target, again.simulated) == ("toy", "x", False)
    pd.testing.assert_frame_equal(again.cells, result.cells)
    pd.testing.assert_frame_equal(again.predictions, result.predictions)


def test_simulated_batches_are_labelled_in_every_table(toy_batches) -> None:
    batches = [replace(b, simulated=True) for b in toy_batches(3)]
    result = run_grid(batches, ["z"], Plan(families=("zero", "mlr"), selectors=("none",)))["z"][1]
    assert result.simulated and result.cells["simulated"].all() and result.batches["simulated"].all()


def test_refit_learns_from_all_batches(grid) -> None:
    batches, results = grid
    crossing, _ = results["z"]
    model = refit(crossing, "correlation", "mlr", 2)
    by_hand = FAMILIES["mlr"]().fit(batches, SELECTORS["correlation"]().select(batches, "z", 2), "z")
    assert model.inputs == by_hand.inputs
    np.testing.assert_allclose(model.predict(batches[0]), by_hand.predict(batches[0]), rtol=1e-9, atol=1e-9)


def test_too_few_batches_is_one_clear_line(toy_batches) -> None:
    with pytest.raises(InputError, match=r"toy: got 1 batch\(es\) with a usable z, need at least 2; ingest more"):
        prepare(toy_batches(1), "z", QUICK)


def test_a_batch_without_a_usable_target_is_left_out_and_named(toy_batches) -> None:
    batches = toy_batches(4)
    table = batches[1].table.copy()
    table["z"] = np.nan
    crossing = prepare([batches[0], replace(batches[1], table=table), *batches[2:]], "z", QUICK)
    assert crossing.design.batch_ids == ("b00", "b02", "b03")
    assert ("z", "batch b01 is left out: no usable z") in crossing.excluded


def test_a_batch_that_cannot_teach_alone_loses_its_fold_only(toy_batches) -> None:
    batches = toy_batches(5)
    table = batches[3].table.copy()
    table.loc[2:, "z"] = np.nan
    crossing = prepare([*batches[:3], replace(batches[3], table=table), batches[4]], "z", QUICK)
    assert [f.name for f in crossing.folds["train-on-one"]] == ["b00", "b01", "b02", "b04"]
    assert len(crossing.folds["leave-batch-out"]) == 5
    assert any("train-on-one without fold b03" in reason for _, reason in crossing.excluded)
