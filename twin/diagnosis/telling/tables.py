"""The tables that a report of a diagnosis shows, from what its steps found."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from twin.calibration.fit_problem import Array
from twin.calibration.whiteness import lagged_sums
from twin.diagnosis.diagnosis import COLUMNS
from twin.diagnosis.rounds.decision import Round
from twin.diagnosis.rounds.fitted import Fitted
from twin.diagnosis.rounds.null import Null
from twin.diagnosis.rounds.prediction import LeftOutRows
from twin.diagnosis.rounds.probability import explanations
from twin.mechanisms import MECHANISMS

LAGS = 40


def empty_tables() -> dict[str, pd.DataFrame]:
    return {name: pd.DataFrame(columns=list(columns)) for name, columns in COLUMNS.items()}


def rms_table(before: LeftOutRows, after: LeftOutRows, fitted: Fitted) -> pd.DataFrame:
    """Left-out rms by batch and channel, with the noise that the machine file states."""
    noise = dict(zip(fitted.problem.channels, fitted.problem.noise, strict=True))
    out = before.rms.rename(columns={"rms": "before"})
    out["after"] = after.rms["rms"]
    out["floor"] = out["channel"].map(noise)
    return out[list(COLUMNS["rms"])]


def series_table(before: LeftOutRows, after: LeftOutRows, fitted: Fitted) -> pd.DataFrame:
    """Recorded and predicted series of the batches left out."""
    problem = fitted.problem
    parts = []
    for k, m in enumerate(problem.measured):
        time_s = fitted.batches[k].time_s
        parts.append(
            pd.DataFrame({
                "batch": m.batch_id,
                "channel": [problem.channels[c] for c in m.channel],
                "unit": [problem.units[c] for c in m.channel],
                "time_s": time_s[m.row],
                "recorded": m.value,
                "before": m.value - before.error[k],
                "after": m.value - after.error[k],
            })
        )  # fmt: skip
    out = pd.concat(parts, ignore_index=True)
    sensors = {r.channel for r in problem.network.readings}
    out.loc[out["channel"].isin(sensors), "unit"] = "degC"
    return out


def acf_table(before: LeftOutRows, after: LeftOutRows, fitted: Fitted) -> pd.DataFrame:
    """Autocorrelation of the left-out errors, pooled over batches."""
    problem = fitted.problem
    rows: list[tuple[str, float, float, float]] = []
    for c, name in enumerate(problem.channels):
        first, step_s = _acf(before.error, fitted, c)
        second, _ = _acf(after.error, fitted, c)
        rows += [(name, k * step_s, a, b) for k, (a, b) in enumerate(zip(first, second, strict=True))]
    return pd.DataFrame(rows, columns=list(COLUMNS["acf"]))


def _acf(errors: Sequence[Array], fitted: Fitted, channel: int) -> tuple[Array, float]:
    total, step_s = np.zeros(LAGS), 0.0
    for k, m in enumerate(fitted.problem.measured):
        at = m.channel == channel
        if at.sum() < 3:
            continue
        step_s = m.stride * fitted.batches[k].step_s
        series = np.full(int((m.row[at][-1] - m.row[at][0]) // m.stride) + 1, np.nan)
        series[(m.row[at] - m.row[at][0]) // m.stride] = errors[k][at]
        sums = lagged_sums(series)[0][:LAGS]
        total[: len(sums)] += sums
    return (total / total[0] if total[0] > 0 else total), step_s


def candidates_table(rounds: Sequence[Round]) -> pd.DataFrame:
    """All that was tried in full or in its cluster, round by round, the likeliest first."""
    rows: list[tuple[object, ...]] = []
    for done in rounds:
        n = len(done.before.batches)
        for e in explanations(done)[0]:
            s, c = e.tried.scored, e.tried.candidate
            amplitude, unit = _amplitude(e.tried.scored.amplitudes, c.mechanism)
            gain = e.tried.gain if e.tried.alike is None else e.tried.alike  # as they were compared
            rows.append(
                (len(rows) + 1, c.mechanism, c.where.kind, c.where.name, c.words, e.tried.cluster, gain,
                 e.tried.improved, n, s.absorbed, amplitude, unit, e.probability)
            )  # fmt: skip
    return pd.DataFrame(rows, columns=list(COLUMNS["candidates"]))


def _amplitude(amplitudes: dict[str, float], mechanism: str) -> tuple[float, str]:
    if not amplitudes or mechanism not in MECHANISMS:
        return float(np.exp(amplitudes["factor"])) if "factor" in amplitudes else np.nan, "1"
    name = max(amplitudes, key=lambda a: abs(amplitudes[a]))
    off = (MECHANISMS[mechanism].off or {}).get(name, 0.0)
    return (
        (off + amplitudes[name], MECHANISMS[mechanism].spec(name).unit)
        if name in (MECHANISMS[mechanism].off or {})
        else (amplitudes[name], "1")
    )


def steps_table(rounds: Sequence[Round]) -> pd.DataFrame:
    rows = [
        (k + 1, r.best.candidate.words, r.best.gain, r.threshold, r.best.improved, r.accepted)
        for k, r in enumerate(rounds)
        if r.best is not None
    ]
    return pd.DataFrame(rows, columns=list(COLUMNS["steps"]))


def null_table(null: Null) -> pd.DataFrame:
    """The largest gain of any candidate in each recording of a refined machine, and its left-out rms over the noise."""
    gain = null.gain.ravel()
    floor = np.sqrt(np.nanmean(null.mean_squares, axis=-1)).ravel()
    return pd.DataFrame({"replicate": np.arange(len(gain)), "gain": gain, "floor": floor})
