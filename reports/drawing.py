"""What all matplotlib figures share: their look, heads, legends, axes placed in inches, and pictures of a page."""

from __future__ import annotations

import base64
import io
import re
from dataclasses import dataclass

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from reports.labels import INK, ORANGE, tex_escaped

MUTED, GRID, RULE, GREY = "#5a6572", "#eef1f4", "#b5bec8", "#c5cbd3"
LINES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7d6608", "#4b3f72")  # Okabe and Ito 2008
SIGNED = LinearSegmentedColormap.from_list("signed", ["#004d7a", "#5fa3cf", "#ffffff", "#e99a66", "#963f00"])
SIZE = LinearSegmentedColormap.from_list("size", ["#ffffff", "#8ebbd9", "#0b5a8f"])
WIDTH_IN = 10.5
THIRD_IN = 3.35  # 360 px on the page


@dataclass(frozen=True)
class Picture:
    """A figure on a page: what it shows, its data: address, whether all of it is simulated.

    `look` is a class of the style sheet; `captioned` sets the label above it; `file` is its place next to a Markdown
    page, which shows no other picture.
    """

    label: str
    source: str
    simulated: bool
    look: str = ""
    captioned: bool = False
    file: str = ""


def picture(figure: Figure, label: str, simulated: bool, kind: str = "png", look: str = "") -> Picture:
    """The figure as svg or png within the page."""
    return Picture(label, data_address(picture_bytes(figure, kind), kind), simulated, look)


def data_address(content: bytes, kind: str) -> str:
    """An image's bytes as a data: address."""
    mime = "image/svg+xml" if kind == "svg" else "image/png"
    return f"data:{mime};base64,{base64.b64encode(content).decode('ascii')}"


def picture_bytes(figure: Figure, kind: str, dpi: int = 160) -> bytes:
    """The figure as svg or png; the same figure gives the same bytes."""
    out = io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": "thermodrift"}):
        figure.savefig(out, format=kind, dpi=dpi, metadata={"Date": None} if kind == "svg" else None)
    return out.getvalue()


def inline_svg(figure: Figure, prefix: str) -> str:
    """The figure as an svg element of an HTML page, whose font sets its text; `prefix` keeps ids apart on the page.

    Coordinates are cut to a hundredth of a point, and names that nothing refers to are left out.
    """
    out = io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": "thermodrift", "svg.fonttype": "none"}):
        figure.savefig(out, format="svg", transparent=True, metadata={"Date": None})
    text = out.getvalue().decode("utf-8")
    text = re.sub(r"\s*\n\s*", " ", text[text.index("<svg") :])
    text = re.sub(r"<metadata>.*?</metadata>|<style.*?</style>", "", text)
    ids = {name: f"{prefix}-{k}" for k, name in enumerate(dict.fromkeys(re.findall(r'(?:href="|url\()#(\w+)', text)))}

    def lean(tag: re.Match[str]) -> str:
        short = re.sub(r' font-family: [^;"]*;?| transform="rotate\(-0 [^"]*"', "", tag[0])
        short = re.sub(r' id="([^"]*)"', lambda m: f' id="{ids[m[1]]}"' if m[1] in ids else "", short)
        short = re.sub(r'(?:xlink:)?(href="|url\()#(\w+)', lambda m: f"{m[1]}#{ids[m[2]]}", short)
        return re.sub(r"(?<=[:;]) ", "", re.sub(r"(\.\d\d)\d+", r"\1", short))

    return re.sub(r"<[^>]*>", lean, text)


def panel(fig: Figure, left_in: float, top_in: float, wide_in: float, tall_in: float) -> Axes:
    """Axes in the shared look, placed in inches from the figure's upper left corner."""
    w, h = fig.get_figwidth(), fig.get_figheight()
    ax = fig.add_axes((left_in / w, 1 - (top_in + tall_in) / h, wide_in / w, tall_in / h))
    calm(ax)
    return ax


def calm(ax: Axes) -> None:
    """The shared look: two soft spines and a faint grid."""
    ax.tick_params(labelsize=7.5, color=MUTED, length=2.5)
    ax.spines[["top", "right"]].set_visible(False)
    ax.spines[["left", "bottom"]].set_color(RULE)
    ax.grid(color=GRID, lw=0.8)
    ax.set_axisbelow(True)


def head(fig: Figure, title: str, simulated: bool) -> None:
    """The title in the upper left corner; simulated data are called so in the right one."""
    high, wide = fig.get_figheight(), fig.get_figwidth()
    y = 1 - 0.2 / high
    fig.text(0.1 / wide, y, tex_escaped(title), fontsize=11.5, color=INK, fontweight="bold", va="center")
    if simulated:
        fig.text(1 - 0.1 / wide, y, "SIMULATED", fontsize=10, color=ORANGE, fontweight="bold", ha="right", va="center")


def headed(fig: Figure, title: str, simulated: bool) -> None:
    """As `head`, for a small figure whose page names what it shows."""
    wide, y = fig.get_figwidth(), 1 - 0.14 / fig.get_figheight()
    fig.text(0.04 / wide, y, tex_escaped(title), fontsize=8.5, color=INK, va="center")
    if simulated:
        fig.text(
            1 - 0.05 / wide, y, "SIMULATED", fontsize=7.5, color=ORANGE, fontweight="bold", va="center", ha="right"
        )
