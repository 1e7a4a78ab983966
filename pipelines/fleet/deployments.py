"""A fleet on a Prefect server: one deployment per machine, whose runs the server schedules and this process begins.

Prefect's own `serve` ends where its server is away for some minutes. Its process worker (3.8) does not, but like
`serve` it then works off every run that was scheduled meanwhile, one after another. With one run at a time for each
deployment (`concurrency_limit` 1, `CANCEL_NEW`) the server is to cancel the others, but the engine ends a run that
cannot renew its place, as it does every 225 s: 8 to 11 s after connections were refused. Here a server that does not
answer is one line, its return another, and no run depends on it; of the runs that came due meanwhile the newest of each
machine is done, the others are cancelled with the reason.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from contextlib import ExitStack, suppress
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any, Self
from uuid import UUID

import httpx
from prefect.client.orchestration import get_client
from prefect.client.schemas.actions import DeploymentScheduleCreate
from prefect.client.schemas.filters import DeploymentFilter, DeploymentFilterTags
from prefect.client.schemas.schedules import SCHEDULE_TYPES, CronSchedule, IntervalSchedule
from prefect.exceptions import ObjectNotFound, PrefectHTTPStatusError
from prefect.settings import (
    PREFECT_API_REQUEST_TIMEOUT,
    PREFECT_API_URL,
    PREFECT_CLIENT_MAX_RETRIES,
    temporary_settings,
)
from prefect.states import Cancelled, Crashed, Pending

from data.errors import masked
from pipelines.caller import Say
from pipelines.fleet.fleet_file import Fleet, FleetMachine
from pipelines.fleet.folders import Folders
from pipelines.fleet.scheduling import Job

if TYPE_CHECKING:
    from prefect.client.orchestration import SyncPrefectClient
    from prefect.client.schemas.responses import DeploymentResponse, FlowRunResponse

FLOW = "thermodrift-retrain"
ENTRYPOINT = "pipelines.fleet.retraining.retrain"
POLL_S = 5.0
LOST_POLL_S = 10.0  # while the server does not answer
LOST_AFTER_S = 15.0  # a server under load drops a connection now and then
UPCOMING_S = 60.0
TIMEOUT_S = 10.0
TROUBLE = (httpx.HTTPError, PrefectHTTPStatusError, RuntimeError, OSError)


class Deployments:
    """The source of jobs of `scheduling.Scheduler` where there is a Prefect server; a context.

    `again`: machines whose turn is to be repeated.
    """

    def __init__(
        self, fleet: Fleet, schema: Mapping[str, Any], folders: Folders, say: Say, again: Iterable[str] = ()
    ) -> None:
        self.url, self._again = masked(str(PREFECT_API_URL.value())), set(again)
        self._fleet, self._schema, self._folders, self._say = fleet, schema, folders, say
        self._ids: dict[UUID, FleetMachine] = {}
        self._due: dict[str, Job] = {}
        self._next: dict[str, datetime | None] = {}
        self._silent: datetime | None = None  # since when no request was answered
        self._lost = False  # and that has been reported
        self._poll_at_s = self._upcoming_at_s = 0.0
        self._open = ExitStack()
        self._client: SyncPrefectClient

    def __enter__(self) -> Self:
        # A request that fails is made again by the next poll; the client's own tries would last a minute.
        own = {PREFECT_CLIENT_MAX_RETRIES: 0, PREFECT_API_REQUEST_TIMEOUT: TIMEOUT_S}
        self._open.enter_context(temporary_settings(own))
        self._client = self._open.enter_context(get_client(sync_client=True))
        return self

    def __exit__(self, *error: Any) -> None:
        self._open.close()

    def due(self, now: datetime) -> list[Job]:
        if time.monotonic() >= self._poll_at_s:
            try:
                self._poll(now)
                self._answered(now)
                self._poll_at_s = time.monotonic() + POLL_S
            except TROUBLE as error:
                self._failed(now, error)
                self._poll_at_s = time.monotonic() + LOST_POLL_S
        return sorted(self._due.values(), key=lambda job: job.since)

    def begin(self, job: Job, now: datetime) -> bool:
        """Pending is what one process alone can propose: another that serves the same deployments gets no second."""
        assert job.flow_run_id is not None
        self._due.pop(job.machine.name, None)
        self._upcoming_at_s = 0.0
        try:
            answer = self._client.set_flow_run_state(UUID(job.flow_run_id), Pending())
        except ObjectNotFound:  # deleted in the UI
            return False
        except TROUBLE as error:
            self._failed(now, error)
            return False
        return bool(answer.status == "ACCEPT")

    def ended(self, job: Job, ok: bool | None) -> None:
        """A run whose process could not say how it ended would be running for ever."""
        if ok is not None or job.flow_run_id is None:
            return
        with suppress(*TROUBLE):
            self._client.set_flow_run_state(UUID(job.flow_run_id), Crashed(message="its process was ended"), force=True)

    def next(self) -> Mapping[str, datetime | None]:
        return self._next

    def _poll(self, now: datetime) -> None:
        if not self._ids:
            self._register()
        settled = self._folders.settled(now)
        for deployment, m in self._ids.items():
            if m.name in settled or m.name in self._again:
                self._client.create_flow_run_from_deployment(deployment, name=f"retrain {m.name}")
                self._folders.taken(m.name)
                self._again.discard(m.name)
        runs = self._scheduled(now)
        before, self._due = self._due, {}
        for deployment, machine in self._ids.items():
            own = [r for r in runs if r.deployment_id == deployment]
            self._skip(own[:-1])
            if own:
                waits = [r.next_scheduled_start_time or now for r in own]
                waits += [before[machine.name].since] if machine.name in before else []  # for a run that is skipped now
                self._due[machine.name] = Job(machine, min(waits), str(own[-1].id), own[-1].parameters)
        if time.monotonic() >= self._upcoming_at_s:
            self._upcoming()
            self._upcoming_at_s = time.monotonic() + UPCOMING_S

    def _scheduled(self, before: datetime) -> list[FlowRunResponse]:
        """Runs that are due, by date."""
        found = self._client.get_scheduled_flow_runs_for_deployments(list(self._ids), scheduled_before=before)
        return sorted(found, key=lambda r: r.next_scheduled_start_time or before)

    def _skip(self, runs: Iterable[FlowRunResponse]) -> None:
        for run in runs:
            message = "missed; a later run of the same machine does its work"
            self._client.set_flow_run_state(run.id, Cancelled(message=message))

    def _upcoming(self) -> None:
        """The next date of each machine as the server has it: nothing where its schedule is paused there."""
        for deployment, machine in self._ids.items():
            runs = self._client.get_scheduled_flow_runs_for_deployments([deployment], limit=1)
            dates = [r.next_scheduled_start_time for r in runs if r.next_scheduled_start_time is not None]
            self._next[machine.name] = min(dates).astimezone(self._fleet.zone) if dates else None

    def _register(self) -> None:
        """A deployment per machine; one that is there as it should be is left as it is, with its due runs."""
        flow = self._client.create_flow_from_name(FLOW)
        ids = {}
        for m in self._fleet.machines:
            there = self._there(m)
            if there is None or not self._as_wanted(there, m):
                ids[self._create(flow, m)] = m
            else:
                ids[there.id] = m
                if there.paused:
                    self._say(f"{m.name}: its deployment is paused on the server; resume it there")
        self._ids = ids
        self._pause_others()

    def _create(self, flow: UUID, m: FleetMachine) -> UUID:
        schedule = self._schedule(m)
        schedules = [] if schedule is None else [DeploymentScheduleCreate(schedule=schedule)]
        return self._client.create_deployment(
            flow, deployment_name(m), schedules=schedules, parameters=m.parameters, tags=self._tags(), path=".",
            description=f"Retrains {m.name} ({m.file}), {m.when.summary}", entrypoint=ENTRYPOINT,
            parameter_openapi_schema=dict(self._schema), enforce_parameter_schema=False,
        )  # fmt: skip

    def _tags(self) -> list[str]:
        return ["thermodrift", f"fleet {self._fleet.key}"]

    def _there(self, m: FleetMachine) -> DeploymentResponse | None:
        try:
            return self._client.read_deployment_by_name(f"{FLOW}/{deployment_name(m)}")
        except ObjectNotFound:
            return None

    def _as_wanted(self, there: DeploymentResponse, m: FleetMachine) -> bool:
        wanted = self._schedule(m)
        same = [_meaning(s.schedule) for s in there.schedules] == ([] if wanted is None else [_meaning(wanted)])
        own = there.parameters == m.parameters and there.entrypoint == ENTRYPOINT
        return same and own and set(self._tags()) <= set(there.tags)

    def _schedule(self, m: FleetMachine) -> SCHEDULE_TYPES | None:
        if m.when.cron is not None:
            return CronSchedule(cron=m.when.cron, timezone=self._fleet.timezone)
        if m.when.every_h is None:
            return None
        first = datetime.now(UTC) + timedelta(hours=m.when.every_h)
        return IntervalSchedule(
            interval=timedelta(hours=m.when.every_h), anchor_date=first, timezone=self._fleet.timezone
        )

    def _pause_others(self) -> None:
        """Deployments of this fleet file whose machines are not in it."""
        tagged = DeploymentFilter(tags=DeploymentFilterTags(all_=self._tags()))
        for d in self._client.read_deployments(deployment_filter=tagged):
            if d.id not in self._ids and not d.paused:
                self._client.pause_deployment(d.id)
                self._say(f"{d.name}: not in {self._fleet.source}; its deployment is paused")

    def _answered(self, now: datetime) -> None:
        if self._lost and self._silent is not None:
            away_s = (now - self._silent).total_seconds()
            away = f"{away_s:.0f} s" if away_s < 120 else f"{away_s / 60:.0f} min"
            self._say(f"{datetime.now():%Y-%m-%d %H:%M} Prefect server {self.url} is back after {away}")
        self._silent, self._lost = None, False

    def _failed(self, now: datetime, error: Exception) -> None:
        self._due, self._ids = {}, {}  # the server may come back without them
        self._silent = self._silent or now
        if not self._lost and (now - self._silent).total_seconds() >= LOST_AFTER_S:
            self._lost = True
            said = " ".join(str(error).split())[:120] or type(error).__name__
            when = f"{datetime.now():%Y-%m-%d %H:%M}"
            self._say(f"{when} Prefect server {self.url} does not answer ({said}); waiting for it")


def deployment_name(m: FleetMachine) -> str:
    """As `prefect deployment ls` has it."""
    return f"retrain-{m.name}"


def _meaning(schedule: SCHEDULE_TYPES) -> tuple[Any, ...]:
    """What makes two schedules the same; an interval begins when it was first registered."""
    every = getattr(schedule, "interval", None)
    return getattr(schedule, "cron", None), None if every is None else every.total_seconds(), schedule.timezone
