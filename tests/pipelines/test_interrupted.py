"""What an interruption at any write leaves: no run that runs for ever, no half-promoted version, no second training."""

from __future__ import annotations

import json
import os
import platform
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest
from mlflow.tracking import MlflowClient

from models.selection.crossing import Plan
from pipelines.caller import DirectCaller
from pipelines.jobs.request import TrainRequest
from pipelines.jobs.training import train
from pipelines.store import registry, runs, tracking
from tests.toys.small_year import write_machine, write_year
from tests.toys.tracked import client_of, log_training, newcomer
from tests.toys.training import toy_batches, toy_result

pytestmark = pytest.mark.slow

READS = ("get_", "search_", "__", "_", "download_", "list_", "load_")
S_UM = [5.0, 6.0, 5.5, 6.5, 5.0, 6.0]

KILLED_IN_THE_MIDDLE = """
import os, signal
from mlflow.tracking import MlflowClient
from pipelines import settings
from tests.toys.tracked import log_training
from tests.toys.training import toy_batches, toy_result
MlflowClient.log_artifacts = lambda *args: os.kill(os.getpid(), signal.SIGKILL)
log_training(toy_result(toy_batches("toy-killed", 3), {"none|mlr|2": [1.0, 2.0, 1.5]}), settings.load())
"""


class Killed(BaseException):
    """The process dies: nothing handles it."""


@contextmanager
def dying(at: int) -> Iterator[None]:
    """The `at`-th call that writes to the store never happens, nor any later one."""
    begun: list[str] = []

    def guarded(name: str, real: Any) -> Any:
        def write(self: MlflowClient, *args: Any, **kwargs: Any) -> Any:
            begun.append(name)
            if len(begun) > at:
                raise Killed(name)
            return real(self, *args, **kwargs)

        return write

    with pytest.MonkeyPatch.context() as patch:
        for name in dir(MlflowClient):
            if not name.startswith(READS) and callable(real := getattr(MlflowClient, name)):
                patch.setattr(MlflowClient, name, guarded(name, real))
        yield


def test_a_killed_training_is_closed_by_the_next_one(store: Any, store_home: Path) -> None:
    environment = {**os.environ, "THERMODRIFT_HOME": str(store_home)}
    command = [sys.executable, "-c", KILLED_IN_THE_MIDDLE]
    done = subprocess.run(command, env=environment, cwd=Path(__file__).parents[2], check=False)
    assert done.returncode == -signal.SIGKILL
    client = client_of(store)
    experiment = client.get_experiment_by_name("toy-killed z")
    (left,) = client.search_runs([experiment.experiment_id])
    assert left.info.status == "RUNNING" and json.loads(left.data.tags["process"])["host"] == platform.node()
    log_training(toy_result(toy_batches("toy-other", 3), {"none|mlr|2": [1.0, 2.0, 1.5]}), store)
    closed = client.get_run(left.info.run_id)
    assert closed.info.status == "KILLED" and closed.info.end_time
    assert closed.data.tags["interrupted"] == "its process ended before the run did"
    assert tracking.trainings("toy-killed", None, store).empty


def test_only_runs_of_ended_processes_of_this_computer_are_closed(store: Any) -> None:
    client, own = client_of(store), json.loads(runs.origin()["process"])
    experiment = runs.experiment_id(client, store, "toy-processes", "z", True)
    child = subprocess.Popen([sys.executable, "-c", "pass"])
    began = runs._iso(psutil.Process(child.pid).create_time())
    child.wait()
    processes = {
        "own": own,
        "ended": {**own, "pid": child.pid, "started": began},
        "other start": {**own, "started": "2020-01-01T00:00:00Z"},  # the number of a process is used again
        "other computer": {**own, "host": "elsewhere", "pid": child.pid, "started": began},
        "no process": {},
    }
    made = {k: client.create_run(experiment, tags={"process": json.dumps(p)}).info.run_id for k, p in processes.items()}
    assert runs.close_interrupted(client) == 2
    status = {k: client.get_run(run_id).info.status for k, run_id in made.items()}
    assert status == {
        "own": "RUNNING", "ended": "KILLED", "other start": "KILLED", "other computer": "RUNNING",
        "no process": "RUNNING",
    }  # fmt: skip
    for run_id in made.values():
        client.set_terminated(run_id)


def test_a_promotion_leaves_its_training_finished_at_every_moment(store: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also while it logs the model; a killed promotion would otherwise take the training off the list."""
    new, client, seen = newcomer(store, "toy-status", S_UM), client_of(store), []
    save = MlflowClient.log_model_artifacts

    def noted(self: MlflowClient, *args: Any, **kwargs: Any) -> Any:
        seen.append(client.get_run(new.training_id).info.status)
        return save(self, *args, **kwargs)

    monkeypatch.setattr(MlflowClient, "log_model_artifacts", noted)
    before = client.get_run(new.training_id).info
    registry.promote(new, store)
    after = client.get_run(new.training_id)
    assert seen == ["FINISHED"] and (after.info.status, after.info.end_time) == ("FINISHED", before.end_time)
    (model,) = client.search_logged_models([before.experiment_id], f"source_run_id = '{new.training_id}'")
    assert model.status == "READY" and {m.key: m.value for m in model.metrics} == after.data.metrics


def test_a_promotion_that_dies_at_any_write_is_finished_by_the_next(store: Any) -> None:
    """The second model of a machine, which replaces the first one."""
    at, done = 0, False
    while not done:
        first = newcomer(store, f"toy-dies-{at}", S_UM)
        registry.promote(first, store)
        new = newcomer(store, f"toy-dies-{at}", [*(s - 1 for s in S_UM), 5.0])
        with dying(at):
            try:
                registry.promote(new, store)
                done = True
            except Killed:
                pass
        check_finished_by_the_next(store, new, "unchanged" if done else "champion")
        tags = client_of(store).get_model_version(f"toy-dies-{at}-z", "2").tags
        assert tags["replaces"] == "1" and "the newcomer replaces the champion" in tags["reason"]
        assert registry.rollback(f"toy-dies-{at}-z", store).version == 1
        at += 1
    assert at > 8  # writes of a promotion


def check_finished_by_the_next(store: Any, new: registry.Newcomer, outcome: str) -> None:
    """One more version, one champion, one outcome, and one model with files."""
    version = 2
    client, name = client_of(store), store.model(new.result.machine, "z")
    run = client.get_run(new.training_id)
    assert run.info.status == "FINISHED"
    listed = registry.status(store).set_index(["name", "version"])
    if (name, version) in listed.index:
        row = listed.loc[(name, version)]
        assert row["aliases"] == "champion" or "was interrupted" in row["reason"]
    again = registry.promote(new, store)
    assert (again.version, again.champion_version, again.outcome) == (version, version, outcome)
    assert {k: int(v) for k, v in client.get_registered_model(name).aliases.items()} == {"champion": version}
    tags = client.get_model_version(name, str(version)).tags
    assert (tags["outcome"], tags["training_id"]) == ("champion", new.training_id)
    kept = json.loads(client.get_run(new.training_id).data.tags["promotion"])
    assert (kept["outcome"], kept["version"]) == ("champion", version)
    models = client.search_logged_models([run.info.experiment_id], f"source_run_id = '{new.training_id}'")
    assert not [m for m in models if m.status == "PENDING"]


def test_after_a_killed_promotion_nothing_is_crossed_or_tracked_again(
    store: Any, store_home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("THERMODRIFT_HOME", str(store_home))
    machine, _ = write_machine(tmp_path / "m.yml", "small-killed"), write_year(tmp_path / "in")
    plan = Plan(("none",), ("zero", "ridge"), ("leave-batch-out",))
    request = TrainRequest(machine, (tmp_path / "in",), ("z",), plan, workers=1)
    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(registry, "_crown", _die)
        train(request, store, DirectCaller())
    (tracked,) = tracking.trainings("small-killed", None, store)["training_id"]
    said: list[str] = []
    outcome = train(request, store, DirectCaller(), said.append)
    assert any(line.startswith("resumes: 2 finished parts") for line in said)
    assert outcome.training_ids == {"z": tracked}
    promoted = outcome.promotions["z"]
    assert (promoted.outcome, promoted.version, promoted.champion_version) == ("champion", 1, 1)
    assert tracking.trainings("small-killed", None, store)["training_id"].tolist() == [tracked]
    assert not list((store_home / "unfinished").glob("*/z__ridge"))


def _die(*_: object) -> None:
    raise Killed
