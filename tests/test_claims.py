"""Sentences with figures are those of the stored results."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

import pandas as pd
import pytest

from docs import claims

ROOT = Path(__file__).parents[1]
FIGURE = re.compile(r"\d+(\.\d+)? ?(µm|%|nats|×)|± ?\d|\d+ of \d+")
# Results of an older version: the kills, until measured anew.
OLDER = {"kills": (1, 1)}
STATED = {"README.md": ("90 % bound",), "results.md": ("at least 30 nats",)}  # definitions, not results


def version_of(text: str) -> tuple[int, ...]:
    return tuple(map(int, text.split(".")[:2]))


@pytest.mark.parametrize("page", claims.PAGES, ids=lambda p: p.name)
def test_a_page_has_every_claim_as_the_stored_results_have_it(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert claims.claims_of(text), "a page without claims needs no entry in PAGES"
    assert claims.rendered(text) == text, "call: python -m docs.claims"


@pytest.mark.parametrize("page", claims.PAGES, ids=lambda p: p.name)
def test_no_figure_of_a_page_comes_from_nowhere(page: Path) -> None:
    text = re.sub(r"```.*?```", "", claims._CLAIM.sub("", page.read_text(encoding="utf-8")), flags=re.DOTALL)
    for definition in STATED.get(page.name, ()):
        text = text.replace(definition, "")
    assert [m[0] for m in FIGURE.finditer(text)] == []


def test_every_claim_is_on_the_page_of_results() -> None:
    page = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    assert set(claims.claims_of(page)) == set(claims.CLAIMS)


@pytest.mark.parametrize("about", sorted((ROOT / "results").glob("*.json")), ids=lambda p: p.stem)
def test_a_stored_result_says_how_it_was_made_and_is_of_this_version(about: Path) -> None:
    made = json.loads(about.read_text(encoding="utf-8"))
    assert made["schema"] == "thermodrift.result/1" and made["command"].startswith("python -m ")
    assert made["rows"] == len(pd.read_csv(about.with_suffix(".csv")))
    own = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    expected = OLDER.get(about.stem, version_of(own))
    assert version_of(made["version"]) == expected, "measure again, or state the version in the sentence"


def test_a_changed_figure_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows, about = claims.table("proof_kinds")
    rows["named"] = 1 - rows["named"].clip(upper=1)
    monkeypatch.setattr(claims, "table", lambda name: (rows, about))
    page = (ROOT / "README.md").read_text(encoding="utf-8")
    assert "visible single effects named in " in claims.kinds() and claims.kinds() not in page


@pytest.mark.parametrize(("hits", "of", "interval"), [(7, 17, "22 to 64"), (0, 20, "0 to 16"), (20, 20, "84 to 100")])
def test_intervals_are_wilson_s(hits: int, of: int, interval: str) -> None:
    """Wilson (1927); values of scipy's example and of Brown, Cai and DasGupta (2001)."""
    assert claims.Share(hits, of).interval == f"95 % interval {interval} %"
