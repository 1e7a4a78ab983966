"""Results that the tracking store did not take: kept as plain files below the home, then delivered once.

A training and a diagnosis are tracked directly. Where the store goes away meanwhile they are kept as a whole, and the
next `train`, `status` or `schedule` delivers them. Until a training is kept, its checkpoint has what was computed.

An item is a folder `TIME-MACHINE-TARGET` with `record.json`, the run's `artifacts/`, the `report/` and, where a
training is still to be promoted, the machine file. A folder is complete once it has its name. A delivery removes an
item after the store has it; if it stops between, the next one finds by the record's id what the store has. An item
that the store or the lake refuses for good is moved to `refused/`, with the reason. One that cannot be delivered now,
such as on a full disk, waits with those after it; those of other channels do not.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from filelock import FileLock, Timeout

from data.errors import InputError, WorkError
from data.files import whole_folder
from data.lakefile import safe_name
from pipelines.caller import Say
from pipelines.settings import Settings
from pipelines.store.database import StoreOutage
from pipelines.store.registry import Promotion
from pipelines.store.runs import Record
from pipelines.store.tracking import attach, log_record

ARTIFACTS, REPORT = "artifacts", "report"
MACHINE = "machine.yml"  # the machine file of a promotion
_RECORD, _REASON = "record.json", "reason.txt"
Promote = Callable[[str, Path], Promotion]  # the id of a tracked training, and a machine file


def keep(settings: Settings, record: Record, fill: Callable[[Path], object]) -> None:
    """Keep a result, all or nothing; one that waits already is not kept again.

    Args:
        fill: writes into a folder what the item has next to its record; `ARTIFACTS` is there.
    """
    item = folder(settings) / f"{record.started_ms}-{_channel(record)}"
    if item.exists():
        return
    with whole_folder(item) as scratch:
        (scratch / ARTIFACTS).mkdir()
        fill(scratch)
        (scratch / _RECORD).write_text(record.model_dump_json(indent=1), encoding="utf-8")


def waiting(settings: Settings) -> list[Path]:
    """The items that wait, in their order."""
    return sorted(p for p in folder(settings).glob("[0-9]*") if p.is_dir())


def folder(settings: Settings) -> Path:
    """Where items wait."""
    return settings.home / "spool"


def reminder(settings: Settings) -> str:
    """How many results wait where, and what delivers them."""
    return (
        f"{len(waiting(settings))} results wait in {folder(settings)}: the next `thermodrift train`, `status` or "
        "`schedule` that reaches the store delivers them"
    )


def deliver(settings: Settings, promote: Promote, say: Say = lambda text: None) -> None:
    """Deliver what waits, with a line for each item. Where another process delivers at the moment, it goes on alone.

    Raises:
        StoreOutage: the server does not answer; what is left waits on.
        WorkError: an item cannot be read.
    """
    if not waiting(settings):
        return
    stuck = set[str]()
    with suppress(Timeout), FileLock(folder(settings) / ".lock", timeout=0.0):
        items = waiting(settings)
        say(f"delivers {len(items)} results that the tracking store does not have yet")
        for path in items:
            record = _read(path)
            if (channel := _channel(record)) in stuck:
                continue
            label = f"{record.kind} of {record.machine} {record.target}"
            try:
                say(f"delivered {label}: {_deliver(settings, path, record, promote, say)}")
            except StoreOutage as error:
                raise StoreOutage(f"{error}; {reminder(settings)}") from None
            except WorkError as error:
                stuck.add(channel)
                say(f"not delivered: {label} ({error}); it waits in {path}")
            except InputError as error:
                say(f"not delivered: {label} ({error}); moved to {_refuse(settings, path, record, str(error))}")
            else:
                gone = path.with_name(f".done-{path.name}")
                path.rename(gone)
                shutil.rmtree(gone, ignore_errors=True)


def _deliver(settings: Settings, path: Path, record: Record, promote: Promote, say: Say) -> str:
    """The promotion stands last, since it may be refused."""
    run_id = log_record(record, path / ARTIFACTS, settings, say)
    for report in (path / REPORT).glob("*"):
        attach(run_id, report, settings)
    machine_file = path / MACHINE
    return promote(run_id, machine_file).summary if machine_file.exists() else f"run {run_id}"


def _refuse(settings: Settings, path: Path, record: Record, reason: str) -> Path:
    (path / _REASON).write_text(f"{reason}\n", encoding="utf-8")
    refused = folder(settings) / "refused"
    refused.mkdir(exist_ok=True)
    path.rename(refused / f"{path.name}-{safe_name(record.id)}")
    return refused


def _channel(record: Record) -> str:
    return f"{safe_name(record.machine)}-{safe_name(record.target)}"


def _read(path: Path) -> Record:
    try:
        return Record.model_validate_json((path / _RECORD).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise WorkError(f"{path / _RECORD}: cannot be read ({error}); move the folder away") from None
