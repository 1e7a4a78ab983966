"""Jobs as flow runs of Prefect: the functions run here, as without it, and Prefect gets reports of them."""

from __future__ import annotations

import itertools
import logging
import platform
import re
import time
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from data.errors import InputError, WorkError
from data.machine import load_machine
from models.selection.grid import Pools, local_pools
from pipelines.caller import LANES, DirectCaller, Done, Say
from pipelines.jobs.diagnosing import DiagnosisRequest, dated_folder, diagnose_file
from pipelines.jobs.request import TrainRequest
from pipelines.jobs.training import TrainOutcome, train
from pipelines.prefect_reports import Reports
from pipelines.settings import Settings, load


class FlowRun:
    """A job as Prefect shows it: running while the context is open, then completed, or failed with the job's error.

    Args:
        flow: the name of the flow.
        name: the name of the run.
        machine: whose job it is; each try of an item is a task named by step, machine and item ("grid mill z ridge").
        parameters: as the UI lists them.
        scheduled: the id of a run that a server has made for this job.
    """

    def __init__(
        self, reports: Reports, flow: str, name: str, machine: str, parameters: Mapping[str, Any],
        scheduled: str | None = None,
    ) -> None:  # fmt: skip
        self._reports, self._machine, self._numbers = reports, machine, itertools.count()
        self._begin = {
            "flow": flow, "name": name, "parameters": dict(parameters), "key": uuid.uuid4().hex, "scheduled": scheduled,
        }  # fmt: skip

    def __enter__(self) -> Self:
        self._reports.send("begin", **self._begin)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None and not isinstance(error, Exception):  # Ctrl-C
            self._reports.stop()
            return
        self._reports.send("end", state="COMPLETED" if error is None else "FAILED", message=_words(error))
        self._reports.close()

    def line(self, text: str, level: int = logging.INFO) -> None:
        """A line of the run."""
        self._reports.send("line", level=level, text=text, at=datetime.now(UTC).isoformat())

    def link(self, report: Path) -> None:
        """The report as an artifact of the run."""
        key = re.sub(r"[^a-z0-9]+", "-", f"report-{self._machine}".lower()).strip("-")
        self._reports.send(
            "link", key=key, text=f"report of {self._machine}", url=report.as_uri(),
            description=f"Comparison report of {self._machine}: {report} on {platform.node()}",
        )  # fmt: skip

    @contextmanager
    def working(self, step: str, item: str) -> Iterator[None]:
        """A task of the run, see `pipelines.caller.Working`. Its message has the seconds that it took here: the server
        dates states by when it gets them."""
        key, began_s = str(next(self._numbers)), time.monotonic()
        task = {"key": key, "step": step, "name": " ".join(filter(None, (step, self._machine, item)))}
        self._reports.send("task", **task, state="RUNNING")
        try:
            yield
        except Exception as error:
            self._reports.send("task", **task, state="FAILED", message=_words(error))
            raise
        self._reports.send("task", **task, state="COMPLETED", message=f"{time.monotonic() - began_s:.1f} s")


def _words(error: BaseException | None) -> str:
    if error is None:
        return ""
    return str(error) if isinstance(error, InputError | WorkError) else f"{type(error).__name__}: {error}"


def train_in_flow(
    request: TrainRequest,
    settings: Settings,
    say: Say = lambda text: None,
    done: Done | None = None,
    reports: Reports | None = None,
    pools: Pools = local_pools,
    lanes: int = LANES,
) -> TrainOutcome:
    """`pipelines.jobs.training.train` as a flow run; same functions, same numbers, whatever happens to Prefect.

    Args:
        reports: the way to Prefect, which may have begun to come up; None opens one.
        pools: where the grid is computed.
        lanes: steps under way at a time.

    Raises what that raises.
    """
    machine, plan = load_machine(request.machine_file).machine, request.plan
    parameters = {
        "machine_file": str(request.machine_file), "recordings": [str(r) for r in request.recordings],
        "channels": list(request.targets), "effort": plan.effort, "families": list(plan.families),
        "selectors": list(plan.selectors), "protocols": list(plan.protocols), "promote": request.promote,
    }  # fmt: skip
    name = " ".join(("train", machine, *request.targets))
    with FlowRun(reports or Reports(), f"thermodrift-train-{machine}", name, machine, parameters) as run:

        def both(text: str) -> None:
            run.line(text)
            say(text)

        outcome = train(request, settings, DirectCaller(done, run.working, lanes), both, pools)
        for text in filter(None, (outcome.stopped, *(p.summary for p in outcome.promotions.values()))):
            run.line(text)
        if outcome.report is not None:
            run.link(outcome.report)
    return outcome


def diagnose(machine_file: str, recordings: list[str], out: str = "") -> str:
    """`pipelines.jobs.diagnosing.diagnose_file` as a flow run, in a dated folder where no `out` is given; returns a
    summary.

    An error is printed in one line, and the run counts as failed.
    """
    file = Path(machine_file)
    parameters = {"machine_file": machine_file, "recordings": recordings, "out": out}
    with FlowRun(Reports(), "thermodrift-diagnose", f"diagnose {file.stem}", file.stem, parameters) as run:
        folder = Path(out) if out else dated_folder(file.stem)
        request = DiagnosisRequest(file, folder, tuple(Path(r) for r in recordings), overwrite=True)
        try:
            outcome = diagnose_file(request, load(), caller=DirectCaller(working=run.working))
        except (InputError, WorkError) as error:
            run.line(f"not diagnosed: {error}", logging.ERROR)
            print(f"{datetime.now():%Y-%m-%d %H:%M} not diagnosed: {error}", flush=True)
            raise
        machine = outcome.diagnosis.findings.machine
        run.line(outcome.summary)
        print(f"{datetime.now():%Y-%m-%d %H:%M} {machine}: {outcome.summary}", flush=True)
        return outcome.summary
