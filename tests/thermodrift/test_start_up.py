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


def loaded(code: str, folder: Path, whole: bool = False) -> set[str]:
    """The top-level modules of a process after `code`, whose last line prints them; `whole` adds those below."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=folder, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    names = json.loads(done.stdout.splitlines()[-1])
    return {name.split(".")[0] for name in names} | set(names if whole else ())


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


COMMAND = """
import sys, json
sys.argv = ["thermodrift", *{given}]
from pipelines.cli import main
try:
    main()
except SystemExit as ended:
    assert ended.code == {code}, ended.code
print()
print(json.dumps(sorted(sys.modules)))
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with six recordings, their machine file and a model."""
    folder = tmp_path_factory.mktemp("place")
    write_year(folder / "runs", 6)
    machine = write_machine(folder / "m.yml", "small")
    batches = td.read(folder / "runs", machine)
    ridge = td.FAMILIES["ridge"]().fit(batches, ("front", "bed"), "z")
    td.save_model(ridge, batches, machine, folder / "model")
    return folder


RUN, SAMPLE = "runs/20250114.csv", str(Path(td.__file__).parents[1] / "machines" / "sample_vmc.yml")


@pytest.mark.parametrize(
    ("given", "code"),
    [
        (["describe", RUN], 0),
        (["describe", "--twin", SAMPLE], 0),
        (["predict", RUN, "--model", "model"], 0),
        (["predict", RUN, "--model", "nowhere"], 2),
        (["predict", "runs/none.csv", "--model", "model"], 2),
        (["describe", "runs/none.csv"], 2),
        (["ingest", "--machine", "m.yml", "runs/none.csv"], 2),
        (["train", "--machine", "none.yml"], 2),
    ],
    ids=lambda v: " ".join(Path(a).name for a in v) if isinstance(v, list) else "",
)
def test_what_reads_a_file_loads_what_tables_need(given: list[str], code: int, place: Path) -> None:
    names = loaded(COMMAND.format(given=given, code=code), place, whole=True)
    heavy = names & (HEAVY - TABLES | SLOW_SCIPY)
    assert "pandas" in names and not heavy, sorted(heavy)


def test_a_wrong_option_is_refused_without_tables(tmp_path: Path) -> None:
    names = loaded(COMMAND.format(given=["predict", "--modle", "x"], code=2), tmp_path)
    assert names >= OUTPUT and not names & (HEAVY - {"pydantic"})
