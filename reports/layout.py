"""What a page is made of: a list of blocks, independent of HTML and Markdown.

A block is a dataclass; `templates/blocks.html.j2` and `templates/blocks.md.j2` draw it by the macro of its name. One
without a macro does not appear there: Markdown has no figures.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

from data.units import in_error_unit
from reports.viewer import Viewer

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Gauge:
    """A small picture of a value in its range, positions in 0..100: a band, marks across it, dots.

    A mark is (look, position): ``expected``, ``bound`` or ``wanted``. Dots beyond the band are drawn in orange.
    """

    band: tuple[float, float]
    marks: tuple[tuple[str, float], ...]
    dots: tuple[float, ...]
    label: str = ""
    look: Literal["drift", "interval"] = "interval"


@dataclass(frozen=True)
class Cell:
    """A cell with a smaller line below, a chip (text, look), a gauge; `alert` where it is the reason of an alert.

    `link` is where its text leads to, relative to the page.
    """

    text: str
    below: str = ""
    alert: bool = False
    chip: tuple[str, str] = ("", "")
    gauge: Gauge | None = None
    simulated: bool = False
    link: str = ""


@dataclass(frozen=True)
class Column:
    """A column's head and how its cells stand."""

    title: str
    unit: str = ""
    kind: Literal["text", "number", "wide"] = "text"


@dataclass(frozen=True)
class Row:
    """A row's cells; `mark` says in a word why it stands out, `look` is a class of the style sheet."""

    cells: tuple[str | Cell, ...]
    mark: str = ""
    look: str = ""

    @classmethod
    def of(cls, *cells: str | Cell, mark: str = "", look: str = "") -> Row:
        """From the cells one by one."""
        return cls(cells, mark, look)


@dataclass(frozen=True)
class Table:
    """A table with its caption and notes below."""

    caption: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    simulated: bool = False
    notes: tuple[str, ...] = ()
    look: str = ""  # stacked: a card per row on a narrow screen

    def folded(self, counted: bool = True) -> Details:
        """The table behind its caption, with the number of its rows."""
        return Details(f"{self.caption} ({len(self.rows)})" if counted else self.caption, (self,))


@dataclass(frozen=True)
class Key:
    """One entry of a figure's legend."""

    label: str
    color: str
    symbol: str = "line"  # line, dot, dash; circle, square, diamond, triangle-up on a line
    alone: bool = False  # the symbol without a line


_PX_PER_IN = 108  # a label of 7.5 points is 11 px high


def with_unit(block: Any, unit: str) -> Any:
    """A part of a page on errors in µm as one on errors in `unit`: its texts, also those of figures."""
    if unit == "um":
        return block
    from matplotlib.figure import Figure  # takes long to load
    from matplotlib.text import Text as FigureText

    if isinstance(block, str):
        return in_error_unit(block, unit)
    if isinstance(block, Figure):
        for text in block.findobj(FigureText):
            text.set_text(in_error_unit(text.get_text(), unit))
    elif isinstance(block, dict):
        return {k: with_unit(v, unit) for k, v in block.items()}
    elif isinstance(block, tuple) and hasattr(block, "_fields"):
        return type(block)(*(with_unit(v, unit) for v in block))
    elif isinstance(block, tuple | list):
        return type(block)(with_unit(v, unit) for v in block)
    elif is_dataclass(block) and not isinstance(block, type):
        return replace(block, **{f.name: with_unit(getattr(block, f.name), unit) for f in fields(block) if f.init})
    return block


@dataclass(frozen=True)
class Plot:
    """A figure; `size` says how much of the page's width it takes."""

    figure: Figure
    title: str
    size: Literal["full", "third"] = "full"

    @property
    def width_px(self) -> int:
        """Width at which its text has the size of the page's notes."""
        return round(_PX_PER_IN * float(self.figure.get_figwidth()))

    def svg(self, anchor: str) -> str:
        """The figure as an svg element with ids that begin with `anchor`."""
        from reports.drawing import inline_svg

        return inline_svg(self.figure, anchor)


@dataclass(frozen=True)
class Panel:
    """Figures that stand together under one caption and legend."""

    caption: str
    plots: tuple[Plot, ...]
    simulated: bool = False
    keys: tuple[Key, ...] = ()
    notes: tuple[str, ...] = field(default=())


@dataclass(frozen=True)
class Text:
    """A paragraph; `strong` stands in bold before it."""

    text: str
    look: str = ""  # classes of the style sheet: note, soft, caution, lead, law, ...
    strong: str = ""


@dataclass(frozen=True)
class Items:
    """A list; numbered where `ordered`."""

    items: tuple[str, ...]
    look: str = ""
    ordered: bool = False


@dataclass(frozen=True)
class Pairs:
    """Labels with their values; a value of several lines is a tuple of texts."""

    entries: tuple[tuple[str, str | tuple[Text, ...]], ...]
    look: str = "facts"  # facts, pairs, glossary, three


@dataclass(frozen=True)
class Heading:
    """A heading inside of a section, with a chip (text, look)."""

    text: str
    chip: tuple[str, str] = ("", "")
    simulated: bool = False
    level: Literal[2, 3] = 3


@dataclass(frozen=True)
class Group:
    """Blocks in a box: pair, unsealed, changed or claim."""

    blocks: tuple[Any, ...]
    look: str


@dataclass(frozen=True)
class Details:
    """Blocks that open on demand."""

    summary: str
    blocks: tuple[Any, ...]


@dataclass(frozen=True)
class Section:
    """A part of the page with an entry in its navigation, `short` or the title; `chip` is (text, look)."""

    anchor: str
    title: str
    blocks: tuple[Any, ...]
    short: str = ""
    chip: tuple[str, str] = ("", "")
    simulated: bool = False
    look: str = ""


@dataclass(frozen=True)
class Page:
    """A page: `top` stands below its headline (the title where none is given), `above` before it.

    `badge` is set next to the headline and behind the title; of simulated recordings it is SIMULATED.
    """

    eyebrow: str
    title: str
    top: tuple[Any, ...]
    sections: tuple[Section, ...] = ()
    footer: tuple[str, ...] = ()
    simulated: bool = False
    headline: str = ""
    chip: tuple[str, str] = ("", "")
    badge: str = ""
    above: tuple[Any, ...] = ()

    @property
    def mark(self) -> str:
        """The badge."""
        return self.badge or ("SIMULATED" if self.simulated else "")

    @property
    def with_viewer(self) -> bool:
        """Whether a block of the page is a viewer of runs."""
        return any(isinstance(b, Viewer) for b in every_block(self))


def every_block(part: Any) -> Iterator[Any]:
    """Every block of a page, a section or a block, the outer ones first."""
    if isinstance(part, Page):
        inner: tuple[Any, ...] = (*part.above, *part.top, *part.sections)
    else:
        yield part
        inner = getattr(part, "blocks", ())
    for block in inner:
        yield from every_block(block)


def given(*blocks: Any) -> tuple[Any, ...]:
    """The blocks that there are: without None and without texts, lists and panels of nothing."""
    return tuple(b for b in blocks if b is not None and not _empty(b))


def _empty(block: Any) -> bool:
    """A panel without plots; a text, a list or a group whose first field, its content, is empty."""
    if isinstance(block, Panel):
        return not block.plots
    of_content = isinstance(block, Text | Items | Pairs | Group)
    return of_content and not next(iter(vars(block).values()))
