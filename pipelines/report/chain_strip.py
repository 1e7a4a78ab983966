"""The strip of error chains: what lengthens to one side, what to the other, and whether both sides are equal."""

from __future__ import annotations

import math
from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipelines.report.network_glyphs import CHAINS, SOFT, say, width_in
from pipelines.report.words import INK, number
from twin.views.overview import ChainView

_ROW_IN, _BAR_IN, _HEAD_IN, _LEFT_IN, _RIGHT_IN = 0.50, 0.21, 0.42, 0.85, 0.35


def strip_height_in(chains: Sequence[ChainView]) -> float:
    """Height that the strip takes."""
    return _HEAD_IN + _ROW_IN * len(chains) + 0.12 if chains else 0.1


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
    unit = "m" if metres else f"{_unit(chains[0].unit)}/K"
    ax.plot([0.3, width - 0.3], [height_in - 0.05] * 2, color="#d5dbe1", lw=0.8)
    drawn = any(sides)  # errors of laws alone have no lengths to draw
    words = "Errors" if not drawn else f"Error chains, lengths in {unit}" if metres else f"Error chains in {unit}"
    say(ax, (0.3, height_in - 0.24), words, 8.5, INK, ha="left", fontweight="bold")
    if drawn:
        say(ax, (zero - 0.1, height_in - 0.24), "◂ −", 7.5, SOFT, ha="right")
        say(ax, (zero + 0.1, height_in - 0.24), "+ ▸", 7.5, SOFT, ha="left")
        ax.plot([zero, zero], [0.12, height_in - _HEAD_IN + 0.06], color=INK, lw=1.0, zorder=6)
    for k, (c, row) in enumerate(zip(chains, sides, strict=True)):
        y = height_in - _HEAD_IN - _ROW_IN * (k + 0.5) + 0.06
        color = CHAINS[k % len(CHAINS)]
        say(ax, (0.3, y), c.channel, 10, color, ha="left", fontweight="bold")
        _bars(ax, c, row, zero, scale, y, color)
        _side_words(ax, c, row, metres, width - tilt_in if drawn else _LEFT_IN + width_in(c.channel, 10), y)


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


def _side_words(ax: Axes, c: ChainView, row: Sequence[float], metres: bool, x: float, y: float) -> None:
    total = sum(row)
    lines = []
    if metres and row:
        closed = abs(total) < 1e-9
        lines.append("closes: both sides are equal" if closed else f"open by {number(total, 3, sign=True)} m")
    for hot, cold, gain in c.tilts:
        lines.append(f"tilt {number(gain, 2, sign=True)} {_unit(c.unit)}/K × ({hot} − {cold})")
    lines += [f"and {name}" if lines else name for name in c.also]
    for k, text in enumerate(lines):
        say(ax, (x, y + 0.13 * ((len(lines) - 1) / 2 - k)), text, 7.6, SOFT, ha="left")


def _unit(unit: str) -> str:
    return {"um": "µm", "um/m": "µm/m"}.get(unit, unit)
