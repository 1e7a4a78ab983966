"""The gallery: short scripts that assert their numbers, each with its picture; they run as a reader would run them."""

from __future__ import annotations

import ast
import shutil
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from docs import gallery  # noqa: E402
from docs.gallery.__main__ import main  # noqa: E402

NAMES = gallery.names()
QUICKEST = ("thermal_test", "heat_flows")
OTHER_FILES = {"__init__", "__main__", "board", "drawing"}


def _runs_and_draws(name: str) -> None:
    picture = gallery.FOLDER / f"{name}.png"
    committed = picture.read_bytes()
    try:
        picture.unlink()
        assert main([name]) == 0
        assert picture.read_bytes().startswith(b"\x89PNG")
    finally:
        picture.write_bytes(committed)


def test_every_script_is_listed_once_and_every_listed_one_exists() -> None:
    assert len(NAMES) == len(set(NAMES)) and 15 <= len(NAMES) <= 20
    assert {p.stem for p in gallery.FOLDER.glob("*.py")} - OTHER_FILES == set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_a_script_is_short_and_says_what_it_asks_and_asserts(name: str) -> None:
    shown = gallery.example(name)
    tree = ast.parse(shown.source)
    assert len(shown.source.splitlines()) < 60
    assert 2 <= len(shown.text.splitlines()) <= 4 and len(shown.title) < 100
    checked = [n.test for n in ast.walk(tree) if isinstance(n, ast.Assert)]
    assert any(isinstance(n, ast.Compare) for test in checked for n in ast.walk(test)), "compares nothing"
    drawn = [n for n in ast.walk(tree) if isinstance(n, ast.Call) and getattr(n.func, "id", "") == "picture"]
    assert len(drawn) == 1
    assert "import thermodrift as td" in shown.source


@pytest.mark.parametrize("name", NAMES)
def test_a_picture_is_there_and_small(name: str) -> None:
    picture = (gallery.FOLDER / f"{name}.png").read_bytes()
    assert picture.startswith(b"\x89PNG") and len(picture) < 80_000


def test_the_index_shows_every_script_and_its_page_the_code() -> None:
    pages = gallery.pages()
    for name in NAMES:
        shown = gallery.example(name)
        assert f"[{shown.title}]({name}.md)" in pages["gallery/index.md"]
        assert f"]({name}.png)" in pages["gallery/index.md"] and f"]({name}.png)" in pages[f"gallery/{name}.md"]
        assert shown.source.split('"""', 2)[2].strip() in pages[f"gallery/{name}.md"]


def test_an_unknown_script_is_one_line(capsys) -> None:
    assert main(["no_such"]) == 2
    assert capsys.readouterr().err.startswith("gallery: no script no_such; there are ")


def test_a_script_that_fails_is_reported(monkeypatch, tmp_path, capsys) -> None:
    (tmp_path / "bad.py").write_text("assert 1 > 2, 'not so'")
    monkeypatch.setattr("docs.gallery.__main__.FOLDER", tmp_path)
    monkeypatch.setattr("docs.gallery.__main__.names", lambda: ("bad",))
    assert main([]) == 1
    said = capsys.readouterr()
    assert "FAILED" in said.out and "not so" in said.err and "failed: bad" in said.err


@pytest.mark.parametrize("name", [QUICKEST[0], *(pytest.param(n, marks=pytest.mark.slow) for n in QUICKEST[1:])])
def test_the_quickest_scripts_run(name: str) -> None:
    _runs_and_draws(name)


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in NAMES if n not in QUICKEST])
def test_every_script_runs(name: str) -> None:
    if name == "export_to_c" and shutil.which("cc") is None:
        pytest.skip("no C compiler (cc) on this computer")
    _runs_and_draws(name)
