"""Retraining on a schedule: the flow of one retraining, and the waiting for its dates."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from zoneinfo import ZoneInfo, available_timezones

from cronsim import CronSim, CronSimError
from prefect import flow
from prefect import settings as prefect_settings
from prefect.client.schemas.schedules import CronSchedule
from prefect.server.api.server import SubprocessASGIServer
from prefect.task_runners import ThreadPoolTaskRunner
from prefect.types.entrypoint import EntrypointType

from data.errors import InputError, WorkError
from data.machine import load_machine
from pipelines import stopping
from pipelines.caller import LANES, Say
from pipelines.flows import PrefectCaller, quiet_prefect, start_server
from pipelines.settings import load
from pipelines.training import TrainRequest, train


@flow(name="thermodrift-retrain", task_runner=ThreadPoolTaskRunner(max_workers=LANES), persist_result=False)
def retrain(machine_file: str, recordings: list[str]) -> str:
    """Ingest what arrived since the last time and train if there is anything new; returns a summary.

    An error is printed in one line, and the run counts as failed.
    """
    quiet_prefect()
    request = TrainRequest(Path(machine_file), tuple(Path(r) for r in recordings), only_if_new=True)
    try:
        outcome = train(request, load(), PrefectCaller(machine=load_machine(request.machine_file).machine))
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
