"""Small pictures of one result for the tracking store."""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from models.protocols import PromotionRule
from models.result import GridResult
from reports.comparison.tables import (
    LeftOut,
    best_per,
    is_baseline,
    left_out_batches,
    paths,
    picked,
    protocols_of,
    scored,
    zero_um,
)
from reports.drawing import picture_bytes
from reports.labels import BLUE, INK, ORANGE, cell_label, family_label, family_style, selector_label, tex_escaped

_DRAWING = threading.Lock()  # matplotlib's font and text caches are shared by all figures
_DPI = 80
_GREY = "#b8bec6"
_MOST_LINES = 8


def figure_pngs(result: GridResult) -> dict[str, bytes]:
    """File name -> PNG: the families' best cells, accuracy against the number of points, left-out predictions.

    Threads may call it at once. Empty where no cell has a score.
    """
    rule = PromotionRule()
    protocol = protocols_of(result)[0]
    cells = scored(result, protocol, rule)
    if cells.empty:
        return {}
    shown = left_out_batches(result, picked(result, rule, protocol))
    with _DRAWING:
        out = {"families.png": _families(result, cells, protocol), "points.png": _points(result, cells, protocol)}
        return out | ({"left_out.png": _left_out(result, shown)} if shown else {})


def _families(result: GridResult, cells: pd.DataFrame, protocol: str) -> bytes:
    best = best_per(cells, "family").iloc[::-1]
    names = [cell_label(str(r["selector"]), str(r["family"]), int(r["n_tsp"])) for r in best.to_dict("records")]
    height = 1.0 + 0.3 * len(best)
    fig, (ax,) = _canvas(6.4, height, 1, left=2.7)
    y, base = np.arange(len(best)), is_baseline(best).to_numpy()
    spread = best["S_std_um"].fillna(0.0)
    ax.barh(y, best["S_mean_um"], color=np.where(base, _GREY, BLUE), height=0.62)
    ax.errorbar(best["S_mean_um"], y, xerr=spread, fmt="none", ecolor=INK, elinewidth=1, capsize=2)
    ax.set_yticks(y, names)
    widest = float((best["S_mean_um"] + spread).max())
    nothing_um = zero_um(cells)
    ax.set_xlim(0, 1.05 * (min(widest, 2 * nothing_um) if nothing_um > 0 else widest) or 1.0)
    _name(ax, f"S_mean ± S_std (µm), {protocol}", _title(result))
    return picture_bytes(fig, "png", _DPI)


def _points(result: GridResult, cells: pd.DataFrame, protocol: str) -> bytes:
    table = paths(cells)
    fig, (ax,) = _canvas(6.4, 3.6, 1, left=0.7)
    for best in best_per(table, "family").head(_MOST_LINES).to_dict("records"):
        family, selector = str(best["family"]), str(best["selector"])
        line = table[(table["family"] == family) & (table["selector"] == selector)].sort_values("n_tsp")
        label = f"{family_label(family)}, {selector_label(selector)}"
        ax.plot(line["n_tsp"], line["S_mean_um"], marker="o", ms=3, lw=1.2, color=family_style(family)[0], label=label)
    nothing_um = zero_um(cells)
    if nothing_um > 0:
        ax.axhline(nothing_um, color=_GREY, lw=1, ls="--", label="no model")
        ax.set_ylim(0, 1.2 * nothing_um)
    if ax.get_legend_handles_labels()[0]:
        ax.legend(fontsize=7, frameon=False, ncols=2, loc="upper right")
    _name(ax, "number of points", _title(result))
    ax.set_ylabel(f"S_mean (µm), {protocol}", fontsize=8)
    return picture_bytes(fig, "png", _DPI)


def _left_out(result: GridResult, shown: Sequence[LeftOut]) -> bytes:
    fig, axes = _canvas(3.5 * len(shown), 3.0, len(shown), left=0.6)
    for ax, b in zip(axes, shown, strict=True):
        along_axis = b.position_mm is not None
        x = b.time_h if b.position_mm is None else b.position_mm
        line, marker = ("", ".") if along_axis else ("-", "")
        ax.plot(x, b.recorded_um, color=INK, lw=1.0, ls=line, marker=marker, label="recorded")
        ax.plot(x, b.predicted_um, color=BLUE, lw=1.4, ls=line, marker=marker, label="predicted, left out")
        ax.plot(x, b.recorded_um - b.predicted_um, color=ORANGE, lw=0.8, ls=line, marker=marker, label="residual")
        place = f"{b.place}: {tex_escaped(b.batch_id)}, S = {b.S_um:.1f} µm"
        _name(ax, "position (mm)" if along_axis else "time since start (h)", place)
    axes[0].set_ylabel(f"{_title(result)} (µm)", fontsize=8)
    axes[0].legend(fontsize=7, frameon=False)
    return picture_bytes(fig, "png", _DPI)


def _canvas(width_in: float, height_in: float, columns: int, left: float) -> tuple[Figure, list[Axes]]:
    """A figure with fixed margins: fitting them by drawing twice would cost half of the time."""
    fig = Figure(figsize=(width_in, height_in))
    axes = fig.subplots(1, columns, squeeze=False)[0]
    fig.subplots_adjust(left / width_in, 0.5 / height_in, 1 - 0.15 / width_in, 1 - 0.35 / height_in, wspace=0.18)
    return fig, list(axes)


def _title(result: GridResult) -> str:
    return tex_escaped(f"{result.machine} {result.target}") + (" SIMULATED" if result.simulated else "")


def _name(ax: Axes, x: str, title: str) -> None:
    ax.set_xlabel(x, fontsize=8)
    ax.set_title(title, fontsize=9)
    ax.tick_params(labelsize=8)
    ax.spines[["top", "right"]].set_visible(False)
