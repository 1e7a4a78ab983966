"""What a tracking server did not take: kept as plain files below the home, delivered later in order, and once.

An item is a folder `NUMBER-KIND-MACHINE-TARGET` with `item.json` and `files/`: a training's run, its promotion, or a
file for its artifacts. A folder is complete once it has its name. A delivery removes an item after the store has it; if
it stops between, the next one finds the record's run by its id and writes none again. An item that the store or the
lake refuses for good is moved to `refused/`, with the reason, so that it blocks nothing.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, Protocol

from filelock import FileLock, Timeout
from pydantic import BaseModel, ConfigDict

from data.errors import InputError, WorkError
from data.files import whole_folder
from data.lakefile import safe_name
from pipelines.caller import Say
from pipelines.runs import Record, find_record
from pipelines.settings import Settings
from pipelines.store import StoreOutage
from pipelines.tracking import attach, log_record, open_store, store_errors

_ITEM, _FILES, _MACHINE, _REASON = "item.json", "files", "machine.yml", "reason.txt"
Kind = Literal["run", "promotion", "file"]
Fill = Callable[[Path], object]  # writes the files of an item


class Promoted(Protocol):
    """The outcome of a promotion."""

    @property
    def summary(self) -> str: ...


Promote = Callable[[str, Path], Promoted]  # the id of a tracked training, and a machine file


class _Item(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Kind
    record_id: str
    machine: str
    target: str
    record: Record | None = None


def keep_run(settings: Settings, record: Record, files: Path) -> None:
    """Keep a run with its files."""
    _keep(settings, "run", record, lambda to: shutil.copytree(files, to, dirs_exist_ok=True), record)


def keep_promotion(settings: Settings, record: Record, machine_yaml: str) -> None:
    """Keep that a training is to be promoted; `machine_yaml` is the text of its machine file."""
    _keep(settings, "promotion", record, lambda to: (to / _MACHINE).write_text(machine_yaml, encoding="utf-8"))


def keep_file(settings: Settings, record: Record, path: Path) -> None:
    """Keep a file for the artifacts of a training."""
    _keep(settings, "file", record, lambda to: shutil.copy(path, to))


def waiting(settings: Settings) -> list[Path]:
    """The items that wait, in their order."""
    return sorted(p for p in folder(settings).glob("[0-9]*") if p.is_dir())


def folder(settings: Settings) -> Path:
    """Where items wait."""
    return settings.home / "spool"


def deliver(settings: Settings, promote: Promote, say: Say = lambda text: None) -> list[str]:
    """Deliver what waits; returns a line for each item. Another process that delivers at the moment goes on alone.

    Raises:
        StoreOutage: the server does not answer; what is left waits on.
    """
    if not waiting(settings):
        return []
    lines: list[str] = []
    try:
        with FileLock(folder(settings) / ".delivery.lock", timeout=0):
            while items := waiting(settings):
                say(f"delivers {len(items)} results that were kept while the tracking server did not answer")
                lines += [_delivered(settings, path, promote) for path in items]
    except Timeout:
        pass
    except StoreOutage as error:
        raise StoreOutage(f"{error}; {len(waiting(settings))} results wait in {folder(settings)}") from None
    return lines


def _keep(settings: Settings, kind: Kind, record: Record, fill: Fill, whole: Record | None = None) -> None:
    """All or nothing. What waits already is not kept again."""
    item = _Item(kind=kind, record_id=record.id, machine=record.machine, target=record.target, record=whole)
    base = folder(settings)
    base.mkdir(parents=True, exist_ok=True)
    with FileLock(base / ".keeping.lock"):
        held = waiting(settings)
        if any((i.kind, i.record_id) == (kind, record.id) for i in map(_read, held)):
            return
        number = 1 + max((int(p.name.partition("-")[0]) for p in held), default=0)
        name = f"{number:06d}-{kind}-{safe_name(record.machine)}-{safe_name(record.target)}"
        with whole_folder(base / name) as scratch:
            (scratch / _FILES).mkdir()
            fill(scratch / _FILES)
            (scratch / _ITEM).write_text(item.model_dump_json(indent=1), encoding="utf-8")


def _read(path: Path) -> _Item:
    try:
        return _Item.model_validate_json((path / _ITEM).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise WorkError(f"{path / _ITEM}: cannot be read ({error}); move the folder away") from None


def _delivered(settings: Settings, path: Path, promote: Promote) -> str:
    item = _read(path)
    label = f"{item.kind} of {item.machine} {item.target}"
    try:
        line = f"delivered {label}: {_deliver(settings, item, path / _FILES, promote)}"
    except StoreOutage:
        raise
    except (InputError, WorkError) as error:
        (path / _REASON).write_text(f"{error}\n", encoding="utf-8")
        refused = folder(settings) / "refused"
        refused.mkdir(exist_ok=True)
        path.rename(refused / f"{item.record_id}-{path.name}")
        return f"not delivered: {label} ({error}); moved to {refused}"
    done = path.with_name(f".done-{path.name}")
    path.rename(done)
    shutil.rmtree(done, ignore_errors=True)
    return line


def _deliver(settings: Settings, item: _Item, files: Path, promote: Promote) -> str:
    if item.record is not None:
        return f"training {log_record(item.record, files, settings)}"
    client = open_store(settings)
    with store_errors(settings):
        training_id = find_record(client, settings, item.record_id, item.machine, item.target)
    if training_id is None:
        raise InputError(f"the store has no finished training of record {item.record_id}")
    if item.kind == "promotion":
        return promote(training_id, files / _MACHINE).summary
    names: Sequence[Path] = sorted(files.iterdir())
    for name in names:
        attach(training_id, name, settings)
    return ", ".join(p.name for p in names)
