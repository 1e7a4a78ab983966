"""The job through Prefect: the same numbers, retries where they help, one line where nothing does, the schedule."""

from __future__ import annotations

import functools
from datetime import UTC, datetime
from pathlib import Path
from types import ModuleType
from typing import Any

import pandas as pd
import pytest
from mlflow import MlflowClient

from data.errors import InputError, WorkError
from models.crossing import Plan
from pipelines import training
from pipelines.caller import RETRIES, DirectCaller
from pipelines.training import TrainRequest
from tests.toys.small_year import write_machine, write_year

PLAN = Plan(("none", "correlation"), ("zero", "ridge", "pls"), ("leave-batch-out", "train-on-one"))
SMALL = Plan(("none",), ("zero", "ridge"), ("leave-batch-out",))


@pytest.fixture(scope="module")
def year(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flow-year")
    write_year(folder / "in")
    return folder


def request_for(year: Path, name: str, plan: Plan = SMALL) -> TrainRequest:
    machine = write_machine(year / f"{name}.yml", name)
    return TrainRequest(machine, (year / "in",), ("z",), plan)


def test_same_numbers_with_prefect_and_without(flows: ModuleType, store: Any, year: Path) -> None:
    steps: list[tuple[str, int, int]] = []
    flowed = flows.train_in_flow(request_for(year, "flow-a", PLAN), store, done=lambda *step: steps.append(step))
    direct = training.train(request_for(year, "flow-b", PLAN), store, DirectCaller())
    a, b = flowed.results["z"], direct.results["z"]
    for table in ("scores", "cells", "subsets", "predictions"):
        pd.testing.assert_frame_equal(getattr(a, table), getattr(b, table), check_exact=True)
    assert flowed.promotions["z"].cell == direct.promotions["z"].cell
    assert flowed.promotions["z"].summary == direct.promotions["z"].summary.replace("flow-b", "flow-a")
    assert flowed.report is not None and flowed.report.exists()
    assert ("grid z pls", 3, 3) in steps and ("ingest", 1, 1) in steps and ("report", 1, 1) in steps


def test_a_step_that_fails_once_is_tried_again(
    flows: ModuleType, store: Any, year: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    true, calls = training._track, []

    def shaky(*given: Any) -> str:
        calls.append(1)
        if len(calls) == 1:
            raise WorkError("tracking store: database is locked")
        return true(*given)

    monkeypatch.setattr(training, "_track", shaky)
    outcome = flows.train_in_flow(request_for(year, "flow-shaky"), store)
    assert len(calls) == 2
    assert outcome.promotions["z"].outcome == "champion"
    client = MlflowClient(store.store_uri, registry_uri=store.store_uri)
    assert len(client.search_model_versions("name = 'flow-shaky-z'")) == 1


def test_a_step_that_keeps_failing_ends_in_our_words(
    flows: ModuleType, store: Any, year: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    calls = []

    def broken(*given: Any) -> str:
        calls.append(1)
        raise WorkError("tracking store: database is locked")

    monkeypatch.setattr(training, "_track", broken)
    with pytest.raises(WorkError, match=r"^tracking store: database is locked$"):
        flows.train_in_flow(request_for(year, "flow-broken"), store)
    assert len(calls) == 1 + RETRIES
    shown = capfd.readouterr()
    assert "Traceback" not in shown.out + shown.err


def test_bad_input_is_not_tried_again(
    flows: ModuleType, store: Any, year: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    calls = []

    def refused(*given: Any) -> str:
        calls.append(1)
        raise InputError("this cannot be used")

    monkeypatch.setattr(training, "_promote", refused)
    with pytest.raises(InputError, match=r"^this cannot be used$"):
        flows.train_in_flow(request_for(year, "flow-refused"), store)
    assert len(calls) == 1
    assert "Traceback" not in "".join(capfd.readouterr())


@pytest.fixture
def small_retrain(flows: ModuleType, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Retraining with a quick plan."""
    monkeypatch.setattr(flows, "TrainRequest", functools.partial(TrainRequest, targets=("z",), plan=SMALL))
    return flows


def test_retraining_learns_once(small_retrain: ModuleType, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    machine = write_machine(tmp_path / "m.yml", "flow-again")
    write_year(tmp_path / "in", 5)
    first = small_retrain.retrain(str(machine), [str(tmp_path / "in")])
    again = small_retrain.retrain(str(machine), [str(tmp_path / "in")])
    assert "flow-again-z version 1 is champion" in first
    assert again == "the last training saw the same batches; nothing new to learn"
    (tmp_path / "in" / "20251015.csv").write_text("nothing")
    assert small_retrain.retrain(str(machine), [str(tmp_path / "in")]).endswith("(files in quarantine: 1)")
    assert f"flow-again: {again}" in capfd.readouterr().out


def test_the_schedule_runs_when_it_is_due_and_goes_on_after_trouble(
    small_retrain: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    waited: list[datetime] = []
    said: list[str] = []
    monkeypatch.setattr(small_retrain, "_wait_until", waited.append)
    monkeypatch.setattr(small_retrain.SubprocessASGIServer, "stop", lambda self: None)  # other tests need it
    monkeypatch.setattr(small_retrain, "local_timezone", lambda: "Asia/Tokyo")
    machine = write_machine(tmp_path / "m.yml", "flow-due")
    write_year(tmp_path / "in", 1)
    before = datetime.now(UTC)
    small_retrain.serve_schedule(machine, [tmp_path / "in"], "0 5 * * 1", said.append, rounds=2)
    assert len(waited) == 2
    for due in waited:
        assert (due.weekday(), due.hour, due.minute, due.utcoffset().total_seconds()) == (0, 5, 0, 9 * 3600)
        assert 0 < (due - before).total_seconds() <= 7 * 86400 + 60
    assert said[0] == f"retraining of m next at {waited[0]:%Y-%m-%d} 05:00 JST; Ctrl-C ends it"
    shown = capfd.readouterr()
    assert shown.out.count("not retrained: flow-due: got 1 batch(es) with a usable z, need at least 2") == 2
    assert "Traceback" not in shown.out + shown.err


def test_a_running_server_gets_a_deployment_with_the_cron(
    flows: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from prefect.client.orchestration import get_client
    from prefect.runner import Runner
    from prefect.settings import PREFECT_API_URL, temporary_settings

    async def at_once(self: Any, *args: Any, **more: Any) -> None:
        return None

    server = flows.SubprocessASGIServer()
    assert server.api_url.startswith("http://127.0.0.1:")
    monkeypatch.setattr(Runner, "start", at_once)
    machine = write_machine(tmp_path / "lathe.yml", "flow-served")
    with temporary_settings({PREFECT_API_URL: server.api_url}):
        flows.serve_schedule(machine, [tmp_path], "30 4 * * 2")
        with get_client(sync_client=True) as client:
            deployment = client.read_deployment_by_name("thermodrift-retrain/retrain-lathe")
    assert [s.schedule.cron for s in deployment.schedules] == ["30 4 * * 2"]
    assert deployment.parameters == {"machine_file": str(machine), "recordings": [str(tmp_path)]}
    assert deployment.entrypoint == "pipelines.flows.retrain"


def test_what_is_no_cron_is_told(flows: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--cron: got 'monday', expected five fields \(minute hour day month weekday"):
        flows.serve_schedule(tmp_path / "m.yml", [tmp_path], "monday")
