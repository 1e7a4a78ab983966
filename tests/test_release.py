"""One version everywhere: package, installation, citation and changelog; other packages have one in one lock file."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

import thermodrift as td

ROOT = Path(__file__).parents[1]
HEADING = re.compile(r"^## \[([^\]]+)\](?: - (\d{4}-\d{2}-\d{2}))?$", re.MULTILINE)


def project(folder: Path = ROOT) -> dict[str, Any]:
    found: dict[str, Any] = tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return found


def project_version() -> str:
    return str(project()["version"])


def names(requirements: list[str]) -> list[str]:
    """Names of packages as an index spells them, without thermodrift itself."""
    plain = (re.sub(r"[-_.]+", "-", re.split(r"[^\w.-]", r)[0]).lower() for r in requirements)
    return [n for n in plain if n != "thermodrift"]


def locked(file: str) -> list[str]:
    return names([line for line in (ROOT / file).read_text(encoding="utf-8").splitlines() if "==" in line])


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


def test_every_dependency_has_its_version_in_one_lock_file() -> None:
    run, dev = locked("requirements.lock"), locked("requirements-dev.lock")
    assert len({*run, *dev}) == len(run) + len(dev)
    extras = [r for extra in project()["optional-dependencies"].values() for r in extra]
    assert not {*names(project()["dependencies"]), "setuptools", "uv"} - {*run}
    assert not {*names(extras), *names(project(ROOT / "exam")["dependencies"])} - {*run, *dev}
    assert not {"asyncua", "onnxruntime", "pytest", "scikit-fem"} & {*run}
