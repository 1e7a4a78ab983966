"""One scheduled retraining as a flow run: it learns once, and says so in Prefect."""

from __future__ import annotations

import time
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from data.errors import WorkError
from tests.toys.small_year import write_machine, write_year

pytestmark = pytest.mark.integration
SMALL: dict[str, Any] = {"channels": ["z"], "selectors": ["none"], "families": ["zero", "ridge"]}


@pytest.fixture
def retraining(flows: ModuleType) -> ModuleType:
    """Imported after the environment of Prefect is set."""
    from pipelines.fleet import retraining as module

    return module


def test_retraining_learns_once(
    retraining: ModuleType, store: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    machine = write_machine(tmp_path / "m.yml", "flow-again")
    write_year(tmp_path / "in", 5)
    first = retraining.retrain(str(machine), [str(tmp_path / "in")], **SMALL)
    scheduled = _scheduled("retrain flow-again z")
    again = retraining.retrain(str(machine), [str(tmp_path / "in")], **SMALL, scheduled=scheduled)
    assert "flow-again-z version 1 is champion" in first
    assert again == "the last training saw the same batches; nothing new to learn"
    (tmp_path / "in" / "20251015.csv").write_text("nothing")
    assert retraining.retrain(str(machine), [str(tmp_path / "in")], **SMALL).endswith("(files in quarantine: 1)")
    shown = capfd.readouterr()
    assert f"flow-again: {again}" in shown.out
    assert "Traceback" not in shown.out + shown.err
    runs, tasks, lines, links = _in_prefect("retrain flow-again z", 12)
    assert [r.state.name for r in runs] == 3 * ["Completed"] and scheduled in {str(r.id) for r in runs}
    assert {"grid flow-again z ridge", "grid flow-again z zero", "ingest flow-again", "track flow-again z"} <= tasks
    assert "grid" in lines and first in lines
    assert any(f"{store.home}/reports/flow-again-" in link for link in links)


def _scheduled(name: str) -> str:
    """The id of a run that the server has made and handed out."""
    from prefect.client.orchestration import get_client

    with get_client(sync_client=True) as client:
        flow = client.create_flow_from_name("thermodrift-retrain")
        run = {"flow_id": str(flow), "name": name, "state": {"type": "PENDING"}}
        return str(client.request("POST", "/flow_runs/", json=run).json()["id"])


def _in_prefect(run_name: str, at_least: int = 1) -> tuple[list[Any], set[str], list[str], list[str]]:
    """Runs of this name, their task names, their logged lines, and the links among their artifacts."""
    from prefect.client.orchestration import get_client
    from prefect.client.schemas.filters import (
        ArtifactFilter,
        ArtifactFilterFlowRunId,
        FlowRunFilter,
        FlowRunFilterName,
        LogFilter,
        LogFilterFlowRunId,
    )

    with get_client(sync_client=True) as client:
        runs = client.read_flow_runs(flow_run_filter=FlowRunFilter(name=FlowRunFilterName(any_=[run_name])))
        ids = [r.id for r in runs]
        which = FlowRunFilter(name=FlowRunFilterName(any_=[run_name]))
        tasks = {t.name for t in client.read_task_runs(flow_run_filter=which)}
        logs: list[Any] = []
        for _ in range(100):  # lines are sent every few seconds
            logs = client.read_logs(LogFilter(flow_run_id=LogFilterFlowRunId(any_=ids)), limit=200)
            if len(logs) >= at_least:
                break
            time.sleep(0.1)
        found = client.read_artifacts(artifact_filter=ArtifactFilter(flow_run_id=ArtifactFilterFlowRunId(any_=ids)))
    return runs, tasks, [entry.message for entry in logs], [str(a.data) for a in found]


def test_a_failure_is_one_line_and_a_failed_run(
    retraining: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def refused(*given: Any, **more: Any) -> Any:
        raise WorkError("the share does not answer")

    monkeypatch.setattr(retraining, "train", refused)
    machine = write_machine(tmp_path / "m.yml", "flow-share")
    with pytest.raises(WorkError, match=r"^the share does not answer$"):
        retraining.retrain(str(machine), [str(tmp_path)], **SMALL)
    shown = capfd.readouterr()
    assert shown.out.count("not retrained: the share does not answer") == 1
    assert "Traceback" not in shown.out + shown.err
    runs, _, lines, _ = _in_prefect("retrain flow-share z")
    assert [r.state.name for r in runs] == ["Failed"]
    assert "not retrained: the share does not answer" in lines and not any("Traceback" in text for text in lines)
