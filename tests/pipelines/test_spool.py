"""Results on their way to the store: delivered once, whatever ends a process or a server."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import mlflow
import pytest
from mlflow.tracking import MlflowClient

from data.errors import WorkError
from models.selection.crossing import Plan
from pipelines import settings
from pipelines.caller import DirectCaller
from pipelines.commands.train import training_dict
from pipelines.jobs.recordings import home_lake
from pipelines.jobs.request import TrainRequest
from pipelines.jobs.training import TrainOutcome, promote_waiting, train
from pipelines.store import registry, spool, tracking
from pipelines.store.database import StoreOutage
from pipelines.store.runs import Record
from tests.toys.command import Call, in_process
from tests.toys.mlflow_server import MlflowServer
from tests.toys.postgres import free_port
from tests.toys.small_year import write_machine, write_year
from tests.toys.tracked import client_of
from tests.toys.training import toy_batches, toy_result

PLAN = Plan(("none",), ("zero", "ridge"), ("leave-batch-out",))
DOWN = "tracking store http://127.0.0.1:5000: does not answer (connection refused)"


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Call:
    """The command in a folder and home of the test's own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("THERMODRIFT_HOME", str(tmp_path / "home"))
    return in_process(monkeypatch, capsys)


def down(*_: object, **__: object) -> Any:
    raise StoreOutage(DOWN)


def trained(
    name: str, folder: Path, store: Any, caller: DirectCaller | None = None, only_if_new: bool = False
) -> TrainOutcome:
    machine, _ = write_machine(folder / "m.yml", name), write_year(folder / "in")
    request = TrainRequest(machine, (folder / "in",), ("z",), PLAN, only_if_new=only_if_new, workers=1)
    return train(request, store, caller or DirectCaller())


def test_a_server_that_does_not_answer_is_one_line_before_anything_is_computed(call: Call, tmp_path: Path) -> None:
    machine, _ = write_machine(tmp_path / "m.yml", "small-down"), write_year(tmp_path / "in")
    address = f"http://127.0.0.1:{free_port()}"
    (tmp_path / "mlflow.yml").write_text(f'tracking: {{store: "{address}", artifacts: null}}\n')
    done = call("train", "--machine", machine, "--recordings", tmp_path / "in", "--direct")
    assert (done.code, done.out, done.err.count("\n")) == (1, "", 1)
    assert done.err.startswith(f"thermodrift: tracking store {address}: does not answer")
    assert not (tmp_path / "home" / "lake").exists() and not (tmp_path / "home" / "spool").exists()


def test_results_wait_and_are_delivered_once(
    store: Any, store_home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: Call
) -> None:
    monkeypatch.setenv("THERMODRIFT_HOME", str(store_home))
    with monkeypatch.context() as patch:
        patch.setattr(tracking, "log_record", down)
        outcome = trained("small-spool", tmp_path, store)
    assert outcome.postponed.startswith(f"{DOWN}; 1 results wait in {store_home / 'spool'}: the next `thermodrift ")
    assert training_dict(outcome)["postponed"] == outcome.postponed
    assert not outcome.training_ids and not outcome.promotions and outcome.report.exists()
    assert [p.name for p in spool.waiting(store)] == [f"{outcome.records['z'].started_ms}-small-spool-z"]
    assert tracking.trainings("small-spool", None, store).empty
    kept = tmp_path / "kept"
    shutil.copytree(store_home / "spool", kept)

    done = call("status", "--json")
    assert done.code == 0 and [line.partition(":")[0] for line in done.err.splitlines()[:2]] == [
        "delivers 1 results that the tracking store does not have yet", "delivered training of small-spool z"
    ]  # fmt: skip
    (training,) = [t for t in json.loads(done.out)["trainings"] if t["machine"] == "small-spool"]
    assert (training["promotion"], training["model"]) == ("champion", "small-spool-z version 1")
    client = client_of(store)
    run = client.get_run(training["training_id"])
    assert run.info.start_time == outcome.records["z"].started_ms
    folder = mlflow.artifacts.download_artifacts(run_id=run.info.run_id, tracking_uri=store.store_uri)
    assert (Path(folder) / "report" / outcome.report.name).read_bytes() == outcome.report.read_bytes()
    assert (Path(folder) / "grid" / "result.json").exists() and list((Path(folder) / "figures").iterdir())
    assert not spool.waiting(store)

    # as if the delivery had died before it removed them
    shutil.copytree(kept, store_home / "spool", dirs_exist_ok=True)
    spool.deliver(store, partial(promote_waiting, store))
    assert not spool.waiting(store)
    table = tracking.trainings("small-spool", None, store)
    assert table["training_id"].tolist() == [training["training_id"]] and table["promotion"].tolist() == ["champion"]
    status = registry.status(store)
    assert status[status["name"] == "small-spool-z"]["version"].tolist() == [1]


def test_a_promotion_that_does_not_reach_the_server_waits_and_one_that_is_refused_blocks_nothing(
    store: Any, store_home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("THERMODRIFT_HOME", str(store_home))
    with monkeypatch.context() as patch:
        patch.setattr(registry, "promote", down)
        outcome = trained("small-later", tmp_path, store)
    assert list(outcome.training_ids) == ["z"] and not outcome.promotions and outcome.postponed.startswith(DOWN)
    with monkeypatch.context() as patch, pytest.raises(StoreOutage, match=r"refused\); 1 results wait in "):
        patch.setattr(spool, "log_record", down)
        spool.deliver(store, partial(promote_waiting, store))
    home_lake().forget_machine("small-later", "sold")
    said: list[str] = []
    spool.deliver(store, partial(promote_waiting, store), said.append)
    assert said[1].startswith("not delivered: training of small-later z (lake ") and "is withdrawn (sold)" in said[1]
    (refused,) = (store_home / "spool" / "refused").iterdir()
    assert (refused / "reason.txt").read_text().strip() in said[1] and not spool.waiting(store)
    client = client_of(store)
    assert client.list_artifacts(outcome.training_ids["z"], "report")


def toy_record(machine: str, store: Any) -> Record:
    result = toy_result(toy_batches(machine, 3), {"none|mlr|2": [1.0, 2.0, 1.5]})
    return tracking.training_record(result, store.promotion)


def test_what_cannot_be_delivered_now_waits_with_what_follows_it_and_other_channels_do_not(
    store: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a full disk: nothing is refused for good, and the order of a channel's results stays."""
    own, names = replace(store, home=tmp_path), ("toy-a", "toy-a", "toy-b")
    for k, name in enumerate(names):
        record = toy_record(name, store)
        spool.keep(own, record.model_copy(update={"started_ms": record.started_ms + k}), lambda item: None)
    log = spool.log_record

    def full(record: Any, *rest: Any) -> str:
        if record.machine == "toy-a":
            raise WorkError(f"{tmp_path}: cannot be written or read (No space left on device)")
        return log(record, *rest)

    said: list[str] = []
    with monkeypatch.context() as patch:
        patch.setattr(spool, "log_record", full)
        spool.deliver(own, partial(promote_waiting, own), said.append)
    assert [line.partition("(")[0].partition(":")[0] for line in said[1:]] == [
        "not delivered", "delivered training of toy-b z"
    ]  # fmt: skip
    assert "No space left on device)); it waits in " in said[1]
    assert [p.name.partition("-")[2] for p in spool.waiting(own)] == ["toy-a-z", "toy-a-z"]
    spool.deliver(own, partial(promote_waiting, own))
    assert not spool.waiting(own) and len(tracking.trainings("toy-a", None, store)) == 2


@pytest.mark.parametrize("step", [pytest.param("log_record", marks=pytest.mark.slow), "promote"])
def test_a_training_that_is_killed_before_the_store_has_it_goes_on(
    step: str, store: Any, store_home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next round of a schedule finds no new batches, and a training that is not finished."""
    monkeypatch.setenv("THERMODRIFT_HOME", str(store_home))
    name = f"small-killed-{step.replace('_', '-')}"

    def killed(*_: object, **__: object) -> Any:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(tracking if step == "log_record" else registry, step, killed)
        trained(name, tmp_path, store)
    assert not spool.waiting(store)
    again = trained(name, tmp_path, store, only_if_new=True)
    table = tracking.trainings(name, None, store)
    assert table["training_id"].tolist() == [again.training_ids["z"]] and table["promotion"].tolist() == ["champion"]
    versions = registry.status(store)
    assert versions[versions["name"] == f"{name}-z"]["version"].tolist() == [1]
    assert trained(name, tmp_path, store, only_if_new=True).stopped


def test_no_item_is_half_written(store: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record, own = toy_record("toy-torn", store), replace(store, home=tmp_path)
    with monkeypatch.context() as patch, pytest.raises(OSError, match="No space left"):
        patch.setattr(Path, "write_text", _full)
        spool.keep(own, record, lambda item: None)
    assert not list(spool.folder(own).iterdir())
    spool.keep(own, record, lambda item: None)
    spool.keep(own, record, lambda item: None)  # waits already
    assert len(spool.waiting(own)) == 1


def _full(*_: object, **__: object) -> int:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


class Interfering(DirectCaller):
    """Calls something before a step."""

    def __init__(self, step: str, before: Callable[[], object]) -> None:
        super().__init__()
        self._step, self._before = step, before

    def map(self, step: str, work: Callable[[Any], Any], items: Sequence[Any], retries: int = 0) -> list[Any]:
        if step == self._step:
            self._before()
        return super().map(step, work, items, retries)


@pytest.mark.integration
@pytest.mark.slow
@pytest.mark.parametrize("when", ["track", "promote", "within"])
def test_a_real_server_that_goes_away(when: str, call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed before the training is tracked, before it is promoted, or while it is tracked."""
    with MlflowServer(tmp_path) as server:
        (tmp_path / "mlflow.yml").write_text(f'tracking: {{store: "{server.address}", artifacts: null}}\n')
        store = settings.load()
        with monkeypatch.context() as patch:
            caller = DirectCaller()
            if when == "within":
                patch.setattr(
                    MlflowClient, "log_inputs", lambda client, *_, **__: (server.kill(), client.get_run("0" * 32))
                )
            else:
                caller = Interfering(when, server.kill)
            outcome = trained("small-gone", tmp_path, store, caller)
        assert (
            "does not answer (connection refused); " in outcome.postponed and " results wait in " in outcome.postponed
        )
        assert len(outcome.training_ids) == (when == "promote") and not outcome.promotions
        assert call("status").code == 1
        server.start()
        done = call("status", "--json")
        assert done.code == 0, done.err
        (training,) = json.loads(done.out)["trainings"]
        assert (training["promotion"], training["model"]) == ("champion", "small-gone-z version 1")
        client = client_of(store)
        found = client.search_runs([client.get_run(training["training_id"]).info.experiment_id])
        status = sorted(r.info.status for r in found if r.data.tags["kind"] == "training")
        assert status == (["FINISHED", "KILLED"] if when == "within" else ["FINISHED"])
        assert {f.path for f in client.list_artifacts(training["training_id"])} >= {"grid", "figures", "report"}
        assert not spool.waiting(store)
        again = trained("small-gone", tmp_path, store)
        assert not again.postponed and again.promotions["z"].outcome == "unchanged"
