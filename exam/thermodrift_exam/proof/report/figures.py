"""The figures of the proof's page. Each takes tables and returns a figure."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

from data.arrays import Array
from data.units import unit_label
from reports.drawing import GREY, MUTED, SIZE, Picture, panel
from reports.drawing import picture as drawn
from reports.labels import BLUE, GREEN, INK, ORANGE, number, tex_escaped
from thermodrift_exam.proof.report.labels import GROUPS, key_label, method_label, origin, plant_letter, plant_origin
from thermodrift_exam.proof.report.tables import SIZES

WIDE_IN, HALF_IN = 10.5, 5.5
_PLANTS = {
    "elements": (BLUE, "o"), "volumes": (ORANGE, "s"), "grafted": (GREEN, "D"), "withheld": ("#8a4fa3", "^"),
    "lathe": ("#b5495b", "v"), "board": ("#3c7d8c", "P"), "horizontal": ("#7a6a2f", "X"), "gantry": ("#4f5d9e", "<"),
    "bench": ("#a0622d", ">"), "battery": ("#5b8c3a", "*"),
}  # fmt: skip


def plant_style(plant: str) -> tuple[str, str]:
    """Colour and marker."""
    return _PLANTS.get(plant, (MUTED, "o"))


def head(fig: Figure, title: str, plants: Sequence[str]) -> None:
    """The title, and below it which part of the figure is simulated."""
    high, wide = fig.get_figheight(), fig.get_figwidth()
    fig.text(0.1 / wide, 1 - 0.18 / high, title, fontsize=11, color=INK, fontweight="bold", va="center")
    said = origin(plants)
    if said and said != "real":
        fig.text(0.1 / wide, 1 - 0.4 / high, said, fontsize=8.5, color=ORANGE, fontweight="bold", va="center")


def keys(fig: Figure, entries: Sequence[tuple[str, str, str]], y_in: float) -> None:
    """Mark, label and colour in a row, right of the origin's line, `y_in` below the top edge."""
    high, wide = fig.get_figheight(), fig.get_figwidth()
    x = wide - 0.1 - sum(0.3 + 0.072 * len(label) for _, label, _ in entries)
    for mark, label, color in entries:
        fig.text(x / wide, 1 - y_in / high, mark, fontsize=9.5, color=color, va="center")
        fig.text((x + 0.17) / wide, 1 - y_in / high, label, fontsize=8.5, color=MUTED, va="center")
        x += 0.3 + 0.072 * len(label)


def plant_keys(plants: Sequence[str]) -> list[tuple[str, str, str]]:
    """Legend entries: the plants' letters."""
    marks = {"o": "●", "s": "■", "D": "◆", "^": "▲", "v": "▼", "P": "✚", "X": "✖", "<": "◀", ">": "▶", "*": "★"}
    return [(marks[plant_style(p)[1]], f"plant {plant_letter(p)}", plant_style(p)[0]) for p in plants]


def picture(figure: Figure, said: str, plants: Sequence[str], look: str = "full") -> Picture:
    """The figure as a data: address; its label states what is simulated."""
    only = {plant_origin(p) for p in plants} == {"SIMULATED"}
    mixed = "" if only else f" ({origin(plants)})"
    return drawn(figure, f"{said}{mixed}", only, look=look)


_GROUP_COLORS = {"diagnosis": BLUE, "baseline": ORANGE, "ablation": "#6b7682"}
_ROW_IN, _NAMES_IN, _TOP_IN = 0.27, 2.75, 1.05


def baselines(compared: pd.DataFrame, plants: Sequence[str]) -> Figure:
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
            label = GROUPS.get(group, group)
            first.text(side, y, label, fontsize=8.5, color=MUTED, transform=first.get_yaxis_transform(), va="center")
    head(fig, "Against other methods, on the same recordings", plants)
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
        color = _GROUP_COLORS.get(group, MUTED)
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


def reliability(table: pd.DataFrame, stated: Array, error: float, plants: Sequence[str]) -> Figure:
    """Share right against claimed probability, bin by bin with 90 % intervals; below, how often each was claimed.

    Args:
        table: bins from low to high: claimed (mean), right, low90, high90, n.
        stated: every probability (n,), 0..1.
        error: expected calibration error; nan where it is not known.
    """
    fig = Figure(figsize=(HALF_IN, 5.6))
    ax = panel(fig, 0.75, 0.75, HALF_IN - 1.0, 3.3)
    ax.plot([0, 100], [0, 100], color=GREY, lw=1.2)
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
    ax.set_title(said, fontsize=8.5, loc="left", color=MUTED, pad=4)
    below = panel(fig, 0.75, 4.3, HALF_IN - 1.0, 0.75)
    below.hist(100 * stated, bins=np.linspace(0, 100, 41).tolist(), color=GREY)
    below.set_xlim(0, 103)
    below.set_xlabel("probability claimed, %", fontsize=8, labelpad=1)
    below.set_ylabel("answers", fontsize=8)
    below.locator_params(axis="y", nbins=3)
    head(fig, "Calibration of the probabilities", plants)
    return fig


def detection(table: pd.DataFrame, plants: Sequence[str]) -> Figure:
    """Share found by effect (rows) and size in detection limits (columns); counts in the cells, all effects on top.

    Args:
        table: `tables.detection_by_size`.
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
    ax.axhline(0.5, color=GREY, lw=0.8)
    ax.set_title("size in detection limits", fontsize=8.5, color=MUTED, loc="left", pad=4)
    head(fig, "Found, by effect and size", plants)
    return fig


def confusion(counts: pd.DataFrame, bounds: Sequence[int], title: str, plants: Sequence[str]) -> Figure:
    """Named (columns) against concealed (rows); shaded by the row's share, the same on both outlined.

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
        ax.axhline(b - 0.5, color=GREY, lw=0.9, zorder=1.5)
        ax.axvline(b - 0.5, color=GREY, lw=0.9, zorder=1.5)
    ax.set(xlim=(-0.5, len(columns) - 0.5), ylim=(len(rows) - 0.5, -0.5))
    ax.set_xticks(range(len(columns)), [key_label(c) for c in columns], rotation=90, fontsize=7.5, color=INK)
    ax.set_yticks(range(len(rows)), [key_label(r) for r in rows], fontsize=7.5, color=INK)
    ax.xaxis.tick_top()
    ax.tick_params(axis="both", length=0, pad=2)
    ax.grid(visible=False)
    head(fig, title, plants)
    return fig


SHADE = "#f3ddc9"


def improvement(cases: pd.DataFrame, plants: Sequence[str]) -> Figure:
    """Left-out error of every case before and after the diagnosis, with the true model and the noise level; sorted.

    Args:
        cases: a row per case with error_before, error_after, error_true and error_floor, in units of the noise.
    """
    fig = Figure(figsize=(WIDE_IN, 4.3))
    ax = panel(fig, 0.75, 0.75, WIDE_IN - 0.95, 3.0)
    shown = cases.sort_values("error_before", ascending=False, kind="stable")
    at = np.arange(len(shown))
    thick = min(2.5, 500 / len(shown))
    ax.vlines(at, shown["error_after"], shown["error_before"], color=GREY, lw=thick, zorder=1)
    size = float(np.clip(420 / len(shown), 2.0, 5.0))
    for column, color, mark in (("error_floor", MUTED, "_"), ("error_true", GREEN, "_"), ("error_before", ORANGE, "o"),
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
    head(fig, "Left-out error before and after the diagnosis", plants)
    lines = [("━", "with the true model", GREEN), ("━", "noise", MUTED)]
    keys(fig, [("●", "before", ORANGE), ("●", "after", BLUE), *lines], 0.4)
    return fig


def amplitudes(terms: pd.DataFrame, plants: Sequence[str]) -> Figure:
    """Amplitude found against true, both in detection limits, with 90 % intervals; the band is ± 40 %.

    Args:
        terms: `tables.with_amplitude`.
    """
    fig = Figure(figsize=(HALF_IN, 5.6))
    ax = panel(fig, 0.75, 0.95, HALF_IN - 1.0, 4.1)
    both = np.concatenate([terms["true_limits"], terms["found_limits"]])
    both = both[np.isfinite(both) & (both > 0)]
    low, high = float(both.min()) / 1.4, float(both.max()) * 1.4
    line = np.array([low, high])
    ax.fill_between(line, 0.6 * line, 1.4 * line, color="#eef1f4", zorder=0)
    ax.plot(line, line, color=GREY, lw=1.2, zorder=1)
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
    ax.axvline(1.0, color=GREY, lw=1.2, zorder=1)
    for y, effect in enumerate(effects):
        own = terms[terms["effect"] == effect]
        for plant, part in own.groupby("plant", sort=True):
            color, mark = plant_style(str(plant))
            x = part["ratio"].clip(0.25, 4)
            ax.plot(x, np.full(len(part), y), mark, color=color, ms=3.6, alpha=0.55, mec="none")
        ax.plot([own["ratio"].median()] * 2, [y - 0.36, y + 0.36], color=INK, lw=1.8, zorder=4)
        known = own["covers"].dropna()
        if len(known):
            ax.text(1.03, y, f"{int(known.sum())}/{len(known)}", fontsize=7.5, color=MUTED,
                    transform=ax.get_yaxis_transform(), va="center")  # fmt: skip
    ax.text(1.03, -0.75, "interval\nholds it", fontsize=7, color=MUTED, transform=ax.get_yaxis_transform(), va="bottom")
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
    """Empirical distribution of the time per case, by plant, with the goal."""
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
    ax.text(wanted_s, 2, f" goal {number(wanted_s, 0)} s", fontsize=8, color=MUTED, ha="left", va="bottom")
    ax.set_xlabel("time, s", fontsize=8, labelpad=2)
    ax.set_ylabel("cases done, %", fontsize=8)
    head(fig, "Time for a case", plants)
    keys(fig, [("—", f"plant {plant_letter(p)}", plant_style(p)[0]) for p in plants], 0.65)
    return fig


def worst_case(series: pd.DataFrame, windows: pd.DataFrame | None, plant: str) -> Figure:
    """Residual of one case's channel before and after, a panel a run; shaded where the concealed effect acts.

    Args:
        series: batch, channel, unit, time_s, recorded, before, after of one case and channel.
        windows: batch, start_s, end_s; without rows the effect always acts, None: nothing is concealed.
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
        ax.axhline(0, color=MUTED, lw=0.6)
        ax.plot(hours, own["recorded"] - own["before"], color=ORANGE, lw=1.3)
        ax.plot(hours, own["recorded"] - own["after"], color=BLUE, lw=1.3)
        if len(hours) > 1:
            ax.set_xlim(hours[0], hours[-1])
        ax.set_title(tex_escaped(str(batch)), fontsize=8.5, loc="left", color=INK, pad=3)
        ax.set_xlabel("time, h", fontsize=8, labelpad=1)
        ax.locator_params(axis="y", nbins=4)
    unit = str(series["unit"].iloc[0]).replace("degC", "K")  # of a difference
    channel = tex_escaped(str(series["channel"].iloc[0]))
    head(fig, f"{channel}: recorded − simulated, {unit_label(unit)}", (plant,))
    shaded = [("■", "the effect works", "#e3b78f")] if windows is not None else []
    keys(fig, [("—", "before", ORANGE), ("—", "after", BLUE), *shaded], 0.4)
    return fig
