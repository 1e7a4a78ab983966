"""Rivals and ablations, reliability, detection over amplitude. Each takes tables and returns a figure."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pipelines.report.proof_drawing import HALF_IN, PALE, WIDE_IN, head, panel
from pipelines.report.proof_extracts import SIZES
from pipelines.report.proof_words import GROUPS, key_label, method_label
from pipelines.report.twin_figures import SIZE, SOFT
from pipelines.report.words import BLUE, INK, ORANGE, number

Array = NDArray[np.float64]
_GROUP_COLORS = {"diagnosis": BLUE, "baseline": ORANGE, "ablation": "#6b7682"}
_ROW_IN, _NAMES_IN, _TOP_IN = 0.27, 2.75, 1.05


def rivals(compared: pd.DataFrame, plants: Sequence[str]) -> Figure:
    """A dot and its 90 % interval per method (rows) and measure (columns), grouped; the diagnosis drawn through.

    Args:
        compared: method, group, measure, value, low90, high90 as shares; `lead`, `lead_low90` and `lead_high90`, where
            there are any, become a last column.
    """
    measures = list(dict.fromkeys(compared["measure"]))
    leads = compared[compared["lead"].notna()] if "lead" in compared else compared[:0]
    rows = _method_rows(compared)
    columns = len(measures) + bool(len(leads))
    tall, wide = _ROW_IN * len(rows), (WIDE_IN - _NAMES_IN) / columns
    fig = Figure(figsize=(WIDE_IN, _TOP_IN + tall + 0.4))
    for k in range(columns):
        ax = panel(fig, _NAMES_IN + k * wide, _TOP_IN, wide - 0.55, tall)
        if k < len(measures):
            own = compared[compared["measure"] == measures[k]].drop_duplicates("method").set_index("method")
            line = float(own["value"].get("diagnosis", np.nan))
            _dots(ax, rows, own[["low90", "value", "high90"]], line)
            ax.set(xlim=(-2, 102), xticks=[0, 25, 50, 75, 100])
            ax.set_title(textwrap.fill(measures[k], 24), fontsize=9, loc="left", color=INK, pad=5)
            ax.set_xlabel("share of cases, %", fontsize=8, labelpad=1)
        else:
            _dots(ax, rows, leads.set_index("method")[["lead_low90", "lead", "lead_high90"]], 0.0)
            ax.locator_params(axis="x", nbins=5)
            ax.set_title("ahead of it in\nright answers", fontsize=9, loc="left", color=INK, pad=5)
            ax.set_xlabel("points", fontsize=8, labelpad=1)
        names = [method_label(m) if m and k == 0 else "" for _, m in rows]
        ax.set_yticks(range(len(rows)), names, fontsize=8.5, color=INK)
    first, side = fig.axes[0], -_NAMES_IN / (wide - 0.55) + 0.05
    for y, (group, method) in enumerate(rows):
        if not method:
            words = GROUPS.get(group, group)
            first.text(side, y, words, fontsize=8.5, color=SOFT, transform=first.get_yaxis_transform(), va="center")
    head(fig, "Against other ways, on the same recordings", plants)
    return fig


def _dots(ax: Axes, rows: Sequence[tuple[str, str]], own: pd.DataFrame, line: float) -> None:
    """Interval and value (low, value, high, as shares) of every method that has them; a line drawn through."""
    if np.isfinite(line):
        ax.axvline(100 * line, color=BLUE, lw=1, alpha=0.45, zorder=1)
    shares = dict(zip(own.index, own.to_numpy(float), strict=True))
    for y, (group, method) in enumerate(rows):
        low, value, high = 100 * shares.get(method, np.full(3, np.nan))
        if not np.isfinite(value):
            continue
        color = _GROUP_COLORS.get(group, SOFT)
        ax.plot([low, high], [y, y], color=color, lw=2, alpha=0.55, zorder=2)
        ax.plot([value], [y], "o", ms=6, color=color, mec="white", mew=0.8, zorder=3)
        ax.text(1.03, y, number(value, 0), fontsize=8, color=INK, transform=ax.get_yaxis_transform(), va="center")
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.tick_params(axis="y", length=0)
    ax.grid(axis="y", visible=False)


def _method_rows(compared: pd.DataFrame) -> list[tuple[str, str]]:
    """(group, method) from top to bottom; a row without a method is a group's heading."""
    out: list[tuple[str, str]] = []
    for group in dict.fromkeys([*(g for g in GROUPS if g in set(compared["group"])), *compared["group"]]):
        methods = list(dict.fromkeys(compared.loc[compared["group"] == group, "method"]))
        out += ([(group, "")] if group != "diagnosis" else []) + [(group, m) for m in methods]
    return out


def reliability(table: pd.DataFrame, told: Array, error: float, plants: Sequence[str]) -> Figure:
    """Share right against claimed probability, bin by bin with 90 % intervals; below, how often each was claimed.

    Args:
        table: bins from low to high: claimed (mean), right, low90, high90, n.
        told: every probability (n,), 0..1.
        error: expected calibration error; nan where it is not known.
    """
    fig = Figure(figsize=(HALF_IN, 5.6))
    ax = panel(fig, 0.75, 0.75, HALF_IN - 1.0, 3.3)
    ax.plot([0, 100], [0, 100], color=PALE, lw=1.2)
    first, last, x, y, low, high = (
        100 * table[c].to_numpy(float) for c in ("low", "high", "claimed", "right", "low90", "high90")
    )
    ax.hlines(y, first, last, color=BLUE, lw=2, alpha=0.25)
    ax.vlines(x, low, high, color=BLUE, lw=2, alpha=0.5)
    ax.plot(x, y, "o", color=BLUE, ms=6, mec="white", mew=0.8)
    ax.set(xlim=(0, 103), ylim=(-3, 103))
    ax.set_ylabel("right, %", fontsize=8)
    said = f"n {int(table['n'].sum())}"
    said = f"expected calibration error {error:.3f}, {said}" if np.isfinite(error) else said
    ax.set_title(said, fontsize=8.5, loc="left", color=SOFT, pad=4)
    below = panel(fig, 0.75, 4.3, HALF_IN - 1.0, 0.75)
    below.hist(100 * told, bins=np.linspace(0, 100, 41).tolist(), color=PALE)
    below.set_xlim(0, 103)
    below.set_xlabel("probability claimed, %", fontsize=8, labelpad=1)
    below.set_ylabel("answers", fontsize=8)
    below.locator_params(axis="y", nbins=3)
    head(fig, "Are the probabilities honest?", plants)
    return fig


def detection(table: pd.DataFrame, plants: Sequence[str]) -> Figure:
    """Share found by effect (rows) and size in detection limits (columns); counts in the cells, all effects on top.

    Args:
        table: `proof_extracts.detection_by_size`.
    """
    effects = [e for e in dict.fromkeys(table["effect"]) if e != "all effects"]
    names = ["all effects", *effects]
    sizes = [s for s in SIZES if s in set(table["size"])]
    tall, left = 0.235 * len(names), 2.3
    fig = Figure(figsize=(WIDE_IN, 0.95 + tall + 0.1))
    ax = panel(fig, left, 0.95, WIDE_IN - left - 0.25, tall)
    at = {(r["effect"], r["size"]): (int(r["found"]), int(r["n"])) for r in table.to_dict("records")}
    for y, name in enumerate(names):
        for x, size in enumerate(sizes):
            found, n = at.get((name, size), (0, 0))
            if not n:
                continue
            share = found / n
            ax.barh(y, 0.62, left=x + 0.05, height=0.62, color="#eef1f4", zorder=2)
            ax.barh(y, 0.62 * share, left=x + 0.05, height=0.62, color=BLUE if y else INK, zorder=3)
            ax.text(x + 0.7, y, f"{found}/{n}", fontsize=7.5, color=INK, va="center", zorder=4)
    ax.set(xlim=(0, len(sizes)), ylim=(len(names) - 0.5, -0.5))
    ax.set_yticks(range(len(names)), [key_label(n) for n in names], fontsize=8, color=INK)
    ax.set_xticks([x + 0.36 for x in range(len(sizes))], sizes, fontsize=8)
    ax.xaxis.tick_top()
    ax.tick_params(axis="both", length=0)
    ax.grid(visible=False)
    ax.spines[["left", "bottom"]].set_visible(False)
    ax.axhline(0.5, color=PALE, lw=0.8)
    ax.set_title("size in detection limits", fontsize=8.5, color=SOFT, loc="left", pad=4)
    head(fig, "Found, by effect and size", plants)
    return fig


def confusion(counts: pd.DataFrame, bounds: Sequence[int], title: str, plants: Sequence[str]) -> Figure:
    """What was named (columns) for what was there (rows); shaded by the row's share, the same on both outlined.

    Args:
        counts: rows and columns in the order to draw.
        bounds: rows after which a group ends.
    """
    rows, columns = [str(r) for r in counts.index], [str(c) for c in counts.columns]
    cell = min(0.36, (WIDE_IN - 2.05) / max(len(columns), 1))
    tall, left = 0.215 * len(rows), 1.95
    top = 0.7 + 0.075 * max((len(c) for c in columns), default=1)
    fig = Figure(figsize=(WIDE_IN, top + tall + 0.1))
    ax = panel(fig, left, top, cell * len(columns), tall)
    values = counts.to_numpy(float)
    shares = values / np.maximum(values.sum(axis=1, keepdims=True), 1.0)
    ax.imshow(shares, cmap=SIZE, vmin=0, vmax=1, aspect="auto", zorder=1)
    for i, j in zip(*np.nonzero(values), strict=True):
        color = "white" if shares[i, j] > 0.55 else INK
        ax.text(j, i, f"{int(values[i, j])}", fontsize=7, color=color, ha="center", va="center", zorder=3)
    for i, row in enumerate(rows):
        if row in columns and row != "other":
            j = columns.index(row)
            ax.plot([j - 0.5, j + 0.5, j + 0.5, j - 0.5, j - 0.5], [i - 0.5, i - 0.5, i + 0.5, i + 0.5, i - 0.5],
                    color=ORANGE, lw=1.0, zorder=2)  # fmt: skip
    for b in bounds:
        ax.axhline(b - 0.5, color=PALE, lw=0.9, zorder=1.5)
        ax.axvline(b - 0.5, color=PALE, lw=0.9, zorder=1.5)
    ax.set(xlim=(-0.5, len(columns) - 0.5), ylim=(len(rows) - 0.5, -0.5))
    ax.set_xticks(range(len(columns)), [key_label(c) for c in columns], rotation=90, fontsize=7.5, color=INK)
    ax.set_yticks(range(len(rows)), [key_label(r) for r in rows], fontsize=7.5, color=INK)
    ax.xaxis.tick_top()
    ax.tick_params(axis="both", length=0, pad=2)
    ax.grid(visible=False)
    head(fig, title, plants)
    return fig
