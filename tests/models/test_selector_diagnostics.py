"""What the grid says about its selectors: at their best cells, from all batches, kept in the files."""

import pandas as pd
import pytest

from features.selectors import SELECTORS
from models.selection.crossing import Plan
from models.selection.grid import run_grid
from models.selection.result import GridResult

CROSSED = ("none", "correlation", "fuzzy_correlation", "vif_pruning", "exhaustive")


@pytest.fixture(scope="module")
def crossed(toy_batches):
    plan = Plan(selectors=CROSSED, families=("zero", "mlr"), protocols=("leave-batch-out", "train-on-one"))
    return run_grid(toy_batches(6), ["z"], plan)["z"]


def test_every_selector_that_chooses_is_looked_at_where_it_is_best(crossed) -> None:
    crossing, result = crossed
    table = result.selector_diagnostics
    assert list(dict.fromkeys(table["selector"])) == list(CROSSED[1:])
    cells = result.cells[(result.cells["protocol"] == "leave-batch-out") & (result.cells["n_inputs"] < 6)]
    for key, rows in table.groupby("selector"):
        own = cells[cells["selector"] == key]
        best = (own["S_mean_um"] + own["S_std_um"]).idxmin()
        assert set(rows["n_tsp"]) == {own.loc[best, "n_tsp"]}
        stability, *others = rows.to_dict("records")
        assert stability["statistic"] == "stability over batches"
        assert stability["value"] == own.loc[best, "tsp_stability"]
        told = SELECTORS[key]().diagnostics(crossing.design, crossing.everything, stability["n_tsp"])
        assert [(r["statistic"], r["value"], r["threshold"], r["ok"], r["comment"]) for r in others] == [
            (d.statistic, d.value, d.threshold, d.ok, d.comment) for d in told
        ]


def test_the_table_survives_its_files_and_may_be_missing_in_older_ones(crossed, tmp_path) -> None:
    _, result = crossed
    result.save(tmp_path)
    pd.testing.assert_frame_equal(GridResult.load(tmp_path).selector_diagnostics, result.selector_diagnostics)
    (tmp_path / "selector_diagnostics.parquet").unlink()
    older = GridResult.load(tmp_path)
    assert older.selector_diagnostics.empty
    pd.testing.assert_frame_equal(older.cells, result.cells)
