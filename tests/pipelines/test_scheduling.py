"""The process that waits: what is due, one run per machine, failures that stay where they are, and its end."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from data.errors import InputError
from pipelines.fleet import fleet_state, scheduling
from pipelines.fleet.fleet_file import Fleet, FleetMachine, When
from pipelines.fleet.folders import Folders
from pipelines.fleet.scheduling import Clock, Scheduler
from pipelines.fleet.service import alone, local_timezone
from tests.toys.small_year import write_machine

ROOT = Path(__file__).parents[2]
MONDAY = datetime(2026, 11, 30, 5, 0, tzinfo=UTC)
WEEK = timedelta(days=7)
APART = scheduling.APART  # of the program
# A run that does what its machine's name says.
TOY = """
import json, os, pathlib, signal, subprocess, sys, time
job = json.loads(sys.stdin.readline())
name = pathlib.Path(job["parameters"]["machine_file"]).stem
if name.startswith("killed"): os.kill(os.getpid(), signal.SIGKILL)
if name.startswith("slow"):
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    print(child.pid, flush=True)
    time.sleep(600)
outcome = {"ok": not name.startswith("bad"), "summary": f"{name} has run"}
open(job["result"], "w").write(json.dumps(outcome))
"""


def fleet_of(*names: str, at_once: int = 1, when: When | None = None) -> Fleet:
    machines = tuple(FleetMachine(n, f"/m/{n}.yml", ("/in",), when or When(cron="0 5 * * 1")) for n in names)
    return Fleet("/m/fleet.yml", machines, at_once, "UTC")


@pytest.fixture
def said() -> list[str]:
    return []


@pytest.fixture(autouse=True)
def toy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(scheduling, "APART", (sys.executable, "-c", TOY))
    monkeypatch.setattr(scheduling, "TICK_S", 0.02)
    monkeypatch.setenv("THERMODRIFT_HOME", str(tmp_path))


def served(fleet: Fleet, home: Path, said: list[str], last: dict[str, datetime] | None = None) -> Scheduler:
    """A scheduler whose machines are due as `last` says; by default all of them are."""
    now = datetime.now(UTC)
    turns = dict.fromkeys((m.name for m in fleet.machines), now - WEEK - timedelta(days=1)) if last is None else last
    clock = Clock(fleet, turns, Folders(fleet, said.append), now)
    return Scheduler(fleet, clock, home, said.append)


def until(condition: Callable[[], object], scheduler: Scheduler, limit_s: float = 60.0) -> None:
    end_s = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end_s
        scheduler.step(datetime.now(UTC))
        time.sleep(0.02)


def test_dates_come_due_one_after_another() -> None:
    fleet = fleet_of("mill", "lathe")
    clock = Clock(fleet, {}, Folders(fleet, print), MONDAY - timedelta(hours=1))
    assert clock.next() == {"mill": MONDAY, "lathe": MONDAY} and not clock.due(MONDAY - timedelta(seconds=1))
    jobs = clock.due(MONDAY)
    assert [j.machine.name for j in jobs] == ["mill", "lathe"]
    assert clock.begin(jobs[0], MONDAY) and [j.machine.name for j in clock.due(MONDAY)] == ["lathe"]
    assert clock.next()["mill"] == MONDAY + WEEK


@pytest.mark.parametrize("when", [When(cron="0 5 * * 1"), When(every_h=1.0)])
def test_missed_dates_are_caught_up_once(when: When) -> None:
    fleet = fleet_of("mill", when=when)
    now = MONDAY + 3 * WEEK + timedelta(hours=2)
    clock = Clock(fleet, {"mill": MONDAY}, Folders(fleet, print), now)
    (job,) = clock.due(now)
    clock.begin(job, now)
    assert not clock.due(now) and clock.next()["mill"] == when.next(now, fleet.zone)
    awake = now + timedelta(days=30)  # the computer was suspended
    (job,) = clock.due(awake)
    clock.begin(job, awake)
    assert not clock.due(awake)


def test_a_machine_that_never_had_its_turn_waits_for_its_first_date() -> None:
    fleet = fleet_of("mill")
    assert not Clock(fleet, {}, Folders(fleet, print), MONDAY + timedelta(minutes=1)).due(MONDAY + timedelta(minutes=1))


class Simulated(Scheduler):
    """Runs take `takes` of simulated time and no process; `turns` counts them."""

    def __init__(self, fleet: Fleet, home: Path, now: datetime, takes: timedelta) -> None:
        self.folders, self.now, self.takes = Folders(fleet, print), now, takes
        super().__init__(fleet, Clock(fleet, {}, self.folders, now), home, print)
        self.turns: list[str] = []

    def step(self, now: datetime) -> None:
        self.running = {n: began for n, began in self.running.items() if now - began < self.takes}  # type: ignore[misc,operator]
        for job in self.source.due(now):
            if job.machine.name not in self.running and len(self.running) < self.fleet.at_once:
                assert self.source.begin(job, now)
                self.running[job.machine.name] = now  # type: ignore[assignment]
                self.turns.append(job.machine.name)


def test_an_overloaded_computer_is_slower_for_every_machine(tmp_path: Path) -> None:
    """Fifty machines every 6 h, 20 min each, one at a time: 72 of 200 turns a day are possible."""
    fleet = fleet_of(*(f"m{k:02d}" for k in range(50)), when=When(every_h=6.0))
    s = Simulated(fleet, tmp_path, MONDAY, timedelta(minutes=20))
    for k in range(30 * 72):
        s.step(MONDAY + k * timedelta(minutes=20))
    counts = [s.turns.count(m.name) for m in fleet.machines]
    assert sum(counts) == 30 * 72 - 18 and max(counts) - min(counts) <= 1


def test_files_that_keep_arriving_take_no_other_machine_s_turn(tmp_path: Path) -> None:
    fleet = fleet_of("a", "b", "c", "d", "e", when=When(watch=True, quiet_min=1.0))
    s = Simulated(fleet, tmp_path, MONDAY, timedelta(minutes=20))
    for k in range(12):
        now = MONDAY + k * timedelta(minutes=20)
        s.step(now)
        s.folders.touch("a", now)
        s.folders.touch("b", now)
    assert s.turns[:5] == ["a", "b", "c", "d", "e"] and set(s.turns[5:]) == {"a", "b"}


def test_a_run_that_ended_with_its_scheduler_is_caught_up_once(tmp_path: Path, said: list[str]) -> None:
    """As after `kill -9`: the turn was noted, its end was not."""
    fleet = fleet_of("mill", "lathe")
    now = datetime.now(UTC)
    fleet_state.note_turn(tmp_path, fleet, "mill", now)
    assert fleet_state.unfinished(tmp_path, fleet) == {"mill": (now, 1)}
    turns = fleet_state.last_turns(tmp_path, fleet)
    clock = Clock(fleet, turns, Folders(fleet, print), now, ["mill"])
    assert [j.machine.name for j in clock.due(now)] == ["mill"]
    Scheduler(fleet, clock, tmp_path, said.append).serve(rounds=1)
    assert said[0].endswith("mill: mill has run") and not fleet_state.unfinished(tmp_path, fleet)
    for _ in range(2):
        fleet_state.note_turn(tmp_path, fleet, "mill", now)
    clock = Clock(fleet, turns, Folders(fleet, print), now)
    Scheduler(fleet, clock, tmp_path, said.append).serve(rounds=0)
    assert not clock.due(now) and not fleet_state.unfinished(tmp_path, fleet)
    assert said[-1].startswith("alert mill: the last retraining failed: 2 runs ended with the process that had begun")


def test_one_machine_s_failure_stays_with_it(tmp_path: Path, said: list[str]) -> None:
    fleet = fleet_of("bad", "killed", "good")
    served(fleet, tmp_path, said).serve(rounds=3)
    lines = [line[17:] for line in said if not line.startswith("alert")]
    log = tmp_path / "fleet" / "killed.log"
    assert lines == [
        "bad: not retrained: bad has run", f"killed: not retrained: its process ended by signal SIGKILL; see {log}",
        "good: good has run",
    ]  # fmt: skip
    runs = {n: fleet_state.read(tmp_path, n, "run") for n in ("bad", "killed", "good")}
    assert [runs[n]["last"]["ok"] for n in runs] == [False, False, True]
    assert runs["bad"]["failed"]["summary"] == "bad has run" and runs["good"]["failed"] is None
    assert "alert bad: the last retraining failed: bad has run" in said
    assert not list(tmp_path.glob("fleet/*.result"))


def test_a_failure_stays_known_after_a_success(tmp_path: Path) -> None:
    fleet_state.note_run(tmp_path, "mill", MONDAY, False, "no share")
    fleet_state.note_run(tmp_path, "mill", MONDAY + WEEK, True, "trained")
    run = fleet_state.read(tmp_path, "mill", "run")
    assert (run["last"]["summary"], run["failed"]["summary"]) == ("trained", "no share")


def test_no_more_runs_at_once_than_allowed_and_one_per_machine(tmp_path: Path, said: list[str]) -> None:
    scheduler = served(fleet_of("slow1", "slow2", "slow3", at_once=2, when=When(every_h=1.0)), tmp_path, said)
    try:
        scheduler.step(datetime.now(UTC))
        scheduler.step(datetime.now(UTC) + timedelta(hours=2))  # the next date of the running ones passes
        assert list(scheduler.running) == ["slow1", "slow2"]
        scheduler.step(datetime.now(UTC) + timedelta(hours=25))  # both are ended: the one that waits comes first
        assert list(scheduler.running) == ["slow3", "slow1"]
    finally:
        scheduler.stop()


def test_what_runs_ends_with_the_scheduler_and_all_that_it_started(tmp_path: Path, said: list[str]) -> None:
    scheduler = served(fleet_of("slow"), tmp_path, said)
    log = tmp_path / "fleet" / "slow.log"
    until(lambda: log.exists() and log.read_text().strip(), scheduler)
    own, started = scheduler.running["slow"].process, int(log.read_text())
    scheduler.stop()
    assert own.poll() is not None
    for _ in range(200):
        if not _lives(started):
            break
        time.sleep(0.02)
    assert not _lives(started)


def test_a_run_that_takes_too_long_is_ended(tmp_path: Path, said: list[str]) -> None:
    fleet = fleet_of("slow", "good")
    fleet = replace(fleet, machines=(replace(fleet.machines[0], limit_h=1.0), fleet.machines[1]))
    scheduler = served(fleet, tmp_path, said)
    try:
        now = datetime.now(UTC)
        scheduler.step(now)
        scheduler.step(now + timedelta(minutes=59))
        assert list(scheduler.running) == ["slow"] and not said
        scheduler.step(now + timedelta(minutes=61))
        assert list(scheduler.running) == ["good"]
        assert said[0].endswith(f"slow: not retrained: ended after 1 h (limit_h); see {tmp_path}/fleet/slow.log")
    finally:
        scheduler.stop()


def test_a_process_that_cannot_be_started_is_a_line(
    tmp_path: Path, said: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scheduling, "APART", (str(tmp_path / "nowhere"),))
    scheduler = served(fleet_of("mill", "lathe"), tmp_path, said)
    scheduler.step(datetime.now(UTC))
    lines = [line for line in said if not line.startswith("alert")]
    assert [line[17:].partition(":")[0] for line in lines] == ["mill", "lathe"] and not scheduler.running
    assert all("No such file or directory" in line for line in lines)


def _lives(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.integration
@pytest.mark.parametrize("what", ["check", "run"])
def test_a_process_of_a_fleet_ends_with_the_one_that_started_it(monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    monkeypatch.setattr(scheduling, "APART", APART)
    fleet = fleet_of("lathe")
    job = {"parameters": fleet.machines[0].parameters, "flow_run_id": None, "result": "/m/result"}
    line = fleet.as_json() if what == "check" else json.dumps(job)
    process = scheduling.started_apart(what, line, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        assert process.stdin is not None
        process.stdin.close()  # as the end of the process that started it does
        assert process.wait(60) == 128 + signal.SIGTERM
    finally:
        process.kill()


def test_turns_and_next_dates_are_kept(tmp_path: Path, said: list[str]) -> None:
    fleet = fleet_of("mill")
    with alone(tmp_path, fleet):
        before = datetime.now(UTC)
        served(fleet, tmp_path, said).serve(rounds=1)
        ((kept, live),) = fleet_state.schedules(tmp_path)
        assert live and datetime.fromisoformat(kept["next"]["mill"]) > before
        assert fleet_state.last_turns(tmp_path, fleet)["mill"] >= before
        with pytest.raises(InputError, match=r"another `thermodrift schedule` serves it"), alone(tmp_path, fleet):
            pass
    assert [live for _, live in fleet_state.schedules(tmp_path)] == [False]
    again = served(fleet, tmp_path, said, fleet_state.last_turns(tmp_path, fleet))
    assert not again.source.due(datetime.now(UTC))


@pytest.mark.integration
def test_it_waits_in_little_memory() -> None:
    """The process that waits imports neither pandas nor mlflow, prefect or torch."""
    code = (
        "import sys; import pipelines.commands.schedule\n"
        "from pipelines.fleet import alerts, folders, service\n"
        "print(sorted({'pandas', 'numpy', 'mlflow', 'prefect', 'torch', 'sklearn'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.integration
@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_a_signal_ends_the_command(tmp_path: Path, number: int) -> None:
    (tmp_path / "in").mkdir()
    fleet = tmp_path / "fleet.yml"
    write_machine(tmp_path / "mill.yml", "mill")
    fleet.write_text("machines: [{machine: mill.yml, recordings: [in], channels: [z]}]")
    environment = {k: v for k, v in os.environ.items() if k != "PREFECT_API_URL"}
    process = subprocess.Popen(
        [sys.executable, "-m", "pipelines.cli", "schedule", str(fleet)], cwd=ROOT, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True, env={**environment, "THERMODRIFT_HOME": str(tmp_path / "home")},
    )  # fmt: skip
    assert process.stdout is not None
    first = process.stdout.readline()
    assert first.startswith("retraining of mill next at ") and first.endswith("; Ctrl-C ends it\n")
    process.send_signal(number)
    error = process.communicate(timeout=60)[1]
    assert (process.returncode, error) == (128 + number, "thermodrift: stopped\n")


def test_the_local_time_zone_has_a_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TZ", "Asia/Tokyo")
    assert local_timezone() == "Asia/Tokyo"
    assert json.loads(fleet_of("m").as_json())["timezone"] == "UTC"
