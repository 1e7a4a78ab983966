"""The rise of the error with the distance from the training: planted, found, and silent where nothing was measured."""

import json

import numpy as np
import pandas as pd
import pytest

from models.crossing import Plan, prepare
from models.trust import COLUMNS, Rise, error_against_distance


def table(factor_per_width: float) -> pd.DataFrame:
    """Twenty batches of their own S, each also predicted from a distance."""
    rng = np.random.default_rng(3)
    rows = []
    for k in range(20):
        own = rng.uniform(1, 30)
        distance = 0.08 * k
        rows.append(("cell", "leave-batch-out", f"b{k}", f"b{k}", 0.0, "", own))
        rows.append(("cell", "leave-season-out", "s", f"b{k}", distance, "t0", own * (1 + factor_per_width * distance)))
        rows.append(("cell", "train-on-one", "b0", f"b{k}", 5.0, "t0", 1e3))
    return pd.DataFrame(rows, columns=COLUMNS)


def test_a_planted_rise_is_found_whatever_the_batches_own_size() -> None:
    rise = Rise.of(table(2.0))
    assert rise.edge == (0.25, 0.5, 1.0, 2.0)  # only one prediction lies inside: that band says nothing
    assert rise.factor == pytest.approx([1.32, 1.8, 2.52, 3.56], abs=0.01)
    assert sum(rise.count) == 19
    expected = rise.expected_um(np.array([0.0, 0.1, 1.5, 9.0, np.nan]))
    np.testing.assert_allclose(expected[:3], rise.inside_um * np.array([1.0, 1.32, 3.56]), rtol=0.01)
    assert np.isnan(expected[3:]).all()


def test_expected_error_never_falls_with_the_distance_nor_below_the_inside() -> None:
    rise = Rise.of(table(-0.5))
    expected = rise.expected_um(np.linspace(0, 2, 30))
    assert (np.diff(expected) >= 0).all() and expected[0] == rise.inside_um


def test_plain_and_back() -> None:
    rise = Rise.of(table(1.0).assign(distance=lambda t: 3 * t["distance"]))
    back = Rise.from_plain(json.loads(json.dumps(rise.as_plain(), allow_nan=False)))
    assert back == rise and back.edge[-1] == np.inf


def test_every_left_out_batch_of_every_protocol_has_its_distance(toy_batches) -> None:
    batches = toy_batches(5)
    crossing = prepare(batches, "z", Plan(("correlation",), ("ridge",), ("leave-batch-out", "train-on-one")))
    found = error_against_distance(crossing, "correlation", "ridge", 2)
    assert list(found) == COLUMNS
    assert found.groupby("protocol").size().to_dict() == {"leave-batch-out": 5, "train-on-one": 20}
    near, far = (found[found["protocol"] == p]["distance"].median() for p in ("leave-batch-out", "train-on-one"))
    assert far > near >= 0
    assert found[found["distance"] > 0]["farthest"].ne("").all()
    outermost = found[(found["protocol"] == "leave-batch-out") & (found["distance"] > 0.05)]
    assert len(outermost) < 5  # the middle of the year lies between its neighbours


def test_the_left_out_error_is_the_grids(toy_batches) -> None:
    from models.crossing import cross_family

    crossing = prepare(toy_batches(5), "z", Plan(("correlation",), ("ridge",), ("leave-batch-out",), (2,)))
    scores = cross_family(crossing, "ridge").scores.set_index("batch_id")["S_um"]
    found = error_against_distance(crossing, "correlation", "ridge", 2).set_index("batch_id")["S_um"]
    np.testing.assert_allclose(found[scores.index], scores, rtol=1e-9)
