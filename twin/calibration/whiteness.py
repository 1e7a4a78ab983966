"""Whiteness tests of residuals per batch and channel, for series with gaps (NaN).

Residuals are taken about zero, not about their mean: under the model zero is what is expected, and an offset
that stays is as much a misfit as a slope.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import pandas as pd
from scipy.fft import irfft, next_fast_len, rfft
from scipy.stats import chi2, combine_pvalues, norm

from data.arrays import Array

COLUMNS = ("batch", "channel", "rows", "mean", "rms", "lag1", "lag1_band", "ljung_box_p", "runs", "runs_expected",
           "runs_p", "correlated_rows")  # fmt: skip


def lagged_sums(series: Array) -> tuple[Array, Array]:
    """``S_k = Σ r_t r_(t+k)`` over the pairs that are both there, and their number; both (n,) for lags 0 … n − 1."""
    n = len(series)
    size = next_fast_len(2 * n, real=True)
    present = np.isfinite(series)
    power = np.abs(rfft(np.where(present, series, 0.0), size)) ** 2
    there = np.abs(rfft(present.astype(float), size)) ** 2
    return irfft(power, size)[:n], np.rint(irfft(there, size)[:n])


def correlated_rows(series: Iterable[Array]) -> float:
    """The integrated autocorrelation time in rows, pooled over series (n,): how many rows count as one independent row.

    ``−1 + 2 Σ_m (rho_2m + rho_2m+1)`` while these sums of neighbours stay positive (the initial positive sequence
    of Geyer 1992, "Practical Markov chain Monte Carlo", Statistical Science 7, §3.3), about zero; not below 1.
    """
    by_length: dict[int, list[Array]] = {}
    for one in series:
        if np.isfinite(one).any():
            by_length.setdefault(len(one), []).append(one)
    pooled = np.zeros(max(by_length, default=0))
    for n, equal in by_length.items():  # their power adds up: one transform back for all
        size = next_fast_len(2 * n, real=True)
        rows = np.where(np.isfinite(equal), equal, 0.0)
        pooled[:n] += irfft((np.abs(rfft(rows, size)) ** 2).sum(axis=0), size)[:n]
    if len(pooled) < 2 or pooled[0] <= 0:
        return 1.0
    pairs = pooled[: len(pooled) // 2 * 2].reshape(-1, 2).sum(axis=1) / pooled[0]
    negative = np.flatnonzero(pairs <= 0)
    return max(1.0, float(-1.0 + 2.0 * pairs[: negative[0] if len(negative) else None].sum()))


def ljung_box_p(series: Array, lags: int | None = None) -> float:
    """The p-value of "no autocorrelation up to `lags`" (default min(10, rows / 5)); NaN below 10 rows.

    Ljung & Box (1978), "On a measure of lack of fit in time series models", Biometrika 65, eq. 1.5; with gaps each
    lag counts by the pairs that are there (its variance), which without gaps is the published formula.
    """
    rows = int(np.count_nonzero(np.isfinite(series)))
    if rows < 10:
        return float("nan")
    sums, pairs = lagged_sums(series)
    chosen = min(lags or min(10, rows // 5), len(series) - 1)
    if sums[0] <= 0:
        return float("nan")
    sums, pairs = sums[1 : chosen + 1] / sums[0], pairs[1 : chosen + 1]
    used = pairs > 0
    statistic = rows * (rows + 2) * float(np.sum(sums[used] ** 2 / pairs[used]))
    return float(chi2.sf(statistic, np.count_nonzero(used)))


def runs_test(series: Array) -> tuple[int, float, float]:
    """Runs of one sign, how many chance expects, and the two-sided p-value (Wald & Wolfowitz 1940); gaps skipped."""
    sign = np.sign(series[np.isfinite(series)])
    sign = sign[sign != 0]
    n = len(sign)
    if n < 2:
        return n, float(n), float("nan")
    runs = 1 + int(np.count_nonzero(np.diff(sign)))
    # Signs are fair coins about zero, so an offset shows as too few runs: n − 1 changes of chance 1/2.
    expected, sd = 1 + (n - 1) / 2, np.sqrt((n - 1) / 4)
    return runs, expected, float(2 * norm.sf(abs(runs - expected) / sd))


def whiteness(residuals: Mapping[str, Mapping[str, Array]]) -> pd.DataFrame:
    """One row per batch and channel of `residuals[batch][channel]` (n,), NaN in gaps; columns `COLUMNS`.

    `lag1_band` is the 95 % band ± about zero of a white series; `correlated_rows` how many rows count as one.
    """
    rows = []
    for batch, channels in residuals.items():
        for channel, given in channels.items():
            series = np.asarray(given, float)
            present = series[np.isfinite(series)]
            if len(present) == 0:
                continue
            sums, pairs = lagged_sums(series)
            neighbours = pairs[1] if len(pairs) > 1 else 0.0
            known = neighbours > 0 and sums[0] > 0
            lag1 = sums[1] / sums[0] * len(present) / neighbours if known else np.nan
            band = 1.96 / np.sqrt(neighbours) if neighbours > 0 else np.nan
            rows.append((batch, channel, len(present), present.mean(), np.sqrt(np.mean(present**2)), lag1, band,
                         ljung_box_p(series), *runs_test(series), correlated_rows([series])))  # fmt: skip
    return pd.DataFrame(rows, columns=list(COLUMNS))


def in_words(table: pd.DataFrame, units: Mapping[str, str]) -> dict[str, str]:
    """One sentence per channel of a `whiteness` table; `units` of the residuals by channel.

    A channel counts as white when Fisher's combination of its batches' Ljung–Box p-values is above 0.01.
    """
    return {str(channel): _sentence(str(channel), rows, units.get(str(channel), "")) for channel, rows in
            table.groupby("channel", sort=False)}  # fmt: skip


def _sentence(channel: str, rows: pd.DataFrame, unit: str) -> str:
    n = rows["rows"].to_numpy(float)
    rms = np.sqrt(np.sum(n * rows["rms"] ** 2) / n.sum())
    of = f"{len(rows)} batch" + ("es" if len(rows) > 1 else "")
    p = np.clip(rows["ljung_box_p"].dropna().to_numpy(float), 1e-300, 1.0)
    size = f"rms {rms:.2g} {unit}".rstrip()
    if len(p) == 0:
        return f"{channel}: too few rows in {of} to test whether the residual is white; {size}"
    lag1 = np.sum(n * rows["lag1"].fillna(0)) / n.sum()
    if float(combine_pvalues(p.tolist()).pvalue) > 0.01:
        return f"{channel}: the residual is white over {of} (lag-1 autocorrelation {lag1:.2f}); {size}"
    coloured = int(np.count_nonzero(p < 0.05))
    alike = np.sum(n * rows["correlated_rows"]) / n.sum()
    return (
        f"{channel}: the residual is not white in {coloured} of {of}: lag-1 autocorrelation {lag1:.2f}, "
        f"about {alike:.2g} rows count as one; {size}"
    )
