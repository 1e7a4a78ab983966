"""What all figures of the proof share: a head that says where the recordings come from, plants in colours."""

from __future__ import annotations

import base64
from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipelines.report.network_picture import picture_bytes
from pipelines.report.proof_words import origin, plant_letter, plant_origin
from pipelines.report.twin_figures import SOFT, _calm
from pipelines.report.twin_report import Picture
from pipelines.report.words import BLUE, GREEN, INK, ORANGE

WIDE_IN, HALF_IN = 10.5, 5.5
PALE = "#c5cbd3"
_PLANTS = {"elements": (BLUE, "o"), "volumes": (ORANGE, "s"), "grafted": (GREEN, "D"), "withheld": ("#8a4fa3", "^")}


def plant_style(plant: str) -> tuple[str, str]:
    """Colour and marker."""
    return _PLANTS.get(plant, (SOFT, "o"))


def head(fig: Figure, title: str, plants: Sequence[str]) -> None:
    """The title, and below it what of the figure is simulated."""
    high, wide = fig.get_figheight(), fig.get_figwidth()
    fig.text(0.1 / wide, 1 - 0.18 / high, title, fontsize=11, color=INK, fontweight="bold", va="center")
    said = origin(plants)
    if said and said != "real":
        fig.text(0.1 / wide, 1 - 0.4 / high, said, fontsize=8.5, color=ORANGE, fontweight="bold", va="center")


def keys(fig: Figure, entries: Sequence[tuple[str, str, str]], y_in: float) -> None:
    """Mark, words and colour in a row, right of the origin's line, `y_in` below the top edge."""
    high, wide = fig.get_figheight(), fig.get_figwidth()
    x = wide - 0.1 - sum(0.3 + 0.072 * len(words) for _, words, _ in entries)
    for mark, words, color in entries:
        fig.text(x / wide, 1 - y_in / high, mark, fontsize=9.5, color=color, va="center")
        fig.text((x + 0.17) / wide, 1 - y_in / high, words, fontsize=8.5, color=SOFT, va="center")
        x += 0.3 + 0.072 * len(words)


def plant_keys(plants: Sequence[str]) -> list[tuple[str, str, str]]:
    """Legend entries: the plants' letters."""
    marks = {"o": "●", "s": "■", "D": "◆", "^": "▲"}
    return [(marks[plant_style(p)[1]], f"plant {plant_letter(p)}", plant_style(p)[0]) for p in plants]


def panel(fig: Figure, left_in: float, top_in: float, wide_in: float, tall_in: float) -> Axes:
    """Axes in the report's calm look, placed in inches from the upper left corner."""
    w, h = fig.get_figwidth(), fig.get_figheight()
    ax = fig.add_axes((left_in / w, 1 - (top_in + tall_in) / h, wide_in / w, tall_in / h))
    _calm(ax)
    return ax


def picture(figure: Figure, said: str, plants: Sequence[str]) -> Picture:
    """The figure as a data: address; its words say what is simulated."""
    content = base64.b64encode(picture_bytes(figure, "png")).decode("ascii")
    only = {plant_origin(p) for p in plants} == {"SIMULATED"}
    mixed = "" if only else f" ({origin(plants)})"
    return Picture(f"{said}{mixed}", f"data:image/png;base64,{content}", only)
