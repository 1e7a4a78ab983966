"""What is kept about a fleet below the home folder, as small JSON files that are read without heavy imports.

fleet/KEY.schedule.json   a fleet: its file, next dates, last turns, which of them did not end; KEY.lock is held while a
                          process serves it
fleet/MACHINE.run.json    a machine's last run and its last failure
fleet/MACHINE.state.json  its champions, their drift and the state of its sensors, see `pipelines.fleet.watching`
fleet/MACHINE.alerts.json the alerts that were last reported
fleet/MACHINE.log         what its last run printed
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

from filelock import FileLock, Timeout

from data.files import from_json, write_atomic
from pipelines.fleet.fleet_file import Fleet


def folder_of(home: Path) -> Path:
    """The folder, made where it is not there."""
    folder = home / "fleet"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def file_name(machine: str) -> str:
    """A machine's name as part of a file name."""
    return quote(machine, safe=" ")


def read(home: Path, machine: str, what: str) -> dict[str, Any]:
    """MACHINE.`what`.json; empty where there is none, or none that can be read."""
    return read_file(home / "fleet" / f"{file_name(machine)}.{what}.json")


def write(home: Path, machine: str, what: str, content: Mapping[str, Any]) -> None:
    """MACHINE.`what`.json, in one step."""
    write_atomic(folder_of(home) / f"{file_name(machine)}.{what}.json", json.dumps(content, ensure_ascii=False))


def write_schedule(home: Path, fleet: Fleet, upcoming: Mapping[str, datetime | None]) -> None:
    """Note the next date of every machine."""
    _update(home, fleet, {"next": {name: None if due is None else due.isoformat() for name, due in upcoming.items()}})


def note_turn(home: Path, fleet: Fleet, machine: str, now: datetime) -> None:
    """A machine has its turn: dates up to now are done. Until `end_turn` the turn is unfinished."""
    kept = _schedule(home, fleet.key)
    open_turns = kept.get("unfinished", {})
    _update(home, fleet, {
        "turns": {**kept.get("turns", {}), machine: now.isoformat()},
        "unfinished": {**open_turns, machine: open_turns.get(machine, 0) + 1},
    })  # fmt: skip


def end_turn(home: Path, fleet: Fleet, machine: str) -> None:
    """A machine's turn is over, however it ended."""
    kept = _schedule(home, fleet.key).get("unfinished", {})
    if machine in kept:
        _update(home, fleet, {"unfinished": {m: tries for m, tries in kept.items() if m != machine}})


def last_turns(home: Path, fleet: Fleet) -> dict[str, datetime]:
    """When each machine last had its turn."""
    return {m: datetime.fromisoformat(when) for m, when in _schedule(home, fleet.key).get("turns", {}).items()}


def unfinished(home: Path, fleet: Fleet) -> dict[str, tuple[datetime, int]]:
    """Machines whose last turn began and did not end: when, and how often in succession."""
    turns, kept = last_turns(home, fleet), _schedule(home, fleet.key).get("unfinished", {})
    own = {m.name for m in fleet.machines}
    return {m: (turns[m], int(tries)) for m, tries in kept.items() if m in own and m in turns}


def note_run(home: Path, machine: str, began: datetime, ok: bool, summary: str) -> None:
    """Note how a run ended; the last failure stays known after a later success."""
    run = {"began": began.isoformat(), "ended": datetime.now(UTC).isoformat(), "ok": ok, "summary": summary}
    failed = read(home, machine, "run").get("failed")
    write(home, machine, "run", {"last": run, "failed": failed if ok else run})


def schedules(home: Path) -> Iterator[tuple[dict[str, Any], bool]]:
    """Every fleet that was served with this home, and whether a process serves it now."""
    for path in sorted((home / "fleet").glob("*.schedule.json")):
        kept = read_file(path)
        if kept:
            yield kept, _served(path.with_name(path.name.replace(".schedule.json", ".lock")))


def _served(path: Path) -> bool:
    try:
        with FileLock(path, timeout=0):
            return False
    except Timeout:
        return True


def _schedule(home: Path, key: str) -> dict[str, Any]:
    return read_file(home / "fleet" / f"{key}.schedule.json")


def _update(home: Path, fleet: Fleet, changes: Mapping[str, Any]) -> None:
    machines = {m.name: {"when": m.when.summary, "file": m.file, "channels": list(m.channels)} for m in fleet.machines}
    content = {**_schedule(home, fleet.key), "source": fleet.source, "machines": machines,
               "alerts": fleet.alerts.model_dump(exclude={"webhook"}), **changes}  # fmt: skip
    write_atomic(folder_of(home) / f"{fleet.key}.schedule.json", json.dumps(content, ensure_ascii=False))


def read_file(path: Path) -> dict[str, Any]:
    """A file with a JSON object; empty where there is none, or none that can be read."""
    try:
        content = from_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
