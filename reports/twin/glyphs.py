"""Pieces of the network picture, in inches on paper: text of known width, boxes, ground symbols, arrows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.font_manager import FontProperties
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
from matplotlib.patheffects import withStroke
from matplotlib.textpath import TextPath

from reports.labels import INK, tex_escaped

SOFT, LINK, FILL, EDGE = "#5a6572", "#8593a1", "#eef3f8", "#41566b"
HEAT = "#b84a00"
GROUNDS = ("#00755a", "#7d6608", "#0072b2", "#8a3b78", "#4b3f72")  # of surroundings, in the file's order
CHAINS = ("#0072b2", "#9a4a7d", "#4b3f72", "#00755a", "#7d6608", "#b84a00")  # of error channels
Point = tuple[float, float]


@dataclass(frozen=True)
class Rect:
    """A rectangle by its middle and size, inches."""

    x: float
    y: float
    w: float
    h: float

    def overlap(self, other: Rect) -> float:
        """Common area."""
        wide = min(self.x + self.w / 2, other.x + other.w / 2) - max(self.x - self.w / 2, other.x - other.w / 2)
        high = min(self.y + self.h / 2, other.y + other.h / 2) - max(self.y - self.h / 2, other.y - other.h / 2)
        return max(wide, 0.0) * max(high, 0.0)

    def inside(self, a: Point, b: Point) -> float:
        """Length of the line from a to b within the rectangle."""
        low, high = 0.0, 1.0
        for start, step, middle, half in (
            (a[0], b[0] - a[0], self.x, self.w / 2),
            (a[1], b[1] - a[1], self.y, self.h / 2),
        ):
            if abs(step) < 1e-12:
                if abs(start - middle) > half:
                    return 0.0
                continue
            t = sorted(((middle - half - start) / step, (middle + half - start) / step))
            low, high = max(low, t[0]), min(high, t[1])
        return max(high - low, 0.0) * float(np.hypot(b[0] - a[0], b[1] - a[1]))

    def border(self, towards: Point, gap: float = 0.0) -> Point:
        """Where the line from the middle to a point leaves the rectangle, `gap` further."""
        dx, dy = towards[0] - self.x, towards[1] - self.y
        far = float(np.hypot(dx, dy)) or 1.0
        share = min(self.w / 2 / abs(dx) if dx else np.inf, self.h / 2 / abs(dy) if dy else np.inf)
        share = min(float(share) + gap / far, 1.0)
        return self.x + dx * share, self.y + dy * share


@cache
def width_in(text: str, size_pt: float, bold: bool = False) -> float:
    """Width of a text in inches."""
    if not text.strip():
        return 0.0
    font = FontProperties(family="DejaVu Sans", weight="bold" if bold else "normal")
    return float(TextPath((0, 0), text.replace("$", "S"), size=size_pt, prop=font).get_extents().width) / 72.0


def say(ax: Axes, at: Point, text: str, size_pt: float = 7.5, color: str = INK, halo: float = 0.0, **look: Any) -> None:
    """Text; a halo keeps it readable over lines. $ is only itself."""
    look = {"ha": "center", "va": "center", "zorder": 6, **look}
    if halo:
        look["path_effects"] = [withStroke(linewidth=halo, foreground="white")]
    ax.text(*at, tex_escaped(text), fontsize=size_pt, color=color, **look)


def box(ax: Axes, r: Rect, fill: str = FILL, edge: str = EDGE, dashed: bool = False) -> None:
    """A body."""
    ax.add_patch(
        FancyBboxPatch(
            (r.x - r.w / 2 + 0.06, r.y - r.h / 2 + 0.06), r.w - 0.12, r.h - 0.12, boxstyle="round,pad=0.06",
            facecolor=fill, edgecolor=edge, linewidth=1.1, linestyle="--" if dashed else "-", zorder=4,
        )
    )  # fmt: skip


def pills(ax: Axes, y: float, x: float, labels: Sequence[tuple[str, str]], size_pt: float = 6.8) -> None:
    """A row of coloured badges about x."""
    left = x - pills_width(labels, size_pt) / 2
    for text, color in labels:
        w = width_in(text, size_pt, True) + 0.11
        ax.add_patch(
            FancyBboxPatch(
                (left + 0.03, y - 0.04), w - 0.06, 0.08, boxstyle="round,pad=0.03", fc=color,
                ec=LINK if _light(color) else "none", lw=0.6, zorder=5,
            )
        )  # fmt: skip
        ink = INK if _light(color) else "white"
        say(ax, (left + w / 2, y), text, size_pt, ink, fontweight="bold", va="center_baseline")
        left += w + 0.05


def _light(color: str) -> bool:
    """Whether dark text reads better on it (relative luminance, WCAG 2.1)."""
    rgb = np.array(to_rgb(color))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722]) > 0.22


def pills_width(labels: Iterable[tuple[str, str]], size_pt: float = 6.8) -> float:
    """How wide such a row is."""
    widths = [width_in(t, size_pt, True) + 0.11 for t, _ in labels]
    return sum(widths) + 0.05 * max(len(widths) - 1, 0)


def ground(ax: Axes, top: Point, color: str, width_pt: float, drop: float, air: bool = False) -> None:
    """A stub down to a ground symbol (a surrounding that nothing warms) or to a ring (a body such as enclosure air)."""
    x, y = top[0], top[1] - drop
    ax.plot([x, x], [top[1], y - 0.08], color="white", lw=width_pt + 5, solid_capstyle="butt", zorder=2.5)
    ax.plot([x, x], [top[1], y], color=color, lw=width_pt, solid_capstyle="butt", zorder=3)
    if air:
        ax.plot([x], [y - 0.035], "o", ms=5.5, mfc="white", mec=color, mew=1.4, zorder=5)
        return
    for k, half in enumerate((0.095, 0.06, 0.025)):
        ax.plot([x - half, x + half], [y - 0.034 * k] * 2, color=color, lw=1.3, solid_capstyle="butt", zorder=5)


def arrow(ax: Axes, a: Point, b: Point, color: str, width_pt: float, zorder: float = 2.0) -> None:
    """An arrow from a to b whose head grows with its width."""
    ax.add_patch(
        FancyArrowPatch(
            a, b, arrowstyle="-|>", mutation_scale=7.0 + 2.2 * width_pt, color=color, lw=width_pt, shrinkA=0, shrinkB=0,
            zorder=zorder, joinstyle="miter", capstyle="butt",
        )
    )  # fmt: skip
