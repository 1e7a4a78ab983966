"""The process that waits for the machines of a fleet and has each retrained in a process of its own.

It decides nothing about models and imports little: what comes due is a `Source` (dates and watched folders here, a
Prefect server in `pipelines.fleet.deployments`), what a run does is in `pipelines.fleet.apart`. One run per machine at
a time, the longest waiting first: too many machines for one computer are each retrained less often. A date that passes
while a run goes on, or while this process does not run, is caught up once, and so is a run that ended with this
process.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Protocol

from data.endings import ending
from data.files import from_json
from pipelines.caller import Say
from pipelines.fleet import alerts, fleet_state
from pipelines.fleet.fleet_file import Fleet, FleetMachine
from pipelines.fleet.folders import Folders

TICK_S = 1.0
NEVER = datetime.min.replace(tzinfo=UTC)
TRIES = 2  # of a turn that ended with this process: what ends twice may be what ends this process
APART = (sys.executable, "-m", "pipelines.fleet.apart")
END_S = 2.5  # for a run to end after SIGTERM; an operator waits 5 s for all of it


def started_apart(what: str, line: str, **streams: Any) -> subprocess.Popen[str]:
    """The process of `pipelines.fleet.apart` that does `what` with a line of JSON.

    Its standard input stays open: it ends when that closes, at the latest with this process.
    """
    process = subprocess.Popen((*APART, what), stdin=subprocess.PIPE, text=True, start_new_session=True, **streams)
    assert process.stdin is not None
    with contextlib.suppress(BrokenPipeError):
        process.stdin.write(line + "\n")
        process.stdin.flush()
    return process


@dataclass(frozen=True)
class Job:
    """A machine whose turn has come, and since when it waits; id and parameters of the run where a server made it."""

    machine: FleetMachine
    since: datetime
    flow_run_id: str | None = None
    parameters: Mapping[str, Any] | None = None


class Source(Protocol):
    """What comes due, and when."""

    def due(self, now: datetime) -> list[Job]:
        """Every job that could begin now, again and again until it begins, the longest waiting first."""

    def begin(self, job: Job, now: datetime) -> bool:
        """The job begins; False where it is no longer to be done."""

    def ended(self, job: Job, ok: bool | None) -> None:
        """The job ended; `ok` None: its process did not say how, or was ended."""

    def next(self) -> Mapping[str, datetime | None]:
        """The next date of each machine by name, None where none is known."""


class Clock:
    """Dates that this process computes, and folders that it watches.

    Args:
        last: when each machine last had its turn.
        again: machines whose turn is to be repeated.
    """

    def __init__(
        self,
        fleet: Fleet,
        last: Mapping[str, datetime],
        folders: Folders,
        now: datetime,
        again: Collection[str] = (),
    ) -> None:
        self._fleet, self._folders, self._last, self._began = fleet, folders, dict(last), now
        self._next: dict[str, datetime | None] = {
            m.name: last.get(m.name, now) if m.name in again else m.when.next(last.get(m.name, now), fleet.zone)
            for m in fleet.machines
        }

    def due(self, now: datetime) -> list[Job]:
        since = {name: due for name, due in self._next.items() if due is not None and due <= now}
        for name, changed in self._folders.settled(now).items():
            since[name] = min(changed, since.get(name, changed))
        jobs = [Job(m, since[m.name]) for m in self._fleet.machines if m.name in since]
        return sorted(jobs, key=lambda j: (j.since, self._last.get(j.machine.name, NEVER)))

    def begin(self, job: Job, now: datetime) -> bool:
        self._next[job.machine.name] = job.machine.when.next(now, self._fleet.zone)
        self._last[job.machine.name] = now
        self._folders.taken(job.machine.name)
        return True

    def ended(self, job: Job, ok: bool | None) -> None:
        pass

    def next(self) -> Mapping[str, datetime | None]:
        return {name: due if due is None else max(due, self._began) for name, due in self._next.items()}


@dataclass
class Run:
    """A retraining under way in its process."""

    job: Job
    process: subprocess.Popen[str]
    result: Path
    log: Path
    began: datetime
    too_long: bool = False  # it was ended for that

    def over(self) -> bool:
        """Whether the process has ended; its id stays taken until `kill`, which ends what it may have left behind."""
        if self.process.returncode is not None or not hasattr(os, "waitid"):
            return self.process.poll() is not None
        return os.waitid(os.P_PID, self.process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None

    def outcome(self) -> dict[str, Any]:
        """`ok` (None: it did not say) and `summary`, of a process that has ended."""
        if self.too_long:
            return {"ok": None, "summary": f"ended after {self.job.machine.limit_h:g} h (limit_h); see {self.log}"}
        try:
            said: dict[str, Any] = from_json(self.result.read_text(encoding="utf-8"))
            return said
        except (OSError, ValueError):
            code = self.process.returncode
            how = f"by signal {signal.Signals(-code).name}" if code < 0 else f"with exit code {code}"
            return {"ok": None, "summary": f"its process ended {how}; see {self.log}"}
        finally:
            self.result.unlink(missing_ok=True)

    def kill(self) -> None:
        """End it with all processes that it started, and take note of how it ended."""
        if self.process.stdin is not None:
            with contextlib.suppress(OSError):
                self.process.stdin.close()
        if hasattr(os, "killpg"):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.process.pid, signal.SIGKILL)
        self.process.kill()
        self.process.wait()


class Scheduler:
    """The loop: begins what is due, at most `at_once` runs and one per machine, and states how they ended."""

    def __init__(self, fleet: Fleet, source: Source, home: Path, say: Say) -> None:
        self.fleet, self.source, self.home, self.say = fleet, source, home, say
        self.running: dict[str, Run] = {}
        self.ended = 0
        self._told: Mapping[str, datetime | None] = {}

    def serve(self, rounds: int | None = None, sleep: Callable[[float], None] = time.sleep) -> None:
        """Until interrupted, or until `rounds` runs have ended."""
        for name, (began, tries) in fleet_state.unfinished(self.home, self.fleet).items():
            if tries >= TRIES:
                said = f"{tries} runs ended with the process that had begun them; the next one is at its next date"
                self._report(name, began, False, said)
        with ending(self.stop):
            while rounds is None or self.ended < rounds:
                self.step(datetime.now(UTC))
                sleep(TICK_S)

    def step(self, now: datetime) -> None:
        """Take note of what ended, begin what is due."""
        for run in list(self.running.values()):
            run.too_long = now - run.began > timedelta(hours=run.job.machine.limit_h)
            if run.too_long or run.over():
                self._end(run)
        for job in self.source.due(now):
            name = job.machine.name
            if name in self.running or len(self.running) >= self.fleet.at_once or not self.source.begin(job, now):
                continue
            try:
                self.running[name] = self._begin(job, now)
            except OSError as error:  # no space, no memory for a process: the next date may fare better
                self.source.ended(job, None)
                self.ended += 1
                self._report(name, now, False, str(error))
        if (upcoming := dict(self.source.next())) != self._told:
            with contextlib.suppress(OSError):  # tried again at the next change
                fleet_state.write_schedule(self.home, self.fleet, upcoming)
            self._told = upcoming

    def stop(self) -> None:
        """End every run, within `END_S`."""
        runs = list(self.running.values())
        for run in runs:
            run.process.terminate()
        end_s = time.monotonic() + END_S
        while not all(r.over() for r in runs) and time.monotonic() < end_s:
            time.sleep(0.02)
        for run in runs:
            run.kill()
            run.result.unlink(missing_ok=True)
            self.source.ended(run.job, None)

    def _begin(self, job: Job, now: datetime) -> Run:
        machine = job.machine
        fleet_state.note_turn(self.home, self.fleet, machine.name, now)
        folder = fleet_state.folder_of(self.home)
        result, log = (folder / f"{fleet_state.file_name(machine.name)}{suffix}" for suffix in (".result", ".log"))
        result.unlink(missing_ok=True)
        with log.open("w", encoding="utf-8") as out:
            parameters = machine.parameters if job.parameters is None else dict(job.parameters)
            line = {"parameters": parameters, "flow_run_id": job.flow_run_id, "result": str(result)}
            process = started_apart("run", json.dumps(line), stdout=out, stderr=subprocess.STDOUT)
        return Run(job, process, result, log, now)

    def _end(self, run: Run) -> None:
        name = run.job.machine.name
        del self.running[name]
        run.kill()
        outcome = run.outcome()
        self.source.ended(run.job, outcome["ok"])
        self.ended += 1
        self._report(name, run.began, bool(outcome["ok"]), " ".join(str(outcome["summary"]).split()))

    def _report(self, name: str, began: datetime, ok: bool, summary: str) -> None:
        self.say(f"{datetime.now():%Y-%m-%d %H:%M} {name}: {'' if ok else 'not retrained: '}{summary}")
        try:
            fleet_state.end_turn(self.home, self.fleet, name)
            fleet_state.note_run(self.home, name, began, ok, summary)
            alerts.after_run(self.home, self.fleet, name, self.say)
        except OSError as error:
            self.say(f"{name}: its state cannot be kept ({error})")
