"""Pages as HTML and Markdown: one template of a page, one macro per kind of block."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import pandas as pd
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from data.errors import InputError, check_suffix
from data.files import write_atomic
from reports.layout import Page

FORMATS = (".html", ".md")
_TEMPLATES = Path(__file__).with_name("templates")
_HELD_TOGETHER = re.compile(r"(?<=\d) (?=(?:%|s|K|µm|points)(?!\w))|(?<=[≤≥]) (?=\d)")

_MARKDOWN = re.compile(r"[\\|*`\[\]<]|(?<!\w)_|_(?!\w)")  # an underscore inside a word is only itself


def write_page(path: Path, page: Page, formats: Sequence[str] = FORMATS) -> None:
    """Write a page; the suffix of `path`, one of `formats`, decides the format. It appears whole or not at all.

    An HTML page is self-contained: it loads nothing, and runs no script but its own, named by their hashes in its
    content security policy. The folder is made.

    Raises:
        InputError: another suffix, or a place that cannot be written.
    """
    check_suffix("report", path, formats)
    text = rendered(page, path.suffix)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, text)
    except OSError as error:
        raise InputError(f"report {path}: cannot be written ({error.strerror}); give another place") from None


def rendered(page: Page, suffix: str) -> str:
    """The page as text in the format of the suffix, with the time in UTC."""
    written = f"{pd.Timestamp.now('UTC'):%Y-%m-%d %H:%M} UTC"
    env = _environment(suffix == ".html")
    scripts = [_resource("page.js")]
    if page.with_viewer:
        scripts = [_resource("uplot/uPlot.iife.min.js"), _resource("viewer.js"), *scripts]
    hashes = [base64.b64encode(hashlib.sha256(s.encode("utf-8")).digest()).decode("ascii") for s in scripts]
    return env.get_template(f"page{suffix}.j2").render(
        page=page, written=written, style=Markup(_resource("style.css")),
        scripts=[Markup(s) for s in scripts], hashes=hashes,
        uplot_style=Markup(_resource("uplot/uPlot.min.css")), uplot_licence=Markup(_resource("uplot/LICENSE")),
    )  # fmt: skip


@cache
def _resource(name: str) -> str:
    return (_TEMPLATES / name).read_text(encoding="utf-8")


@cache
def _environment(html: bool) -> Environment:
    env = Environment(
        loader=FileSystemLoader(_TEMPLATES), autoescape=html, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True, keep_trailing_newline=True, finalize=None if html else _markdown,
    )  # fmt: skip
    env.filters["kind"] = lambda value: type(value).__name__.lower()
    env.filters["unbroken"] = _unbroken

    def show(block: object, anchor: str) -> Markup:
        macros = env.get_template(f"blocks.{'html' if html else 'md'}.j2").module
        draw = getattr(macros, type(block).__name__.lower(), None)
        return Markup("" if draw is None else draw(block, anchor))

    env.globals["show"] = show
    return env


def _markdown(value: object) -> object:
    """Names as they are: what Markdown would read as markup gets a backslash."""
    if isinstance(value, Markup) or not isinstance(value, str):
        return value
    return _MARKDOWN.sub(r"\\\g<0>", value).replace("\n", " ")


def _unbroken(text: str) -> str:
    """No line ends between a number and its unit, or between a bound's sign and its number."""
    return _HELD_TOGETHER.sub("\u00a0", text)
