"""Retraining on a schedule: when it is due, through a server, and after trouble."""

from __future__ import annotations

import functools
from datetime import UTC, datetime
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from data.errors import InputError
from models.crossing import Plan
from pipelines.training import TrainRequest
from tests.toys.small_year import write_machine, write_year

SMALL = Plan(("none",), ("zero", "ridge"), ("leave-batch-out",))


@pytest.fixture
def scheduling(flows: ModuleType) -> ModuleType:
    """Imported after the environment of Prefect is set."""
    from pipelines import scheduling as module

    return module


@pytest.fixture
def small_retrain(scheduling: ModuleType, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Retraining with a quick plan."""
    monkeypatch.setattr(scheduling, "TrainRequest", functools.partial(TrainRequest, targets=("z",), plan=SMALL))
    return scheduling


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
    flows: ModuleType, scheduling: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
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
        scheduling.serve_schedule(machine, [tmp_path], "30 4 * * 2")
        with get_client(sync_client=True) as client:
            deployment = client.read_deployment_by_name("thermodrift-retrain/retrain-lathe")
    assert [s.schedule.cron for s in deployment.schedules] == ["30 4 * * 2"]
    assert deployment.parameters == {"machine_file": str(machine), "recordings": [str(tmp_path)]}
    assert deployment.entrypoint == "pipelines.scheduling.retrain"


def test_what_is_no_cron_is_told(scheduling: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--cron: got 'monday', expected five fields \(minute hour day month weekday"):
        scheduling.serve_schedule(tmp_path / "m.yml", [tmp_path], "monday")
