"""Left-out runs of a cell: what is known before their error, their curves, and the peers that disagree."""

import numpy as np
import pytest

from models.selection.crossing import Plan, cross_family
from models.selection.grid import run_grid
from models.selection.judging import KEPT
from models.selection.trust import COLUMNS, disagreement_um, left_out_runs

CELL = ("correlation", "ridge", 2)


@pytest.fixture(scope="module")
def crossed(toy_batches):
    plan = Plan(("correlation",), ("ridge", "distributed_lag", "mlr"), ("forward", "leave-batch-out"), (2,))
    return run_grid(toy_batches(8), ["z"], plan)["z"]


def test_every_left_out_batch_of_every_protocol_has_its_row(crossed) -> None:
    crossing, _ = crossed
    scored = cross_family(crossing, "ridge")
    runs, curves = left_out_runs(crossing, CELL, scored.predictions)
    assert list(runs) == COLUMNS and runs["start"].notna().all() and runs["disagreement_um"].isna().all()
    assert runs[runs["distance"] > 0]["farthest"].ne("").all()
    outermost = runs[(runs["protocol"] == "leave-batch-out") & (runs["distance"] > 0.05)]
    assert len(outermost) < 8  # the middle of the year lies between its neighbours
    scores = scored.scores.set_index(["protocol", "batch_id"])["S_um"]
    found = runs.set_index(["protocol", "batch_id"])["S_um"].reindex(scores.index)
    np.testing.assert_allclose(found, scores, rtol=1e-5)
    assert set(curves["protocol"]) == {"forward", "leave-batch-out"} <= set(KEPT)
    for (protocol, batch_id), own in curves.groupby(["protocol", "batch_id"]):
        S_um = np.sqrt(np.sum((own["recorded_um"] - own["predicted_um"]) ** 2) / (len(own) - 1))
        assert S_um == pytest.approx(scores[protocol, batch_id], rel=1e-5)


def test_the_best_of_other_families_disagree_about_a_run(crossed) -> None:
    crossing, result = crossed
    assert set(result.stack["family"]) == {"ridge", "distributed_lag", "mlr"}  # though no stack was asked for
    every = {}
    for key in result.stack["family"]:
        every |= cross_family(crossing, key).predictions
    runs = left_out_runs(crossing, CELL, every, result.stack).runs.set_index(["protocol", "batch_id"])
    ridge, lag, mlr = (every[f"leave-batch-out|correlation|{f}|2"][: crossing.batches[0].n_rows].astype(float)
                       for f in ("ridge", "distributed_lag", "mlr"))  # fmt: skip
    apart_um = [np.sqrt(np.mean((other - ridge) ** 2)) for other in (lag, mlr)]
    first = runs.loc[("leave-batch-out", crossing.batches[0].batch_id), "disagreement_um"]
    assert first == pytest.approx(np.median(apart_um), rel=1e-5)


def test_without_peers_nobody_disagrees() -> None:
    assert np.isnan(disagreement_um(np.ones(3), []))
    assert disagreement_um(np.zeros(3), [np.ones(3), 2 * np.ones(3), 9 * np.ones(3)]) == pytest.approx(2.0)
