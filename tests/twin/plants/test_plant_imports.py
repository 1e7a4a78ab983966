"""A plant that shared code with what is examined on it would prove nothing: what all of `twin.plants` imports."""

from __future__ import annotations

import ast
import json
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import twin.plants

PLANTS = "twin.plants"
FOLDER = Path(twin.plants.__file__).parent
OUTSIDE = {"data", "numpy", "scipy", "pandas", "yaml", "skfem"}
OWN = {"data", "features", "models", "twin", "pipelines"}
MODULES = sorted(m.name for m in pkgutil.walk_packages(twin.plants.__path__, f"{PLANTS}."))
IMPORT_ALL = """
import importlib, json, sys
for name in json.load(sys.stdin):
    importlib.import_module(name)
print(json.dumps(sorted(sys.modules)))
"""


def _file(module: str) -> Path:
    path = FOLDER.joinpath(*module.split(".")[2:])
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def _imported(tree: ast.AST) -> set[str]:
    """Every module that is named anywhere in a file, in functions too."""
    out = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            out |= {a.name for a in node.names}
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            out |= {f"{node.module}.{a.name}" for a in node.names}
    return out


def _foreign(name: str) -> bool:
    top = name.split(".")[0]
    if top == "twin":
        return not (name == PLANTS or name.startswith(f"{PLANTS}."))
    return top not in OUTSIDE | set(sys.stdlib_module_names)


def test_the_modules_are_all_found() -> None:
    assert {_file(m) for m in MODULES} == set(FOLDER.rglob("*.py")) - {FOLDER / "__init__.py"}
    assert f"{PLANTS}.volumes.solver" in MODULES


@pytest.mark.parametrize("module", MODULES)
def test_a_file_names_nothing_of_the_twin(module: str) -> None:
    tree = ast.parse(_file(module).read_text(encoding="utf-8"))
    assert not {n for n in _imported(tree) if _foreign(n)}
    said = {n.value for n in ast.walk(tree) if isinstance(n, ast.Constant) and isinstance(n.value, str)}
    by_name = {s for s in said if s.startswith(tuple(f"{own}." for own in OWN)) and ":" in s}  # registries
    assert all(s.startswith(f"{PLANTS}.") for s in by_name)


def test_a_fresh_interpreter_with_all_plants_has_nothing_of_the_twin() -> None:
    done = subprocess.run(
        [sys.executable, "-c", IMPORT_ALL], input=json.dumps(MODULES), capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    loaded = {m for m in json.loads(done.stdout) if m.split(".")[0] in OWN - {"data"}}
    assert f"{PLANTS}.volumes.solver" in loaded
    assert {m for m in loaded if m != "twin" and _foreign(m)} == set()
