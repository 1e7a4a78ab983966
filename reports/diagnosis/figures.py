"""The figures of a diagnosis. Each takes data and returns a figure; none computes a result."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from data.units import unit_label
from reports.diagnosis.map import KINDS
from reports.diagnosis.tables import SEEN_Z, ordered, strongest
from reports.drawing import MUTED, SIGNED, WIDTH_IN, calm, head, legend_row
from reports.labels import BLUE, INK, ORANGE, digits_of, number, tex_escaped

FLOOR = "#cfd6dd"
_ROW_IN, _MOST_ROWS, _MOST_RUNS = 0.27, 12, 30
_NAMES_IN, _NUMBERS_IN = 1.15, 1.95


def before_after(channels: pd.DataFrame, changed: bool, simulated: bool) -> Figure:
    """A dumbbell per channel, displacements left and temperatures right, with the noise floor as a bar behind.

    Args:
        channels: `tables.by_channel`, in the order to draw; at most 12 of a unit are drawn.
        changed: whether something was found; else there is one dot a channel.
    """
    groups = [part for _, part in channels.groupby(channels["unit"].isin(["K", "degC"]), sort=False)]
    hidden = [max(len(g) - _MOST_ROWS, 0) for g in groups]
    groups = [g[:_MOST_ROWS] for g in groups]
    high = _ROW_IN * max(len(g) for g in groups) + 1.3
    fig = Figure(figsize=(WIDTH_IN, high))
    panel = WIDTH_IN / len(groups)
    for k, part in enumerate(groups):
        left, wide, tall = k * panel + _NAMES_IN, panel - _NAMES_IN - _NUMBERS_IN, _ROW_IN * len(part)
        ax = fig.add_axes((left / WIDTH_IN, 1 - (0.86 + tall) / high, wide / WIDTH_IN, tall / high))
        _bells(ax, part, [str(c) for c in part["channel"]], changed)
        _numbers(ax, part, changed, wide)
        if hidden[k]:
            ax.set_xlabel(f"{ax.get_xlabel()}; {hidden[k]} more channels change less", fontsize=8, labelpad=1)
    head(fig, "Error of left-out runs against the noise floor", simulated)
    _keys(fig, changed)
    return fig


def by_run(rms: pd.DataFrame, channels: Sequence[str], changed: bool, simulated: bool) -> Figure:
    """The same run by run (at most 30), a panel for each of the given channels."""
    every = list(dict.fromkeys(rms["batch"]))
    runs = every[:_MOST_RUNS]
    high = 0.2 * len(runs) + 1.35
    fig = Figure(figsize=(WIDTH_IN, high))
    wide = (WIDTH_IN - _NAMES_IN) / len(channels)
    for k, channel in enumerate(channels):
        own = rms[rms["channel"] == channel].drop_duplicates("batch").set_index("batch")
        part = own.reindex(runs)
        size = ((_NAMES_IN + k * wide) / WIDTH_IN, 0.45 / high, (wide - 0.25) / WIDTH_IN, 0.2 * len(runs) / high)
        ax = fig.add_axes(size)
        _bells(ax, part, [_shortened(str(r)) for r in runs] if k == 0 else [""] * len(runs), changed)
        ax.set_title(tex_escaped(channel), fontsize=9, loc="left", color=INK, pad=4)
        if changed:
            better = f"{int((own['after'] < own['before']).sum())} of {int(own['after'].notna().sum())} better"
            ax.set_title(better, fontsize=8, loc="right", color=MUTED, pad=4)
    first = f" (the first {len(runs)} of {len(every)})" if len(every) > len(runs) else ""
    head(fig, f"Run by run, each predicted from the others{first}", simulated)
    _keys(fig, changed)
    return fig


def _bells(ax: Axes, part: pd.DataFrame, names: Sequence[str], changed: bool) -> None:
    """Floor, before and after of every row."""
    calm(ax)
    top = float(np.nanmax(part[["before", "after", "floor"]].to_numpy(float), initial=0.0)) or 1.0
    units = part["unit"].dropna()
    at = np.arange(len(part))
    ax.barh(at, part["floor"], height=0.62, color=FLOOR, zorder=2)
    if changed:
        ax.hlines(at, part["before"], part["after"], color="#8593a1", lw=2.0, zorder=3)
        ax.plot(part["before"], at, "o", ms=7, mfc=ORANGE, mec="white", mew=0.9, zorder=4)
    ax.plot(part["after"], at, "o", ms=7, mfc=BLUE, mec="white", mew=0.9, zorder=5)
    ax.set(xlim=(0, 1.06 * top), ylim=(len(part) - 0.5, -0.5))
    ax.set_yticks(at, [tex_escaped(n) for n in names], fontsize=8.5)
    unit = unit_label(str(units.iloc[0])) if len(units) else ""
    ax.set_xlabel(f"rms, {unit}", fontsize=8, labelpad=1)
    ax.grid(axis="y", visible=False)
    ax.tick_params(axis="y", length=0)
    ax.locator_params(axis="x", nbins=6)


def _numbers(ax: Axes, part: pd.DataFrame, changed: bool, wide_in: float) -> None:
    """Columns right of a panel: before → after, noise, runs that improve."""
    columns = [1 + x / wide_in for x in (0.8, 1.2, 1.9)]
    style: dict[str, Any] = {"transform": ax.get_yaxis_transform(), "va": "center", "ha": "right"}
    for x, label in zip(columns, ("rms", "noise", "runs better" if changed else ""), strict=True):
        ax.text(x, -0.86, label, fontsize=7.5, color=MUTED, **style)
    for i, r in enumerate(part.to_dict("records")):
        digits = digits_of(r["before"], r["after"], r["floor"])
        after = number(r["after"], digits)
        values = f"{number(r['before'], digits)} → {after}" if changed else after
        cells = (values, number(r["floor"], digits), f"{r['improved']} of {r['batches']}" if changed else "")
        for x, label, color in zip(columns, cells, (INK, MUTED, MUTED), strict=True):
            ax.text(x, i, label, fontsize=8.5, color=color, **style)


def _keys(fig: Figure, changed: bool) -> None:
    """What the marks mean, below the title."""
    entries = [("●", "before", ORANGE), ("●", "after", BLUE)] if changed else [("●", "simulation", BLUE)]
    legend_row(fig, [*entries, ("■", "noise floor", FLOOR)], _NAMES_IN, 0.5)


def left_out_batches(
    series: pd.DataFrame, rms: pd.DataFrame, batches: Sequence[tuple[str, str]], channels: Sequence[str], changed: bool,
    simulated: bool,
) -> Figure:  # fmt: skip
    """Small multiples: a row per left-out batch (with the reason why it is shown), a column per channel."""
    n, m = len(batches), max(len(channels), 1)
    cell, top = 1.75, 0.95
    high = cell * n + top + 0.35
    fig = Figure(figsize=(WIDTH_IN, high))
    left, gap = 0.05, 0.04
    wide = (1 - left - 0.005 - gap * (m - 1)) / m
    for i, (batch, why) in enumerate(batches):
        y = 1 - (top + cell * i) / high
        fig.text(
            0.1 / WIDTH_IN, y + 0.12 / high, tex_escaped(batch), fontsize=9, color=INK, fontweight="bold", va="center"
        )
        x = 0.1 / WIDTH_IN + 0.0086 * len(batch) + 0.012
        fig.text(x, y + 0.12 / high, why, fontsize=8.5, color=MUTED, va="center")
        for j, channel in enumerate(channels):
            bottom = y - (cell - 0.42) / high
            ax = fig.add_axes((left + j * (wide + gap), bottom, wide, (cell - 0.72) / high))
            own = series[(series["batch"] == batch) & (series["channel"] == channel)]
            scores = rms[(rms["batch"] == batch) & (rms["channel"] == channel)]
            _run(ax, own, scores, channel, changed)
            if i == n - 1:
                ax.set_xlabel("time, h", fontsize=8, labelpad=1)
            else:
                ax.tick_params(labelbottom=False)
    head(fig, "Left-out runs, predicted without ever having been seen", simulated)
    entries = [("—", "recording", INK)]
    entries += [("—", "simulation before", ORANGE)] if changed else []
    legend_row(fig, [*entries, ("—", "simulation after" if changed else "simulation", BLUE)], left * WIDTH_IN, 0.5)
    return fig


def _run(ax: Axes, own: pd.DataFrame, scores: pd.DataFrame, channel: str, changed: bool) -> None:
    calm(ax)
    hours = own["time_s"].to_numpy(float) / 3600
    if changed:
        ax.plot(hours, own["before"], color=ORANGE, lw=1.5, label="before")
    ax.plot(hours, own["after"], color=BLUE, lw=1.9, label="after")
    ax.plot(hours, own["recorded"], color=INK, lw=0.9, label="recorded")
    unit = unit_label(str(own["unit"].iloc[0])) if len(own) else ""
    ax.set_title(tex_escaped(f"{channel}, {unit}"), fontsize=8.5, loc="left", color=INK, pad=3)
    for r in scores.to_dict("records"):
        digits = digits_of(r["before"], r["after"])
        after = f"rms {number(r['after'], digits)} {unit_label(r['unit'])}"
        label = after.replace("rms ", f"rms {number(r['before'], digits)} → ") if changed else after
        ax.set_title(label, fontsize=8, loc="right", color=BLUE, pad=3)
    ax.locator_params(axis="y", nbins=4)
    if len(hours) > 1:
        ax.set_xlim(hours[0], hours[-1])


def _shortened(name: str) -> str:
    """Both ends of a long name: what distinguishes runs stands mostly last."""
    return name if len(name) <= 13 else f"{name[:4]}…{name[-8:]}"


BY = {"regime": "by regime", "batch": "by run", "hour": "by time of day", "since_start": "since the run's start"}
_CELL_IN, _MOST_PLACES, _MOST_LABELS = 0.25, 9, 40


def where_when(where: pd.DataFrame, groups: Sequence[str], simulated: bool) -> Figure:
    """Place × label for each group side by side, the kinds of mismatch below each other, each on its own colours.

    Cells that chance explains (|z| < 2) are pale.

    Args:
        where: the diagnosis' table "map".
        groups: which `by` to draw, as columns of panels.
    """
    groups = [g for g in groups if (where["by"] == g).any()]
    kinds = [k for k in KINDS if (where["kind"] == k).any()]
    places = {k: strongest(where, k, _MOST_PLACES) for k in kinds}
    labels = {g: ordered(where, g)[:_MOST_LABELS] for g in groups}
    feet = 0.066 * min(max(len(x) for g in groups for x in labels[g]), 22) + 0.12
    heights = [_CELL_IN * len(places[k]) for k in kinds]
    high = sum(heights) + 0.42 * len(kinds) + feet + 0.72
    fig = Figure(figsize=(WIDTH_IN, high))
    left, right, gap = 1.25, 0.85, 0.22
    share = [max(len(labels[g]), 3) for g in groups]
    room = WIDTH_IN - left - right - gap * (len(groups) - 1)
    y = high - 0.67
    for i, kind in enumerate(kinds):
        own = where[where["kind"] == kind]
        unit = unit_label(str(own["unit"].iloc[0]))
        norm = _symmetric(own[own["by"].isin(groups)])
        fig.text(0.1 / WIDTH_IN, 1 - (high - y + 0.26) / high, KINDS[kind], fontsize=8.5, color=MUTED, va="center")
        y -= 0.42
        x = left
        for g, n in zip(groups, share, strict=True):
            wide = room * n / sum(share)
            ax = fig.add_axes((x / WIDTH_IN, (y - heights[i]) / high, wide / WIDTH_IN, heights[i] / high))
            _matrix(ax, own[own["by"] == g], places[kind], labels[g], norm)
            ax.set_yticks(
                range(len(places[kind])), [tex_escaped(p) if x == left else "" for p in places[kind]], fontsize=8
            )
            if i == 0:
                ax.set_title(BY.get(g, g), fontsize=9, color=INK, loc="left", pad=4)
            if i == len(kinds) - 1:
                ax.set_xticks(
                    range(len(labels[g])), [tex_escaped(_cut(t)) for t in labels[g]], fontsize=7.5, rotation=90
                )
            x += wide + gap
        _bar(fig, norm, unit, (x - gap + 0.1, y - heights[i], 0.1, heights[i]), high)
        y -= heights[i]
    head(fig, "Where × when the recordings hold more (+) or less (−) than the simulation", simulated)
    below = f"Pale: within chance, |z| < {SEEN_Z:g}."
    fig.text(0.1 / WIDTH_IN, 1 - 0.46 / high, below, fontsize=8, color=MUTED, va="center")
    return fig


def _symmetric(own: pd.DataFrame) -> Normalize:
    """Up to the greatest, but at least eight standard deviations: chance never fills the scale."""
    value, z = (np.abs(own[c].to_numpy(float)) for c in ("value", "z"))
    good = np.isfinite(value) & (z > 0)
    if not good.any():
        return Normalize(-1.0, 1.0)
    top = max(float(np.quantile(value[good], 0.99)), 8.0 * float(np.median(value[good] / z[good]))) or 1.0
    return Normalize(-top, top)


def _matrix(ax: Axes, own: pd.DataFrame, places: Sequence[str], labels: Sequence[str], norm: Normalize) -> None:
    wide = [own.pivot_table(index="place", columns="label", values=k, sort=False) for k in ("value", "z")]
    value, z = (w.reindex(index=list(places), columns=list(labels)).to_numpy(float) for w in wide)
    rgba = SIGNED(norm(value))
    pale = (np.abs(z) < SEEN_Z)[..., None]
    rgba[..., :3] = np.where(pale, 1 - 0.18 * (1 - rgba[..., :3]), rgba[..., :3])
    rgba[~np.isfinite(value)] = (0.91, 0.93, 0.95, 1.0)
    ax.imshow(rgba, aspect="auto", interpolation="nearest")
    ax.set_xticks([])
    ax.set_xticks(np.arange(len(labels) + 1) - 0.5, minor=True)
    ax.set_yticks(np.arange(len(places) + 1) - 0.5, minor=True)
    ax.grid(which="minor", color="white", lw=1.4)
    ax.tick_params(which="both", length=0, pad=3)
    ax.spines[:].set_color("#e4e8ec")


def _bar(fig: Figure, norm: Normalize, unit: str, at: tuple[float, float, float, float], high: float) -> None:
    """A colour bar in inches from the lower left corner."""
    tall = max(at[3], 0.6)
    low = at[1] - (tall - at[3]) / 2
    cax = fig.add_axes((at[0] / WIDTH_IN, low / high, at[2] / WIDTH_IN, tall / high))
    bar = fig.colorbar(ScalarMappable(norm, SIGNED), cax=cax)
    bar.set_label(unit, fontsize=8)
    bar.ax.locator_params(nbins=3)
    bar.ax.tick_params(labelsize=7.5, length=2)
    bar.outline.set_visible(False)


def autocorrelation(acf: pd.DataFrame, changed: bool, simulated: bool, most: int = 4) -> Figure:
    """The residual against itself some time later, before and after, a panel per channel."""
    channels = list(dict.fromkeys(acf["channel"]))[:most]
    high = 2.35
    fig = Figure(figsize=(WIDTH_IN, high))
    wide = 0.945 / len(channels)
    for k, channel in enumerate(channels):
        own = acf[acf["channel"] == channel]
        ax = fig.add_axes((0.05 + k * wide, 0.42 / high, wide - 0.035, 1.15 / high))
        calm(ax)
        hours = own["lag_s"].to_numpy(float) / 3600
        if changed:
            ax.plot(hours, own["before"], color=ORANGE, lw=1.6)
        ax.plot(hours, own["after"], color=BLUE, lw=1.8)
        ax.axhline(0, color=MUTED, lw=0.7)
        ax.set_ylim(min(-0.25, float(np.nanmin(own[["before", "after"]].to_numpy(float)))), 1.03)
        ax.set_xlim(0, hours[-1])
        ax.set_title(tex_escaped(str(channel)), fontsize=8.5, loc="left", color=INK, pad=3)
        ax.set_xlabel("later by, h", fontsize=8, labelpad=1)
    head(fig, "Autocorrelation of the residual of left-out runs", simulated)
    entries = [("—", "before", ORANGE), ("—", "after", BLUE)] if changed else [("—", "simulated", BLUE)]
    legend_row(fig, entries, 0.05 * WIDTH_IN, 0.48)
    return fig


def missing_flux(flux: pd.DataFrame, simulated: bool, most: int = 6) -> Figure:
    """What would have to arrive at a place so that the simulation meets the recording, with its 90 % band."""
    pairs = list(dict.fromkeys(zip(flux["kind"], flux["place"], flux["batch"], strict=True)))[:most]
    columns = min(len(pairs), 3)
    rows = -(-len(pairs) // columns)
    cell, above = 1.65, 0.5
    high = cell * rows + above + 0.2
    fig = Figure(figsize=(WIDTH_IN, high))
    wide = 0.945 / columns
    for k, (kind, place, batch) in enumerate(pairs):
        i, j = divmod(k, columns)
        bottom = 1 - (above + cell * (i + 1) - 0.3) / high
        ax = fig.add_axes((0.05 + j * wide, bottom, wide - 0.035, (cell - 0.6) / high))
        calm(ax)
        own = flux[(flux["kind"] == kind) & (flux["place"] == place) & (flux["batch"] == batch)]
        hours, value, sd = (own[c].to_numpy(float) for c in ("time_s", "value", "sd"))
        hours = hours / 3600
        ax.fill_between(hours, value - 1.645 * sd, value + 1.645 * sd, color=BLUE, alpha=0.2, lw=0)
        ax.plot(hours, value, color=BLUE, lw=1.6)
        ax.axhline(0, color=MUTED, lw=0.7)
        shared = flux[(flux["kind"] == kind) & (flux["place"] == place)]
        low, top = (float(f(shared["value"] + s * 1.645 * shared["sd"])) for f, s in ((np.nanmin, -1), (np.nanmax, 1)))
        ax.set_ylim(min(low, 0.0) - 0.04 * (top - low or 1), max(top, 0.0) + 0.04 * (top - low or 1))
        if len(hours) > 1:
            ax.set_xlim(hours[0], hours[-1])
        unit = unit_label(str(own["unit"].iloc[0]))
        ax.set_title(tex_escaped(f"{place}, {unit}"), fontsize=8.5, loc="left", color=INK, pad=3)
        ax.set_title(tex_escaped(str(batch)), fontsize=8, loc="right", color=MUTED, pad=3)
        ax.locator_params(axis="y", nbins=4)
        if i == rows - 1:
            ax.set_xlabel("time, h", fontsize=8, labelpad=1)
    kinds = " and ".join(dict.fromkeys("heat" if k == "heat" else str(k) for k, _, _ in pairs))
    head(fig, f"Reconstructed missing {kinds}, with its 90 % band", simulated)
    return fig


def _cut(label: str) -> str:
    return label if len(label) <= 22 else label[:21] + "…"
