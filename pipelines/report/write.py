"""Write the report: collect, fill the template, put the file in place at once."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import pandas as pd
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from data.atomic_file import write_atomic
from data.errors import InputError
from pipelines.report.layout import Strip
from pipelines.report.page import page
from pipelines.settings import Settings
from pipelines.tracking import Training

FORMATS = (".html", ".md")
_TEMPLATES = Path(__file__).parent / "templates"
_HELD_TOGETHER = re.compile(r"(?<=\d) (?=(?:%|s|K|µm|points)(?!\w))|(?<=[≤≥]) (?=\d)")
_MARKDOWN = re.compile(r"[\\|*`\[\]<]|(?<!\w)_|_(?!\w)")  # an underscore inside a word is only itself


def write_report(trainings: Sequence[Training], path: Path, settings: Settings) -> Path:
    """One page from tracked trainings; the suffix of `path`, .html or .md, decides the format.

    The HTML page holds everything it needs and asks no network. The folder is made; the file appears whole or not
    at all.

    Raises:
        InputError: no training given, one without a judged cell, another suffix, or a place that cannot be written.
    """
    path = Path(path)
    if path.suffix not in FORMATS:
        raise InputError(f"report {path}: got suffix {path.suffix!r}, expected .html or .md")
    shown = page(trainings, settings)
    written = f"{pd.Timestamp.now('UTC'):%Y-%m-%d %H:%M} UTC"
    html = path.suffix == ".html"
    text = template_environment(html).get_template(f"report{path.suffix}.j2").render(page=shown, written=written)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, text)
    except OSError as error:
        raise InputError(f"report {path}: cannot be written ({error.strerror}); give another place") from None
    return path


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


def _unbroken(text: str) -> str:
    """No line ends between a number and its unit, or between a bound's sign and its number."""
    return _HELD_TOGETHER.sub("\u00a0", text)


def _markdown(value: object) -> object:
    """Names and words as they are: what Markdown would read as markup gets a backslash."""
    return _MARKDOWN.sub(r"\\\g<0>", value).replace("\n", " ") if isinstance(value, str) else value
