"""Edits of a YAML text keep what the user wrote: comments, order, quotes and numbers."""

from __future__ import annotations

from pathlib import Path

import pytest

from data.yaml_edit import YamlText

MACHINES = sorted((Path(__file__).parents[2] / "machines").glob("*.yml"))
WRITTEN = """# head
a: {b: 1e3, c: 0.10, d: ~}  # by hand
e: 'yes'
f: yes
g: 0x1F
h: 2026-01-01T10:00:00+01:00

# next
i: >-
  folded
  text
j:
  - "x"
  - y # last
"""


@pytest.mark.parametrize("text", [WRITTEN, *(p.read_text(encoding="utf-8") for p in MACHINES)])
def test_a_text_that_is_not_edited_stays(text: str) -> None:
    assert str(YamlText(text)) == text


def test_comments_between_brackets_move_above_their_entry() -> None:
    text = "x: 1\nb:\n  a: {\n    c: {d: 1}, # one\n    e: [1, # two\n 2] } # end\nz: 2\n"
    assert str(YamlText(text)) == "x: 1\nb:\n  # one\n  # two\n  a: {c: {d: 1}, e: [1, 2]} # end\nz: 2\n"


def test_a_new_entry_stands_before_the_comment_of_the_next() -> None:
    document = YamlText("a:\n  b: {c: 1}  # own\n\n  # of d\n  d: 2\n\n# of e\ne: 3\n")
    document.set(["a"], "x", "new", order=["b", "x"])
    document.set(["a"], "y", [1, 2])
    assert str(document) == ("a:\n  b: {c: 1}  # own\n  x: new\n\n  # of d\n  d: 2\n  y: [1, 2]\n\n# of e\ne: 3\n")


def test_a_comment_opens_the_brackets_around_its_entry() -> None:
    document = YamlText("a: {b: 1, c: {d: 2}}\n")
    document.set(["a"], "e", {"f": "4 W"}, "why")
    assert str(document) == "a:\n  b: 1\n  c: {d: 2}\n  # why\n  e: {f: 4 W}\n"


def test_text_that_would_be_read_as_something_else_is_quoted() -> None:
    document = YamlText("a: 1\n")
    document.set([], "b", "yes")
    document.set([], "c", "2026-01-01")
    assert str(document) == "a: 1\nb: 'yes'\nc: '2026-01-01'\n"


def test_entries_are_refused_where_no_mapping_stands() -> None:
    with pytest.raises(ValueError, match=r"a.b: expected a mapping, got '3'"):
        YamlText("a: {b: 3}\n").set(["a", "b"], "c", 1)
    with pytest.raises(ValueError, match=r"a.c: does not stand in the file"):
        YamlText("a: {b: 3}\n").comment(["a", "c"], "x")


@pytest.mark.parametrize("empty", ["", " ~", " null", " {}"])
@pytest.mark.parametrize("behind", ["", " # none"])
def test_what_is_empty_is_filled(empty: str, behind: str) -> None:
    document = YamlText(f"a:\n  b:{empty}{behind}\n  c: 1\n")
    document.set(["a", "b"], "d", {"e": 2}, "why")
    assert str(document) == f"a:\n  b:{behind}\n    # why\n    d: {{e: 2}}\n  c: 1\n"
