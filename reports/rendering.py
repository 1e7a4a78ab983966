"""Jinja templates filled with pages, tables and figures: HTML and Markdown."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from reports.layout import Strip

FORMATS = (".html", ".md")


_TEMPLATES = Path(__file__).with_name("templates")


_HELD_TOGETHER = re.compile(r"(?<=\d) (?=(?:%|s|K|µm|points)(?!\w))|(?<=[≤≥]) (?=\d)")


_MARKDOWN = re.compile(r"[\\|*`\[\]<]|(?<!\w)_|_(?!\w)")  # an underscore inside a word is only itself


@cache
def template_environment(html: bool) -> Environment:
    env = Environment(
        loader=FileSystemLoader(_TEMPLATES), autoescape=html, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True, keep_trailing_newline=True, finalize=None if html else _markdown,
    )  # fmt: skip
    env.tests["strip"] = lambda cell: isinstance(cell, Strip)
    if html:
        env.globals["style"] = Markup((_TEMPLATES / "style.css").read_text(encoding="utf-8"))
        env.globals["script"] = Markup((_TEMPLATES / "figures.js").read_text(encoding="utf-8"))
        env.globals["plotly_js"] = Markup(get_plotlyjs().replace("</script", "<\\/script"))
        env.filters["raw"] = Markup
        env.filters["unbroken"] = _unbroken
    return env


def _markdown(value: object) -> object:
    """Names and words as they are: what Markdown would read as markup gets a backslash."""
    return _MARKDOWN.sub(r"\\\g<0>", value).replace("\n", " ") if isinstance(value, str) else value


def _unbroken(text: str) -> str:
    """No line ends between a number and its unit, or between a bound's sign and its number."""
    return _HELD_TOGETHER.sub("\u00a0", text)
