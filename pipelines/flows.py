"""The same steps as Prefect flows: tasks with retries, and one temporary server per command."""

from __future__ import annotations

import logging
import platform
import re
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any, TypeVar

from prefect import flow, get_run_logger, task
from prefect.artifacts import create_link_artifact
from prefect.cache_policies import NO_CACHE
from prefect.task_runners import ThreadPoolTaskRunner
from threadpoolctl import threadpool_limits

from data.errors import InputError, WorkError
from data.machine import load_machine
from models.selection.grid import Pools, local_pools
from pipelines.caller import LANES, Done, Say, counted, label
from pipelines.jobs.diagnosing import DiagnosisRequest, dated_folder, diagnose_file
from pipelines.jobs.request import TrainRequest
from pipelines.jobs.training import TrainOutcome, train
from pipelines.settings import Settings, load

T = TypeVar("T")
R = TypeVar("R")
RETRY_DELAY_S = 2.0


class PrefectCaller:
    """Steps as tasks of the flow that is running, each named by step, machine and item ("grid mill z ridge")."""

    def __init__(self, done: Done | None = None, machine: str = "") -> None:
        self.done, self.machine = done, machine

    def map(self, step: str, work: Callable[[T], R], items: Sequence[T], retries: int = 0) -> list[R]:
        # Items travel in a closure: Prefect would otherwise walk through every data frame looking for futures.
        # The lake's hashes are the cache, so Prefect keeps none.
        reported = counted(step, work, len(items), self.done)

        def one(i: int, called: str) -> R:
            return reported(items[i])

        unit = task(
            one,
            name=step,
            task_run_name="{called}",
            cache_policy=NO_CACHE,
            persist_result=False,
            retries=retries,
            retry_delay_seconds=RETRY_DELAY_S,
            retry_condition_fn=_can_succeed,
        )
        with threadpool_limits(limits=1):
            names = [" ".join(filter(None, (step, self.machine, label(item)))) for item in items]
            futures = [unit.submit(i, name) for i, name in enumerate(names)]
            return [future.result() for future in futures]


def _can_succeed(task: Any, run: Any, state: Any) -> bool:
    """Whether another try may help: input that cannot be used does not improve by waiting."""
    try:
        state.result()
    except InputError:
        return False
    except Exception:
        return True
    return True


def train_in_flow(
    request: TrainRequest,
    settings: Settings,
    say: Say = lambda text: None,
    done: Done | None = None,
    server: threading.Thread | None = None,
    pools: Pools = local_pools,
    lanes: int = LANES,
) -> TrainOutcome:
    """`pipelines.jobs.training.train` as a flow; same functions, same numbers.

    Args:
        server: the start of a temporary server, see `prefect_server.start_server`.
        pools: where the grid is computed.
        lanes: steps under way at a time.
    """
    machine = load_machine(request.machine_file).machine
    run_name = " ".join(("train", machine, *request.targets))

    @flow(name=f"thermodrift-train-{machine}", flow_run_name=run_name, task_runner=ThreadPoolTaskRunner(lanes),
          persist_result=False, validate_parameters=False)  # fmt: skip
    def training(
        machine_file: str,
        recordings: list[str],
        channels: list[str],
        effort: str,
        families: list[str],
        selectors: list[str],
        protocols: list[str],
        promote: bool,
    ) -> TrainOutcome:  # what the UI shows; `request` has it all
        log = get_run_logger()

        def both(text: str) -> None:
            log.info(text)
            say(text)

        outcome = train(request, settings, PrefectCaller(done, machine), both, pools)
        for text in filter(None, (outcome.stopped, *(p.summary for p in outcome.promotions.values()))):
            log.info(text)
        if outcome.report is not None:
            link_report(machine, outcome.report)
        return outcome

    if server is not None:
        server.join()
    log_to_server()
    return training(**_parameters(request))


def _parameters(request: TrainRequest) -> dict[str, Any]:
    """A request as the UI lists a run's parameters; empty lists mean all."""
    plan = request.plan
    return {
        "machine_file": str(request.machine_file), "recordings": [str(r) for r in request.recordings],
        "channels": list(request.targets), "effort": plan.effort, "families": list(plan.families),
        "selectors": list(plan.selectors), "protocols": list(plan.protocols), "promote": request.promote,
    }  # fmt: skip


@flow(name="thermodrift-diagnose", task_runner=ThreadPoolTaskRunner(max_workers=LANES), persist_result=False)
def diagnose(machine_file: str, recordings: list[str], out: str = "") -> str:
    """`pipelines.jobs.diagnosing.diagnose_file` as a flow, in a dated folder where no `out` is given; returns a
    summary.

    An error is printed in one line, and the run counts as failed.
    """
    log_to_server()
    log = get_run_logger()
    file = Path(machine_file)
    folder = Path(out) if out else dated_folder(file.stem)
    request = DiagnosisRequest(file, folder, tuple(Path(r) for r in recordings), overwrite=True)
    try:
        outcome = diagnose_file(request, load(), caller=PrefectCaller(machine=file.stem))
    except (InputError, WorkError) as error:
        log.error("not diagnosed: %s", error)
        print(f"{datetime.now():%Y-%m-%d %H:%M} not diagnosed: {error}", flush=True)
        raise
    machine = outcome.diagnosis.findings.machine
    log.info(outcome.summary)
    print(f"{datetime.now():%Y-%m-%d %H:%M} {machine}: {outcome.summary}", flush=True)
    return outcome.summary


def link_report(machine: str, report: Path) -> None:
    """The report as an artifact of the run; without it the run is as good."""
    key = re.sub(r"[^a-z0-9]+", "-", f"report-{machine}".lower()).strip("-")
    with suppress(Exception):
        create_link_artifact(
            link=report.as_uri(), link_text=f"report of {machine}", key=key,
            description=f"Comparison report of {machine}: {report} on {platform.node()}",
        )  # fmt: skip


class _Plain(logging.Filter):
    """An expected error has one line of its own; Prefect's with a traceback adds nothing."""

    def filter(self, record: logging.LogRecord) -> bool:
        error = record.exc_info[1] if record.exc_info else None
        return not isinstance(error, InputError | WorkError)


def log_to_server() -> None:
    """Lines of a run go to the server and not to the console, where the run prints what it has to say."""
    for name in ("prefect.flow_runs", "prefect.task_runs"):
        logger = logging.getLogger(name)
        logger.setLevel(logging.INFO)
        logger.propagate = False
        for handler in logger.handlers:
            if not any(isinstance(f, _Plain) for f in handler.filters):
                handler.addFilter(_Plain())
