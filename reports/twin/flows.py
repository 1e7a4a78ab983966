"""Heat flows drawn: stacked areas over time, and the network at one moment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, Normalize, to_hex
from matplotlib.figure import Figure

from data.arrays import Array
from reports.drawing import MUTED, WIDTH_IN, calm, head
from reports.labels import INK, number, tex_escaped
from reports.twin.glyphs import LINK, SOFT, arrow, ground, say, width_in
from reports.twin.network_picture import (
    SIDE_IN,
    TEXT_PT,
    Body,
    Stub,
    arranged,
    draw,
    given_to,
    ground_color,
    grown,
    label_lines,
    placed,
    segments,
    shortened,
    title,
)
from twin.views.heat_flows import HeatFlows
from twin.views.overview import BodyView, Overview, Tie

_HEATS = LinearSegmentedColormap.from_list("heats", ["#7a2e00", "#d55e00", "#f0a35e", "#f8d9b8"])
_STORES = LinearSegmentedColormap.from_list("stores", ["#0b4f7d", "#3b8cc4", "#8fc1e3", "#d3e6f3"])
_LOSSES = LinearSegmentedColormap.from_list("losses", ["#00553f", "#3a9c7f", "#a5d3c3"])
_MOST_STORES = 6


def heat_stack(flows: HeatFlows) -> Figure:
    """Heat put in above zero; what bodies store and what surroundings take below. Both sides are equal at all times.

    What gives heat back (a body that cools, a surrounding warmer than the machine) stands on the other side.
    """
    fig = Figure(figsize=(WIDTH_IN, 5.4))
    ax = fig.add_axes((0.07, 0.10, 0.66, 0.80))
    calm(ax)
    hours = np.repeat(flows.time_s / 3600, 2)[1:-1]
    groups: list[tuple[str, Mapping[str, Array], LinearSegmentedColormap, float]] = [
        ("heat", flows.heat_W, _HEATS, 1.0),
        ("taken by", flows.loss_W, _LOSSES, -1.0),
        ("stored in", _greatest(flows.storage_W, flows.dt_s, _MOST_STORES), _STORES, -1.0),
    ]
    up, down = np.zeros(len(flows.dt_s)), np.zeros(len(flows.dt_s))
    entries: list[tuple[str, str, float]] = []
    duration_s = float(flows.dt_s.sum())
    for group, series, colors, sign in groups:
        entries.append((group, "", float("nan")))
        for k, (name, watts) in enumerate(series.items()):
            color = to_hex(colors(k / max(len(series) - 1, 1)))
            up, down = _area(ax, hours, sign * watts, up, down, color, f"{group} {name}")
            entries.append((name, color, float(watts @ flows.dt_s) / duration_s))
    ax.axhline(0, color=INK, lw=0.9)
    ax.set_xlim(hours[0], hours[-1])
    ax.set_xlabel("time, h", fontsize=9)
    ax.set_ylabel("W, put in above, stored and given off below", fontsize=9)
    _entries(fig, entries)
    head(fig, f"{flows.batch_id}: where the watts go", flows.simulated)
    return fig


def _greatest(series: Mapping[str, Array], dt_s: Array, most: int) -> dict[str, Array]:
    """The greatest by the energy that moves; the others as one."""
    order = sorted(series, key=lambda n: -float(np.abs(series[n]) @ dt_s))
    out = {n: series[n] for n in order[:most]}
    rest = order[most:]
    if len(rest) == 1:
        out[rest[0]] = series[rest[0]]
    elif rest:
        out[f"{len(rest)} others"] = np.sum([series[n] for n in rest], axis=0)
    return out


def _area(ax: Axes, hours: Array, watts: Array, up: Array, down: Array, color: str, label: str) -> tuple[Array, Array]:
    """Stack a series: its positive part on what is above, its negative part below; steps, as means of intervals are."""
    for part, base in ((np.maximum(watts, 0.0), up), (np.minimum(watts, 0.0), down)):
        if np.any(part):
            ax.fill_between(
                hours, np.repeat(base, 2), np.repeat(base + part, 2), color=color, lw=0.3, ec="white", label=label
            )
    return up + np.maximum(watts, 0.0), down + np.minimum(watts, 0.0)


def _entries(fig: Figure, entries: Sequence[tuple[str, str, float]]) -> None:
    y = 0.89
    fig.text(0.985, y + 0.005, "mean W", fontsize=8, color=MUTED, ha="right", va="center")
    for name, color, mean in entries:
        if not color:
            y -= 0.012
            fig.text(0.75, y, name, fontsize=8.5, color=INK, va="center", fontweight="bold")
        else:
            fig.text(0.755, y, "■", fontsize=10, color=color, va="center")
            fig.text(0.777, y, tex_escaped(name), fontsize=8.5, color=INK, va="center")
            fig.text(
                0.985, y, number(mean, 0 if abs(mean) >= 9.95 else 1), fontsize=8.5, color=INK, ha="right", va="center"
            )
        y -= 0.036


WARMTH = LinearSegmentedColormap.from_list("warmth", ["#8ec3e6", "#f4f7fa", "#fbd9bd", "#f0a266", "#e27a35"])
_LEGEND_IN, _LEAST_W = 0.72, 0.5


def flow_picture(view: Overview, flows: HeatFlows, time_s: float) -> Figure:
    """Flows in the interval that `time_s` lies in, rises at its end; nothing is drawn for less than half a watt."""
    k = int(np.clip(np.searchsorted(flows.time_s, time_s, side="right") - 1, 0, len(flows.dt_s) - 1))
    links = [t for t in view.ties if not t.ground]
    most = max([abs(float(flows.link_W[t.name][k])) for t in view.ties] or [1.0]) or 1.0
    rises = [float(r[k + 1]) for r in flows.rise_K.values()]
    warmth = _warmth(rises)
    fig, ax, bodies = arranged(view, [_body(view, b, flows, k, warmth, most) for b in view.bodies], _LEGEND_IN)
    lines = segments(links, bodies, 0.03)
    watts = [float(flows.link_W[t.name][k]) for t in links]
    for w, (a, b) in zip(watts, lines, strict=True):
        if abs(w) < _LEAST_W:
            ax.plot([a[0], b[0]], [a[1], b[1]], color="#cdd4db", lw=1.0, zorder=1)
        else:
            arrow(ax, *((a, b) if w > 0 else (b, a)), LINK, _width_pt(w, most), zorder=1)
    bodies = placed(bodies, lines)
    label_lines(ax, [_watts(abs(w)) if abs(w) >= _LEAST_W else "" for w in watts], lines, bodies, INK)
    for body in bodies:
        draw(ax, body)
    _legend(ax, view, warmth, most)
    minutes = round(float(flows.time_s[k + 1]) / 60)
    label = f"{flows.batch_id} at {minutes // 60}:{minutes % 60:02d} h: heat through {view.machine}"
    put_in, stored = (sum(float(w[k]) for w in f.values()) for f in (flows.heat_W, flows.storage_W))
    gone = sum(float(w[k]) for w in flows.loss_W.values())
    below = f"{number(put_in, 0)} W put in, {number(stored, 0)} W stored, {number(gone, 0)} W to the surroundings"
    title(ax, label, below, flows.simulated)
    return fig


def _warmth(rises: Sequence[float]) -> Normalize:
    """White at no rise, as warm as the greatest rise or fall; the cold half shows only where something cooled."""
    top = max(max(rises, default=0.0), -2.0 * min(rises, default=0.0), 0.5)
    return Normalize(-top / 3, top)


def _color(rise_K: float, warmth: Normalize) -> str:
    return to_hex(WARMTH(float(warmth(rise_K))))


def _body(view: Overview, b: BodyView, flows: HeatFlows, k: int, warmth: Normalize, most: float) -> Body:
    rise, stored = float(flows.rise_K[b.name][k + 1]), float(flows.storage_W[b.name][k])
    lines = [
        (f"{number(rise, 1, sign=True)} K", INK),
        (f"{'stores' if stored >= 0 else 'gives'} {_watts(abs(stored))}", INK),
    ]
    return Body(
        b.name,
        tuple(lines),
        grown(view, b),
        (),
        shortened(_heats(view, b.name, flows, k)),
        tuple(
            _stub(view, t, float(flows.link_W[t.name][k]), most) for t in view.ties if t.ground and t.ends[0] == b.name
        ),
        _color(rise, warmth),
        ground_color(view, b.name) if given_to(view, b.name) else "",
    )


def _heats(view: Overview, body: str, flows: HeatFlows, k: int) -> list[str]:
    """A body's share of every law's watts at the moment."""
    out = []
    for h in view.heats:
        total = sum(x.share for x in view.heats if x.law == h.law)
        watts = float(flows.heat_W[h.law][k]) * h.share / total if abs(total) > 1e-9 else 0.0
        if h.body == body and abs(watts) >= _LEAST_W:
            out.append(f"{h.law}  {_watts(watts)}")
    return out


def _stub(view: Overview, t: Tie, watts: float, most: float) -> Stub:
    to = t.ends[1]
    width = min(_width_pt(watts, most), 5.0) if abs(watts) >= _LEAST_W else 0.8
    return Stub(f"{to} {_watts(watts)}", ground_color(view, to), width, any(b.name == to for b in view.bodies))


def _watts(watts: float) -> str:
    return f"{number(watts, 0 if abs(watts) >= 9.5 else 1)} W"


def _width_pt(watts: float, most: float) -> float:
    return 1.0 + 6.0 * abs(watts) / most


def _legend(ax: Axes, view: Overview, warmth: Normalize, most: float) -> None:
    y, x = 0.36, SIDE_IN + 0.05
    ax.plot([SIDE_IN, ax.get_xlim()[1] - SIDE_IN], [y + 0.3] * 2, color="#d5dbe1", lw=0.8)
    for w in (0.1 * most, 0.5 * most, most):
        arrow(ax, (x, y), (x + 0.42, y), LINK, _width_pt(w, most))
        say(ax, (x + 0.5, y), _watts(w), TEXT_PT, SOFT, ha="left")
        x += 0.68 + width_in(_watts(w), TEXT_PT)
    low, high = float(warmth.vmin or 0.0), float(warmth.vmax or 1.0)
    for i in range(41):
        rise = low + i * (high - low) / 40
        ax.plot([x + 0.035 * i] * 2, [y - 0.07, y + 0.07], color=_color(rise, warmth), lw=3.0, solid_capstyle="butt")
    label = f"rise {number(low, 1)} to {number(high, 1)} K"
    say(ax, (x + 1.52, y), label, TEXT_PT, SOFT, ha="left")
    x += 1.75 + width_in(label, TEXT_PT)
    names = list(dict.fromkeys(t.ends[1] for t in view.ties if t.ground))
    for name in names:
        ring = any(b.name == name for b in view.bodies)
        ground(ax, (x + 0.05, y + 0.1), ground_color(view, name), 2.0, 0.09, ring)
        say(ax, (x + 0.22, y), f"to {name}", TEXT_PT, ground_color(view, name), ha="left")
        x += 0.42 + width_in(f"to {name}", TEXT_PT)
