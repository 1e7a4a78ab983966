"""Every numbered example runs and meets its own assertions."""

import runpy
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).parent.parent / "docs").glob("[0-9]*.py"))


@pytest.fixture(autouse=True)
def _registry_as_before(monkeypatch):
    from models import FAMILIES

    monkeypatch.setattr(FAMILIES, "_members", dict(FAMILIES._members))


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda p: p.stem)
def test_example(example, capsys) -> None:
    runpy.run_path(str(example), run_name="__main__")
    assert capsys.readouterr().out.strip()


def test_there_are_examples() -> None:
    assert [p.stem for p in EXAMPLES] == ["01_by_hand", "02_add_a_family"]
