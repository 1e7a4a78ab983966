"""Start-up imports little: no heavy library by the package, by `thermodrift --help`, or by the help of a command."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

HEAVY = {
    "asyncua", "distributed", "fastapi", "jinja2", "matplotlib", "mlflow", "multiprocessing", "numpy", "onnx",
    "openpyxl", "pandas", "paho", "pint", "prefect", "psycopg", "pyarrow", "pydantic", "ruamel", "scipy", "skfem",
    "sklearn", "sqlalchemy", "torch", "yaml",
}  # fmt: skip
OUTPUT = {"rich", "typer"}
HELP = """
import sys, json
from typer.testing import CliRunner
from pipelines.cli import app
group = {group}
done = CliRunner().invoke(app, ["--help"])
assert done.exit_code == 0
if group:
    import typer
    tree = [((), typer.main.get_command(app))]
    for path, command in tree:
        tree += [((*path, name), below) for name, below in getattr(command, "commands", {{}}).items()]
        done = CliRunner().invoke(app, [*path, "--help"])
        assert done.exit_code == 0 and "Usage: " in done.output, (path, done.output)
        assert path != ("train",) or "--direct" in done.output
    assert len(tree) > 25
print(json.dumps(sorted(sys.modules)))
"""


def loaded(code: str, folder: Path) -> set[str]:
    """The top-level modules of a process after `code`, whose last line prints them."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=folder, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return {name.split(".")[0] for name in json.loads(done.stdout.splitlines()[-1])}


def test_import_thermodrift_loads_the_standard_library_alone(tmp_path: Path) -> None:
    names = loaded("import thermodrift, json, sys; print(json.dumps(sorted(sys.modules)))", tmp_path)
    assert "thermodrift" in names and not names & (HEAVY | OUTPUT | {"data", "models", "pipelines"})


@pytest.mark.parametrize("every", [False, True], ids=["thermodrift", "every command"])
def test_help_loads_what_prints_it(every: bool, tmp_path: Path) -> None:
    names = loaded(HELP.format(group=every), tmp_path)
    heavy = names & (HEAVY - {"pydantic"} if every else HEAVY)  # typer reads the options of a command with pydantic
    assert names >= OUTPUT and not heavy, sorted(heavy)


def test_what_status_and_predict_need_loads_no_large_part_of_scipy(tmp_path: Path) -> None:
    selection = ", ".join(f"models.selection.{m}" for m in ("promotion", "trust", "updating"))
    used = f"data.recording, features.design, {selection}, models.numerics.lags"
    code = f"import {used}, json, sys; print(json.dumps([m.replace('scipy.', 'scipy_') for m in sys.modules]))"
    assert not loaded(code, tmp_path) & {"scipy_signal", "scipy_stats", "scipy_optimize", "sklearn", "torch", "twin"}
