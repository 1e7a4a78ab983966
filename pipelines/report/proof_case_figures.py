"""Figures with a mark for every case: errors before and after, amplitudes, times. Each takes tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

from pipelines.report.diagnosis_words import UNITS
from pipelines.report.proof_drawing import HALF_IN, PALE, WIDE_IN, head, keys, panel, plant_keys, plant_style
from pipelines.report.proof_words import key_label, plant_letter
from pipelines.report.twin_figures import SOFT
from pipelines.report.words import BLUE, GREEN, INK, ORANGE, number

_TRUE = GREEN
SHADE = "#f3ddc9"


def improvement(cases: pd.DataFrame, plants: Sequence[str]) -> Figure:
    """Left-out error of every case before and after the diagnosis, with the true model and the noise; sorted.

    Args:
        cases: a row a case with error_before, error_after, error_true and error_floor, in units of the noise.
    """
    fig = Figure(figsize=(WIDE_IN, 4.3))
    ax = panel(fig, 0.75, 0.75, WIDE_IN - 0.95, 3.0)
    shown = cases.sort_values("error_before", ascending=False, kind="stable")
    at = np.arange(len(shown))
    thick = min(2.5, 500 / len(shown))
    ax.vlines(at, shown["error_after"], shown["error_before"], color=PALE, lw=thick, zorder=1)
    size = float(np.clip(420 / len(shown), 2.0, 5.0))
    for column, color, mark in (("error_floor", SOFT, "_"), ("error_true", _TRUE, "_"), ("error_before", ORANGE, "o"),
                                ("error_after", BLUE, "o")):  # fmt: skip
        wide = 1.6 * size if mark == "_" else size
        ax.plot(at, shown[column], mark, color=color, ms=wide, mec=color, mew=1.2 if mark == "_" else 0, zorder=2)
    ax.set_yscale("log")
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.set_xlim(-1, len(shown))
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.yaxis.set_major_formatter(lambda v, _: f"{v:g}")
    ax.yaxis.set_minor_formatter(lambda v, _: "")
    ax.set_ylabel("left-out error, units of the noise", fontsize=8)
    ax.set_xlabel("visible cases, largest error first", fontsize=8, labelpad=2)
    head(fig, "What the diagnosis repairs", plants)
    entries = [("●", "before", ORANGE), ("●", "after", BLUE), ("━", "with the true model", _TRUE), ("━", "noise", SOFT)]
    keys(fig, entries, 0.4)
    return fig


def amplitudes(terms: pd.DataFrame, plants: Sequence[str]) -> Figure:
    """Amplitude found against true, both in detection limits, with 90 % intervals; the band is ± 40 %.

    Args:
        terms: `proof_extracts.with_amplitude`.
    """
    fig = Figure(figsize=(HALF_IN, 5.6))
    ax = panel(fig, 0.75, 0.95, HALF_IN - 1.0, 4.1)
    both = np.concatenate([terms["true_limits"], terms["found_limits"]])
    both = both[np.isfinite(both) & (both > 0)]
    low, high = float(both.min()) / 1.4, float(both.max()) * 1.4
    line = np.array([low, high])
    ax.fill_between(line, 0.6 * line, 1.4 * line, color="#eef1f4", zorder=0)
    ax.plot(line, line, color=PALE, lw=1.2, zorder=1)
    for plant in plants:
        own = terms[terms["plant"] == plant]
        color, mark = plant_style(plant)
        ax.vlines(own["true_limits"], own["low_limits"], own["high_limits"], color=color, lw=0.8, alpha=0.35, zorder=2)
        ax.plot(own["true_limits"], own["found_limits"], mark, color=color, ms=4, mec="white", mew=0.4, zorder=3)
    ax.set(xscale="log", yscale="log", xlim=(low, high), ylim=(low, high))
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(lambda v, _: f"{v:g}")
        axis.set_minor_formatter(lambda v, _: "")
    ax.set_xlabel("true amplitude, in detection limits", fontsize=8, labelpad=2)
    ax.set_ylabel("amplitude found, in detection limits", fontsize=8)
    head(fig, "Amplitude found against true", plants)
    keys(fig, plant_keys(plants), 0.65)
    return fig


def ratios(terms: pd.DataFrame, plants: Sequence[str]) -> Figure:
    """Amplitude found by amplitude true, a row of dots per effect with its median and how many intervals hold it."""
    effects = list(dict.fromkeys(terms["effect"]))
    tall = 0.22 * len(effects) + 0.2
    fig = Figure(figsize=(HALF_IN, 0.95 + tall + 0.55))
    ax = panel(fig, 1.75, 0.95, HALF_IN - 2.45, tall)
    ax.axvspan(0.6, 1.4, color="#eef1f4", zorder=0)
    ax.axvline(1.0, color=PALE, lw=1.2, zorder=1)
    for y, effect in enumerate(effects):
        own = terms[terms["effect"] == effect]
        for plant, part in own.groupby("plant", sort=True):
            color, mark = plant_style(str(plant))
            x = part["ratio"].clip(0.25, 4)
            ax.plot(x, np.full(len(part), y), mark, color=color, ms=3.6, alpha=0.55, mec="none")
        ax.plot([own["ratio"].median()] * 2, [y - 0.36, y + 0.36], color=INK, lw=1.8, zorder=4)
        told = own["covers"].dropna()
        if len(told):
            ax.text(1.03, y, f"{int(told.sum())}/{len(told)}", fontsize=7.5, color=SOFT,
                    transform=ax.get_yaxis_transform(), va="center")  # fmt: skip
    ax.text(1.03, -0.75, "interval\nholds it", fontsize=7, color=SOFT, transform=ax.get_yaxis_transform(), va="bottom")
    ax.set(xscale="log", xlim=(0.22, 4.6), ylim=(len(effects) - 0.5, -0.8))
    ax.set_xticks([0.25, 0.5, 1, 2, 4], ["≤ ¼", "½", "1", "2", "≥ 4"], fontsize=8)
    ax.xaxis.set_minor_locator(NullLocator())
    ax.set_yticks(range(len(effects)), [key_label(e) for e in effects], fontsize=8, color=INK)
    ax.tick_params(axis="y", length=0)
    ax.grid(axis="y", visible=False)
    ax.set_xlabel("found / true", fontsize=8, labelpad=2)
    head(fig, "Amplitude by effect", plants)
    return fig


def times(cases: pd.DataFrame, wanted_s: float, plants: Sequence[str]) -> Figure:
    """Share of cases that took no longer, by plant, with the goal."""
    fig = Figure(figsize=(HALF_IN, 5.6))
    ax = panel(fig, 0.75, 0.95, HALF_IN - 1.0, 4.1)
    ax.axvline(wanted_s, color=INK, lw=1, ls="--")
    longest = max(float(cases["seconds"].max()), wanted_s)
    for plant in plants:
        own = np.sort(cases.loc[cases["plant"] == plant, "seconds"].dropna().to_numpy(float))
        if len(own):
            share = 100 * np.arange(len(own) + 1) / len(own)
            ax.step([own[0], *own], share, where="post", color=plant_style(plant)[0], lw=1.8)
    ax.set(xlim=(0, 1.06 * longest), ylim=(0, 103))
    ax.text(wanted_s, 2, f" goal {number(wanted_s, 0)} s", fontsize=8, color=SOFT, ha="left", va="bottom")
    ax.set_xlabel("time, s", fontsize=8, labelpad=2)
    ax.set_ylabel("cases done, %", fontsize=8)
    head(fig, "Time for a case", plants)
    keys(fig, [("—", f"plant {plant_letter(p)}", plant_style(p)[0]) for p in plants], 0.65)
    return fig


def worst_case(series: pd.DataFrame, windows: pd.DataFrame | None, plant: str) -> Figure:
    """Residual of one case's channel before and after, a panel a run; shaded where the concealed effect works.

    Args:
        series: batch, channel, unit, time_s, recorded, before, after of one case and channel.
        windows: batch, start_s, end_s; without rows the effect works always, None: nothing is concealed.
    """
    batches = list(dict.fromkeys(series["batch"]))
    fig = Figure(figsize=(WIDE_IN, 2.35))
    wide = (WIDE_IN - 0.6) / len(batches)
    for k, batch in enumerate(batches):
        own = series[series["batch"] == batch]
        ax = panel(fig, 0.6 + k * wide, 0.72, wide - 0.35, 1.2)
        hours = own["time_s"].to_numpy(float) / 3600
        if windows is not None:
            for w in windows[windows["batch"] == batch].to_dict("records"):
                ax.axvspan(w["start_s"] / 3600, w["end_s"] / 3600, color=SHADE, lw=0, zorder=0)
            if windows.empty:
                ax.set_facecolor(SHADE)
        ax.axhline(0, color=SOFT, lw=0.6)
        ax.plot(hours, own["recorded"] - own["before"], color=ORANGE, lw=1.3)
        ax.plot(hours, own["recorded"] - own["after"], color=BLUE, lw=1.3)
        if len(hours) > 1:
            ax.set_xlim(hours[0], hours[-1])
        ax.set_title(str(batch).replace("$", r"\$"), fontsize=8.5, loc="left", color=INK, pad=3)
        ax.set_xlabel("time, h", fontsize=8, labelpad=1)
        ax.locator_params(axis="y", nbins=4)
    unit = str(series["unit"].iloc[0]).replace("degC", "K")  # of a difference
    channel = str(series["channel"].iloc[0]).replace("$", r"\$")
    head(fig, f"{channel}: recorded − simulated, {UNITS.get(unit, unit)}", (plant,))
    shaded = [("■", "the effect works", "#e3b78f")] if windows is not None else []
    keys(fig, [("—", "before", ORANGE), ("—", "after", BLUE), *shaded], 0.4)
    return fig
