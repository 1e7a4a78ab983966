"""Results on their way to the tracking store: kept as plain files below the home, then delivered in order, and once.

Every result is kept first, whether or not the store answers: a training's or diagnosis' run, a promotion, a file for a
run's artifacts. An outage, or the end of the process, is thereby a result that is not delivered yet: the next `train`,
`status` or `schedule` does it.

An item is a folder `NUMBER-KIND-MACHINE-TARGET` with `item.json` and `files/`. A folder is complete once it has its
name. A delivery removes an item after the store has it; if it stops between, the next one finds the record's run by its
id and writes none again. An item that the store or the lake refuses for good is moved to `refused/`, with the reason.
One that cannot be delivered now, such as on a full disk, waits with those after it; those of other channels do not.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Literal, Protocol, TypeVar

from filelock import FileLock, Timeout
from pydantic import BaseModel, ConfigDict

from data.errors import InputError, WorkError
from data.files import whole_folder
from data.lakefile import safe_name
from pipelines.caller import Say
from pipelines.settings import Settings
from pipelines.store.database import StoreOutage
from pipelines.store.runs import Record, find_record
from pipelines.store.tracking import attach, log_record, open_store, store_errors

MACHINE = "machine.yml"  # the machine file of a promotion
_ITEM, _FILES, _REASON = "item.json", "files", "reason.txt"
Kind = Literal["run", "promotion", "file"]


class Promoted(Protocol):
    """The outcome of a promotion."""

    @property
    def summary(self) -> str: ...


P = TypeVar("P", bound=Promoted)
Promote = Callable[[str, Path], P]  # the id of a tracked training, and a machine file


class _Item(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Kind
    record_id: str
    machine: str
    target: str
    record: Record | None = None


@dataclass(frozen=True)
class Delivery(Generic[P]):
    """What became of an item: `run_id` in the store, and what a promotion led to; or the `error`."""

    line: str
    run_id: str = ""
    promoted: P | None = None
    error: InputError | WorkError | None = None


def keep(settings: Settings, kind: Kind, record: Record, fill: Callable[[Path], object]) -> None:
    """Keep a result, all or nothing; what waits already is not kept again.

    Args:
        fill: writes the item's files into a folder.
    """
    whole = record if kind == "run" else None
    item = _Item(kind=kind, record_id=record.id, machine=record.machine, target=record.target, record=whole)
    base = folder(settings)
    base.mkdir(parents=True, exist_ok=True)
    with FileLock(base / ".keeping.lock"):
        held = waiting(settings)
        if any((i.kind, i.record_id) == (kind, record.id) for i in map(_read, held)):
            return
        number = 1 + max((int(p.name.partition("-")[0]) for p in held), default=0)
        with whole_folder(base / f"{number:06d}-{kind}-{_channel(item)}") as scratch:
            (scratch / _FILES).mkdir()
            fill(scratch / _FILES)
            (scratch / _ITEM).write_text(item.model_dump_json(indent=1), encoding="utf-8")


def waiting(settings: Settings) -> list[Path]:
    """The items that wait, in their order."""
    return sorted(p for p in folder(settings).glob("[0-9]*") if p.is_dir())


def folder(settings: Settings) -> Path:
    """Where items wait."""
    return settings.home / "spool"


def deliver(settings: Settings, promote: Promote[P], say: Say = lambda text: None) -> list[Delivery[P]]:
    """Deliver what waits, channel by channel. Another process that delivers a channel at the moment goes on alone.

    Raises:
        StoreOutage: the server does not answer; what is left waits on.
    """
    items = waiting(settings)
    if items:
        say(f"delivers {len(items)} results that the tracking store does not have yet")
    found: list[Delivery[P]] = []
    for channel in dict.fromkeys(_channel(_read(path)) for path in items):
        with suppress(Timeout), _alone(settings, channel, timeout_s=0.0):
            found += _deliver_channel(settings, channel, promote, say)
    return found


def hand_over(
    settings: Settings,
    kind: Kind,
    record: Record,
    fill: Callable[[Path], object],
    promote: Promote[P] | None = None,
    say: Say = lambda text: None,
) -> Delivery[P]:
    """`keep` a result and deliver it, after what waits of its channel.

    Raises:
        StoreOutage: the server does not answer; the result waits.
        WorkError: it cannot be kept, or not be delivered now; then it waits, too.
        InputError: the store or the lake refuses it.
    """
    with _alone(settings, _channel(record)):
        keep(settings, kind, record, fill)
        done: Delivery[P] = _deliver_channel(settings, _channel(record), promote, say)[-1]
    if done.error is not None:
        raise done.error
    return done


@contextmanager
def _alone(settings: Settings, channel: str, timeout_s: float = -1.0) -> Iterator[None]:
    """One process at a time delivers the results of a channel."""
    folder(settings).mkdir(parents=True, exist_ok=True)
    with FileLock(folder(settings) / f".{channel}.lock", timeout=timeout_s):
        yield


def _deliver_channel(settings: Settings, channel: str, promote: Promote[P] | None, say: Say) -> list[Delivery[P]]:
    found: list[Delivery[P]] = []
    for path, item in [(p, _read(p)) for p in waiting(settings)]:
        if _channel(item) != channel:
            continue
        try:
            found.append(_delivered(settings, path, item, promote, say))
        except StoreOutage as error:
            raise StoreOutage(
                f"{error}; {len(waiting(settings))} results wait in {folder(settings)}: the next `thermodrift train`, "
                "`status` or `schedule` that reaches the store delivers them"
            ) from None
        if isinstance(found[-1].error, WorkError):
            break
    return found


def _channel(of: Record | _Item) -> str:
    return f"{safe_name(of.machine)}-{safe_name(of.target)}"


def _read(path: Path) -> _Item:
    try:
        return _Item.model_validate_json((path / _ITEM).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise WorkError(f"{path / _ITEM}: cannot be read ({error}); move the folder away") from None


def _delivered(settings: Settings, path: Path, item: _Item, promote: Promote[P] | None, say: Say) -> Delivery[P]:
    label = f"{item.kind} of {item.machine} {item.target}"
    try:
        done = _deliver(settings, item, path / _FILES, promote, say)
    except StoreOutage:
        raise
    except WorkError as error:
        return Delivery(f"not delivered: {label} ({error}); it waits in {path}", error=error)
    except InputError as error:
        (path / _REASON).write_text(f"{error}\n", encoding="utf-8")
        refused = folder(settings) / "refused"
        refused.mkdir(exist_ok=True)
        path.rename(refused / f"{item.record_id}-{path.name}")
        return Delivery(f"not delivered: {label} ({error}); moved to {refused}", error=error)
    gone = path.with_name(f".done-{path.name}")
    path.rename(gone)
    shutil.rmtree(gone, ignore_errors=True)
    said = done.promoted.summary if done.promoted is not None else done.line
    return Delivery(f"delivered {label}: {said}", done.run_id, done.promoted)


def _deliver(settings: Settings, item: _Item, files: Path, promote: Promote[P] | None, say: Say) -> Delivery[P]:
    if item.record is not None:
        run_id = log_record(item.record, files, settings, say)
        return Delivery(f"{item.record.kind} {run_id}", run_id)
    client = open_store(settings)
    with store_errors(settings):
        run = find_record(client, settings, item.record_id, item.machine, item.target)
    if run is None:
        raise InputError(f"the store has no finished training of record {item.record_id}")
    if item.kind == "promotion":
        assert promote is not None  # the channel of a diagnosis has none
        return Delivery("", run, promote(run, files / MACHINE))
    names = sorted(files.iterdir())
    for name in names:
        attach(run, name, settings)
    return Delivery(", ".join(p.name for p in names), run)
