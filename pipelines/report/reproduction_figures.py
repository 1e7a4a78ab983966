"""Pictures of a repeated study: every seed a dot, the published value beside them."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pipelines.report.words import BLUE, GREEN, INK, ORANGE, number, plus_minus

Array = NDArray[np.float64]
_SOFT, _LINE, _FAINT = "#5a6572", "#c5cbd3", "#eef1f4"
_WIDTH_IN, _ROW_IN, _TOP_IN, _BOTTOM_IN, _LEFT_IN, _RIGHT_IN = 9.6, 0.5, 0.06, 0.5, 3.1, 1.55
_WORDS_WIDE = 46


@dataclass(frozen=True)
class Strip:
    """One figure of a study over its seeds: values (S,), unit, what was printed (NaN: nothing)."""

    words: str
    values: Array
    unit: str
    published: float
    digits: int


def claim_figure(strips: Sequence[Strip], held: NDArray[np.bool_]) -> Figure:
    """The figures of one ordering on one axis, a line per seed: grey where the ordering holds, orange where not."""
    fig, ax = _canvas(len(strips))
    places = np.arange(len(strips), dtype=float)
    table = np.stack([s.values for s in strips])
    for seed, holds in enumerate(held):
        ax.plot(table[:, seed], places, color=_LINE if holds else ORANGE, lw=0.8 if holds else 1.1, alpha=0.9, zorder=1)
    for place, strip in zip(places, strips, strict=True):
        _strip(ax, place, strip)
    ax.set_ylim(len(strips) - 0.5, -0.5)
    ax.set_xlabel(strips[0].unit, fontsize=9, color=_SOFT)
    return fig


def published_figure(strips: Sequence[Strip]) -> Figure:
    """Figures with a printed value, each on an axis of its own."""
    height = _ROW_IN + 0.22
    total = height * len(strips)
    fig = Figure(figsize=(_WIDTH_IN, total))
    for k, strip in enumerate(strips):
        bottom = total - height * (k + 1) + 0.27
        box = (_LEFT_IN / _WIDTH_IN, bottom / total, 1 - (_LEFT_IN + _RIGHT_IN) / _WIDTH_IN, (height - 0.3) / total)
        ax = fig.add_axes(box)
        _bare(ax)
        _strip(ax, 0.0, strip)
        ax.set_ylim(0.4, -0.4)
    return fig


def _canvas(rows: int) -> tuple[Figure, Axes]:
    total = _TOP_IN + _ROW_IN * rows + _BOTTOM_IN
    fig = Figure(figsize=(_WIDTH_IN, total))
    box = (_LEFT_IN / _WIDTH_IN, _BOTTOM_IN / total, 1 - (_LEFT_IN + _RIGHT_IN) / _WIDTH_IN, _ROW_IN * rows / total)
    ax = fig.add_axes(box)
    _bare(ax)
    return fig, ax


def _bare(ax: Axes) -> None:
    ax.set_yticks([])
    ax.tick_params(labelsize=8, color=_LINE, labelcolor=_SOFT)
    ax.spines[["top", "right", "left"]].set_visible(False)
    ax.spines["bottom"].set_color(_LINE)
    ax.grid(axis="x", color=_FAINT, lw=0.8)
    ax.set_axisbelow(True)


def _strip(ax: Axes, place: float, strip: Strip) -> None:
    """Words on the left; dots, the 5–95 % range, the mean; numbers on the right."""
    values = strip.values[np.isfinite(strip.values)]
    side = ax.get_yaxis_transform()
    said = textwrap.fill(strip.words, _WORDS_WIDE)
    ax.text(-0.02, place, said, fontsize=8.5, color=INK, transform=side, va="center", ha="right", linespacing=1.15)
    if not len(values):
        return
    low, high = np.quantile(values, [0.05, 0.95])
    ax.plot([low, high], [place, place], color=BLUE, lw=6, alpha=0.18, solid_capstyle="butt", zorder=2)
    ax.plot(values, np.full(len(values), place), "o", color=BLUE, ms=4.5, alpha=0.5, mec="none", zorder=3)
    ax.plot([values.mean()] * 2, [place - 0.16, place + 0.16], color=INK, lw=2, zorder=4)
    sd = float(values.std(ddof=1)) if len(values) > 1 else float("nan")
    ours = plus_minus(float(values.mean()), sd, strip.digits) + f" {strip.unit}"
    printed = np.isfinite(strip.published)
    up = 0.13 if printed else 0.0
    ax.text(1.02, place - up, ours, fontsize=8.5, color=INK, transform=side, va="center")
    if printed:
        ax.plot([strip.published], [place], "D", color=GREEN, ms=7, mec="white", mew=1.0, zorder=5)
        ax.text(1.02, place + 0.17, f"published {number(strip.published, strip.digits)}", fontsize=8, color=GREEN,
                transform=side, va="center")  # fmt: skip
