"""Without torch everything but the training of nets works, and what needs it says so in one line."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from data.errors import InputError
from data.registry import check_packages, packages_reason
from models.selection.crossing import Plan
from tests.toys.small_year import write_machine, write_year

ROOT = Path(__file__).parents[2]
HIDDEN = """
from importlib.machinery import PathFinder
find = PathFinder.find_spec
PathFinder.find_spec = lambda name, *rest: None if name.partition(".")[0] == "torch" else find(name, *rest)
"""
GRID = """
import json
from dataclasses import replace
from pathlib import Path
import thermodrift as td
from data.errors import InputError
from data.recording import read_batches
from models.selection.grid import run_grid

def refusal(do):
    try:
        do()
    except InputError as error:
        return str(error)

machine = td.load_machine("small.yml")
batches = [b for f in sorted(Path("in").iterdir()) for b in read_batches(f, machine)]
usual = td.Plan(effort="usual").suited(machine, [machine.channel("z")])
quick = td.Plan(("none",), effort="complete", protocols=("leave-batch-out",), n_tsps=(1,)).suited(machine)
few = tuple(f for f in quick.families if f in ("zero", "ridge"))
_, result = run_grid(batches, ["z"], replace(quick, families=few), machine)["z"]
print(json.dumps({
    "usual": usual.families, "left_out": usual.left_out, "excluded": result.excluded.to_dict("records"),
    "cells": sorted(set(result.cells["family"])),
    "named": refusal(lambda: td.Plan(families=("ridge", "lstm")).suited(machine)),
    "selector": refusal(lambda: td.Plan(("main_factor_bp",)).suited(machine)),
    "fits": {k: refusal(lambda: td.FAMILIES[k]().fit(batches[:4], ("front",), "z")) for k in ("bp", "gru")},
}))
"""


def without_torch(folder: Path, *command: str) -> subprocess.CompletedProcess[str]:
    """A Python command in `folder`, in which torch cannot be found, nor in the processes that it starts."""
    (folder / "hidden").mkdir(exist_ok=True)
    (folder / "hidden" / "sitecustomize.py").write_text(HIDDEN, encoding="utf-8")
    return subprocess.run(
        [sys.executable, *command], capture_output=True, text=True, cwd=folder, check=False,
        env={**os.environ, "PYTHONPATH": f"{folder / 'hidden'}:{ROOT}", "THERMODRIFT_HOME": str(folder / "home")},
    )  # fmt: skip


@pytest.mark.integration
def test_a_grid_runs_without_what_needs_torch(tmp_path: Path) -> None:
    write_machine(tmp_path / "small.yml", "small")
    write_year(tmp_path / "in")
    done = without_torch(tmp_path, "-c", GRID)
    assert done.returncode == 0, done.stderr[-2000:]
    got = json.loads(done.stdout.splitlines()[-1])
    reason = "family bp needs torch, not installed; install it (pip install torch)"
    assert got["cells"] == ["ridge", "zero"] and "bp" not in got["usual"] and "ridge" in got["usual"]
    assert ["family bp", reason] in got["left_out"]
    assert {"channel": "family bp", "reason": reason} in got["excluded"]
    assert got["named"] == f"{reason.replace('bp', 'lstm')}, or leave the family out"
    assert got["selector"].startswith("selector main_factor_bp needs torch, not installed;")
    assert got["fits"] == {key: got["named"].replace("lstm", key) for key in ("bp", "gru")}


def test_a_package_that_is_missing_is_named() -> None:
    class Odd:
        key = "odd"
        packages = ("numpy", "no_such_package")

    assert packages_reason("family", Odd) == (
        "family odd needs no_such_package, not installed; install it (pip install no_such_package)"
    )
    with pytest.raises(InputError, match=r"or leave the selector out$"):
        check_packages("selector", Odd())


def test_with_torch_nothing_is_left_out() -> None:
    assert Plan(effort="complete").suited(None).left_out == ()


@pytest.mark.slow
def test_train_promotes_and_predicts(tmp_path: Path) -> None:
    machine, files = write_machine(tmp_path / "small.yml", "small"), write_year(tmp_path / "in")
    train = ("train", "--machine", str(machine), "--recordings", "in", "--channels", "z", "--direct")
    predict = ("predict", str(files[0]), "--model", "models:/small-z@provisional", "--out", "out.csv")
    for command in (train, predict):
        done = without_torch(tmp_path, "-m", "pipelines.cli", *command)
        assert done.returncode == 0, done.stderr[-2000:]
    assert len((tmp_path / "out.csv").read_text().splitlines()) > 10
