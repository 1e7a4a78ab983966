"""Bodies as boxes with what hangs on them: sized, placed, kept clear of the links, drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipelines.report.network_glyphs import (
    EDGE,
    FILL,
    GROUNDS,
    HEAT,
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
from pipelines.report.words import INK, ORANGE
from twin.views.layout import places
from twin.views.overview import Overview, Tie

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
        """What its words need."""
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
    # the same room for words in every box, so that a larger one always means more capacity
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
    """Heat above (or beside) and stubs below every box, shifted to where the fewest lines and words are."""
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
    left = abs(at.x - at.w / 2 - r.x) > abs(at.x + at.w / 2 - r.x)  # the words stand left of the arrow
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


def title(ax: Axes, words: str, below: str, simulated: bool) -> None:
    """The head of the picture."""
    width, height = ax.get_xlim()[1], ax.get_ylim()[1]
    say(ax, (SIDE_IN, height - 0.27), words, 14, INK, ha="left", fontweight="bold")
    say(ax, (SIDE_IN, height - 0.52), below, 9, SOFT, ha="left")
    if simulated:
        say(ax, (width - SIDE_IN, height - 0.27), "SIMULATED", 12, ORANGE, ha="right", fontweight="bold")
