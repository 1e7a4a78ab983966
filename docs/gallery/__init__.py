"""The gallery: one script for one question, each with asserted numbers and a picture.

`python -m docs.gallery` runs the scripts and renews their pictures; `pages` gives the pages of the site, which
`docs/build.py` adds.
"""

from __future__ import annotations

import ast
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
SECTIONS: Mapping[str, tuple[str, ...]] = {
    "Models": (
        "selectors_compared", "forward_or_left_out", "expected_error", "season_arrives", "error_along_an_axis",
    ),
    "At the machine": ("probe_readings", "sensor_fails", "export_to_c"),
    "Recordings": ("lake_in_duckdb", "thermal_test"),
    "The twin": ("heat_flows", "calibration_intervals"),
    "Diagnosis": (
        "missing_effect", "nothing_missing", "next_run", "unlisted_effect", "wrong_value",
        "findings_in_pandas",
    ),
    "Extend": ("own_selector",),
}  # fmt: skip
HEAD = """# Gallery

One question of an engineer each, answered by a script of less than 60 lines that runs as it is: it makes its own
recordings (all are simulated), checks its main numbers by `assert`, and draws the picture. `make gallery` runs all of
them, `python -m docs.gallery NAME` some.
"""


@dataclass(frozen=True)
class Example:
    """A script: its name, the first line of its docstring, and the others."""

    name: str
    title: str
    text: str
    source: str


def names() -> tuple[str, ...]:
    """All scripts in the order of the gallery."""
    return tuple(name for members in SECTIONS.values() for name in members)


def example(name: str) -> Example:
    """A script as read from its file.

    Raises:
        ValueError: the script has no docstring.
    """
    source = (FOLDER / f"{name}.py").read_text(encoding="utf-8")
    docstring = ast.get_docstring(ast.parse(source))
    if docstring is None:
        raise ValueError(f"docs/gallery/{name}.py: has no docstring; the gallery shows its first line as the title")
    title, _, text = docstring.partition("\n")
    return Example(name, title.rstrip("."), text.strip(), source)


def pages() -> dict[str, str]:
    """Path below docs/ → Markdown: the gallery's index, and a page for each script with its picture and code."""
    index = [HEAD]
    made = {}
    for section, members in SECTIONS.items():
        index += [f"## {section}", "", '<div class="cards" markdown>', ""]
        for shown in map(example, members):
            index += ["<div markdown>", "", f"[![{shown.title}]({shown.name}.png)]({shown.name}.md)", ""]
            index += [f"**[{shown.title}]({shown.name}.md)**", "", "</div>", ""]
            made[f"gallery/{shown.name}.md"] = _page(shown)
        index += ["</div>", ""]
    return {"gallery/index.md": "\n".join(index), **made}


def _page(shown: Example) -> str:
    """The title, what is asked and seen, the picture, and the code below the docstring."""
    path = f"docs/gallery/{shown.name}.py"
    body = shown.source.split('"""', 2)[2].strip()
    lines = [f"# {shown.title}", "", shown.text, "", f"![{shown.title}]({shown.name}.png)", ""]
    lines += [f'```python title="{path}"', body, "```", "", "[All examples](index.md)", ""]
    return "\n".join(lines)
