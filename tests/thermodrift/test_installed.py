"""The wheel: it holds what the repository's packages hold, and works without the repository."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from pipelines.cli import app
from tests.test_architecture import ALLOWED, MODULES, ROOT, room_of

ROOMS = (*sorted(ALLOWED), "machines")
ADDED = "thermodrift.commands"  # by other distributions
BUILD = "import sys; from setuptools.build_meta import build_wheel; build_wheel(sys.argv[1])"
LOADED = """
import importlib, json, sys
from pathlib import Path
for name in json.load(sys.stdin):
    module = importlib.import_module(name)
    assert sys.prefix in module.__file__, module.__file__
"""
Run = Callable[..., subprocess.CompletedProcess[str]]


def repository_files() -> list[str]:
    """What git keeps, or would keep, of the packages."""
    listed = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z", *ROOMS]
    done = subprocess.run(listed, cwd=ROOT, capture_output=True, text=True, check=True)
    return [name for name in done.stdout.split("\0") if name and (ROOT / name).is_file()]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from a copy, since a build writes next to its source."""
    folder = tmp_path_factory.mktemp("wheel")
    for name in (*repository_files(), "pyproject.toml", "README.md", "LICENSE"):
        (folder / "source" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, folder / "source" / name)
    done = subprocess.run(
        [sys.executable, "-c", BUILD, str(folder)], cwd=folder / "source", capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    (built,) = folder.glob("*.whl")
    return built


@pytest.mark.integration
def test_it_holds_every_file_of_the_packages_and_no_other(wheel: Path) -> None:
    held = {n for n in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in n}
    wanted = set(repository_files())
    assert {"machines/sample_vmc.yml", "reports/templates/page.html.j2", "reports/templates/uplot/LICENSE"} <= wanted
    assert held == wanted, "data files need a line under tool.setuptools.package-data in pyproject.toml"


@pytest.mark.integration
def test_it_has_the_command(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (n for n in archive.namelist() if n.endswith("entry_points.txt"))
        assert "thermodrift = pipelines.cli:main" in archive.read(name).decode()


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Runs a program of an environment that has the wheel and, behind it, the libraries of this one."""
    folder = tmp_path_factory.mktemp("installed")
    subprocess.run([sys.executable, "-m", "venv", str(folder / "venv")], check=True)
    pip = [folder / "venv" / "bin" / "pip", "install", "--quiet", "--no-deps", "--no-index", "--no-compile"]
    subprocess.run([*pip, str(wheel)], check=True)
    site = folder / "venv" / "lib" / f"python3.{sys.version_info[1]}" / "site-packages"
    # a folder that a .pth file names is searched, its own .pth files are not read: the repository stays out
    (site / "libraries.pth").write_text(sysconfig.get_path("purelib"), encoding="utf-8")
    (folder / "empty").mkdir()
    left = {k: v for k, v in os.environ.items() if not k.startswith(("THERMODRIFT", "PYTHON", "MLFLOW", "PREFECT"))}

    def run(program: str, *arguments: str, given: str = "") -> subprocess.CompletedProcess[str]:
        command = [str(folder / "venv" / "bin" / program), *arguments]
        done = subprocess.run(
            command, input=given, capture_output=True, text=True, check=False, cwd=folder / "empty",
            env={**left, "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"},
        )  # fmt: skip
        assert done.returncode == 0, f"{command}: {done.stdout[-1000:]}{done.stderr[-2000:]}"
        return done

    return run


@pytest.mark.slow
def test_every_command_has_help(installed: Run) -> None:
    own = [c for c in app.registered_commands if c.callback and c.callback.__module__.startswith("pipelines.")]
    groups = [g.name for g in app.registered_groups if g.name not in {e.name for e in entry_points(group=ADDED)}]
    commands = [c.name or str(c.callback.__name__) for c in own if c.callback]
    assert len(commands) > 15 and "lake" in groups
    for name in [*groups, *commands]:
        assert "Usage: thermodrift" in installed("thermodrift", name, "--help").stdout


@pytest.mark.slow
def test_every_module_loads_from_the_wheel(installed: Run) -> None:
    installed("python", "-c", LOADED, given=json.dumps(sorted(m for m in MODULES if room_of(m) in ALLOWED)))


@pytest.mark.slow
def test_the_sample_year_trains_and_predicts_from_an_empty_folder(installed: Run) -> None:
    installed("thermodrift", "simulate", "--sample-year", "--out", "year")
    installed(
        "thermodrift", "train", "--machine", "year/sample_vmc.yml", "--recordings", "year", "--channels", "z",
        "--selectors", "correlation", "--families", "zero,mean_curve,mlr", "--direct",
    )  # fmt: skip
    assert "sample_vmc-z/1 champion" in installed("thermodrift", "status").stdout
    first = installed("python", "-c", "from pathlib import Path; print(min(Path('year').glob('*.csv')))").stdout.strip()
    predicted = installed("thermodrift", "predict", first, "--model", "models:/sample_vmc-z@champion").stdout
    assert "predicted_um" in predicted.splitlines()[0] and len(predicted.splitlines()) > 50
