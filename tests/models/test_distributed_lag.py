"""Distributed lags against sums written out, planted laws, brute-force choices, and other sampling steps."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch, Channel
from features.design import Design
from features.rises import first_order_lag
from models.families.distributed_lag import (
    CRITERIA,
    KOYCK_TAUS_S,
    RIDGES,
    DistributedLag,
    criterion,
    lag_shapes,
)
from models.families.linear import Task
from models.numerics.lags import lag_responses
from tests.toys.runs import stack

SIZES = (60, 45, 52, 40, 57)


def rises(n, p, rng, step_s=300.0):
    """Smooth rises with some ripple, 0 at the start, (n, p)."""
    hours = np.arange(n)[:, None] * step_s / 3600
    load = rng.uniform(5, 15, p) * (1 - np.exp(-hours / rng.uniform(0.3, 4, p)))
    return load + rng.uniform(0.5, 2, p) * np.sin(hours * rng.uniform(2, 5, p))


def make_design(law=None, p=2, noise_um=0.0, seed=0, step_s=300.0) -> Design:
    """`law(x)` gives the error (n,) of one batch from its rises (n, p)."""
    rng = np.random.default_rng(seed)
    parts = [rises(n, p, rng, step_s) for n in SIZES]
    y = np.concatenate([law(x) if law else 2 * x[:, 0] - x[:, -1] for x in parts])
    design = stack(np.vstack(parts), y + rng.normal(0, noise_um, len(y)), list(SIZES))
    return replace(design, time_s=np.concatenate([np.arange(n) * step_s for n in SIZES]), step_s=step_s)


def shifted(x, rows, before=0.0):
    out = np.full_like(x, before)
    out[rows:] = x[: len(x) - rows]
    return out


def table_of(design, orders):
    """The lagged columns written out, lag after lag, `orders` rows apart."""
    return np.vstack([np.hstack([shifted(design.x[design.rows(k)], rows) for rows in orders])
                      for k in range(design.n_batches)])  # fmt: skip


def ridge(x, y, k):
    """Coefficients and intercept with k times the mean variance of the columns as penalty."""
    centred = x - x.mean(0)
    matrix = centred.T @ centred
    matrix += k * np.trace(matrix) / len(matrix) * np.eye(len(matrix))
    beta = np.linalg.solve(matrix, centred.T @ (y - y.mean()))
    return beta, y.mean() - x.mean(0) @ beta


def test_responses_are_shifts_and_first_order_lags_of_each_batch_alone():
    design = make_design(seed=1)
    got = lag_responses(design, design.x, [(0, 0), (900, 0), (450, 0), (0, 1800), (600, 1800)], at_rest=False)
    for k in range(design.n_batches):
        x, own = design.x[design.rows(k)], got[design.rows(k)]
        np.testing.assert_array_equal(own[:, 0], x)
        np.testing.assert_array_equal(own[:, 1], shifted(x, 3))
        np.testing.assert_allclose(own[:, 2], (shifted(x, 1) + shifted(x, 2)) / 2, atol=1e-12)
        lag = np.column_stack([first_order_lag(c, 1800, 300) for c in x.T])
        np.testing.assert_allclose(own[:, 3], lag, atol=1e-12)
        np.testing.assert_allclose(own[:, 4], shifted(lag, 2), atol=1e-12)


def test_before_the_start_a_temperature_has_its_first_value_and_another_input_rests():
    design = make_design(seed=2)
    design.x[:] += 7.0
    got = lag_responses(design, design.x, [(600, 0), (0, 3600)], np.array([False, True]))[design.rows(1)]
    x = design.x[design.rows(1)]
    np.testing.assert_array_equal(got[:2, 0], [[x[0, 0], 0.0]] * 2)
    np.testing.assert_array_equal(got[0, 1], [x[0, 0], 0.0])
    np.testing.assert_allclose(got[:, 1, 1], first_order_lag(x[:, 1], 3600, 300, start=0.0), atol=1e-12)


def test_holes_are_bridged_and_a_missing_input_is_nan():
    design = make_design(seed=3)
    design.x[5:8, 0] = np.nan
    design.x[design.rows(2), 1] = np.nan
    model = DistributedLag().fit_design(design, [0, 1, 3])
    own, other = model.predict_design(design, [0, 2])
    assert np.isfinite(own).all() and np.isnan(other).all()


LINE = np.array([[3.0, -1.0], [2.0, -0.5], [1.0, 0.0], [0.0, 0.5]])  # weights of two inputs, on a line over the lags


def over_lags(x):
    return sum(shifted(x, 4 * lag) @ w for lag, w in enumerate(LINE))


def koyck(x):
    """Koyck's transformed equation run free, y_t = λ y_(t−1) + 4 (1 − λ) x_t, and a direct part −1.5 x_t."""
    keep, y = np.exp(-300 / KOYCK_TAUS_S[3]), np.zeros(len(x))
    for t in range(1, len(x)):
        y[t] = keep * y[t - 1] + 4 * (1 - keep) * x[t, 0]
    return y - 1.5 * x[:, 0]


@pytest.mark.parametrize(("law", "options", "p", "weights", "delays_s", "taus_s"), [
    (over_lags, {"lags": "free", "lag_min": 20, "max_lags": 3}, 2, LINE, [0, 1200, 2400, 3600], [0] * 4),
    (over_lags, {"lags": "almon", "lag_min": 20, "max_lags": 3, "degree": 1}, 2, LINE, [0, 1200, 2400, 3600], [0] * 4),
    (koyck, {}, 1, [[-1.5], [4.0]], [0, 0], [0, KOYCK_TAUS_S[3]]),
])  # fmt: skip
def test_a_planted_law_is_found(law, options, p, weights, delays_s, taus_s):
    design = make_design(law, p, seed=4)
    model = DistributedLag(**options).fit_design(design, [0, 1, 2, 3])
    np.testing.assert_allclose(model.predict_design(design, [4])[0], design.y_um[design.rows(4)], atol=1e-3)
    np.testing.assert_allclose(model.fitted["weights_um_per_K"], weights, atol=1e-3)
    np.testing.assert_array_equal([model.fitted["delays_s"], model.fitted["taus_s"]], [delays_s, taus_s])


def test_no_lag_where_none_is():
    design = make_design(lambda x: 2 * x[:, 0] - 3 * x[:, 1], noise_um=0.5, seed=6)
    for lags in ("free", "almon", "koyck"):
        fitted = DistributedLag(lags, order_by="bic").fit_design(design, range(5)).fitted
        np.testing.assert_array_equal([fitted["delays_s"], fitted["taus_s"]], [[0], [0]])
        np.testing.assert_allclose(fitted["weights_um_per_K"], [[2, -3]], atol=0.1)
        assert fitted["residual_autocorrelation"] < 0.15


def test_almon_weights_lie_on_a_polynomial_and_equal_regression_on_its_terms():
    design = make_design(lambda x: sum(shifted(x, 2 * lag) @ [1.0, -0.3] * lag for lag in range(7)), noise_um=1, seed=8)
    model = (
        DistributedLag("almon", lag_min=10, max_lags=6, degree=2, order_by="aic")
        .as_published()
        .fit_design(design, range(5))
    )
    weights, lag = model.fitted["weights_um_per_K"], np.arange(7)
    assert len(weights) == 7
    for column in weights.T:
        np.testing.assert_allclose(np.polyval(np.polyfit(lag, column, 2), lag), column, atol=1e-10)
    terms = np.linalg.qr(np.vander(lag / 3.0 - 1, 3, increasing=True))[0]
    table = np.stack([table_of(design, [2 * m]) for m in lag], axis=1)
    basis = np.einsum("nlp,ld->ndp", table, terms).reshape(len(table), -1)
    beta, _ = ridge(basis, design.y_um, model.fitted["k"])
    np.testing.assert_allclose(weights, terms @ beta.reshape(3, 2), atol=1e-6)


def task_of(design, folds):
    masks = np.array([[k in fold for k in range(design.n_batches)] for fold in folds])
    return Task.of(design, masks, False)


@pytest.mark.parametrize("order_by", ["aic", "bic"])
def test_the_criteria_count_parameters_and_effective_rows(order_by):
    design = make_design(noise_um=1.0, seed=9)
    columns = stack(table_of(design, [0, 3, 6]), design.y_um, list(SIZES))
    task = task_of(columns, [[0, 1, 2, 3, 4], [1, 2, 3]])
    got = criterion(task, lag_shapes(2, 2), order_by)
    for f, fold in enumerate([[0, 1, 2, 3, 4], [1, 2, 3]]):
        x, y, batch = columns.stacked(fold)
        beta, constant = ridge(x, y, RIDGES[-1])
        e = y - x @ beta - constant
        rho = sum(e[batch == k][1:] @ e[batch == k][:-1] for k in fold) / (e @ e)
        rows = len(y) * (1 - max(rho, 0)) / (1 + max(rho, 0))
        for q in range(3):
            for r, k in enumerate(RIDGES):
                z = x[:, : 2 * q + 2] - x[:, : 2 * q + 2].mean(0)
                beta, constant = ridge(x[:, : 2 * q + 2], y, k)
                sse = np.sum((y - x[:, : 2 * q + 2] @ beta - constant) ** 2)
                values = np.linalg.svd(z, compute_uv=False) ** 2
                parameters = 1 + np.sum(values / (values + k * values.mean()))
                weight = 2 if order_by == "aic" else np.log(rows)
                want = rows * np.log(sse / len(y)) + weight * parameters
                assert got[f, q * len(RIDGES) + r] == pytest.approx(want, rel=1e-6)


@pytest.mark.parametrize("lags", ["koyck", "almon", "free"])
def test_a_model_learned_at_one_step_holds_at_another(lags):
    hours = [np.arange(0, n * 300, 60) / 3600 for n in SIZES]
    fine = [
        np.column_stack([9 * (1 - np.exp(-h / 1.5)), 5 * (1 - np.exp(-h / 3)) + np.sin(2 * h) * h / 4]) for h in hours
    ]

    def design_of(every):
        parts = [x[::every] for x in fine]
        y = np.concatenate([2 * x[:, 0] + shifted(x[:, 1], 60 // every) for x in parts])
        sizes = [len(x) for x in parts]
        design = stack(np.vstack(parts), y, sizes)
        return replace(design, time_s=design.time_s / 5 * every, step_s=60.0 * every)

    coarse, close = design_of(5), design_of(1)
    model = DistributedLag(lags).fit_design(coarse, [0, 1, 2, 3])
    at_300_s, at_60_s = model.predict_design(coarse, [4])[0], model.predict_design(close, [4])[0]
    assert np.abs(at_60_s[::5] - at_300_s).max() < 0.02 * np.ptp(at_300_s)


def test_lags_are_never_closer_than_a_step():
    design = make_design(step_s=900.0)
    fitted = (
        DistributedLag("free", lag_min=5, max_lags=2, order_by="aic").as_published().fit_design(design, range(5)).fitted
    )
    assert set(np.diff(fitted["delays_s"])) <= {900.0}


def drifting_runs(n_runs=9, n=48, step_s=300.0) -> list[Batch]:
    """Dated runs whose relation drifts: the second sensor takes over from a lag of the first, run by run."""
    rng = np.random.default_rng(12)
    channels = {name: Channel(name, "temperature", "degC", 0.1) for name in ("a", "b")}
    channels |= {"z": Channel("z", "error", "um")}
    runs = []
    for k in range(n_runs):
        x = rises(n, 2, rng, step_s)
        late = k / (n_runs - 1)
        z = (1 - late) * shifted(x[:, 0], 6) + 2 * late * x[:, 1] + rng.normal(0, 0.3, n)
        table = pd.DataFrame({"time_s": np.arange(n) * step_s, "a": 20 + x[:, 0], "b": 20 + x[:, 1], "z": z - z[0]})
        runs.append(Batch("vmc", f"K{k}", table, channels, start=pd.Timestamp("2026-01-01") + pd.Timedelta(days=k)))
    return runs


def test_the_choice_looks_forward_whatever_the_order_of_the_batches():
    runs = drifting_runs()
    design = Design.build(runs, ("a", "b"), "z")
    family = DistributedLag("free", lag_min=15, max_lags=3, order_by="forward").as_published()
    fitted = family.fit_design(design, range(9)).fitted
    parts = [np.arange(design.offsets[k], design.offsets[k + 1]) for k in range(9)]
    S_um = {}
    for q in (0, 1, 2, 3):
        table = table_of(design, [3 * lag for lag in range(q + 1)])
        for k in RIDGES:
            left = []
            for now in range(2, 9):
                past = np.concatenate(parts[:now])
                beta, constant = ridge(table[past], design.y_um[past], k)
                e = design.y_um[parts[now]] - table[parts[now]] @ beta - constant
                left.append(np.sqrt(e @ e / (len(e) - 1)))
            S_um[q, k] = np.mean(left)
    q, k = min(S_um, key=S_um.get)
    assert (len(fitted["delays_s"]) - 1, fitted["k"]) == (q, k)
    beta, constant = ridge(table_of(design, [3 * lag for lag in range(q + 1)]), design.y_um, k)
    np.testing.assert_allclose(fitted["weights_um_per_K"].ravel(), beta, atol=1e-6)
    assert fitted["intercept_um"] == pytest.approx(constant, abs=1e-6)
    order = np.random.default_rng(3).permutation(9)
    shuffled = Design.build([runs[k] for k in order], ("a", "b"), "z")
    again = family.fit_design(shuffled, range(9)).fitted
    np.testing.assert_allclose(again["weights_um_per_K"], fitted["weights_um_per_K"], atol=1e-9)
    mixed = DistributedLag("free", lag_min=15, max_lags=3, order_by="leave_batch_out").as_published()
    interpolated = mixed.fit_design(design, range(9)).fitted
    assert (len(interpolated["delays_s"]), interpolated["k"]) != (len(fitted["delays_s"]), fitted["k"])


def test_undated_or_few_batches_are_left_out_in_turn():
    runs = drifting_runs()
    undated = [replace(b, start=None, source=f"{k}.csv") for k, b in enumerate(runs)]
    for some in (undated, runs[:5]):
        design = Design.build(some, ("a", "b"), "z")
        ahead, in_turn = (DistributedLag(order_by=o).fit_design(design, range(len(some))) for o in CRITERIA[:2])
        assert ahead.fitted["k"] == in_turn.fitted["k"]
        np.testing.assert_array_equal(ahead.fitted["weights_um_per_K"], in_turn.fitted["weights_um_per_K"])
