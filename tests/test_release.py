"""One version everywhere: package, installation, citation and changelog."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from ruamel.yaml import YAML

import thermodrift as td

ROOT = Path(__file__).parents[1]
HEADING = re.compile(r"^## \[([^\]]+)\](?: - (\d{4}-\d{2}-\d{2}))?$", re.MULTILINE)


def project_version() -> str:
    return str(tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"])


def test_package_citation_and_changelog_state_the_same_version() -> None:
    version = project_version()
    citation = YAML(typ="safe").load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    headings = HEADING.findall((ROOT / "CHANGELOG.md").read_text(encoding="utf-8"))
    assert citation["version"] == version
    assert headings[0] == ("Unreleased", "") and headings[1] == (version, str(citation["date-released"]))


def test_the_installed_package_has_the_version_of_its_sources() -> None:
    assert td.__version__ == project_version(), "the installation is older than pyproject.toml; call: pip install -e ."


def test_releases_stand_from_the_newest_to_the_oldest() -> None:
    _, *releases = HEADING.findall((ROOT / "CHANGELOG.md").read_text(encoding="utf-8"))
    numbers = [tuple(map(int, version.split("."))) for version, _ in releases]
    assert numbers == sorted(numbers, reverse=True) and all(day for _, day in releases)
