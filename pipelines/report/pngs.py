"""Small pictures of one result for the tracking store."""

from __future__ import annotations

import io
import threading

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from models.result import GridResult
from pipelines.report.extracts import best_per, is_baseline, left_out_batches, picked, protocols_of, scored
from pipelines.report.words import BLUE, INK, ORANGE, family_label, selector_label
from pipelines.settings import PromotionRule

_DRAWING = threading.Lock()  # matplotlib's font and text caches are shared by all figures
_DPI = 80


def figure_pngs(result: GridResult) -> dict[str, bytes]:
    """File name -> PNG: the leaderboard's families, accuracy against the number of points, left-out predictions.

    Threads may call it at once.
    """
    rule = PromotionRule()
    protocol = protocols_of(result)[0]
    cells = scored(result, protocol, rule)
    if cells.empty:
        return {}
    with _DRAWING:
        out = {"families.png": _families(result, cells, protocol), "points.png": _points(result, cells, protocol)}
        shown = left_out_batches(result, picked(result, rule, protocol))
        if shown:
            fig = Figure(figsize=(3.6 * len(shown), 3.0), layout="tight")
            axes = np.atleast_1d(fig.subplots(1, len(shown), sharey=True))
            for ax, b in zip(axes, shown, strict=True):
                ax.plot(b.time_h, b.recorded_um, color=INK, lw=1.2, label="recorded")
                ax.plot(b.time_h, b.predicted_um, color=BLUE, lw=1.2, label="predicted, left out")
                ax.set_title(f"{b.place}: {b.batch_id}, S = {b.S_um:.1f} µm", fontsize=9)
                _plain(ax, "time (h)", "")
            axes[0].set_ylabel(f"{result.target} (µm)", fontsize=8)
            axes[0].legend(fontsize=7, frameon=False)
            out["left_out.png"] = _png(fig)
    return out


def _families(result: GridResult, cells: object, protocol: str) -> bytes:
    best = best_per(cells, "family").iloc[::-1]  # type: ignore[arg-type]
    names = [
        family_label(r.family)
        if r.n_tsp == 0
        else f"{family_label(r.family)}, {r.n_tsp} by {selector_label(r.selector)}"
        for r in best.itertuples()
    ]
    fig = Figure(figsize=(6.4, 0.9 + 0.3 * len(best)), layout="tight")
    ax = fig.subplots()
    y = np.arange(len(best))
    base = is_baseline(best).to_numpy()
    ax.barh(y, best["S_mean_um"], color=np.where(base, "#b8bec6", BLUE), height=0.62)
    ax.errorbar(best["S_mean_um"], y, xerr=best["S_std_um"], fmt="none", ecolor=INK, elinewidth=1, capsize=2)
    ax.set_yticks(y, names, fontsize=8)
    cap = 1.6 * float(best.loc[base, "S_mean_um"].max() if base.any() else best["S_mean_um"].median())
    ax.set_xlim(0, min(cap, 1.1 * float((best["S_mean_um"] + best["S_std_um"].fillna(0)).max())) or 1.0)
    _plain(ax, f"S_mean ± S_std (µm), {protocol}", _title(result))
    return _png(fig)


def _points(result: GridResult, cells: object, protocol: str) -> bytes:
    table = cells[~is_baseline(cells)]  # type: ignore[index, arg-type]
    fig = Figure(figsize=(6.4, 3.6), layout="tight")
    ax = fig.subplots()
    for row in best_per(table, "family").head(7).itertuples():
        line = table[(table["family"] == row.family) & (table["selector"] == row.selector)].sort_values("n_tsp")
        label = f"{family_label(row.family)}, {selector_label(row.selector)}"
        ax.plot(line["n_tsp"], line["S_mean_um"], marker="o", ms=3, lw=1.2, label=label)
    zero = cells[cells["family"] == "zero"]["S_mean_um"]  # type: ignore[index, call-overload]
    if len(zero):
        ax.axhline(zero.iloc[0], color=ORANGE, lw=1, ls="--", label="no model")
        ax.set_ylim(0, 1.2 * float(zero.iloc[0]))
    ax.legend(fontsize=7, frameon=False)
    _plain(ax, "number of temperature-sensitive points", _title(result))
    ax.set_ylabel(f"S_mean (µm), {protocol}", fontsize=8)
    return _png(fig)


def _title(result: GridResult) -> str:
    return f"{result.machine} {result.target}" + (" – SIMULATED" if result.simulated else "")


def _plain(ax: Axes, x: str, title: str) -> None:
    ax.set_xlabel(x, fontsize=8)
    if title:
        ax.set_title(title, fontsize=9)
    ax.tick_params(labelsize=8)
    ax.spines[["top", "right"]].set_visible(False)


def _png(fig: Figure) -> bytes:
    FigureCanvasAgg(fig)
    out = io.BytesIO()
    fig.savefig(out, format="png", dpi=_DPI)
    return out.getvalue()
