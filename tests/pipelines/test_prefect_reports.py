"""Prefect serves the job and never ends it: a server that is silent, late, gone or strange costs one line at most."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from data.errors import InputError, WorkError
from models.selection.crossing import Plan
from pipelines import prefect_process, prefect_reports
from pipelines.caller import DirectCaller
from pipelines.flows import FlowRun, train_in_flow
from pipelines.jobs.request import TrainRequest
from pipelines.prefect_reports import Reports
from tests.toys.prefect_stub import Stub, running
from tests.toys.signalled import Command
from tests.toys.small_year import write_machine, write_year

pytestmark = pytest.mark.integration
ITEMS = [1, 2, 3]
STARTED_S = 120.0  # for the imports of the process on a slow computer
GONE_S = prefect_process.CRASHED_S + 7.0  # on a busy one


@pytest.fixture(autouse=True)
def environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PREFECT_HOME", str(tmp_path))


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Reports]]:
    """Reports to a server, with `end_s` for the rest of them after the job; none of their processes may be left."""
    made: list[Reports] = []

    def open_reports(stub: Stub, end_s: float = STARTED_S) -> Reports:
        monkeypatch.setenv("PREFECT_API_URL", stub.url)
        monkeypatch.setattr(prefect_reports, "END_S", end_s)
        made.append(Reports())
        return made[-1]

    yield open_reports
    for reports in made:
        assert reports._process is not None and reports._process.returncode is not None
        reports.stop()


def job(reports: Reports, work: Callable[[int], Any] = lambda n: n * n) -> list[Any]:
    """Three items of a step, one after the other."""
    with FlowRun(reports, "toy", "toy run", "mill", {"a": 1}) as run:
        run.line("begins")
        return DirectCaller(working=run.working, lanes=1).map("grid", work, ITEMS)


def wait_for(condition: Callable[[], object], limit_s: float = STARTED_S) -> None:
    end_s = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.02)


def the_line(capfd: pytest.CaptureFixture[str]) -> str:
    """The one line that was printed, without what all of them share."""
    (line,) = "".join(capfd.readouterr()).splitlines()
    assert line.startswith("Prefect: ")
    assert line.endswith("; its record of this run is incomplete, the job does not depend on it")
    return line


def test_a_server_gets_the_run_its_steps_and_its_end(opened: Any, capfd: pytest.CaptureFixture[str]) -> None:
    with running() as stub:
        assert job(opened(stub)) == [1, 4, 9]
    assert stub.states("flow_runs") == ["RUNNING", "COMPLETED"]
    assert stub.states("task_runs") == 3 * ["RUNNING", "COMPLETED"]
    assert [v["name"] for path, v in stub.got if path == "/task_runs/"] == [f"grid mill {n}" for n in ITEMS]
    assert "".join(capfd.readouterr()) == ""


def test_a_server_that_never_answers(opened: Any, capfd: pytest.CaptureFixture[str]) -> None:
    forever = threading.Event()
    with running(lambda path: (200, str(forever.wait(60)))) as stub:
        reports = opened(stub, end_s=3.0)
        begun_s = time.monotonic()
        assert job(reports) == [1, 4, 9]
        assert time.monotonic() - begun_s < 6.0
        forever.set()
    assert "its server did not take all reports within 3 s after the job" in the_line(capfd)


def test_a_server_that_dies_in_the_middle(opened: Any, capfd: pytest.CaptureFixture[str]) -> None:
    done: list[int] = []
    with running() as stub:
        reports = opened(stub, end_s=3.0)

        def work(n: int) -> int:
            done.append(n)
            if n == 2:
                wait_for(lambda: stub.states("task_runs") == ["RUNNING", "COMPLETED", "RUNNING"])  # all so far
                stub.stop()
            return n

        assert job(reports, work) == ITEMS and done == ITEMS
    assert f"server {stub.url}/ does not answer (ConnectError: " in the_line(capfd)


def test_a_server_that_answers_late_or_again_gets_everything(opened: Any, capfd: pytest.CaptureFixture[str]) -> None:
    stub = Stub()
    reports = opened(stub)

    def answer() -> None:
        wait_for(lambda: reports._why)  # it has been tried in vain
        stub.start()

    threading.Thread(target=answer).start()
    try:
        assert job(reports) == [1, 4, 9]
    finally:
        stub.stop()
    assert stub.states("flow_runs") == ["RUNNING", "COMPLETED"] and len(stub.states("task_runs")) == 6
    assert "".join(capfd.readouterr()) == ""


@pytest.mark.parametrize(
    "answer", [(404, '{"detail": "Not Found"}'), (200, "<html>"), (200, "[]")], ids=["no page", "html", "list"]
)
def test_a_server_of_another_kind(opened: Any, capfd: pytest.CaptureFixture[str], answer: tuple[int, str]) -> None:
    with running(lambda path: answer) as stub:
        assert job(opened(stub)) == [1, 4, 9]
    assert f"server {stub.url}/ gave an unexpected answer (" in the_line(capfd)


def test_after_a_refused_report_the_run_still_ends(opened: Any, capfd: pytest.CaptureFixture[str]) -> None:
    with running(lambda path: (422, "{}") if "task_runs" in path else (200, '{"id": "1"}')) as stub:
        assert job(opened(stub)) == [1, 4, 9]
    assert stub.states("flow_runs") == ["RUNNING", "COMPLETED"] and stub.states("task_runs") == ["RUNNING"]
    assert "422" in the_line(capfd)


@pytest.mark.parametrize("error", [InputError("cannot be used"), WorkError("no answer"), ValueError("a defect")])
def test_an_error_of_the_job_is_raised_and_reported(opened: Any, error: Exception) -> None:
    def work(n: int) -> int:
        raise error

    with running() as stub, pytest.raises(type(error), match=str(error)):
        job(opened(stub), work)
    assert stub.states("flow_runs") == ["RUNNING", "FAILED"] and stub.states("task_runs")[:2] == ["RUNNING", "FAILED"]
    assert str(error) in stub.got[-1][1]["state"]["message"]


def test_an_error_of_the_job_is_raised_without_a_server(opened: Any) -> None:
    def work(n: int) -> int:
        raise InputError("cannot be used")

    with pytest.raises(InputError, match=r"^cannot be used$"):
        job(opened(Stub(), end_s=0.1), work)


def test_a_process_that_hangs_holds_nobody_up(opened: Any, capfd: pytest.CaptureFixture[str]) -> None:
    reports = opened(Stub(), end_s=0.1)
    os.kill(reports._process.pid, signal.SIGSTOP)
    begun_s = time.monotonic()
    with FlowRun(reports, "toy", "toy run", "mill", {}) as run:
        for _ in range(200):
            run.line("a" * 1000)
    assert time.monotonic() - begun_s < 5.0
    assert "its process hangs" in the_line(capfd)


def test_a_process_that_cannot_be_started(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(prefect_reports, "PROCESS", ("/nowhere/python",))
    assert job(Reports()) == [1, 4, 9]
    assert "its process cannot be started (No such file or directory)" in the_line(capfd)


def test_a_prefect_that_cannot_be_imported(
    opened: Any, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    code = "import sys; sys.modules['prefect'] = None; from pipelines import prefect_process; prefect_process.main()"
    monkeypatch.setattr(prefect_reports, "PROCESS", (sys.executable, "-c", code))
    assert job(opened(Stub())) == [1, 4, 9]
    assert "Prefect: cannot be used (ModuleNotFoundError: " in the_line(capfd)


def test_a_training_whose_server_is_killed_in_the_grid(
    store: Any, store_home: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Its own server, which is part of the process that is killed."""
    monkeypatch.setenv("THERMODRIFT_HOME", str(store_home))
    monkeypatch.delenv("PREFECT_API_URL", raising=False)
    write_year(tmp_path / "in")
    machine = write_machine(tmp_path / "m.yml", "prefect-killed")
    steps: list[tuple[str, int, int]] = []
    reports = Reports()

    def done(*step: Any) -> None:
        steps.append(step)
        if step[0].startswith("grid") and step[1] == 1:
            assert reports._process is not None
            os.kill(reports._process.pid, signal.SIGKILL)

    plan = Plan(("none",), ("zero", "ridge"), ("leave-batch-out",))
    outcome = train_in_flow(TrainRequest(machine, (tmp_path / "in",), ("z",), plan), store, done=done, reports=reports)
    assert outcome.promotions["z"].outcome == "champion" and outcome.report is not None
    assert [(n, of) for step, n, of in steps if step.startswith("grid")] == [(1, 2), (2, 2)]
    assert "its process ended with exit code -9" in the_line(capfd)


def test_the_process_ends_with_the_command_though_its_server_is_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    """A killed command leaves nothing but the end of its input."""
    forever = threading.Event()
    with running(lambda path: (200, str(forever.wait(60)))) as stub:
        monkeypatch.setenv("PREFECT_API_URL", stub.url)
        process = subprocess.Popen(prefect_reports.PROCESS, stdin=subprocess.PIPE)
        try:
            begin = {"what": "begin", "flow": "toy", "name": "toy run", "parameters": {}, "key": "1", "scheduled": None}
            assert process.stdin is not None
            process.stdin.write(json.dumps(begin).encode() + b"\n")
            process.stdin.flush()
            wait_for(lambda: stub.got)
            process.stdin.close()
            assert process.wait(GONE_S) == 1
        finally:
            process.kill()
            forever.set()


@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="looks for processes below /proc")
def test_nothing_is_left_of_a_command_that_is_killed(tmp_path: Path) -> None:
    """And its run does not go on for ever on the server."""
    write_year(tmp_path / "in")
    machine = write_machine(tmp_path / "m.yml", "killed")
    with running() as stub:
        command = Command(
            tmp_path / "home", "train", "--machine", machine, "--recordings", tmp_path / "in", "--channels", "z",
            PREFECT_API_URL=stub.url,
        )  # fmt: skip
        try:
            assert command.reached(lambda c: stub.states("task_runs"), STARTED_S), command.output()
            assert any("prefect_process" in line for line in command.processes().values())
            command.process.kill()
            command.process.wait()
            wait_for(lambda: not command.processes(), GONE_S)
        finally:
            command.kill()
    assert stub.states("flow_runs") == ["RUNNING", "CRASHED"]


@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="looks for processes below /proc")
def test_nothing_is_left_where_the_server_is_still_coming_up(tmp_path: Path) -> None:
    write_year(tmp_path / "in")
    machine = write_machine(tmp_path / "m.yml", "killed")
    command = Command(tmp_path / "home", "train", "--machine", machine, PREFECT_API_URL="")
    try:
        assert command.reached(lambda c: "prefect_process" in "".join(c.processes().values()), STARTED_S)
        command.process.kill()
        command.process.wait()
        wait_for(lambda: not command.processes(), GONE_S)
    finally:
        command.kill()
