"""The same steps as Prefect flows: tasks with retries, a schedule, and one temporary server per command."""

from __future__ import annotations

import atexit
import logging
import os
import threading
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, TypeVar
from zoneinfo import ZoneInfo, available_timezones

from cronsim import CronSim, CronSimError
from prefect import flow, task
from prefect import settings as prefect_settings
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.schedules import CronSchedule
from prefect.server.api.server import SubprocessASGIServer
from prefect.task_runners import ThreadPoolTaskRunner
from prefect.types.entrypoint import EntrypointType
from threadpoolctl import threadpool_limits

from data.errors import InputError, WorkError
from data.processes import at_end, without_interrupt
from pipelines import stopping
from pipelines.caller import LANES, Done, Say, counted
from pipelines.diagnosing import DiagnosisRequest, dated_folder, diagnose_file
from pipelines.settings import Settings, load
from pipelines.training import TrainOutcome, TrainRequest, train

T = TypeVar("T")
R = TypeVar("R")
RETRY_DELAY_S = 2.0
POPEN_S = 1.0  # for the operating system to start a process


class PrefectCaller:
    """Steps as tasks of the flow that is running."""

    def __init__(self, done: Done | None = None) -> None:
        self.done = done

    def map(self, step: str, work: Callable[[T], R], items: Sequence[T], retries: int = 0) -> list[R]:
        # Items travel in a closure: Prefect would otherwise walk through every data frame looking for futures.
        # The lake's hashes are the cache, so Prefect keeps none.
        reported = counted(step, work, len(items), self.done)

        def one(i: int) -> R:
            return reported(items[i])

        unit = task(
            one,
            name=step,
            task_run_name=f"{step} {{i}}",
            cache_policy=NO_CACHE,
            persist_result=False,
            retries=retries,
            retry_delay_seconds=RETRY_DELAY_S,
            retry_condition_fn=_can_succeed,
        )
        with threadpool_limits(limits=1):
            futures = [unit.submit(i) for i in range(len(items))]
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


def start_server() -> threading.Thread | None:
    """Start Prefect's temporary server in the background, so that it comes up while other work goes on.

    None where PREFECT_API_URL names a running one. The flow finds the same server again. Prefect starts this server
    by itself as well, but only when the flow begins, and has no public way to start it earlier or to stop it.
    """
    if prefect_settings.PREFECT_API_URL.value():
        return None
    thread = threading.Thread(target=_serve, daemon=True)
    thread.start()
    at_end(partial(_kill_server, thread))
    return thread


def _serve() -> None:
    with without_interrupt():
        SubprocessASGIServer().start(timeout=60)


def _kill_server(starting: threading.Thread) -> None:
    """Its own way to stop may take 5 s, and lets a client that misses it start another one.

    Its store is SQLite, which a kill leaves in order.
    """
    server = SubprocessASGIServer()
    server.running = True  # so that none is started from now on
    atexit.unregister(server.stop)
    end_s = time.monotonic() + POPEN_S
    while server.server_process is None and starting.is_alive() and time.monotonic() < end_s:
        time.sleep(0.01)
    if server.server_process is not None:
        server.server_process.kill()
        server.server_process.wait()


def train_in_flow(
    request: TrainRequest,
    settings: Settings,
    say: Say = lambda text: None,
    done: Done | None = None,
    server: threading.Thread | None = None,
) -> TrainOutcome:
    """`pipelines.training.train` as a flow; same functions, same numbers."""

    @flow(name=f"thermodrift-train-{request.machine_file.stem}", task_runner=ThreadPoolTaskRunner(max_workers=LANES),
          persist_result=False, validate_parameters=False)  # fmt: skip
    def training() -> TrainOutcome:
        return train(request, settings, PrefectCaller(done), say)

    if server is not None:
        server.join()
    _quiet_prefect()
    return training()


@flow(name="thermodrift-retrain", task_runner=ThreadPoolTaskRunner(max_workers=LANES), persist_result=False)
def retrain(machine_file: str, recordings: list[str]) -> str:
    """Ingest what arrived since the last time and train if there is anything new; returns a summary.

    An error is printed in one line, and the run counts as failed.
    """
    _quiet_prefect()
    request = TrainRequest(Path(machine_file), tuple(Path(r) for r in recordings), only_if_new=True)
    try:
        outcome = train(request, load(), PrefectCaller())
    except (InputError, WorkError) as error:
        print(f"{datetime.now():%Y-%m-%d %H:%M} not retrained: {error}", flush=True)
        raise
    summary = outcome.stopped or "; ".join(p.summary for p in outcome.promotions.values())
    quarantined = len(outcome.ingested.quarantined) if outcome.ingested else 0
    summary += f" (files in quarantine: {quarantined})" if quarantined else ""
    waiting = len(outcome.ingested.waiting) if outcome.ingested else 0
    summary += f" (files still being written: {waiting})" if waiting else ""
    summary += f"; {outcome.diagnosis_summary}" if outcome.diagnosis_summary else ""
    print(f"{datetime.now():%Y-%m-%d %H:%M} {outcome.machine}: {summary}", flush=True)
    return summary


@flow(name="thermodrift-diagnose", task_runner=ThreadPoolTaskRunner(max_workers=LANES), persist_result=False)
def diagnose(machine_file: str, recordings: list[str], out: str = "") -> str:
    """`pipelines.diagnosing.diagnose_file` as a flow, in a dated folder where no `out` is given; returns a summary.

    An error is printed in one line, and the run counts as failed.
    """
    _quiet_prefect()
    file = Path(machine_file)
    folder = Path(out) if out else dated_folder(file.stem)
    request = DiagnosisRequest(file, folder, tuple(Path(r) for r in recordings), overwrite=True)
    try:
        outcome = diagnose_file(request, load(), caller=PrefectCaller())
    except (InputError, WorkError) as error:
        print(f"{datetime.now():%Y-%m-%d %H:%M} not diagnosed: {error}", flush=True)
        raise
    machine = outcome.diagnosis.findings.machine
    print(f"{datetime.now():%Y-%m-%d %H:%M} {machine}: {outcome.summary}", flush=True)
    return outcome.summary


def serve_schedule(
    machine_file: Path,
    recordings: Sequence[Path],
    cron: str,
    say: Say = lambda text: None,
    rounds: int | None = None,
) -> None:
    """Retrain on a cron schedule in local time until interrupted (or for `rounds`).

    Where PREFECT_API_URL names a server, a deployment is served whose runs that server schedules. Without one this
    process waits by itself and starts Prefect's temporary server for each run, because such a server schedules
    nothing. An error in one run is printed; the next one follows all the same.

    Raises:
        InputError: `cron` is no cron expression.
    """
    zone = ZoneInfo(local_timezone())
    try:
        schedule = CronSchedule(cron=cron, timezone=zone.key)
        CronSim(cron, datetime.now(zone))
    except (ValueError, CronSimError):
        raise InputError(
            f"--cron: got {cron!r}, expected five fields (minute hour day month weekday), such as '0 5 * * 1' for "
            "Mondays at 5:00"
        ) from None
    parameters = {"machine_file": str(machine_file.resolve()), "recordings": [str(r.resolve()) for r in recordings]}
    if prefect_settings.PREFECT_API_URL.value():
        say(f"retraining of {machine_file.stem} at '{cron}' ({zone.key}); Ctrl-C ends it")
        stopping.release()  # Prefect ends its runs and pauses the schedule on the server
        retrain.serve(
            name=f"retrain-{machine_file.stem}",
            schedule=schedule,
            parameters=parameters,
            limit=1,
            print_starting_message=False,
            entrypoint_type=EntrypointType.MODULE_PATH,  # a file path would be relative to the working directory
        )
        return
    while rounds is None or rounds > 0:
        due = next(CronSim(cron, datetime.now(zone)))  # from now on: a run may last past the next date
        say(f"retraining of {machine_file.stem} next at {due:%Y-%m-%d %H:%M %Z}; Ctrl-C ends it")
        _wait_until(due)
        server = start_server()
        try:
            if server is not None:
                server.join()
            retrain(**parameters)
        except (InputError, WorkError):
            pass  # the flow has printed it
        except Exception as error:
            print(f"{datetime.now():%Y-%m-%d %H:%M} not retrained: {type(error).__name__}: {error}", flush=True)
        finally:
            SubprocessASGIServer().stop()
        rounds = None if rounds is None else rounds - 1


def _wait_until(due: datetime) -> None:
    """In short sleeps, since a computer may be suspended or its clock set."""
    while (left_s := (due - datetime.now(UTC)).total_seconds()) > 0:
        time.sleep(min(left_s, 30.0))


def local_timezone() -> str:
    """The IANA name of the local time zone, UTC where the system does not state it."""
    named = os.environ.get("TZ", "").lstrip(":")
    linked = Path("/etc/localtime").resolve().as_posix().partition("zoneinfo/")[2]
    return next((z for z in (named, linked) if z in available_timezones()), "UTC")


def _quiet_prefect() -> None:
    """The command prints an error once, in one line; Prefect would log it with a traceback."""
    for name in ("prefect.flow_runs", "prefect.task_runs"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
