"""The service behind `thermodrift schedule`: a fleet is checked and scheduled, by this process or a Prefect server."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from zoneinfo import available_timezones

from filelock import FileLock, Timeout

from data.endings import ending
from data.errors import InputError, WorkError
from pipelines.caller import Say
from pipelines.fleet import fleet_state
from pipelines.fleet.fleet_file import Fleet
from pipelines.fleet.folders import Folders
from pipelines.fleet.scheduling import TRIES, Clock, Scheduler, started_apart


def local_timezone() -> str:
    """The IANA name of the local time zone, UTC where the system does not state it."""
    named = os.environ.get("TZ", "").lstrip(":")
    linked = Path("/etc/localtime").resolve().as_posix().partition("zoneinfo/")[2]
    return next((z for z in (named, linked) if z in available_timezones()), "UTC")


def checked(fleet: Fleet, say: Say) -> tuple[Fleet, dict[str, Any]]:
    """The fleet with the machines' names, and the schema of a run's parameters; in a process of its own.

    Raises:
        InputError: a line for every machine file, channel or family that cannot be used.
        WorkError: the process of the check fails.
    """
    process = started_apart("check", fleet.as_json(), stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdin is not None
    kept_open, process.stdin = process.stdin, None  # else `communicate` closes it, which ends the process
    with ending(process.kill), contextlib.closing(kept_open):
        out, error = process.communicate()
    if process.returncode:
        raise WorkError(f"the check of {fleet.source} failed: {(error.strip() or '?').splitlines()[-1]}")
    found = json.loads(out.splitlines()[-1])
    if found["problems"]:
        raise InputError("\n".join(found["problems"]))
    for note in found["notes"]:
        say(note)
    machines = tuple(replace(m, name=n) for m, n in zip(fleet.machines, found["names"], strict=True))
    return replace(fleet, machines=machines), found["schema"]


@contextmanager
def alone(home: Path, fleet: Fleet) -> Iterator[None]:
    """One process per fleet file and home.

    Raises:
        InputError: another process serves this fleet.
    """
    try:
        held = FileLock(fleet_state.folder_of(home) / f"{fleet.key}.lock", timeout=0).acquire()
    except Timeout:
        raise InputError(
            f"{fleet.source}: another `thermodrift schedule` serves it with home {home}; end that one first"
        ) from None
    with held:
        yield


def serve_fleet(fleet: Fleet, home: Path, say: Say, rounds: int | None = None) -> None:
    """Retrain the machines of a checked fleet when they are due, until interrupted (or for `rounds` runs).

    Where PREFECT_API_URL names a server, each machine is a deployment there. Without one this process waits by itself,
    and each run is reported to Prefect's temporary server.

    Raises:
        InputError: another process serves the fleet, or the machine files cannot be used.
    """
    with alone(home, fleet):
        fleet, schema = checked(fleet, say)
        folders = Folders(fleet, say)
        again = [name for name, (_, tries) in fleet_state.unfinished(home, fleet).items() if tries < TRIES]
        with folders.watching():
            if has_server(home):
                from pipelines.fleet.deployments import Deployments

                with Deployments(fleet, schema, folders, say, again) as source:
                    say(_first_line(fleet, f"as scheduled by {source.url}"))
                    Scheduler(fleet, source, home, say).serve(rounds)
            else:
                clock = Clock(fleet, fleet_state.last_turns(home, fleet), folders, datetime.now(UTC), again)
                dates = {n: d for n, d in clock.next().items() if d is not None}
                first = min(dates, key=lambda n: dates[n], default="")
                say(_first_line(fleet, f"next at {dates[first]:%Y-%m-%d %H:%M %Z}" if first else "when files arrive"))
                Scheduler(fleet, clock, home, say).serve(rounds)


def has_server(home: Path) -> bool:
    """Whether PREFECT_API_URL is set, in the environment or in a profile of Prefect's."""
    folder = Path(os.environ.setdefault("PREFECT_HOME", str(home / "prefect"))).expanduser()
    if os.environ.get("PREFECT_API_URL", "").strip():
        folder.mkdir(parents=True, exist_ok=True)
        return True
    if not (folder / "profiles.toml").exists():
        return False
    from prefect.settings import PREFECT_API_URL

    return bool(PREFECT_API_URL.value())


def _first_line(fleet: Fleet, when: str) -> str:
    n = len(fleet.machines)
    return f"retraining of {fleet.machines[0].name if n == 1 else f'{n} machines'} {when}; Ctrl-C ends it"
