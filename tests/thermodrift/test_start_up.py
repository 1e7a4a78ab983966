"""Start-up imports little: by the package, by `thermodrift --help` or the help of a command no heavy library, by a
refusal and by commands that read a file only what that takes."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

import thermodrift as td
from tests.toys.small_year import write_machine, write_year

pytestmark = pytest.mark.integration
HEAVY = {
    "asyncua", "distributed", "fastapi", "jinja2", "matplotlib", "mlflow", "multiprocessing", "numpy", "onnx",
    "openpyxl", "pandas", "paho", "pint", "prefect", "psycopg", "pyarrow", "pydantic", "ruamel", "scipy", "skfem",
    "sklearn", "sqlalchemy", "torch", "yaml",
}  # fmt: skip
TABLES = {
    "jinja2", "multiprocessing", "numpy", "pandas", "pint", "pyarrow", "pydantic", "ruamel", "scipy", "yaml",
}  # fmt: skip
SLOW_SCIPY = {"scipy.interpolate", "scipy.optimize", "scipy.signal", "scipy.stats"}
OUTPUT = {"rich", "typer"}
SHOW = "print(json.dumps(sorted(sys.modules)))"
HELP = f"""
import sys, json
from typer.testing import CliRunner
from pipelines.cli import app
done = CliRunner().invoke(app, ["--help"])
assert done.exit_code == 0
{SHOW}
import typer
tree = [((), typer.main.get_command(app))]
for path, command in tree:
    tree += [((*path, name), below) for name, below in getattr(command, "commands", {{}}).items()]
    done = CliRunner().invoke(app, [*path, "--help"])
    assert done.exit_code == 0 and "Usage: " in done.output, (path, done.output)
    assert path != ("train",) or "--direct" in done.output
assert len(tree) > 20
{SHOW}
"""


def loaded(code: str, folder: Path) -> list[set[str]]:
    """All modules of a process each time that `code` prints them."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=folder, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return [set(json.loads(line)) for line in done.stdout.splitlines() if line.startswith('["')]


def top(names: set[str]) -> set[str]:
    """The packages that they belong to."""
    return {name.partition(".")[0] for name in names}


def test_import_thermodrift_loads_the_standard_library_alone(tmp_path: Path) -> None:
    (names,) = map(top, loaded(f"import thermodrift, json, sys; {SHOW}", tmp_path))
    assert "thermodrift" in names and not names & (HEAVY | OUTPUT | {"data", "models", "pipelines"})


def test_help_loads_what_prints_it(tmp_path: Path) -> None:
    """Of the program, then of every command: typer reads the options of one with pydantic."""
    own, every = map(top, loaded(HELP, tmp_path))
    for names, heavy in ((own, own & HEAVY), (every, every & (HEAVY - {"pydantic"}))):
        assert names >= OUTPUT and not heavy, sorted(heavy)


def test_what_status_and_predict_need_loads_no_large_part_of_scipy(tmp_path: Path) -> None:
    selection = ", ".join(f"models.selection.{m}" for m in ("promotion", "trust", "updating"))
    used = f"data.recording, features.design, {selection}, models.numerics.lags"
    (names,) = loaded(f"import {used}, json, sys; {SHOW}", tmp_path)
    assert not (names | top(names)) & {"scipy.signal", "scipy.stats", "scipy.optimize", "sklearn", "torch", "twin"}


RUN, SAMPLE = "runs/20250114.csv", str(Path(td.__file__).parents[1] / "machines" / "sample_vmc.yml")
REFUSED = (["predict", "--modle", "x"], 2)
READING = [
    (["describe", RUN], 0),
    (["describe", "--twin", SAMPLE], 0),
    (["predict", RUN, "--model", "model"], 0),
    (["predict", RUN, "--model", "nowhere"], 2),
    (["predict", "runs/none.csv", "--model", "model"], 2),
    (["describe", "runs/none.csv"], 2),
    (["ingest", "--machine", "m.yml", "runs/none.csv"], 2),
    (["train", "--machine", "none.yml"], 2),
]
COMMANDS = f"""
import sys, json
from pipelines.cli import main
for given, code in {[REFUSED, *READING]}:
    sys.argv = ["thermodrift", *given]
    try:
        main()
    except SystemExit as ended:
        assert ended.code == code, (given, ended.code)
    print()
    {SHOW}
"""


@pytest.fixture(scope="module")
def after(tmp_path_factory: pytest.TempPathFactory) -> list[set[str]]:
    """The modules after each of the commands, which run one after the other in a process.

    In a folder with six recordings, their machine file and a model.
    """
    folder = tmp_path_factory.mktemp("place")
    write_year(folder / "runs", 6)
    machine = write_machine(folder / "m.yml", "small")
    batches = td.read(folder / "runs", machine)
    ridge = td.FAMILIES["ridge"]().fit(batches, ("front", "bed"), "z")
    td.save_model(ridge, batches, machine, folder / "model")
    return loaded(COMMANDS, folder)


def test_a_wrong_option_is_refused_without_tables(after: list[set[str]]) -> None:
    names = top(after[0])
    assert names >= OUTPUT and not names & (HEAVY - {"pydantic"})


@pytest.mark.parametrize("place", range(len(READING)), ids=[" ".join(Path(a).name for a in g) for g, _ in READING])
def test_what_reads_a_file_loads_what_tables_need(place: int, after: list[set[str]]) -> None:
    assert len(after) == 1 + len(READING)
    before, names = after[place], after[place + 1]
    new = names - before
    heavy = (new | top(names) - top(before)) & (HEAVY - TABLES | SLOW_SCIPY)
    assert "pandas" in names and not heavy, sorted(heavy)
