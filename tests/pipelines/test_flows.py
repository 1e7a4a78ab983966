"""The job through Prefect: the same numbers, retries where they help, one line where nothing does."""

from __future__ import annotations

import time
from pathlib import Path
from types import ModuleType
from typing import Any

import pandas as pd
import pytest

from data.errors import InputError, WorkError
from models.selection.crossing import Plan
from pipelines.caller import RETRIES, DirectCaller
from pipelines.jobs import training
from pipelines.jobs.request import TrainRequest
from tests.toys.small_year import write_machine, write_year
from tests.toys.tracked import client_of

pytestmark = pytest.mark.integration
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
    grid = [step for step in steps if step[0].startswith("grid z ")]  # they end in any order
    assert {name for name, _, _ in grid} == {"grid z zero", "grid z pls", "grid z ridge"}
    assert [(n, of) for _, n, of in grid] == [(1, 3), (2, 3), (3, 3)]
    assert ("ingest", 1, 1) in steps and ("report", 1, 1) in steps


def test_the_server_has_a_training_s_parameters_lines_and_report(flows: ModuleType, store: Any, year: Path) -> None:
    from prefect.client.orchestration import get_client
    from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterName, LogFilter, LogFilterFlowRunId

    request, lines = request_for(year, "flow-seen"), []
    outcome = flows.train_in_flow(request, store, say=lines.append)
    with get_client(sync_client=True) as client:
        (run,) = client.read_flow_runs(
            flow_run_filter=FlowRunFilter(name=FlowRunFilterName(any_=["train flow-seen z"]))
        )
        assert run.parameters["machine_file"] == str(request.machine_file) and run.parameters["channels"] == ["z"]
        assert run.parameters["families"] == list(SMALL.families) and run.parameters["promote"] is True
        of_run, logged = LogFilter(flow_run_id=LogFilterFlowRunId(any_=[run.id])), list[str]()
        for _ in range(60):  # they are sent every two seconds
            logged = [entry.message for entry in client.read_logs(of_run)]
            if outcome.promotions["z"].summary in logged:
                break
            time.sleep(0.5)
        assert outcome.promotions["z"].summary in logged and set(lines) <= set(logged) and "grid" in logged
        links = [a.data for a in client.read_artifacts() if a.key == "report-flow-seen"]
    assert len(links) == 1 and outcome.report is not None and outcome.report.as_uri() in str(links[0])


@pytest.mark.slow
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
    client = client_of(store)
    assert len(client.search_model_versions("name = 'flow-shaky-z'")) == 1


def test_a_step_that_keeps_failing_ends_in_our_words(
    flows: ModuleType, store: Any, year: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    calls = []

    def broken(*given: Any) -> str:
        calls.append(1)
        raise WorkError("tracking store: database is locked")

    monkeypatch.setattr(training, "_track", broken)
    with pytest.raises(
        WorkError,
        match=r"^tracking store: database is locked; 2 finished parts .* kept in .*; run the same command to go on$",
    ):
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
