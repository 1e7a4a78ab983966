"""A home that is full, cannot be written, is used twice at once, or has moved: one line, and nothing torn."""

from __future__ import annotations

import errno
import os
import resource
import shutil
import sqlite3
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from time import sleep
from typing import Any

import mlflow
import pytest
from mlflow.tracking import MlflowClient

from data.errors import WorkError
from models.selection.crossing import Plan
from models.selection.promotion import choose
from pipelines.caller import DirectCaller
from pipelines.jobs.request import TrainRequest
from pipelines.jobs.training import train
from pipelines.settings import NamesPart, Settings
from pipelines.store import checkpoint, database, model_store, registry, tracking
from tests.toys.command import in_process
from tests.toys.small_year import write_machine, write_year
from tests.toys.tracked import log_training
from tests.toys.training import machine_yaml, toy_batches, toy_model, toy_result

S_UM = {"none|zero|0": [50.0, 51.0, 52.0], "none|mlr|2": [1.0, 2.0, 1.5]}
OPEN = """
import sys
from data.errors import WorkError
from pipelines import settings
from pipelines.store import tracking
try:
    tracking.open_store(settings.load())
except WorkError as error:
    sys.exit(str(error))
"""


def full(*_: object, **__: object) -> Any:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.slow
def test_a_disk_that_is_full_while_the_store_is_made_leaves_nothing(tmp_path: Path, store: Any) -> None:
    """A process that may write no file above 100 kB gets the errors of a full disk."""
    environment = {**os.environ, "THERMODRIFT_HOME": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", OPEN], env=environment, cwd=Path(__file__).parents[2], capture_output=True, text=True,
        check=False, preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000)),
    )  # fmt: skip
    assert done.returncode == 1 and done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith(f"tracking store sqlite:///{tmp_path / 'mlflow.db'}: (sqlite3.OperationalError) ")
    assert [p.name for p in tmp_path.iterdir()] == ["mlflow.db.lock"]
    file = tmp_path / "mlflow.db"
    database.make(file, lambda made: shutil.copy(store.store_file, made))  # the next run
    assert database.is_made(file)


def test_two_first_uses_make_one_store(tmp_path: Path) -> None:
    made: list[Path] = []

    def fill(file: Path) -> None:
        made.append(file)
        sleep(0.3)
        with sqlite3.connect(file) as db:
            db.execute("create table alembic_version (version_num text)")

    with ThreadPoolExecutor() as pool:
        list(pool.map(lambda _: database.make(tmp_path / "mlflow.db", fill), range(3)))
    assert len(made) == 1 and database.is_made(tmp_path / "mlflow.db")


@pytest.mark.parametrize("left", ["", "create table runs (run_uuid text)"])
def test_what_an_interrupted_first_use_left_is_made_anew(left: str, tmp_path: Path) -> None:
    """An empty file, or MLflow's first tables without a version, which it cannot go on with."""
    file = tmp_path / "mlflow.db"
    file.touch()
    with sqlite3.connect(file) as db:
        db.executescript(left)
    scratch = tmp_path / ".making-killed"
    scratch.mkdir()
    assert not database.is_made(file)
    database.make(file, lambda made: made.write_bytes(b"whole"))
    assert file.read_bytes() == b"whole" and not scratch.exists()
    with sqlite3.connect(tmp_path / "old.db") as db:  # of an old MLflow, with runs: MLflow reports it
        db.executescript("create table runs (run_uuid text); insert into runs values ('1')")
    assert database.is_made(tmp_path / "old.db")


def test_a_home_that_cannot_be_written_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("THERMODRIFT_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("PREFECT_HOME", "")

    def refuse(self: Path, *_: object, **__: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(self))

    monkeypatch.setattr(Path, "mkdir", refuse)
    done = in_process(monkeypatch, capsys)("train", "--machine", write_machine(tmp_path / "m.yml", "small-rofs"))
    assert (done.code, done.out) == (1, "")
    assert done.err == (
        f"thermodrift: {tmp_path / 'home' / 'prefect'}: Read-only file system; make it writable or let "
        "THERMODRIFT_HOME name another folder, then run the same command again\n"
    )
    with pytest.raises(WorkError, match=r"home: cannot be written or read \(Read-only file system\)"):
        tracking.open_store(Settings(tmp_path, f"sqlite:///{tmp_path}/home/mlflow.db", None, NamesPart(), None))


def test_a_disk_that_is_full_while_a_training_is_tracked_is_one_line(
    store: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(MlflowClient, "log_artifacts", full)
    with pytest.raises(WorkError, match=r"artifacts: cannot be written or read \(No space left on device\)$"):
        log_training(toy_result(toy_batches("toy-full", 3), S_UM), store)
    assert tracking.trainings("toy-full", None, store).empty


@pytest.mark.slow
@pytest.mark.parametrize("where", ["crossing", "artifacts", "report"])
def test_a_disk_that_is_full_at_a_step_keeps_the_crossing(
    where: str, store: Any, store_home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("THERMODRIFT_HOME", str(store_home))
    name = f"small-full-{where}"
    machine, _ = write_machine(tmp_path / "m.yml", name), write_year(tmp_path / "in", 4)
    request = TrainRequest(
        machine,
        (tmp_path / "in",),
        ("z",),
        Plan(("none",), ("zero", "ridge"), ("leave-batch-out",)),
        promote=False,
        workers=1,
    )
    point = {
        "crossing": (checkpoint, "_write"), "artifacts": (MlflowClient, "log_artifacts"),
        "report": (tracking, "attach"),
    }[where]  # fmt: skip
    with monkeypatch.context() as patch, pytest.raises(WorkError) as caught:
        patch.setattr(*point, full)
        train(request, store, DirectCaller())
    kept = 0 if where == "crossing" else 2
    assert "No space left on device" in str(caught.value)
    assert f"; {kept} finished parts of the crossing kept in " in str(caught.value)
    assert not list((store_home / "unfinished").glob("*/.writing-*"))
    said: list[str] = []
    outcome = train(request, store, DirectCaller(), said.append)
    assert any(line.startswith("resumes: 2 finished parts") for line in said) == (kept == 2)
    assert tracking.trainings(name, None, store)["training_id"].tolist() == [outcome.training_ids["z"]]


def test_a_home_that_moved_or_was_copied_has_its_files(store: Any, tmp_path: Path) -> None:
    """Runs, models and new runs: all in the home that is used, also while the one that it is a copy of is there."""
    first = at_home(store, tmp_path / "first")
    database.make(first.store_file, lambda made: shutil.copy(store.store_file, made))
    batches = toy_batches("toy_moved-50", 3)
    result = toy_result(batches, S_UM)
    training_id = log_training(result, first)
    model, region = toy_model(batches)
    new = registry.Newcomer(
        result, choose(result, first.promotion), model, machine_yaml("toy-moved"), training_id, region
    )
    promoted = registry.promote(new, first, force=True)

    shutil.copytree(tmp_path / "first", tmp_path / "second")
    shutil.move(tmp_path / "first", tmp_path / "third")
    for name in ("second", "third"):
        moved, said = at_home(store, tmp_path / name), []
        tracking.open_store(moved, said.append)
        assert said == [f"the home has moved: addresses in the tracking store now lead to {moved.artifacts_uri}"]
        assert tracking.load_training(training_id, moved).result.batches.equals(result.batches)
        folder = Path(registry.local_folder(promoted.model_uri, moved))
        assert folder.is_relative_to(tmp_path / name) and model_store.load(folder)
        later = log_training(result, moved)
        assert list((tmp_path / name / "artifacts").rglob(f"{later}/artifacts/grid/result.json"))
        tracking.open_store(moved, said.append)
        assert len(said) == 1
    mlflow.set_tracking_uri(store.store_uri)


def test_other_artifacts_in_the_settings_move_nothing(store: Any, tmp_path: Path) -> None:
    """Without the files there, the earlier runs keep their addresses."""
    own = at_home(store, tmp_path)
    database.make(own.store_file, lambda made: shutil.copy(store.store_file, made))
    training_id = log_training(toy_result(toy_batches("toy-elsewhere", 3), S_UM), own)
    assert database.follow(own.store_file, (tmp_path / "elsewhere").as_uri()) == []
    assert database.follow(own.store_file, "s3://bucket/artifacts") == []
    assert tracking.load_training(training_id, own)
    mlflow.set_tracking_uri(store.store_uri)


def at_home(store: Any, home: Path) -> Settings:
    """The settings of the session's store, in another home."""
    home.mkdir(exist_ok=True)
    return replace(
        store, home=home, store_uri=f"sqlite:///{home}/mlflow.db", artifacts_uri=(home / "artifacts").as_uri()
    )
