"""Heat flows drawn: stacked areas over time, and the network at one moment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from matplotlib.colors import LinearSegmentedColormap, to_hex
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, Patch

from data.arrays import Array
from reports.drawing import WIDTH_IN, calm, head
from reports.labels import INK, number, tex_escaped
from reports.twin.network_picture import (
    LINK,
    Card,
    Drawn,
    Lines,
    arranged,
    heat_lines,
    is_shared,
    watts_label,
)
from twin.views.heat_flows import HeatFlows
from twin.views.overview import Overview, Tie

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
    groups = (
        ("heat", flows.heat_W, _HEATS, 1.0), ("taken by", flows.loss_W, _LOSSES, -1.0),
        ("stored in", _greatest(flows.storage_W, flows.dt_s, _MOST_STORES), _STORES, -1.0),
    )  # fmt: skip
    parts: list[tuple[Array, str]] = []
    keys = []
    for group, series, colors, sign in groups:
        keys.append(Patch(alpha=0.0, label=f"{group}, mean"))
        for k, (name, watts) in enumerate(series.items()):
            parts.append((sign * np.append(watts, watts[-1]), to_hex(colors(k / max(len(series) - 1, 1)))))
            mean_W = float(watts @ flows.dt_s / flows.dt_s.sum())
            keys.append(Patch(color=parts[-1][1], label=f"{tex_escaped(name)}, {watts_label(mean_W)}"))
    hours = flows.time_s / 3600
    for side in (np.maximum, np.minimum):
        shown = [(side(watts, 0.0), color) for watts, color in parts if np.any(side(watts, 0.0))]
        areas, colors_of = zip(*shown, strict=True) if shown else ((), ())
        ax.stackplot(hours, *areas, colors=colors_of, step="post", lw=0.3, ec="white")
    ax.axhline(0, color=INK, lw=0.9)
    ax.set_xlim(hours[0], hours[-1])
    ax.set_xlabel("time, h", fontsize=9)
    ax.set_ylabel("W, put in above, stored and given off below", fontsize=9)
    ax.legend(handles=keys, loc="upper left", bbox_to_anchor=(1.01, 1.02), frameon=False, fontsize=8.5)
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


WARMTH = LinearSegmentedColormap.from_list("warmth", ["#8ec3e6", "#f4f7fa", "#fbd9bd", "#f0a266", "#e27a35"])
_LEAST_W = 0.5


def flow_picture(view: Overview, flows: HeatFlows, time_s: float) -> Figure:
    """Flows in the interval that `time_s` lies in, rises at its end; nothing is drawn for less than half a watt."""
    k = int(np.clip(np.searchsorted(flows.time_s, time_s, side="right") - 1, 0, len(flows.dt_s) - 1))
    rises = [float(r[k + 1]) for r in flows.rise_K.values()]
    # white at no rise; the cold half shows only where something cooled
    top = max(max(rises, default=0.0), -2.0 * min(rises, default=0.0), 0.5)
    fills = {b: to_hex(WARMTH(0.75 * (float(r[k + 1]) / top + 1 / 3))) for b, r in flows.rise_K.items()}
    cards = [Card(b.name, _lines(view, b.name, flows, k), fills[b.name], is_shared(view, b.name)) for b in view.bodies]
    minutes = round(float(flows.time_s[k + 1]) / 60)
    put_in, stored = (sum(float(w[k]) for w in f.values()) for f in (flows.heat_W, flows.storage_W))
    gone = sum(float(w[k]) for w in flows.loss_W.values())
    drawn = arranged(
        view, cards,
        [f"Arrows: heat through links. + : heat put in. → : given off. Colour: rise up to {number(top, 1)} K."],
        f"{flows.batch_id} at {minutes // 60}:{minutes % 60:02d} h: heat through {view.machine}",
        f"{number(put_in, 0)} W put in, {number(stored, 0)} W stored, {number(gone, 0)} W to the surroundings",
    )  # fmt: skip
    links = [t for t in view.ties if not t.ground]
    most = max([abs(float(flows.link_W[t.name][k])) for t in links] or [1.0]) or 1.0
    for t in links:
        watts = float(flows.link_W[t.name][k])
        _arrow(drawn, t if watts > 0 else replace(t, ends=t.ends[::-1]), abs(watts), most)
    return drawn.figure


def _lines(view: Overview, body: str, flows: HeatFlows, k: int) -> Lines:
    """A body's rise, what it stores, its share of every law's watts, and what it gives to surroundings."""
    stored = float(flows.storage_W[body][k])
    lines = [(f"{number(float(flows.rise_K[body][k + 1]), 1, sign=True)} K", INK)]
    lines.append((f"{'stores' if stored >= 0 else 'gives'} {watts_label(abs(stored))}", INK))
    heats = []
    for h in (h for h in view.heats if h.body == body):
        total = sum(x.share for x in view.heats if x.law == h.law)
        watts = float(flows.heat_W[h.law][k]) * h.share / total if abs(total) > 1e-9 else 0.0
        heats += [f"{h.law} {watts_label(watts)}"] if abs(watts) >= _LEAST_W else []
    own = [(t.ends[1], float(flows.link_W[t.name][k])) for t in view.ties if t.ground and t.ends[0] == body]
    return (*lines, *heat_lines(heats, INK), *((f"→ {to} {watts_label(watts)}", INK) for to, watts in own))


def _arrow(drawn: Drawn, t: Tie, watts: float, most_W: float) -> None:
    """From the first body of a link to the second, as wide as its watts; a thin line where nearly nothing flows."""
    a, b = t.ends
    if watts < _LEAST_W:
        drawn.line(t, "#cdd4db", 1.0)
        return
    width = 1.0 + 6.0 * watts / most_W
    drawn.ax.add_patch(
        FancyArrowPatch(
            drawn.middle(a), drawn.middle(b), arrowstyle="-|>", mutation_scale=7.0 + 2.2 * width, color=LINK, lw=width,
            patchA=drawn.cards[a], patchB=drawn.cards[b], shrinkA=2, shrinkB=2, zorder=1, joinstyle="miter",
        )
    )  # fmt: skip
    drawn.label(t, watts_label(watts), INK)
