"""A fleet on a Prefect server: its deployments, missed runs, and a server that goes away."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from pipelines.fleet.fleet_file import Fleet, FleetMachine, When
from pipelines.fleet.folders import Folders

pytestmark = [pytest.mark.integration, pytest.mark.slow]

SOON = timedelta(seconds=1)


@pytest.fixture
def module(flows: ModuleType, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Imported after the environment of Prefect is set; polls whenever it may."""
    from pipelines.fleet import deployments as module

    for name in ("POLL_S", "LOST_POLL_S", "UPCOMING_S"):
        monkeypatch.setattr(module, name, 0.0)
    return module


@pytest.fixture
def api(flows: ModuleType, module: ModuleType) -> Iterator[str]:
    from prefect.server.api.server import SubprocessASGIServer
    from prefect.settings import PREFECT_API_URL, temporary_settings

    url = SubprocessASGIServer().api_url
    with temporary_settings({PREFECT_API_URL: url}):
        yield url


@pytest.fixture
def client(api: str) -> Iterator[Any]:
    from prefect.client.orchestration import get_client

    with get_client(sync_client=True) as client:
        yield client


def fleet_of(folder: Path, *names: str, when: When | None = None) -> Fleet:
    when = when or When(cron="30 4 * * 2")
    machines = tuple(FleetMachine(n, f"/m/{n}.yml", (str(folder),), when, channels=("z",)) for n in names)
    return Fleet(str(folder / "fleet.yml"), machines, 1, "Europe/Berlin")


Served = Callable[[Fleet], Any]


@pytest.fixture
def served(module: ModuleType, api: str, said: list[str]) -> Iterator[Served]:
    opened = []

    def serve(fleet: Fleet) -> Any:
        folders = Folders(fleet, said.append)
        source = module.Deployments(fleet, {"type": "object", "properties": {}}, folders, said.append)
        opened.append(source.__enter__())
        return source

    yield serve
    for source in reversed(opened):
        source.__exit__(None, None, None)


@pytest.fixture
def said() -> list[str]:
    return []


def test_each_machine_has_a_deployment(served: Served, client: Any, tmp_path: Path, said: list[str]) -> None:
    fleet = fleet_of(tmp_path, "dep-a", "dep-b")
    source = served(fleet)
    assert source.due(datetime.now(UTC)) == [] and not said
    there = client.read_deployment_by_name("thermodrift-retrain/retrain-dep-a")
    assert [(s.schedule.cron, s.schedule.timezone) for s in there.schedules] == [("30 4 * * 2", "Europe/Berlin")]
    assert there.parameters == fleet.machines[0].parameters and there.entrypoint == "pipelines.fleet.retraining.retrain"
    served(fleet).due(datetime.now(UTC))
    assert client.read_deployment_by_name("thermodrift-retrain/retrain-dep-a").updated == there.updated
    other = replace(fleet, machines=(replace(fleet.machines[0], when=When(every_h=6.0)),))
    served(other).due(datetime.now(UTC))
    changed = client.read_deployment_by_name("thermodrift-retrain/retrain-dep-a")
    assert changed.id == there.id and [s.schedule.interval for s in changed.schedules] == [timedelta(hours=6)]
    assert client.read_deployment_by_name("thermodrift-retrain/retrain-dep-b").paused
    assert said == [f"retrain-dep-b: not in {fleet.source}; its deployment is paused"]


def test_the_newest_missed_run_is_done_and_the_others_are_cancelled(
    served: Served, client: Any, tmp_path: Path
) -> None:
    from prefect.states import Scheduled

    source = served(fleet_of(tmp_path, "missed"))
    source.due(datetime.now(UTC))
    deployment = client.read_deployment_by_name("thermodrift-retrain/retrain-missed")
    now = datetime.now(UTC)
    runs = [
        client.create_flow_run_from_deployment(deployment.id, state=Scheduled(scheduled_time=now - timedelta(hours=h)))
        for h in (3, 1, 2)
    ]
    (job,) = source.due(now)
    assert job.flow_run_id == str(runs[1].id) and job.machine.name == "missed"
    states = [client.read_flow_run(runs[k].id).state for k in (0, 2)]
    assert [(s.name, s.message) for s in states] == 2 * [
        ("Cancelled", "missed; a later run of the same machine does its work")
    ]
    again = served(fleet_of(tmp_path, "missed"))
    (same,) = again.due(now)
    assert source.begin(job, now) and not again.begin(same, now)  # a second process gets none
    assert source.due(now) == []
    source.ended(job, None)
    assert client.read_flow_run(runs[1].id).state.name == "Crashed"


def test_a_watched_folder_makes_a_run(served: Served, client: Any, tmp_path: Path) -> None:
    source = served(fleet_of(tmp_path, "arrived", when=When(watch=True)))
    (job,) = source.due(datetime.now(UTC) + SOON)
    assert client.read_flow_run(job.flow_run_id).name == "retrain arrived"
    assert client.read_deployment_by_name("thermodrift-retrain/retrain-arrived").schedules == []
    (same,) = source.due(datetime.now(UTC) + SOON)
    assert same == job and source.begin(job, datetime.now(UTC))
    assert source.due(datetime.now(UTC) + SOON) == [] and source.next() == {"arrived": None}


def test_an_hour_without_the_server_is_two_lines(
    served: Served, client: Any, tmp_path: Path, said: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import httpx

    source = served(fleet_of(tmp_path, "away"))
    begun = datetime.now(UTC)
    source.due(begun)
    request = type(source._client).request

    def refused(*given: Any, **more: Any) -> Any:
        raise httpx.ConnectError("[Errno 111] Connection refused")

    monkeypatch.setattr(type(source._client), "request", refused)
    for minute in range(60):
        assert source.due(begun + timedelta(minutes=minute)) == []
    assert len(said) == 1 and said[0].endswith(" does not answer ([Errno 111] Connection refused); waiting for it")
    monkeypatch.setattr(type(source._client), "request", request)
    source.due(begun + timedelta(hours=1))
    source.due(begun + timedelta(hours=1, minutes=1))
    assert len(said) == 2 and said[1].endswith(" is back after 60 min")


def test_a_short_trouble_is_no_line(
    served: Served, tmp_path: Path, said: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import httpx

    source = served(fleet_of(tmp_path, "shaky"))
    now = datetime.now(UTC)
    source.due(now)
    with monkeypatch.context() as patch:
        patch.setattr(type(source._client), "request", lambda *a, **k: (_ for _ in ()).throw(httpx.ReadError("reset")))
        source.due(now + timedelta(seconds=5))
    source.due(now + timedelta(seconds=10))
    assert said == [] and "shaky" in source.next()
