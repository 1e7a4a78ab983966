"""The machine with the mismatch coloured in: heat at bodies, sensors, displacement; what was found is marked."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd
from matplotlib.colors import LinearSegmentedColormap, to_hex
from matplotlib.figure import Figure

from data.units import unit_label
from reports.labels import BLUE, INK, number, tex_escaped
from reports.twin.network_picture import TEXT_PT, Card, Drawn, Lines, arranged, is_shared, link_widths_pt, middle
from twin.views.overview import Overview, Tie

MISMATCH = LinearSegmentedColormap.from_list("mismatch", ["#fdf3ea", "#fad3b0", "#f0a266", "#d9692a"])
_CALM, _CALM_LINK, _MOST_SENSORS = "#f6f8fa", "#c3cbd3", 3
KINDS = {"heat": "unexplained heat", "displacement": "unexplained displacement", "sensor": "unexplained reading"}


@dataclass(frozen=True)
class Mark:
    """What was found, and where it goes in the picture."""

    label: str
    kind: str  # node, link, sensor or error
    name: str


@dataclass(frozen=True)
class _Tints:
    """Colour and label of every place whose mismatch is more than chance."""

    of: Mapping[tuple[str, str], tuple[float, float, str]]  # size, mean, unit
    top: Mapping[str, tuple[float, str]]  # by kind

    @classmethod
    def found(cls, found: pd.DataFrame) -> _Tints:
        of: dict[tuple[str, str], tuple[float, float, str]] = {}
        top: dict[str, tuple[float, str]] = {}
        for r in found[found["shown"].astype(bool)].to_dict("records"):
            kind, size, unit = str(r["kind"]), float(r["size"]), unit_label(str(r["unit"])).replace("°C", "K")
            of[kind, str(r["place"])] = (size, float(r["mean"]), unit)
            top[kind] = (max(size, top.get(kind, (0.0, ""))[0]), unit)
        return cls(of, top)

    def color(self, kind: str, place: str, calm: str = _CALM) -> str:
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
    tints = _Tints.found(found)
    cards = [
        Card(b.name, _lines(view, b.name, tints), tints.color("heat", b.name), is_shared(view, b.name))
        for b in view.bodies
    ]
    errors = [
        Card(c.channel, ((tints.label("displacement", c.channel) or "–", INK),), tints.color("displacement", c.channel))
        for c in view.chains
    ]
    at = {m: _place(view, m) for m in marks}
    head = "; ".join(f"{m.label}: {m.name}" for m, place in at.items() if place is None) or _head(found)
    title = "What the simulation leaves unexplained"
    drawn = arranged(view, cards, [_legend(tints, found)], title, head, errors)
    for t, width_pt in link_widths_pt(view):
        drawn.line(t, BLUE if t in at.values() else tints.color("heat", t.name, _CALM_LINK), width_pt)
    above: Counter[object] = Counter()
    for m, place in at.items():
        if place is not None:
            _mark(drawn, m, place, above[place])
            above[place] += 1
    return drawn.figure


def _lines(view: Overview, body: str, tints: _Tints) -> Lines:
    """The unexplained heat of a body, and its sensors, those with a mismatch first; the last line counts the rest."""
    own = sorted((c for c, at in view.sensors if at == body), key=lambda c: -tints.of.get(("sensor", c), (0.0,))[0])
    shown = own if len(own) <= _MOST_SENSORS else own[: _MOST_SENSORS - 1]
    lines = [(text, INK) for text in (tints.label("heat", body),) if text]
    for c in shown:
        lines.append((f"◆ {c} {tints.label('sensor', c)}".strip(), INK))
    return (*lines, *([(f"{len(own) - len(shown)} more", INK)] if len(own) > len(shown) else []))


def _place(view: Overview, m: Mark) -> Tie | str | None:
    """The link, the body or the error channel that a mark is at; None where the picture has no such place."""
    if m.kind == "link":
        tie = next((t for t in view.ties if t.name == m.name), None)
        return tie if tie is None or not tie.ground else tie.ends[0]
    if m.kind == "error":
        return next((c.channel for c in view.chains if c.channel == m.name), None)
    if m.kind == "sensor":
        return next((b for c, b in view.sensors if c == m.name), None)
    return next((b.name for b in view.bodies if b.name == m.name.partition("@")[0]), None)


def _mark(drawn: Drawn, m: Mark, place: Tie | str, above: int) -> None:
    """A frame and a badge, over the badges that the place has already."""
    if isinstance(place, Tie):
        x, y = drawn.halfway(place)
    else:
        patch = (drawn.below if m.kind == "error" else drawn.cards)[place]
        patch.set(edgecolor=BLUE, linewidth=2.6)
        x, y = middle(patch)
        y += patch.get_height() / 2 + 0.16
    style: Any = {"boxstyle": "round,pad=0.3", "fc": BLUE, "ec": "white", "lw": 1.2}
    label: Any = {"fontsize": TEXT_PT, "fontweight": "bold", "color": "white", "ha": "center", "va": "center"}
    drawn.ax.text(x, y + 0.22 * above, tex_escaped(m.label), bbox=style, zorder=9, **label)


def _head(found: pd.DataFrame) -> str:
    if found.empty or not found["shown"].any():
        return "Nothing above chance: no place holds heat, displacement or a reading that the simulation lacks."
    return "Colour: size over all runs. + : the recording has more heat, growth or reading than the simulation."


def _legend(tints: _Tints, found: pd.DataFrame) -> str:
    """What the colours of each kind range over, and what the marks mean."""
    said = []
    for kind in dict.fromkeys(str(k) for k in found["kind"]):
        label = KINDS.get(kind, kind)
        size, unit = tints.top.get(kind, (0.0, ""))
        said.append(f"{label} 0 to {_digits(size)} {unit}" if kind in tints.top else f"no {label}")
    return f"Colour: {'; '.join(said)}. ◆ : sensor. Below: the error, given the temperatures."


def _digits(value: float) -> str:
    """Two digits that count."""
    return number(value, 0 if abs(value) >= 9.5 else 1 if abs(value) >= 0.95 else 2)
