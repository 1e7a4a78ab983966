"""The rooms: imports point one way, no cycle stands anywhere, and simulated machines share no code with the twin."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ALLOWED: Mapping[str, set[str]] = {
    "data": set(),
    "features": {"data"},
    "twin": {"data"},
    "models": {"data", "features", "twin"},
    "diagnosis": {"data", "twin"},
    "plants": {"data"},
    "compensation": {"data", "features", "models", "twin"},
    "reports": {"data", "features", "models", "twin", "diagnosis", "compensation"},
    "pipelines": {"data", "features", "models", "twin", "compensation", "diagnosis", "plants", "reports"},
    "thermodrift": {
        "data", "features", "models", "twin", "compensation", "diagnosis", "plants", "reports", "pipelines",
    },
}  # fmt: skip
EXAM: Mapping[str, set[str]] = {  # a distribution of its own, which no room of the product may import
    "thermodrift_exam.plants": {"data", "plants"},
    "thermodrift_rivals": {"data", "twin", "diagnosis"},  # the answering process reads it, and nothing else of exam/
    "thermodrift_exam": {
        "data", "features", "models", "twin", "diagnosis", "plants", "reports", "pipelines", "thermodrift_exam.plants",
    },
}  # fmt: skip
EVERY = {**ALLOWED, **EXAM}
FOLDERS: Mapping[str, tuple[str, ...]] = {  # a folder may use those before it
    "models": ("numerics", "families", "selection"),
    "pipelines": ("store", "jobs", "fleet", "commands"),
}
ORCHESTRATION = {"prefect", "mlflow", "typer"}
TRAINERS = {"features.levenberg_marquardt", "models.numerics.torch_training"}
PLANTS = {"plants", "thermodrift_exam.plants"}
PLANTS_MAY_USE = {"data", *PLANTS, "numpy", "scipy", "pandas", "yaml", "skfem"}
IMPORT_ALL = """
import importlib, json, sys
for name in json.load(sys.stdin):
    importlib.import_module(name)
print(json.dumps(sorted(sys.modules)))
"""


def _modules() -> dict[str, Path]:
    found = {}
    for room in EVERY:
        root = ROOT / "exam" if room in EXAM else ROOT
        for path in (root / room.partition(".")[0]).rglob("*.py"):
            name = ".".join(path.relative_to(root).with_suffix("").parts)
            found[name.removesuffix(".__init__")] = path
    return found


MODULES = _modules()


def room_of(module: str) -> str:
    """The longest name of a room that a module's begins with; else its first part."""
    rooms = [r for r in EVERY if module == r or module.startswith(f"{r}.")]
    return max(rooms, key=len, default=module.split(".")[0])


def _imported(path: Path) -> Iterator[str]:
    """Every module that a file imports, in functions and under TYPE_CHECKING too."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (a.name for a in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            for a in node.names:
                full = f"{node.module}.{a.name}"
                yield full if full in MODULES else str(node.module)


@cache
def graph() -> Mapping[str, set[str]]:
    """What each module imports; reading them all takes seconds."""
    return {name: set(_imported(path)) - {name} for name, path in MODULES.items()}


def test_a_file_imports_only_what_its_room_may() -> None:
    wrong = [
        (name, other)
        for name, others in graph().items()
        for other in others
        if (top := room_of(other)) in EVERY and top != (room := room_of(name)) and top not in EVERY[room]
    ]
    assert not wrong


def test_only_pipelines_imports_what_orchestrates_and_tracks() -> None:
    wrong = [
        (name, other)
        for name, others in graph().items()
        for other in others
        if other.split(".")[0] in ORCHESTRATION and not name.startswith(("pipelines", "thermodrift_exam.commands"))
    ]
    assert not wrong


def test_no_module_executes_text() -> None:
    """What runs at a machine is data that its digest covers, or this code."""
    for path in _modules().values():
        calls = [n.func for n in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(n, ast.Call)]
        named = {f.id for f in calls if isinstance(f, ast.Name)}
        assert not named & {"exec", "eval", "compile"}, path


def test_two_modules_import_torch() -> None:
    """Without it everything else works, see tests/thermodrift/test_without_torch.py."""
    assert {name for name, others in graph().items() if any(o.split(".")[0] == "torch" for o in others)} == TRAINERS


@pytest.mark.parametrize("room", FOLDERS)
def test_no_arrow_points_upwards_inside_a_room(room: str) -> None:
    place = {
        name: i
        for i, folder in enumerate(FOLDERS[room])
        for name in MODULES
        if f"{name}.".startswith(f"{room}.{folder}.")
    }
    assert set(place.values()) == set(range(len(FOLDERS[room])))
    assert not [(name, other) for name in place for other in graph()[name] if place.get(other, -1) > place[name]]


def test_no_cycle() -> None:
    """Repeatedly take away what imports nothing that is left; a cycle cannot be taken away."""
    left = {name: {o for o in others if o in MODULES} for name, others in graph().items()}
    while free := {name for name, others in left.items() if not others & left.keys()}:
        left = {name: others for name, others in left.items() if name not in free}
    assert not left, f"import cycles among {sorted(left)}"


@pytest.mark.parametrize("module", sorted(m for m in MODULES if room_of(m) in PLANTS))
def test_a_plant_names_nothing_of_the_twin(module: str) -> None:
    """A plant that shared code with what is examined on it would prove nothing; registries name modules in strings."""
    foreign = {room_of(o) for o in graph()[module]} - PLANTS_MAY_USE - set(sys.stdlib_module_names)
    assert not foreign
    tree = ast.parse(MODULES[module].read_text(encoding="utf-8"))
    text = {n.value for n in ast.walk(tree) if isinstance(n, ast.Constant) and isinstance(n.value, str)}
    assert not {s for s in text if ":" in s and room_of(s.partition(":")[0]) in EVERY.keys() - PLANTS}


@pytest.mark.integration
def test_a_fresh_interpreter_with_all_plants_has_nothing_of_the_twin() -> None:
    every = sorted(m for m in MODULES if room_of(m) in PLANTS)
    done = subprocess.run(
        [sys.executable, "-c", IMPORT_ALL],
        input=json.dumps(every),
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stderr
    loaded = {room_of(m) for m in json.loads(done.stdout)}
    assert loaded >= PLANTS and not loaded & (EVERY.keys() - {*PLANTS, "data", "thermodrift_exam"})
    assert not [m for m in json.loads(done.stdout) if room_of(m) == "thermodrift_exam" and m != "thermodrift_exam"]
