"""The machine with the mismatch coloured in: heat at bodies, sensors, displacement; what was found is marked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, to_hex
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from data.units import unit_label
from reports.labels import BLUE, INK, number
from reports.twin.glyphs import SOFT, Point, Rect, box, pills, pills_width, say, width_in
from reports.twin.network_picture import (
    NAME_PT,
    SIDE_IN,
    TEXT_PT,
    Body,
    Stub,
    arranged,
    draw,
    given_to,
    grown,
    link_width_pt,
    placed,
    segments,
    title,
)
from twin.views.overview import BodyView, Overview, Tie

MISMATCH = LinearSegmentedColormap.from_list("mismatch", ["#fdf3ea", "#fad3b0", "#f0a266", "#d9692a"])
CALM, GREY = "#f6f8fa", "#9aa5b1"
_LEGEND_IN, _ERRORS_IN, _SPARE_IN = 0.62, 0.72, 0.42
_WIDEST_IN, _MOST_PILL_ROWS, _ROW_IN, _LINE_IN = 1.42, 2, 0.17, 0.165  # of the sensors in a box
KINDS = {"heat": "unexplained heat", "displacement": "unexplained displacement", "sensor": "unexplained reading"}


@dataclass(frozen=True)
class Mark:
    """What was found, and where it goes in the picture."""

    label: str
    kind: str  # node, link, sensor or error
    name: str


@dataclass(frozen=True)
class _Drawn:
    """Where everything stands."""

    bodies: dict[str, Rect]
    lines: dict[str, tuple[Point, Point]]
    errors: dict[str, Rect]


@dataclass(frozen=True)
class _Tints:
    """Colour and label of every place whose mismatch is more than chance."""

    of: dict[tuple[str, str], tuple[float, float, str]]  # size, mean, unit
    top: dict[str, tuple[float, str]]  # by kind

    def color(self, kind: str, place: str, calm: str = CALM) -> str:
        found = self.of.get((kind, place))
        return calm if found is None else to_hex(MISMATCH(found[0] / self.top[kind][0]))

    def label(self, kind: str, place: str) -> str:
        found = self.of.get((kind, place))
        if found is None:
            return ""
        size, mean, unit = found
        sign = "±" if abs(mean) < 0.5 * size else "+" if mean > 0 else "−"
        return f"{sign}{_digits(size)} {unit}"


def mismatch_picture(view: Overview, found: pd.DataFrame, marks: Sequence[Mark]) -> Figure:
    """The network with its bodies, links, sensors and errors tinted by their unexplained part.

    Args:
        found: `tables.mismatch`: kind, place, unit, size, mean, shown.
        marks: what was accepted; places that the picture lacks are listed in its head.
    """
    tints = _tints(found)
    low = _LEGEND_IN + (_ERRORS_IN if view.chains else 0.0)
    fig, ax, bodies = arranged(view, [_body(view, b, tints) for b in view.bodies], low)
    _lowered(fig, ax)
    links = [t for t in view.ties if not t.ground]
    lines = segments(links, bodies)
    marked = {m.name for m in marks if m.kind == "link"}
    every = [t.conductance_W_per_K for t in links]
    for t, (a, b) in zip(links, lines, strict=True):
        color = BLUE if t.name in marked else tints.color("heat", t.name, "#c3cbd3")
        ax.plot(*zip(a, b, strict=True), color=color, lw=link_width_pt(t.conductance_W_per_K, every), zorder=1)
    bodies = placed(bodies, lines)
    for body in bodies:
        draw(ax, body)
        _sensors(ax, body, _sensor_rows(view, body.name, tints))
    errors = _errors(ax, view, tints)
    _legend(ax, tints, found)
    drawn = _Drawn({b.name: b.rect for b in bodies}, dict(zip([t.name for t in links], lines, strict=True)), errors)
    lost = [m for m in marks if not _marked(ax, view, m, drawn)]
    below = "; ".join(f"{m.label}: {m.name}" for m in lost) or _below(found)
    title(ax, f"What the simulation of {view.machine} leaves unexplained", below, view.simulated)
    return fig


def _lowered(fig: Figure, ax: Axes) -> None:
    """No heat stands above the boxes here: less paper at the top."""
    width, height = fig.get_size_inches()
    fig.set_size_inches(width, height - _SPARE_IN)
    ax.set_ylim(0, height - _SPARE_IN)


def _below(found: pd.DataFrame) -> str:
    if found.empty or not found["shown"].any():
        return "Nothing above chance: no place holds heat, displacement or a reading that the simulation lacks."
    return "Colour: size over all runs. + : the recording has more heat, growth or reading than the simulation."


def _tints(found: pd.DataFrame) -> _Tints:
    shown = found[found["shown"].astype(bool)]
    of = {
        (str(r["kind"]), str(r["place"])): (
            float(r["size"]),
            float(r["mean"]),
            unit_label(str(r["unit"])).replace("°C", "K"),
        )
        for r in shown.to_dict("records")
    }
    top: dict[str, tuple[float, str]] = {}
    for (kind, _), (size, _, unit) in of.items():
        top[kind] = (max(size, top.get(kind, (0.0, ""))[0]), unit)
    return _Tints(of, top)


def _body(view: Overview, b: BodyView, tints: _Tints) -> Body:
    label = tints.label("heat", b.name)
    stubs = tuple(_stub(view, t) for t in view.ties if t.ground and t.ends[0] == b.name)
    ring = "#7c8896" if given_to(view, b.name) else ""
    rows = _sensor_rows(view, b.name, tints)
    last = rows[-1] if rows else ()
    lines = (((label, INK),) if label else ()) + ((" ", INK),) * (len(rows) - 1)  # lines that further pills take
    return Body(b.name, lines, grown(view, b), tuple(last), (), stubs, tints.color("heat", b.name), ring)


def _sensor_rows(view: Overview, body: str, tints: _Tints) -> list[list[tuple[str, str]]]:
    """Pills of a body's sensors in rows that a box holds, those with a mismatch first; the last counts the rest."""
    own = [c for c, at in view.sensors if at == body]
    own.sort(key=lambda c: -tints.of.get(("sensor", c), (0.0, 0.0, ""))[0])
    rows: list[list[tuple[str, str]]] = []
    for k, c in enumerate(own):
        pill = (_pill(c, tints.label("sensor", c)), tints.color("sensor", c, "#ffffff"))
        if rows and pills_width([*rows[-1], pill]) <= _WIDEST_IN:
            rows[-1].append(pill)
        elif len(rows) < _MOST_PILL_ROWS:
            rows.append([pill])
        else:
            rows[-1][-1] = (f"{len(own) - k + 1} more", "#ffffff")
            break
    return sorted(rows, key=pills_width)  # the widest last: the box is made for it


def _pill(channel: str, size: str) -> str:
    label = f"◆ {channel} {size}".strip()
    while pills_width([(label, "")]) > _WIDEST_IN and len(channel) > 4:
        channel = channel[:-2].rstrip("…") + "…"
        label = f"◆ {channel} {size}".strip()
    return label


def _sensors(ax: Axes, b: Body, rows: list[list[tuple[str, str]]]) -> None:
    """All but the last row of pills, which the box draws itself."""
    low = b.rect.y - _ROW_IN * (b.rows - 1) / 2 - 0.015
    for k, row in enumerate(reversed(rows[:-1]), 1):
        pills(ax, low + _LINE_IN * k, b.rect.x, row)


def _stub(view: Overview, t: Tie) -> Stub:
    return Stub(t.ends[1], GREY, 1.6, any(b.name == t.ends[1] for b in view.bodies))


def _errors(ax: Axes, view: Overview, tints: _Tints) -> dict[str, Rect]:
    """A box per error channel above the legend."""
    if not view.chains:
        return {}
    y = _LEGEND_IN + 0.36
    ax.plot([SIDE_IN, ax.get_xlim()[1] - SIDE_IN], [_LEGEND_IN + 0.72] * 2, color="#d5dbe1", lw=0.8)
    label = "Tool against workpiece, given the temperatures"
    say(ax, (SIDE_IN, y), label, TEXT_PT + 0.5, SOFT, ha="left")
    x = SIDE_IN + width_in(label, TEXT_PT + 0.5) + 0.3
    out = {}
    for c in view.chains:
        size = tints.label("displacement", c.channel)
        w = 0.36 + width_in(c.channel, NAME_PT, True) + (width_in(size, TEXT_PT) + 0.1 if size else 0.0)
        out[c.channel] = Rect(x + w / 2, y, w, 0.36)
        box(ax, out[c.channel], tints.color("displacement", c.channel))
        say(ax, (x + 0.18, y), c.channel, NAME_PT, INK, ha="left", fontweight="bold")
        if size:
            say(ax, (x + w - 0.16, y), size, TEXT_PT, INK, ha="right")
        x += w + 0.22
    return out


def _legend(ax: Axes, tints: _Tints, found: pd.DataFrame) -> None:
    """A colour bar for every kind that has something to show, and what the marks mean."""
    y, x = 0.3, SIDE_IN + 0.05
    ax.plot([SIDE_IN, ax.get_xlim()[1] - SIDE_IN], [y + 0.32] * 2, color="#d5dbe1", lw=0.8)
    for kind in dict.fromkeys(str(k) for k in found["kind"]):
        label = KINDS.get(kind, kind)
        if kind not in tints.top:
            text = f"no {label}"
            say(ax, (x, y), text, TEXT_PT, SOFT, ha="left")
            x += width_in(text, TEXT_PT) + 0.32
            continue
        top, unit = tints.top[kind]
        for i in range(41):
            shade = to_hex(MISMATCH(i / 40))
            ax.plot([x + 0.025 * i] * 2, [y - 0.06, y + 0.06], color=shade, lw=2.4, solid_capstyle="butt")
        text = f"{label} 0 to {_digits(top)} {unit}"
        say(ax, (x + 1.1, y), text, TEXT_PT, SOFT, ha="left")
        x += 1.1 + width_in(text, TEXT_PT) + 0.32
    say(ax, (x, y), "◆ sensor", TEXT_PT, SOFT, ha="left")


def _marked(ax: Axes, view: Overview, m: Mark, drawn: _Drawn) -> bool:
    """Draw a mark; False where the picture has no such place."""
    if m.kind == "link" and m.name in drawn.lines:
        a, b = drawn.lines[m.name]
        _tab(ax, ((a[0] + b[0]) / 2, (a[1] + b[1]) / 2), m.label)
        return True
    if m.kind == "error":
        r, side = drawn.errors.get(m.name), 1
    elif m.kind == "link":  # an exposure: its ground symbol hangs below its body
        r, side = drawn.bodies.get(next((t.ends[0] for t in view.ties if t.name == m.name), "")), -1
    elif m.kind == "sensor":
        r, side = drawn.bodies.get(next((b for c, b in view.sensors if c == m.name), "")), 1
    else:
        r, side = drawn.bodies.get(m.name.partition("@")[0]), 1
    if r is None:
        return False
    _ringed(ax, r)
    _tab(ax, (r.x, r.y + side * (r.h / 2 + 0.08)), m.label)
    return True


def _ringed(ax: Axes, r: Rect) -> None:
    ax.add_patch(
        FancyBboxPatch((r.x - r.w / 2 + 0.06, r.y - r.h / 2 + 0.06), r.w - 0.12, r.h - 0.12,
                       boxstyle="round,pad=0.06", fc="none", ec=BLUE, lw=2.6, zorder=5.5)
    )  # fmt: skip


def _tab(ax: Axes, at: Point, label: str) -> None:
    """A badge that nothing covers."""
    w = width_in(label, TEXT_PT, True) + 0.16
    low = (at[0] - w / 2 + 0.04, at[1] - 0.07)
    ax.add_patch(FancyBboxPatch(low, w - 0.08, 0.14, boxstyle="round,pad=0.04", fc=BLUE, ec="white", lw=1.2, zorder=8))
    say(ax, at, label, TEXT_PT, "white", fontweight="bold", zorder=9, va="center_baseline")


def _digits(value: float) -> str:
    """Two digits that count."""
    return number(value, 0 if abs(value) >= 9.5 else 1 if abs(value) >= 0.95 else 2)
