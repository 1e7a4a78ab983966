import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2

from twin.calibration.whiteness import (
    COLUMNS,
    correlated_rows,
    in_words,
    lagged_sums,
    ljung_box_p,
    runs_test,
    whiteness,
)


def ar1(rng: np.random.Generator, rows: int, memory: float) -> np.ndarray:
    return lfilter([np.sqrt(1 - memory**2)], [1, -memory], rng.normal(size=rows + 500))[500:]


def holed(series: np.ndarray, seed: int = 0, share: float = 0.3) -> np.ndarray:
    return np.where(np.random.default_rng(seed).random(len(series)) < share, np.nan, series)


def test_lagged_sums_equal_the_loop_with_gaps():
    series = holed(np.random.default_rng(0).normal(size=40))
    sums, pairs = lagged_sums(series)
    for lag in range(40):
        products = series[: 40 - lag] * series[lag:]
        assert sums[lag] == pytest.approx(np.nansum(products), abs=1e-12)
        assert pairs[lag] == np.count_nonzero(np.isfinite(products))


def test_ljung_box_equals_the_published_formula():
    series = np.random.default_rng(1).normal(size=120)
    r = [np.sum(series[: 120 - k] * series[k:]) / np.sum(series**2) for k in range(1, 6)]
    expected = chi2.sf(120 * 122 * sum(v**2 / (120 - k) for k, v in enumerate(r, 1)), 5)
    assert ljung_box_p(series, lags=5) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("gaps", [False, True])
def test_ljung_box_keeps_its_level(gaps):
    rng = np.random.default_rng(2)
    p = [ljung_box_p(holed(s, i) if gaps else s) for i, s in enumerate(rng.normal(size=(800, 200)))]
    assert 0.03 <= np.mean(np.array(p) < 0.05) <= 0.075


def test_ljung_box_sees_what_is_not_white():
    rng = np.random.default_rng(3)
    assert ljung_box_p(holed(ar1(rng, 400, 0.5))) < 1e-6
    assert ljung_box_p(rng.normal(size=400) + 0.8) < 1e-6  # an offset is not white about zero
    assert np.isnan(ljung_box_p(np.ones(9)))
    assert np.isnan(ljung_box_p(np.zeros(50)))


@pytest.mark.parametrize("memory", [0.5, 0.9, 0.97])
def test_correlated_rows_of_ar1(memory):
    rng = np.random.default_rng(4)
    found = correlated_rows([ar1(rng, 6000, memory) for _ in range(12)])
    assert found == pytest.approx((1 + memory) / (1 - memory), rel=0.15)


def test_correlated_rows_of_white_noise_are_one():
    rng = np.random.default_rng(5)
    found = [correlated_rows(list(rng.normal(size=(12, 500)))) for _ in range(100)]
    assert min(found) >= 1.0 and np.mean(found) < 1.05 and np.quantile(found, 0.95) < 1.15


def test_correlated_rows_of_an_offset_are_the_whole_batch():
    assert correlated_rows([np.ones(300), -np.ones(300)]) == pytest.approx(300, rel=0.01)
    assert correlated_rows([np.array([]), np.full(5, np.nan)]) == 1.0


def test_runs():
    runs, expected, p = runs_test(np.array([1.0, 2, np.nan, -1, -1, 3, -2]))
    assert (runs, expected) == (4, 3.5)
    assert p == pytest.approx(2 * 0.327360, rel=1e-4)  # 0.5 / sqrt(5 / 4) = 0.4472 standard deviations
    assert runs_test(np.ones(100))[2] < 1e-20


def example() -> dict[str, dict[str, np.ndarray]]:
    rng = np.random.default_rng(6)
    return {
        f"b{b}": {"bed": holed(rng.normal(size=600), b), "head": 2 * ar1(rng, 600, 0.95), "tank": rng.normal(size=6)}
        for b in range(5)
    }


def test_the_table_has_a_row_per_batch_and_channel():
    residuals = example()
    residuals["b4"]["tank"] = np.full(6, np.nan)  # nothing recorded: no row
    table = whiteness(residuals)
    assert tuple(table.columns) == COLUMNS
    assert len(table) == 14
    bed = table[table["channel"] == "bed"]
    first = residuals["b0"]["bed"]
    there = first[np.isfinite(first)]
    assert bed["rows"].iloc[0] == len(there)
    assert bed["rms"].iloc[0] == pytest.approx(np.sqrt(np.mean(there**2)))
    assert bed["mean"].iloc[0] == pytest.approx(there.mean())
    both = np.count_nonzero(np.isfinite(first[1:]) & np.isfinite(first[:-1]))
    assert bed["lag1_band"].iloc[0] == pytest.approx(1.96 / np.sqrt(both))
    assert np.all(np.abs(bed["lag1"]) < 1.5 * bed["lag1_band"])
    head = table[table["channel"] == "head"]
    np.testing.assert_allclose(head["lag1"], 0.95, atol=0.05)
    assert np.all(head["runs"] < head["runs_expected"] / 2) and np.all(head["runs_p"] < 1e-6)


def test_lag_one_is_not_shrunk_by_gaps():
    series = ar1(np.random.default_rng(7), 20_000, 0.8)
    table = whiteness({"b": {"whole": series, "holed": holed(series, share=0.5)}}).set_index("channel")
    assert table.loc["holed", "lag1"] == pytest.approx(table.loc["whole", "lag1"], abs=0.02)


def test_one_sentence_per_channel():
    words = in_words(whiteness(example()), {"bed": "K", "head": "µm"})
    assert words["bed"].startswith("bed: the residual is white over 5 batches (lag-1 autocorrelation ")
    assert words["bed"].endswith("); rms 0.98 K")
    assert words["head"].startswith("head: the residual is not white in 5 of 5 batches: lag-1 autocorrelation 0.9")
    assert " rows count as one; rms " in words["head"] and words["head"].endswith(" µm")
    assert words["tank"].startswith("tank: too few rows in 5 batches to test whether the residual is white; rms ")


def test_an_empty_table_has_its_columns_and_no_sentence():
    table = whiteness({"b": {"bed": np.full(4, np.nan)}})
    assert tuple(table.columns) == COLUMNS and table.empty
    assert in_words(table, {}) == {}
