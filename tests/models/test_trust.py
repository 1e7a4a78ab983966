"""Left-out runs of a cell: what is known before their error, their curves, and the siblings that disagree."""

from dataclasses import replace

import numpy as np
import pytest

from models import FAMILIES
from models.crossing import Plan, cross_family, prepare
from models.judging import KEPT
from models.trust import COLUMNS, disagreement_um, fit_siblings, left_out_runs, siblings_of


def test_every_left_out_batch_of_every_protocol_has_its_row(toy_batches) -> None:
    batches = toy_batches(5)
    plans = [Plan(("correlation",), ("ridge",), p) for p in (("leave-batch-out", "train-on-one"), ("train-on-one",))]
    found, alone = (left_out_runs(prepare(batches, "z", p), "correlation", "ridge", 2).runs for p in plans)
    assert list(found) == COLUMNS
    assert found.groupby("protocol").size().to_dict() == {
        "leave-batch-out": 5
    }  # a study decides nothing where another is
    assert alone.groupby("protocol").size().to_dict() == {"train-on-one": 20}
    assert alone["distance"].median() > found["distance"].median() >= 0
    assert found[found["distance"] > 0]["farthest"].ne("").all()
    outermost = found[(found["protocol"] == "leave-batch-out") & (found["distance"] > 0.05)]
    assert len(outermost) < 5  # the middle of the year lies between its neighbours
    assert found["start"].notna().all() and (found["disagreement_um"] > 0).all()


def test_rows_and_curves_agree_with_the_grid(toy_batches) -> None:
    plan = Plan(("correlation",), ("ridge",), ("forward", "leave-batch-out"), (2,))
    crossing = prepare(toy_batches(8), "z", plan)
    scores = cross_family(crossing, "ridge").scores.set_index(["protocol", "batch_id"])["S_um"]
    runs, curves = left_out_runs(crossing, "correlation", "ridge", 2)
    found = runs.set_index(["protocol", "batch_id"])["S_um"].reindex(scores.index)
    np.testing.assert_allclose(found, scores, rtol=1e-9)
    assert set(curves["protocol"]) == {"forward", "leave-batch-out"} <= set(KEPT)
    for (protocol, batch_id), own in curves.groupby(["protocol", "batch_id"]):
        S_um = np.sqrt(np.sum((own["recorded_um"] - own["predicted_um"]) ** 2) / (len(own) - 1))
        assert S_um == pytest.approx(scores[protocol, batch_id], rel=1e-9)


def test_siblings_are_other_models_of_the_same_inputs(toy_batches) -> None:
    batches = toy_batches(5)
    ridge = FAMILIES["ridge"]().fit(batches[:4], ("t0", "t4"), "z")
    assert [s.key for s in fit_siblings(ridge, batches[:4])] == ["distributed_lag"]
    assert siblings_of("pls", ("t0",)) == ("ridge", "distributed_lag") and siblings_of("zero", ()) == ()
    assert fit_siblings(ridge, ()) == () == fit_siblings(ridge, batches[:1] and [])
    strange = replace(batches[4], table=batches[4].table.assign(t0=lambda t: t["t0"] + np.linspace(0, 60, len(t))))
    usual, unlike = (disagreement_um(ridge.predict(b), [s.predict(b) for s in fit_siblings(ridge, batches[:4])])
                     for b in (batches[4], strange))  # fmt: skip
    assert unlike > 2 * usual
    assert np.isnan(disagreement_um(np.ones(3), []))
