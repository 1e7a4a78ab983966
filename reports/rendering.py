"""Jinja templates filled with pages, tables and figures: HTML and Markdown."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import pandas as pd
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from data.errors import InputError, check_suffix
from data.files import write_atomic
from reports.layout import Shade, Strip

FORMATS = (".html", ".md")
_TEMPLATES = Path(__file__).with_name("templates")
_HELD_TOGETHER = re.compile(r"(?<=\d) (?=(?:%|s|K|µm|points)(?!\w))|(?<=[≤≥]) (?=\d)")

_MARKDOWN = re.compile(r"[\\|*`\[\]<]|(?<!\w)_|_(?!\w)")  # an underscore inside a word is only itself


def write_page(path: Path, template: str, page: object, formats: Sequence[str] = FORMATS) -> None:
    """Write a page by its template; the suffix of `path`, one of `formats`, decides the format.

    The folder is made; the file appears whole or not at all.

    Raises:
        InputError: another suffix, or a place that cannot be written.
    """
    check_suffix("report", path, formats)
    text = rendered(f"{template}{path.suffix}", page)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, text)
    except OSError as error:
        raise InputError(f"report {path}: cannot be written ({error.strerror}); give another place") from None


def rendered(name: str, page: object, **more: object) -> str:
    """The text of a template (``twin.html``, ``twin.md``) filled with a page and the time in UTC."""
    written = f"{pd.Timestamp.now('UTC'):%Y-%m-%d %H:%M} UTC"
    template = template_environment(name.endswith(".html")).get_template(f"{name}.j2")
    return template.render(page=page, written=written, **more)


@cache
def template_environment(html: bool) -> Environment:
    env = Environment(
        loader=FileSystemLoader(_TEMPLATES), autoescape=html, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True, keep_trailing_newline=True, finalize=None if html else _markdown,
    )  # fmt: skip
    env.tests["strip"] = lambda cell: isinstance(cell, Strip)
    env.tests["shade"] = lambda cell: isinstance(cell, Shade)
    if html:
        env.globals["style"] = Markup((_TEMPLATES / "style.css").read_text(encoding="utf-8"))
        env.filters["unbroken"] = _unbroken
    return env


def _markdown(value: object) -> object:
    """Names as they are: what Markdown would read as markup gets a backslash."""
    return _MARKDOWN.sub(r"\\\g<0>", value).replace("\n", " ") if isinstance(value, str) else value


def _unbroken(text: str) -> str:
    """No line ends between a number and its unit, or between a bound's sign and its number."""
    return _HELD_TOGETHER.sub("\u00a0", text)
