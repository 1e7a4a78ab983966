"""The picture of a machine file's network: bodies, links, surroundings, heat, sensors, error chains.

Links are lines from body to body. What a body gives to a surrounding, or to air that many bodies share, ends in a
ground symbol below it, as in a circuit diagram: so no line runs through the picture that nobody can follow.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from data.units import unit_label
from reports.labels import INK, ORANGE, number
from reports.twin.glyphs import (
    CHAINS,
    EDGE,
    FILL,
    GROUNDS,
    HEAT,
    LINK,
    SOFT,
    Point,
    Rect,
    arrow,
    box,
    ground,
    pills,
    pills_width,
    say,
    width_in,
)
from reports.twin.tables import capacity_label, counted
from twin.views.layout import places
from twin.views.overview import BodyView, ChainView, HeatView, Overview, Tie

PITCH_IN = (2.3, 1.72)
SIDE_IN = 0.3
NAME_PT, TEXT_PT, SMALL_PT = 10.5, 8.0, 7.4
MOST_HEATS = 4
_TITLE_IN, _ROW_IN, _LINE_IN, _DROP_IN, _GAP_IN, _LEAST_WIDTH_IN = 0.78, 0.17, 0.148, 0.13, 0.10, 9.6
_WIDER_IN, _HIGHER_IN, _ASIDE_IN = 0.55, 0.36, 0.3
_SHIFTS = (0.0, -0.5, 0.5, -1.0, 1.0)
_ROUNDS = 3

_NOWHERE = Rect(0.0, 0.0, 1.0, 1.0)


@dataclass(frozen=True)
class Stub:
    """What a body gives to a surrounding, or to a body that many give to."""

    label: str
    color: str
    width_pt: float
    ring: bool

    @property
    def width_in(self) -> float:
        return max(width_in(self.label, SMALL_PT), 0.22) + _GAP_IN


@dataclass(frozen=True)
class Body:
    """A box: its name, lines of text, badges, heat that arrives and stubs that leave."""

    name: str
    lines: tuple[tuple[str, str], ...]  # text, colour
    grow: float  # 0 to 1: how much larger than the least
    badges: tuple[tuple[str, str], ...] = ()
    heats: tuple[str, ...] = ()
    stubs: tuple[Stub, ...] = ()
    fill: str = FILL
    ring: str = ""  # colour of the mark of a body that others give to
    rect: Rect = _NOWHERE
    heat_at: Rect | None = None
    stubs_at: Rect | None = None

    @property
    def rows(self) -> int:
        return 1 + len(self.lines) + bool(self.badges)

    @property
    def width_in(self) -> float:
        """What its text needs."""
        wide = [width_in(self.name, NAME_PT, True), pills_width(self.badges), 0.75]
        return max(wide + [width_in(t, TEXT_PT) for t, _ in self.lines])


def arranged(view: Overview, bodies: Sequence[Body], low_in: float) -> tuple[Figure, Axes, list[Body]]:
    """A figure whose unit is the inch, and the bodies at their places `low_in` above its lower edge."""
    links = {t.ends: t.conductance_W_per_K for t in view.ties if not t.ground}
    heavy = {b.name: b.capacity_J_per_K for b in view.bodies}
    at = places([b.name for b in bodies], links, heavy, PITCH_IN)
    across, up = (max((p[i] for p in at.values()), default=0.0) for i in (0, 1))
    width, low = max(across + PITCH_IN[0] + 2 * SIDE_IN, _LEAST_WIDTH_IN), low_in + 1.05
    height = low + up + 0.95 + _TITLE_IN
    fig = Figure(figsize=(width, height))
    ax = fig.add_axes((0, 0, 1, 1))
    ax.set(xlim=(0, width), ylim=(0, height))
    ax.axis("off")
    left = (width - across) / 2
    # the same room for text in every box, so that a larger one always means more capacity
    wide, rows = max(b.width_in - _WIDER_IN * b.grow for b in bodies), max(b.rows for b in bodies)
    rects = {
        b.name: Rect(
            left + at[b.name][0],
            low + at[b.name][1],
            wide + 0.2 + _WIDER_IN * b.grow,
            _ROW_IN * rows + 0.12 + _HIGHER_IN * b.grow,
        )
        for b in bodies
    }
    return fig, ax, [replace(b, rect=rects[b.name]) for b in bodies]


def segments(links: Sequence[Tie], bodies: Sequence[Body], gap_in: float = 0.0) -> list[tuple[Point, Point]]:
    """Every link from box to box."""
    rects = {b.name: b.rect for b in bodies}
    pairs = [(rects[t.ends[0]], rects[t.ends[1]]) for t in links]
    return [(a.border((b.x, b.y), gap_in), b.border((a.x, a.y), gap_in)) for a, b in pairs]


def placed(bodies: Sequence[Body], lines: Sequence[tuple[Point, Point]]) -> list[Body]:
    """Heat above (or next to) and stubs below every box, shifted to where the fewest lines and texts are."""
    boxes = [b.rect for b in bodies]
    heat: dict[str, Rect] = {}
    stubs: dict[str, Rect] = {}
    for _ in range(_ROUNDS):  # again, now that the others have a place
        for b in bodies:
            for options, found in ((_heat_options(b), heat), (_stub_options(b), stubs)):
                if options:
                    found.pop(b.name, None)
                    found[b.name] = best(options, lines, [*boxes, *heat.values(), *stubs.values()])
    return [replace(b, heat_at=heat.get(b.name), stubs_at=stubs.get(b.name)) for b in bodies]


def _heat_options(b: Body) -> list[Rect]:
    if not b.heats:
        return []
    r, w, h = b.rect, max(width_in(t, TEXT_PT) for t in b.heats) + 0.2, _LINE_IN * len(b.heats) + 0.1
    ends = [r.x + s * (r.w / 2 - 0.12) for s in (-1, 1, -0.4, 0.4, 0)]
    options = [Rect(x + side * w / 2, r.y + r.h / 2 + h / 2, w, h) for x in ends for side in (1, -1)]
    return options + [Rect(r.x + s * (r.w / 2 + (w + _ASIDE_IN) / 2), r.y, w + _ASIDE_IN, h) for s in (1, -1)]


def _stub_options(b: Body) -> list[Rect]:
    if not b.stubs:
        return []
    r, w, h = b.rect, sum(s.width_in for s in b.stubs), _DROP_IN + 0.34
    slack = max((r.w - w) / 2 + 0.08, 0.0)
    return [Rect(r.x + s * slack, r.y - r.h / 2 - h / 2, w, h) for s in _SHIFTS]


def best(options: Sequence[Rect], lines: Sequence[tuple[Point, Point]], taken: Sequence[Rect]) -> Rect:
    """The rectangle with the least of lines and other things in it; the first of equals."""

    def cost(r: Rect) -> float:
        return sum(r.inside(a, b) for a, b in lines) + 20 * sum(r.overlap(t) for t in taken)

    return min(options, key=cost)


def label_lines(
    ax: Axes, texts: Sequence[str], lines: Sequence[tuple[Point, Point]], bodies: Sequence[Body], color: str = SOFT
) -> None:
    """A text on every line, where nothing else is."""
    taken = [x for b in bodies for x in (b.rect, b.heat_at, b.stubs_at) if x is not None]
    for k, (text, (a, b)) in enumerate(zip(texts, lines, strict=True)):
        if not text:
            continue
        others = [line for j, line in enumerate(lines) if j != k]
        w = width_in(text, TEXT_PT) + 0.06
        shares = (0.5, 0.42, 0.58, 0.33, 0.67)
        options = [Rect(a[0] + s * (b[0] - a[0]), a[1] + s * (b[1] - a[1]), w, 0.14) for s in shares]
        r = best(options, others, taken)
        taken.append(r)
        say(ax, (r.x, r.y), text, TEXT_PT, color, halo=3.0)


def draw(ax: Axes, b: Body) -> None:
    """The box with its text, badges, heat and stubs."""
    r = b.rect
    box(ax, r, b.fill, b.ring or EDGE, dashed=bool(b.ring))
    if b.ring:
        ax.plot([r.x + r.w / 2 - 0.14], [r.y + r.h / 2 - 0.14], "o", ms=5.5, mfc="white", mec=b.ring, mew=1.4, zorder=5)
    y = r.y + _ROW_IN * (b.rows - 1) / 2
    say(ax, (r.x, y + 0.01), b.name, NAME_PT, INK, fontweight="bold")
    for k, (text, color) in enumerate(b.lines):
        say(ax, (r.x, y - 0.015 - 0.162 * (k + 1)), text, TEXT_PT, color)
    if b.badges:
        pills(ax, r.y - _ROW_IN * (b.rows - 1) / 2 - 0.015, r.x, b.badges)
    if b.heat_at is not None:
        _heat(ax, b, b.heat_at)
    if b.stubs_at is not None:
        left = b.stubs_at.x - b.stubs_at.w / 2
        for stub in b.stubs:
            x = left + stub.width_in / 2
            left += stub.width_in
            ground(ax, (x, r.y - r.h / 2), stub.color, stub.width_pt, _DROP_IN, stub.ring)
            say(ax, (x, r.y - r.h / 2 - _DROP_IN - 0.165), stub.label, SMALL_PT, stub.color, halo=2.6)


def _heat(ax: Axes, b: Body, at: Rect) -> None:
    r = b.rect
    if at.y < r.y + r.h / 2:
        _heat_aside(ax, b, at, 1 if at.x > r.x else -1)
        return
    left = abs(at.x - at.w / 2 - r.x) > abs(at.x + at.w / 2 - r.x)  # the text stands left of the arrow
    x = at.x + at.w / 2 if left else at.x - at.w / 2
    arrow(ax, (x, at.y + at.h / 2), (x, r.y + r.h / 2 + 0.01), HEAT, 1.8, zorder=5)
    for k, text in enumerate(b.heats):
        y = at.y + at.h / 2 - _LINE_IN * (k + 0.5)
        say(ax, (x - 0.11 if left else x + 0.11, y), text, TEXT_PT, HEAT, halo=2.6, ha="right" if left else "left")


def _heat_aside(ax: Axes, b: Body, at: Rect, side: int) -> None:
    """Heat from the right (1) or the left (-1), where lines leave no room above."""
    border = b.rect.x + side * (b.rect.w / 2 + 0.01)
    tail = border + side * (_ASIDE_IN + 0.04)
    arrow(ax, (tail, b.rect.y), (border, b.rect.y), HEAT, 1.8, zorder=5)
    for k, text in enumerate(b.heats):
        y = at.y + at.h / 2 - 0.05 - _LINE_IN * (k + 0.5)
        say(ax, (tail + side * 0.05, y), text, TEXT_PT, HEAT, halo=2.6, ha="left" if side > 0 else "right")


def shortened(heats: Sequence[str]) -> tuple[str, ...]:
    """At most `MOST_HEATS` lines; the last one counts the others."""
    if len(heats) <= MOST_HEATS:
        return tuple(heats)
    return (*heats[: MOST_HEATS - 1], f"and {len(heats) - MOST_HEATS + 1} more")


def given_to(view: Overview, body: str) -> int:
    """How many exposures end at a body."""
    return sum(t.ground and t.ends[1] == body for t in view.ties)


def ground_color(view: Overview, name: str) -> str:
    """The colour of a surrounding, or of a body that others are exposed to."""
    names = [s.name for s in view.surroundings] + [b.name for b in view.bodies if given_to(view, b.name)]
    return GROUNDS[names.index(name) % len(GROUNDS)]


def title(ax: Axes, label: str, below: str, simulated: bool) -> None:
    """The head of the picture."""
    width, height = ax.get_xlim()[1], ax.get_ylim()[1]
    say(ax, (SIDE_IN, height - 0.27), label, 14, INK, ha="left", fontweight="bold")
    say(ax, (SIDE_IN, height - 0.52), below, 9, SOFT, ha="left")
    if simulated:
        say(ax, (width - SIDE_IN, height - 0.27), "SIMULATED", 12, ORANGE, ha="right", fontweight="bold")


_CHAIN_ROW_IN, _BAR_IN, _HEAD_IN, _LEFT_IN, _RIGHT_IN = 0.50, 0.21, 0.42, 0.85, 0.35


def strip_height_in(chains: Sequence[ChainView]) -> float:
    """Height that the strip takes."""
    return _HEAD_IN + _CHAIN_ROW_IN * len(chains) + 0.12 if chains else 0.1


def by_length(chains: Sequence[ChainView]) -> bool:
    """Whether every part states its length, so that the strip can show metres; else it shows displacement per K."""
    return all(math.isfinite(length) for c in chains for _, length, _ in c.parts)


def chain_strip(fig: Figure, chains: Sequence[ChainView], height_in: float) -> None:
    """Draw it along the bottom of a figure: a row per channel, + to the right, − to the left, from the same zero."""
    width, high = fig.get_figwidth(), fig.get_figheight()
    metres = by_length(chains)
    ax = fig.add_axes((0, 0, 1, height_in / high))
    ax.set(xlim=(0, width), ylim=(0, height_in))
    ax.axis("off")
    sides = [[v for v in _values(c, metres)] for c in chains]
    left = max((-sum(v for v in row if v < 0) for row in sides), default=0.0)
    right = max((sum(v for v in row if v > 0) for row in sides), default=0.0)
    tilt_in = 3.25
    scale = (width - _LEFT_IN - _RIGHT_IN - tilt_in) / max(left + right, 1e-12)
    zero = _LEFT_IN + left * scale
    unit = "m" if metres else f"{unit_label(chains[0].unit)}/K"
    ax.plot([0.3, width - 0.3], [height_in - 0.05] * 2, color="#d5dbe1", lw=0.8)
    drawn = any(sides)  # errors of laws alone have no lengths to draw
    label = "Errors" if not drawn else f"Error chains, lengths in {unit}" if metres else f"Error chains in {unit}"
    say(ax, (0.3, height_in - 0.24), label, 8.5, INK, ha="left", fontweight="bold")
    if drawn:
        say(ax, (zero - 0.1, height_in - 0.24), "◂ −", 7.5, SOFT, ha="right")
        say(ax, (zero + 0.1, height_in - 0.24), "+ ▸", 7.5, SOFT, ha="left")
        ax.plot([zero, zero], [0.12, height_in - _HEAD_IN + 0.06], color=INK, lw=1.0, zorder=6)
    for k, (c, row) in enumerate(zip(chains, sides, strict=True)):
        y = height_in - _HEAD_IN - _CHAIN_ROW_IN * (k + 0.5) + 0.06
        color = CHAINS[k % len(CHAINS)]
        say(ax, (0.3, y), c.channel, 10, color, ha="left", fontweight="bold")
        _bars(ax, c, row, zero, scale, y, color)
        _side_text(ax, c, row, metres, width - tilt_in if drawn else _LEFT_IN + width_in(c.channel, 10), y)


def _values(c: ChainView, metres: bool) -> list[float]:
    return [length if metres else gain for _, length, gain in c.parts]


def _bars(ax: Axes, c: ChainView, row: Sequence[float], zero: float, scale: float, y: float, color: str) -> None:
    at = {True: zero, False: zero}
    for k, ((body, _, _), value) in enumerate(zip(c.parts, row, strict=True)):
        begin = at[value > 0]
        at[value > 0] = begin + value * scale
        ax.barh(
            y, value * scale, height=_BAR_IN, left=begin, color=color, alpha=0.30, edgecolor="white", lw=1.4, zorder=3
        )
        wide, middle = abs(value * scale), begin + value * scale / 2
        digits = f"{abs(value):.3g}"
        if width_in(f"{body} {digits}", 7.6) < wide - 0.1:
            say(ax, (middle, y), f"{body} {digits}", 7.6, INK)
        elif width_in(body, 7.6) < wide - 0.07:
            say(ax, (middle, y), body, 7.6, INK)
        else:  # too narrow: above and below in turn
            say(ax, (middle, y + (0.165 if k % 2 == 0 else -0.165)), body, 7.0, SOFT)


def _side_text(ax: Axes, c: ChainView, row: Sequence[float], metres: bool, x: float, y: float) -> None:
    total = sum(row)
    lines = []
    if metres and row:
        closed = abs(total) < 1e-9
        lines.append("closes: both sides are equal" if closed else f"open by {number(total, 3, sign=True)} m")
    for hot, cold, gain in c.tilts:
        lines.append(f"tilt {number(gain, 2, sign=True)} {unit_label(c.unit)}/K × ({hot} − {cold})")
    lines += [f"and {name}" if lines else name for name in c.also]
    for k, text in enumerate(lines):
        say(ax, (x, y + 0.13 * ((len(lines) - 1) / 2 - k)), text, 7.6, SOFT, ha="left")


_LEGEND_IN = 0.78


def network_picture(view: Overview) -> Figure:
    """The picture, with the strip of error chains and the legend."""
    strip = strip_height_in(view.chains)
    fig, ax, bodies = arranged(view, [_body(view, b) for b in view.bodies], strip + _LEGEND_IN)
    links = [t for t in view.ties if not t.ground]
    every = [t.conductance_W_per_K for t in links]
    lines = segments(links, bodies)
    for t, (a, b) in zip(links, lines, strict=True):
        width = link_width_pt(t.conductance_W_per_K, every)
        ax.plot([a[0], b[0]], [a[1], b[1]], color=LINK, lw=width, zorder=1, solid_capstyle="butt")
    bodies = placed(bodies, lines)
    label_lines(ax, [f"{t.conductance_W_per_K:.3g}" for t in links], lines, bodies)
    for body in bodies:
        draw(ax, body)
    _legend(ax, view, strip + 0.42)
    title(ax, f"Thermal network of {view.machine}", counted(view), view.simulated)
    if view.chains:
        chain_strip(fig, view.chains, strip)
    return fig


def heat_label(h: HeatView) -> str:
    """The law by its name in the file, with its watts where a speed is stated."""
    return h.law if math.isnan(h.watts) else f"{h.law}  {number(h.watts, 0 if abs(h.watts) >= 9.5 else 1)} W"


def grown(view: Overview, b: BodyView) -> float:
    """0 for the least capacity to 1 for the greatest, by the logarithm."""
    logs = [math.log(x.capacity_J_per_K) for x in view.bodies]
    span = max(logs) - min(logs)
    return (math.log(b.capacity_J_per_K) - min(logs)) / span if span > 0 else 0.0


def link_width_pt(g: float, every: Sequence[float]) -> float:
    """1 to 5.5 points by the logarithm of the conductance."""
    low, high = math.log(min(every)), math.log(max(every))
    return 1.0 + (4.5 * (math.log(g) - low) / (high - low) if high > low else 1.5)


def _body(view: Overview, b: BodyView) -> Body:
    sensors = [c for c, body in view.sensors if body == b.name]
    lines = [(capacity_label(b), SOFT)] + ([(f"◆ {', '.join(sensors)}", INK)] if sensors else [])
    badges = []
    for k, c in enumerate(view.chains):
        gain = sum(gain for body, _, gain in c.parts if body == b.name)
        if gain:
            badges.append((f"{c.channel} {'+' if gain > 0 else '−'}", CHAINS[k % len(CHAINS)]))
    return Body(
        b.name,
        tuple(lines),
        grown(view, b),
        tuple(badges),
        shortened([heat_label(h) for h in view.heats if h.body == b.name]),
        tuple(_stub(view, t) for t in view.ties if t.ground and t.ends[0] == b.name),
        fill="white" if given_to(view, b.name) else "#eef3f8",
        ring=ground_color(view, b.name) if given_to(view, b.name) else "",
    )


def _stub(view: Overview, t: Tie) -> Stub:
    width = min(link_width_pt(t.conductance_W_per_K, [x.conductance_W_per_K for x in view.ties]), 4.0)
    to = t.ends[1]
    ring = any(b.name == to for b in view.bodies)
    return Stub(f"{to} {t.conductance_W_per_K:.3g}", ground_color(view, to), width, ring)


def _legend(ax: Axes, view: Overview, y: float) -> None:
    """What the marks mean, and how every surrounding is known."""
    ax.plot([SIDE_IN, ax.get_xlim()[1] - SIDE_IN], [y + 0.42] * 2, color="#d5dbe1", lw=0.8)
    x = SIDE_IN + 0.05
    for name, label, ring in _ground_labels(view):
        color = ground_color(view, name)
        ground(ax, (x + 0.05, y + 0.27), color, 2.0, 0.09, ring)
        say(ax, (x + 0.24, y + 0.18), label, TEXT_PT, color, ha="left")
        x += 0.5 + width_in(label, TEXT_PT)
    x, y = SIDE_IN + 0.05, y - 0.12
    every = sorted(t.conductance_W_per_K for t in view.ties if not t.ground)
    for g in dict.fromkeys((every[0], every[len(every) // 2], every[-1])) if every else ():
        ax.plot([x, x + 0.3], [y, y], color=LINK, lw=link_width_pt(g, every), solid_capstyle="butt")
        say(ax, (x + 0.36, y), f"{g:.3g} W/K", TEXT_PT, SOFT, ha="left")
        x += 0.54 + width_in(f"{g:.3g} W/K", TEXT_PT)
    if view.heats:
        label = f"heat, {view.stated}" if view.stated else "heat, by its law"
        arrow(ax, (x + 0.05, y + 0.11), (x + 0.05, y - 0.11), HEAT, 1.8)
        say(ax, (x + 0.18, y), label, TEXT_PT, HEAT, ha="left")
        x += 0.46 + width_in(label, TEXT_PT)
    for label, color in ((("◆ sensor", INK),) if view.sensors else ()) + (("box: larger with heat capacity", SOFT),):
        say(ax, (x, y), label, TEXT_PT, color, ha="left")
        x += 0.28 + width_in(label, TEXT_PT)


def _ground_labels(view: Overview) -> list[tuple[str, str, bool]]:
    used = {t.ends[1] for t in view.ties if t.ground}
    out = [(s.name, f"{s.name}: {s.label}", False) for s in view.surroundings if s.name in used]
    shared = [b for b in view.bodies if b.name in used]
    return out + [(b.name, f"{b.name}: {b.label or 'a body of its own'}", True) for b in shared]
