"""Bounds on the S of a run: covered, scaled by what is visible, honest for few runs, wider after misses."""

import json
from dataclasses import asdict

import numpy as np
import pandas as pd
import pytest

from models.selection.conformal import LEVEL, RunBound, expected_next


def left_out(S_um: np.ndarray, protocol: str = "forward", **columns: np.ndarray) -> pd.DataFrame:
    """Runs in blocks of four."""
    k = np.arange(len(S_um))
    table = pd.DataFrame(
        {"protocol": protocol, "fold": [f"block {i}" for i in k // 4], "batch_id": [f"b{i}" for i in k]}
    )
    return table.assign(S_um=S_um, **columns)


def drawn(rng: np.random.Generator, n: int, power: float) -> pd.DataFrame:
    """Runs whose S follows the disagreement to a power."""
    apart_um = np.exp(rng.normal(0.0, 1.0, n))
    S_um = 5.0 * apart_um**power * np.exp(rng.normal(0.0, 0.4, n))
    return left_out(S_um, disagreement_um=apart_um, distance=np.zeros(n))


@pytest.mark.parametrize(
    ("n", "power"),
    [
        (4, 0.25),
        pytest.param(16, 0.0, marks=pytest.mark.slow),
        pytest.param(16, 0.7, marks=pytest.mark.slow),
        pytest.param(60, 0.7, marks=pytest.mark.slow),
    ],
)
def test_nine_new_runs_in_ten_stay_below_the_bound(n: int, power: float) -> None:
    rng = np.random.default_rng(n)
    covered = []
    for _ in range(150):
        bound, new = RunBound.of(drawn(rng, n, power)), drawn(rng, 10, power)
        factor = [bound.factor(d, 0.0) for d in new["disagreement_um"]]
        covered.append(np.mean(new["S_um"] <= bound.bound_um * np.array(factor)))
    assert 0.85 <= np.mean(covered) <= 0.95


def test_the_bound_follows_what_is_visible_only_where_it_matters() -> None:
    rng = np.random.default_rng(1)
    follows, silent = (RunBound.of(drawn(rng, 80, power)) for power in (0.7, 0.0))
    assert follows.slopes[0] == pytest.approx(0.7, abs=0.15) and silent.slopes[0] < 0.12
    assert follows.factor(10.0, 0.0) > 3 > 1.5 > silent.factor(10.0, 0.0)
    assert follows.factor(0.1, 0.0) < 1 and follows.factor(np.nan, np.nan) == 1.0


def test_a_run_that_is_farther_out_is_never_expected_to_be_better() -> None:
    rng = np.random.default_rng(2)
    distance = rng.uniform(0, 2, 40)
    bound = RunBound.of(left_out(np.exp(1 - distance), distance=distance))
    assert bound.factor(np.nan, 2.0) >= bound.factor(np.nan, 0.0) == 1.0
    assert bound.tested == pytest.approx(distance.max())


def test_one_in_ten_of_the_runs_that_kept_the_promise_is_flagged() -> None:
    apart_um = np.arange(1.0, 41.0)
    S_um = np.where(apart_um > 30, 50.0, 5.0)  # of the others the peers agree well
    assert RunBound.of(left_out(S_um, disagreement_um=apart_um)).usual_um == 27.0
    assert RunBound.of(left_out(S_um)).usual_um == 0.0


def test_few_runs_give_a_wide_bound_and_never_none() -> None:
    one, same = RunBound.of(left_out(np.array([5.0]))), RunBound.of(left_out(np.full(40, 5.0)))
    assert one.bound_um > 1.5 * 5.0 and 5.0 <= same.expected_um <= same.bound_um < 1.2 * 5.0
    exact = RunBound.of(left_out(np.zeros(5)))
    assert 0 <= exact.bound_um < 1e-3
    only = RunBound.of(left_out(np.array([4.0, 6.0]), protocol="train-on-one"))
    assert np.isfinite(only.bound_um) and only.n_runs == 2


def test_misses_of_later_runs_raise_the_level() -> None:
    near = left_out(np.linspace(4, 6, 16), protocol="leave-batch-out")
    calm, drifting = (pd.concat([near, left_out(S_um)]) for S_um in (np.linspace(6, 4, 16), np.linspace(6, 18, 16)))
    assert RunBound.of(calm).level == LEVEL < RunBound.of(drifting).level


def test_the_next_season_is_led_by_later_runs() -> None:
    near, later = left_out(np.full(8, 2.0), protocol="leave-batch-out"), left_out(np.full(4, 6.0))
    found = expected_next(pd.concat([near, later]))
    assert (found.S_um, found.n_runs, found.protocol) == (6.0, 4, "forward") and found.bound_um >= 6.0
    assert expected_next(near)[2:] == (8, "leave-batch-out")
    assert expected_next(near.iloc[:0]).n_runs == 0


def test_plain_and_back() -> None:
    bound = RunBound.of(drawn(np.random.default_rng(3), 20, 0.5))
    plain = json.loads(json.dumps(bound.as_plain(), allow_nan=False))
    assert RunBound.from_plain(plain) == bound == RunBound.from_plain(plain | {"unusual": 1.2})
    del plain["usual_um"]  # a model of an earlier program: nobody disagrees enough
    assert np.isinf(RunBound.from_plain(plain).usual_um)


def test_another_cells_bound_comes_from_its_scores() -> None:
    scores = left_out(np.linspace(2, 4, 8), protocol="leave-batch-out").assign(selector="none", family="mlr", n_tsp=2)
    bound = RunBound.of_cell(pd.DataFrame(), scores, "none", "mlr", 2)
    assert bound is not None and bound.n_runs == 8
    own = scores.assign(cell="none|mlr|2", S_um=9.0, disagreement_um=1.0, distance=0.0)
    known = RunBound.of_cell(own, scores, "none", "mlr", 2)
    assert known is not None and known.expected_um > 2 * bound.expected_um
    assert RunBound.of_cell(own, scores, "none", "pls", 2) is None
    assert all(np.isfinite(v) for v in asdict(bound).values() if isinstance(v, float))
