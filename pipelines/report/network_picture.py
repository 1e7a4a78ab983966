"""The picture of a machine file's network: bodies, links, surroundings, heat, sensors, error chains.

Links are lines from body to body. What a body gives to a surrounding, or to air that many bodies share, ends in a
ground symbol below it, as in a circuit diagram: so no line runs through the picture that nobody can follow.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipelines.report.chain_strip import chain_strip, strip_height_in
from pipelines.report.network_boxes import (
    SIDE_IN,
    TEXT_PT,
    Body,
    Stub,
    arranged,
    draw,
    given_to,
    ground_color,
    label_lines,
    placed,
    segments,
    shortened,
    title,
)
from pipelines.report.network_glyphs import CHAINS, HEAT, LINK, SOFT, arrow, ground, say, width_in
from pipelines.report.words import INK, count, number
from twin.views.overview import BodyView, HeatView, Overview, Tie

_LEGEND_IN = 0.78


def picture_bytes(figure: Figure, kind: str) -> bytes:
    """The figure as svg or png; the same figure gives the same bytes."""
    import matplotlib as mpl

    out = io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": "thermodrift"}):
        figure.savefig(out, format=kind, dpi=160, metadata={"Date": None} if kind == "svg" else None)
    return out.getvalue()


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


def counted(view: Overview) -> str:
    """What the network consists of, in a line."""
    n, links = len(view.bodies), sum(not t.ground for t in view.ties)
    parts = [f"{n} {'body' if n == 1 else 'bodies'}", count(links, "link"), count(len(view.ties) - links, "exposure")]
    parts.append(count(len(view.sensors), "sensor"))
    return f"{', '.join(parts)}; {view.free} free and {view.fixed} fixed parameters"


def capacity_words(b: BodyView) -> str:
    """``6.6 kJ/K``, with the number of cells where a body has several."""
    joules = b.capacity_J_per_K
    words = f"{number(joules / 1e3, 1 if joules < 1e5 else 0)} kJ/K" if joules >= 1e3 else f"{joules:.3g} J/K"
    return words + (f", {b.n_cells} cells" if b.n_cells > 1 else "")


def heat_words(h: HeatView) -> str:
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
    lines = [(capacity_words(b), SOFT)] + ([(f"◆ {', '.join(sensors)}", INK)] if sensors else [])
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
        shortened([heat_words(h) for h in view.heats if h.body == b.name]),
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
    for name, words, ring in _ground_words(view):
        color = ground_color(view, name)
        ground(ax, (x + 0.05, y + 0.27), color, 2.0, 0.09, ring)
        say(ax, (x + 0.24, y + 0.18), words, TEXT_PT, color, ha="left")
        x += 0.5 + width_in(words, TEXT_PT)
    x, y = SIDE_IN + 0.05, y - 0.12
    every = sorted(t.conductance_W_per_K for t in view.ties if not t.ground)
    for g in dict.fromkeys((every[0], every[len(every) // 2], every[-1])) if every else ():
        ax.plot([x, x + 0.3], [y, y], color=LINK, lw=link_width_pt(g, every), solid_capstyle="butt")
        say(ax, (x + 0.36, y), f"{g:.3g} W/K", TEXT_PT, SOFT, ha="left")
        x += 0.54 + width_in(f"{g:.3g} W/K", TEXT_PT)
    if view.heats:
        words = f"heat, {view.stated}" if view.stated else "heat, by its law"
        arrow(ax, (x + 0.05, y + 0.11), (x + 0.05, y - 0.11), HEAT, 1.8)
        say(ax, (x + 0.18, y), words, TEXT_PT, HEAT, ha="left")
        x += 0.46 + width_in(words, TEXT_PT)
    for words, color in ((("◆ sensor", INK),) if view.sensors else ()) + (("box: larger with heat capacity", SOFT),):
        say(ax, (x, y), words, TEXT_PT, color, ha="left")
        x += 0.28 + width_in(words, TEXT_PT)


def _ground_words(view: Overview) -> list[tuple[str, str, bool]]:
    used = {t.ends[1] for t in view.ties if t.ground}
    out = [(s.name, f"{s.name}: {s.words}", False) for s in view.surroundings if s.name in used]
    shared = [b for b in view.bodies if b.name in used]
    return out + [(b.name, f"{b.name}: {b.words or 'a body of its own'}", True) for b in shared]
