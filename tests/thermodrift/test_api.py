"""The public API as a notebook uses it: recordings to a prediction, a calibration and a diagnosis."""

from __future__ import annotations

import copy
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

import thermodrift as td
from data.errors import InputError
from tests.toys.small_year import law_um, write_machine, write_year
from tests.twin.machines import TWO_BODIES
from tests.twin.recordings import empty_batches, recorded
from twin.compile import compile_network


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, copied_stores: None) -> Iterator[Path]:
    """An empty working directory."""
    folder = tmp_path_factory.mktemp("notebook")
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("THERMODRIFT_HOME", raising=False)
        patch.chdir(folder)
        yield folder


@pytest.fixture(scope="module")
def two(folder: Path) -> Path:
    """A machine file whose belt loses less power than the machine's, and recordings of the machine next to it."""
    raw = copy.deepcopy(TWO_BODIES)
    raw["recording"] = {"step_s": 300, "files": ["*.csv"]}
    (folder / "two.yml").write_text(yaml.safe_dump(raw), encoding="utf-8")
    machine = td.load_machine("two.yml")
    network = compile_network(machine)
    truth = np.array(network.values)
    truth[network.index("mechanisms.belt.power")] *= 1.3
    (folder / "runs").mkdir()
    for batch in recorded(machine, empty_batches(machine, 3), truth, seed=1):
        batch.table.to_csv(folder / "runs" / f"{batch.batch_id}.csv", index=False)
    return folder / "two.yml"


def test_recordings_become_a_promoted_model_and_a_prediction(folder: Path) -> None:
    machine, files = write_machine(folder / "small.yml", "small"), write_year(folder / "in")
    plan = td.Plan(("none",), ("zero", "ridge"), ("leave-batch-out",))
    outcome = td.train(machine, "in", channels=["z"], plan=plan)
    predicted = td.predict("models:/small-z@champion", files[0])
    assert outcome.promotions["z"].outcome == "champion" and outcome.report is not None
    assert outcome.report.is_relative_to(folder / "var")
    assert np.abs(predicted["predicted_um"] - law_um(pd.read_csv(files[0]))).max() < 1.5
    (first, *_) = td.read(files[0], machine)
    again = td.predict(td.load_model("models:/small-z@champion"), first)
    np.testing.assert_allclose(again["predicted_um"], predicted["predicted_um"])
    assert {r.status for r in td.ingest("in", machine).rows} == {"unchanged"}
    assert td.Lake(folder / "var" / "lake").batch_ids("small") == [f.stem for f in files]


def test_a_crossing_stores_nothing_and_is_ranked(folder: Path) -> None:
    machine, _ = write_machine(folder / "small.yml", "small"), write_year(folder / "in")
    batches = td.read("in", machine)
    before = sorted(folder.rglob("*"))
    plan = td.Plan(("none", "correlation"), ("zero", "ridge"), ("leave-batch-out",), (2,))
    crossed = td.cross(batches, machine, channels=["z"], plan=plan)
    assert list(crossed) == ["z"] and sorted(folder.rglob("*")) == before
    board = td.leaderboard(crossed["z"])
    assert list(board["family"]) == ["ridge", "zero"] and board["score_um"].is_monotonic_increasing
    assert board["S_mean_um"][0] < board["S_mean_um"][1] and set(board["protocol"]) == {"leave-batch-out"}
    alone = td.leaderboard(crossed["z"], "leave-batch-out")  # counts 1 a run there, and the families' records less
    pd.testing.assert_frame_equal(alone.drop(columns="score_um"), board.drop(columns="score_um"))
    with pytest.raises(InputError, match="unknown protocol 'forwards': did you mean 'forward'"):
        td.leaderboard(crossed["z"], "forwards")
    with pytest.raises(InputError, match="expected one of its protocols forward;"):
        td.leaderboard(crossed["z"], "forward")
    with pytest.raises(InputError, match="no error channel 'w'"):
        td.cross(batches, machine, channels=["w"], plan=plan)


def test_a_fitted_family_becomes_a_model_folder(folder: Path) -> None:
    machine, files = write_machine(folder / "small.yml", "small"), write_year(folder / "in")
    batches = td.read("in", machine)
    points = td.SELECTORS["correlation"]().select(batches[:-1], "z", n_tsp=2)
    ridge = td.FAMILIES["ridge"]().fit(batches[:-1], points, "z")
    stored = td.save_model(ridge, batches[:-1], machine, folder / "by_hand")
    predicted = td.predict(folder / "by_hand", files[-1])
    np.testing.assert_allclose(predicted["predicted_um"], ridge.predict(batches[-1]), rtol=1e-6, atol=1e-6)
    assert stored.family.key == "ridge" and predicted["expected_S_um"].isna().all()
    assert td.rehearse(folder / "by_hand", [files[-1]]).band_um("z")
    assert td.export(folder / "by_hand", "json", out=folder / "exported")
    with pytest.raises(InputError, match="by_hand: is not empty; give a new one"):
        td.save_model(ridge, batches, machine, folder / "by_hand")


def test_the_sample_year_is_written_with_its_machine_file(tmp_path: Path) -> None:
    machine, files = td.sample_year(tmp_path / "year", seed=3)
    assert len(files) == 30 and machine.parent == files[0].parent == tmp_path / "year"
    (first, *_) = td.read(files[:1], machine)
    assert first.simulated
    machine.write_text(machine.read_text() + "# edited\n")
    td.sample_year(tmp_path / "year", seed=3)
    assert machine.read_text().endswith("# edited\n")


@pytest.mark.slow
def test_recordings_become_a_diagnosis(two: Path) -> None:
    batches = td.read("runs", two)
    found = td.diagnose(two, batches, out="diagnosis")
    assert found.findings.verdict == "consistent" and found.findings.batches == ("b00", "b01", "b02")
    assert {"findings.json", "report.html"} <= {p.name for p in Path("diagnosis").iterdir()}
    with pytest.raises(InputError, match=r"findings\.json exists; give another --out"):
        td.diagnose(two, batches, out="diagnosis")
    with pytest.raises(InputError, match="with `out` give the path of the machine file"):
        td.diagnose(td.load_machine(two), batches, out="other")


def test_recordings_become_a_calibrated_machine_file_that_simulates(two: Path) -> None:
    found = td.calibrate(two, td.read(["runs/b00.csv", "runs/b01.csv", "runs/b02.csv"], two), out="calibrated.yml")
    network = compile_network(td.load_machine("calibrated.yml"))
    assert network.parameters[network.index("mechanisms.belt.power")].value == pytest.approx(156.0, rel=0.05)
    assert found.left_out is None
    Path("plan.yml").write_text("stages: [{hours: 1, rpm: 3000}]\nsurroundings: {room: 21 degC}\n", encoding="utf-8")
    before, after = (td.simulate(m, "plan.yml", step_s=60.0).batch for m in (td.load_machine(two), "calibrated.yml"))
    assert after.simulated and after.n_rows == 61
    assert after.values("t_shaft")[-1] > before.values("t_shaft")[-1]


def test_names_are_listed_and_load_at_first_use(tmp_path: Path) -> None:
    assert {"ridge", "zero"} <= set(td.FAMILIES) and "none" in td.SELECTORS and "belt_loss" in td.MECHANISMS
    assert set(td.__all__) <= set(dir(td)) and td.__version__
    with pytest.raises(AttributeError, match=r"module 'thermodrift' has no attribute 'trian'; it has .*train"):
        _ = td.trian
    code = "import sys, thermodrift; print({'numpy', 'pandas', 'typer', 'data.machine'} & set(sys.modules))"
    assert imported(code, tmp_path).stdout.strip() == "set()"


def imported(code: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Python code in a process of its own that runs in a folder."""
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=folder, check=False)


@pytest.mark.parametrize("code", ["import thermodrift", "import data, thermodrift"])
@pytest.mark.parametrize("name", ["data.py", "data/__init__.py"])
def test_a_module_of_the_user_with_a_rooms_name_is_refused_in_one_line(name: str, code: str, tmp_path: Path) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("", encoding="utf-8")
    done = imported(code, tmp_path)
    line = done.stderr.strip().splitlines()[-1]
    assert done.returncode == 1 and line.startswith(f"ImportError: thermodrift: 'data' is {tmp_path / name}, expected")
    assert line.endswith("data/__init__.py; rename that file or folder, or start Python in another folder")


def test_a_folder_of_recordings_with_a_rooms_name_is_harmless(tmp_path: Path) -> None:
    for name in ("data", "models", "diagnosis"):
        (tmp_path / name).mkdir()
    done = imported("import thermodrift as td; print(td.Lake.__module__)", tmp_path)
    assert (done.returncode, done.stdout.strip()) == (0, "data.lake"), done.stderr
