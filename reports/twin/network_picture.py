"""The picture of a machine file's network: a card for each body, a line for each link.

A card says what the body holds, reads, gets and gives: an exposure to a surrounding, or to air that many bodies share,
is a line of its text, so that no line runs through the picture that nobody can follow.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.patches import FancyBboxPatch
from matplotlib.patheffects import withStroke
from matplotlib.textpath import TextPath

from data.units import unit_label
from reports.drawing import MUTED
from reports.labels import GREEN, INK, ORANGE, number, tex_escaped
from reports.twin.tables import capacity_label, counted
from twin.views.layout import places
from twin.views.overview import ChainView, Overview, Tie

LINK, EDGE, FILL, HEAT = "#8593a1", "#41566b", "#eef3f8", "#b84a00"
NAME_PT, TEXT_PT, FOOT_PT, TITLE_PT = 10.0, 8.0, 8.5, 14.0
_LINE_IN, _FOOT_LINE_IN, _HEAD_IN, _MARGIN_IN = 0.155, 0.17, 0.75, 0.3
_ASIDE_IN, _ABOVE_IN, _LEAST_IN = 0.55, 0.45, 9.0  # between cards; of the paper's width
_MOST_HEATS, _MOST_LETTERS = 4, 26
Lines = tuple[tuple[str, str], ...]  # text, colour


@dataclass(frozen=True)
class Card:
    """A body, or an error channel below the network: its name and lines of text; `shared` where others give to it."""

    name: str
    lines: Lines
    fill: str = FILL
    shared: bool = False

    @property
    def size_in(self) -> tuple[float, float]:
        wide = [_width_in(self.name, NAME_PT, True), *(_width_in(text, TEXT_PT) for text, _ in self.lines)]
        return max(wide) + 0.24, 0.3 + _LINE_IN * len(self.lines)


@dataclass(frozen=True)
class Drawn:
    """A picture whose unit is the inch, and the cards in it."""

    figure: Figure
    ax: Axes
    cards: Mapping[str, FancyBboxPatch]
    below: Mapping[str, FancyBboxPatch]

    def middle(self, name: str) -> tuple[float, float]:
        """The middle of a body's card."""
        return middle(self.cards[name])

    def halfway(self, t: Tie) -> tuple[float, float]:
        """The point between the two bodies of a link."""
        (x, y), (u, v) = (self.middle(end) for end in t.ends)
        return (x + u) / 2, (y + v) / 2

    def line(self, t: Tie, color: str, width_pt: float) -> None:
        """A link as a line behind the cards."""
        self.ax.plot(*zip(*(self.middle(end) for end in t.ends), strict=True), color=color, lw=width_pt, zorder=1)

    def label(self, t: Tie, text: str, color: str = MUTED) -> None:
        """A text on a link, halfway."""
        say(self.ax, *self.halfway(t), text, color=color, halo=True)


def network_picture(view: Overview) -> Figure:
    """The picture, with error chains and what the marks mean in its foot."""
    cards = [Card(b.name, _lines(view, b.name, capacity_label(b)), shared=is_shared(view, b.name)) for b in view.bodies]
    heat = f" + : heat, {view.stated or 'by its law'}." if view.heats else ""
    sensors = " ◆ : sensor." if view.sensors else ""
    foot = [f"Lines: links in W/K. → : exposures in W/K.{heat}{sensors} Dashed: others are exposed to it."]
    foot += [f"{s.name}: {s.label}" for s in view.surroundings]
    foot += [chain_label(c) for c in view.chains]
    drawn = arranged(view, cards, foot, f"Thermal network of {view.machine}", counted(view))
    for t, width_pt in link_widths_pt(view):
        drawn.line(t, LINK, width_pt)
        drawn.label(t, f"{t.conductance_W_per_K:.3g}")
    return drawn.figure


def _lines(view: Overview, body: str, capacity: str) -> Lines:
    """Capacity, sensors, what moves with the body, its heats and what it is exposed to."""
    lines = [(capacity, MUTED), *sensor_lines(view, body)]
    moved = [(c.channel, sum(gain for name, _, gain in c.parts if name == body)) for c in view.chains]
    if any(gain for _, gain in moved):
        lines.append((", ".join(f"{c} {'+' if gain > 0 else '−'}" for c, gain in moved if gain), EDGE))
    heats = [(h.law, h.watts) for h in view.heats if h.body == body]
    lines += heat_lines([name if math.isnan(watts) else f"{name} {watts_label(watts)}" for name, watts in heats])
    own = [t for t in view.ties if t.ground and t.ends[0] == body]
    return (*lines, *((f"→ {t.ends[1]} {t.conductance_W_per_K:.3g}", GREEN) for t in own))


def sensor_lines(view: Overview, body: str) -> Lines:
    """The sensors of a body on one line; many are counted."""
    names = [c for c, at in view.sensors if at == body]
    text = ", ".join(names)
    if len(text) > _MOST_LETTERS and len(names) > 1:
        text = f"{names[0]} and {len(names) - 1} more"
    return ((f"◆ {text}", INK),) if names else ()


def heat_lines(heats: Sequence[str], color: str = HEAT) -> Lines:
    """A line each, at most `_MOST_HEATS`; the last one counts the others."""
    kept = list(heats)
    if len(kept) > _MOST_HEATS:
        kept = [*kept[: _MOST_HEATS - 1], f"{len(kept) - _MOST_HEATS + 1} more"]
    return tuple((f"+ {text}", color) for text in kept)


def watts_label(watts: float) -> str:
    """``9.2 W``, ``149 W``."""
    return f"{number(watts, 0 if abs(watts) >= 9.5 else 1)} W"


def chain_label(c: ChainView) -> str:
    """An error's measuring loop with signs: ``z: + head 0.3 − bed 0.3 m, closes; tilt …; speed_shift``."""
    metres = all(math.isfinite(length) for _, length, _ in c.parts)
    values = [(body, length if metres else gain) for body, length, gain in c.parts]
    said = [" ".join(f"{'+' if v > 0 else '−'} {body} {abs(v):.3g}" for body, v in values)] if values else []
    if values:
        total = sum(v for _, v in values)
        open_by = "closes" if abs(total) < 1e-9 else f"open by {number(total, 3, sign=True)} m"
        said[0] += f" m, {open_by}" if metres else f" {unit_label(c.unit)}/K"
    said += [f"tilt {number(g, 2, sign=True)} {unit_label(c.unit)}/K × ({hot} − {cold})" for hot, cold, g in c.tilts]
    return f"{c.channel}: {'; '.join([*said, *c.also])}"


def arranged(
    view: Overview, cards: Sequence[Card], foot: Sequence[str], title: str, under: str, below: Sequence[Card] = ()
) -> Drawn:
    """The cards of the bodies at their places under the title, a row of further cards, and the foot's lines of text."""
    wide, high = (max((c.size_in[i] for c in cards), default=1.0) for i in (0, 1))
    links = {t.ends: t.conductance_W_per_K for t in view.ties if not t.ground}
    heavy = {b.name: b.capacity_J_per_K for b in view.bodies}
    at = places([c.name for c in cards], links, heavy, (wide + _ASIDE_IN, high + _ABOVE_IN))
    across, up = (max((p[i] for p in at.values()), default=0.0) for i in (0, 1))
    titled = _width_in(f"{title}   SIMULATED", TITLE_PT, True)
    width = max(max(across + wide, titled) + 2 * _MARGIN_IN, _LEAST_IN)
    foot = [line for text in foot for line in textwrap.wrap(text, round(15 * (width - 2 * _MARGIN_IN)))]
    foot_in = _FOOT_LINE_IN * len(foot) + 0.25
    low = foot_in + (0.8 if below else 0.0)
    height = low + up + high + 0.2 + _HEAD_IN
    fig = Figure(figsize=(width, height))
    ax = fig.add_axes((0, 0, 1, 1))
    ax.set(xlim=(0, width), ylim=(0, height))
    ax.axis("off")
    left = (width - across) / 2
    bodies = {c.name: _card(ax, c, left + at[c.name][0], low + high / 2 + at[c.name][1]) for c in cards}
    row = {c.name: _card(ax, c, _MARGIN_IN + 0.75 + 1.6 * k, foot_in + 0.35) for k, c in enumerate(below)}
    ax.plot([_MARGIN_IN, width - _MARGIN_IN], [foot_in] * 2, color="#d5dbe1", lw=0.8)
    for k, text in enumerate(foot):
        say(ax, _MARGIN_IN, foot_in - 0.15 - _FOOT_LINE_IN * k, text, FOOT_PT, MUTED, ha="left")
    say(ax, _MARGIN_IN, height - 0.27, title, TITLE_PT, ha="left", bold=True)
    say(ax, _MARGIN_IN, height - 0.52, under, 9, MUTED, ha="left")
    if view.simulated:
        say(ax, width - _MARGIN_IN, height - 0.27, "SIMULATED", 12, ORANGE, ha="right", bold=True)
    return Drawn(fig, ax, bodies, row)


def _card(ax: Axes, c: Card, x: float, y: float) -> FancyBboxPatch:
    w, h = c.size_in
    patch = FancyBboxPatch(
        (x - w / 2 + 0.06, y - h / 2 + 0.06), w - 0.12, h - 0.12, boxstyle="round,pad=0.06", facecolor=c.fill,
        edgecolor=EDGE, linewidth=1.1, linestyle="--" if c.shared else "-", zorder=4,
    )  # fmt: skip
    ax.add_patch(patch)
    top = y + h / 2 - 0.15
    say(ax, x, top, c.name, NAME_PT, bold=True)
    for k, (text, color) in enumerate(c.lines, 1):
        say(ax, x, top - _LINE_IN * k, text, color=color)
    return patch


def middle(patch: FancyBboxPatch) -> tuple[float, float]:
    """The middle of a card."""
    return patch.get_x() + patch.get_width() / 2, patch.get_y() + patch.get_height() / 2


def say(
    ax: Axes, x: float, y: float, text: str, size_pt: float = TEXT_PT, color: str = INK, ha: str = "center",
    bold: bool = False, halo: bool = False,
) -> None:  # fmt: skip
    """Text; a halo keeps it readable over lines, behind cards. $ is only itself."""
    shown = ax.text(x, y, tex_escaped(text), fontsize=size_pt, color=color, ha=ha, va="center", zorder=3 if halo else 6)
    shown.set_fontweight("bold" if bold else "normal")
    if halo:
        shown.set_path_effects([withStroke(linewidth=3.0, foreground="white")])


@cache
def _width_in(text: str, size_pt: float, bold: bool = False) -> float:
    """Width of a text in inches."""
    font = FontProperties(family="DejaVu Sans", weight="bold" if bold else "normal")
    return float(TextPath((0, 0), text.replace("$", "S"), size=size_pt, prop=font).get_extents().width) / 72.0


def is_shared(view: Overview, body: str) -> bool:
    """Whether an exposure ends at the body."""
    return any(t.ground and t.ends[1] == body for t in view.ties)


def link_widths_pt(view: Overview) -> list[tuple[Tie, float]]:
    """The links, each 1 to 5.5 points wide by the logarithm of its conductance."""
    links = [t for t in view.ties if not t.ground]
    size = [math.log(t.conductance_W_per_K) for t in links]
    low, high = min(size, default=0.0), max(size, default=0.0)
    return [
        (t, 1.0 + (4.5 * (own - low) / (high - low) if high > low else 1.5)) for t, own in zip(links, size, strict=True)
    ]
