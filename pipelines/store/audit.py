"""The log of champions: who made which version of a model the champion, when and why, and which one it was at a time.

The log is part of the registry. Every entry is a tag of the registered model, one JSON object. Several machines share
one tracking server: a file below a home would hold the entries of one of them, and an artifact is read, extended and
uploaded again, so that two machines would overwrite each other's entries. Setting a tag is one atomic request. The key
of an entry ends in a random part, is written once and never deleted here, so the log only grows. It records what
thermodrift does; it is no protection against an administrator who edits the store.

MLflow cannot set a tag and an alias in one transaction. `move_champion` writes the entry, with the version that the
alias names before; then moves the alias; then writes a second tag, which marks the entry as done. A process may stop
after any of the three. An entry that is not marked was carried out if the alias names its new version: at the time of
the next entry, which states what the alias named then, or now if none follows. Otherwise it was interrupted, and
look-ups skip it. No repair is necessary, and the next promotion works in each case.

Entries are ordered by the number in their key, since the clocks of two machines may differ. An entry is never earlier
than those before it: where the clock was set back, it has their latest time, and what the clock showed.
"""

from __future__ import annotations

import getpass
import os
import platform
import re
import uuid
from dataclasses import dataclass
from datetime import UTC, date, datetime, time, timedelta
from typing import TYPE_CHECKING, Literal

from pydantic import AwareDatetime, BaseModel, ConfigDict

from data.errors import InputError

if TYPE_CHECKING:
    from mlflow.entities.model_registry import RegisteredModel
    from mlflow.tracking import MlflowClient

CHAMPION = "champion"
PROVISIONAL = "provisional"  # of a version that is better than no model, but not beyond doubt; only without a champion
Action = Literal["promote", "rollback"]
When = str | date | datetime
_KEY = re.compile(r"thermodrift\.log\.(\d+)\.[0-9a-f]+")
_DONE = ".done"
_MAX_WHY = 3000  # characters; a database behind a server takes 5000 for the whole entry
_TIME = "%Y-%m-%d %H:%M:%S"


class Entry(BaseModel):
    """One change of a champion, as the log holds it.

    `when` is UTC, taken before the alias moves; where the clock showed an earlier time than the entries before have, it
    is the latest of theirs, and `clock` is what the clock showed. `who` is MLFLOW_TRACKING_USERNAME, else the user of
    the operating system. `from_version` is the version that the alias named before, None without a champion.
    `code_version` is that of the program which made the change, see `tracking.code_version`.
    """

    model_config = ConfigDict(frozen=True)

    when: AwareDatetime
    clock: AwareDatetime | None = None
    who: str
    host: str
    action: Action
    model: str
    from_version: int | None
    to_version: int
    why: str
    forced: bool
    training_id: str
    code_version: str


@dataclass(frozen=True)
class Reign:
    """A version as champion from `since` until `until` (UTC; None: still). `note` states what the log cannot know."""

    entry: Entry
    until: datetime | None
    note: str = ""

    @property
    def version(self) -> int:
        return self.entry.to_version

    @property
    def since(self) -> datetime:
        return self.entry.when


@dataclass(frozen=True)
class Log:
    """The entries of a registered model, oldest first, and for each whether it was carried out.

    `champion` and `provisional` are the versions that these aliases name now. `trouble` is the one line on an entry
    that cannot be read, which leaves the champions unknown; empty where all can be read. `unmarked` is the key of the
    last entry where it was carried out and its process stopped before it could say so.
    """

    model: str
    machine: str
    target: str
    champion: int | None
    entries: tuple[Entry, ...]
    carried_out: tuple[bool, ...]
    trouble: str = ""
    provisional: int | None = None
    unmarked: str = ""

    @property
    def stack(self) -> list[int]:
        """Versions to go back to, the champion last. A promotion puts one on top, a roll-back takes away all above the
        one that it goes to; what was rolled back returns by a promotion only."""
        found: list[int] = []
        for e in (e for e, done in zip(self.entries, self.carried_out, strict=True) if done):
            if not found and e.from_version is not None:  # champion before the log began
                found = [e.from_version]
            if e.action == "promote":
                found = [*(v for v in found if v != e.to_version), e.to_version]
            else:
                found = [*found[: found.index(e.to_version)], e.to_version] if e.to_version in found else [e.to_version]
        return found

    @property
    def reigns(self) -> list[Reign]:
        """Every version's time as champion, oldest first."""
        carried = [k for k, done in enumerate(self.carried_out) if done and not self.trouble]
        reigns = []
        for k in carried:
            later = [i for i in carried if i > k]
            # What the alias named until the next change, and then, or now.
            named = [e.from_version for e in self.entries[k + 1 : later[0] + 1 if later else None]]
            named += [] if later else [self.champion]
            other = [n for n in named if n != self.entries[k].to_version]
            notes = []
            if clock := self.entries[k].clock:
                notes.append(
                    f"the clock showed {stamp(clock)}, earlier than the entry before it: since when is not certain; "
                    "the time is the earliest that is possible"
                )
            if other:
                what = "no version" if other[0] is None else f"version {other[0]}"
                notes.append(
                    f"later the alias named {what}: changed outside thermodrift or by two machines at the same time"
                )
            # The least of the later times: with clocks that differ, a champion's end never lies after its successor's.
            until = min((self.entries[i].when for i in later), default=None)
            reigns.append(Reign(self.entries[k], until, "; ".join(notes)))
        return reigns

    def champions(self, span: Span) -> list[Reign]:
        """Who was champion at a point in time, or in the course of a day."""
        begun = [r for r in self.reigns if r.since <= span.start or r.since < span.end]
        return [r for r in begun if r.until is None or span.start < r.until]

    def silence(self) -> str:
        """Why there is no champion at a time that no reign covers."""
        if self.trouble:
            return self.trouble
        carried = [e for e, done in zip(self.entries, self.carried_out, strict=True) if done]
        if not carried:
            if self.champion is None:
                return "it never had a champion"
            return f"version {self.champion} became champion outside the log; since when is not recorded"
        first, when = carried[0], stamp(carried[0].when)
        if first.from_version is None:
            return f"its first promotion was at {when}"
        return f"its log begins at {when}, when version {first.from_version} was champion; before, nothing is recorded"


def move_champion(
    client: MlflowClient,
    name: str,
    version: str,
    *,
    action: Action,
    why: str,
    training_id: str,
    code_version: str,
    forced: bool = False,
) -> None:
    """Make a version the champion and log that; the caller holds the model's lock.

    Raises:
        MlflowException: the store refuses; what is written until then is consistent, see above.
    """
    model = client.get_registered_model(name)
    number = 1 + max((int(m[1]) for key in model.tags if (m := _KEY.fullmatch(key))), default=0)
    clock = now()
    latest = max((e.when for e in read(model).entries), default=clock)
    entry = Entry(
        when=max(clock, latest), clock=clock if clock < latest else None, who=who(), host=platform.node(),
        action=action, model=name, from_version=_named(model, CHAMPION), to_version=int(version),
        why=why[:_MAX_WHY], forced=forced, training_id=training_id, code_version=code_version,
    )  # fmt: skip
    key = f"thermodrift.log.{number:06d}.{uuid.uuid4().hex[:12]}"
    client.set_registered_model_tag(name, key, entry.model_dump_json())
    client.set_registered_model_alias(name, CHAMPION, version)
    finish(client, name, key)


def finish(client: MlflowClient, name: str, key: str) -> None:
    """Mark an entry as carried out."""
    client.set_registered_model_tag(name, key + _DONE, now().isoformat())


def read(model: RegisteredModel) -> Log:
    """The log of a registered model."""
    trouble = ""
    keyed: list[tuple[int, datetime, str, Entry]] = []
    for key, text in model.tags.items():
        if match := _KEY.fullmatch(key):
            try:
                entry = Entry.model_validate_json(text)
            except ValueError:  # edited outside thermodrift
                trouble = (
                    f"model {model.name!r}: the log entry in tag {key!r} cannot be read; expected the JSON object that "
                    "thermodrift wrote; restore the tag from a backup of the store"
                )
                continue
            keyed.append((int(match[1]), entry.when, key, entry))
    keyed.sort(key=lambda k: k[:3])
    entries, champion = [k[3] for k in keyed], _named(model, CHAMPION)
    named = [*(e.from_version for e in entries[1:]), champion]
    carried = [k[2] + _DONE in model.tags or k[3].to_version == n for k, n in zip(keyed, named, strict=False)]
    tags = model.tags
    unmarked = keyed[-1][2] if keyed and carried[-1] and keyed[-1][2] + _DONE not in tags else ""
    return Log(model.name, tags.get("machine", ""), tags.get("target", ""), champion, tuple(entries), tuple(carried),
               trouble, _named(model, PROVISIONAL), unmarked)  # fmt: skip


@dataclass(frozen=True)
class Span:
    """A point in time (`start` equals `end`) or a day in local time (`end` excluded); both are UTC."""

    start: datetime
    end: datetime

    def __str__(self) -> str:
        if self.start == self.end:
            return f"at {stamp(self.start)} ({self.start:{_TIME}} UTC)"
        day = f"{self.start.astimezone():%Y-%m-%d}"
        return f"on {day} (local day, {self.start:%Y-%m-%d %H:%M} to {self.end:%Y-%m-%d %H:%M} UTC)"


def span_of(at: When) -> Span:
    """The point or day that is meant: a date is a whole day; a time without a zone is local time.

    Raises:
        InputError: not a date or time, or one in the future.
    """
    try:
        given = _parsed(at)
        if isinstance(given, datetime):
            start = end = given.astimezone(UTC)
        else:
            midnights = (datetime.combine(d, time()) for d in (given, given + timedelta(days=1)))
            start, end = (m.astimezone(UTC) for m in midnights)
    except (ValueError, OverflowError, OSError):
        raise InputError(
            f"time {str(at)!r}: expected a day such as 2026-03-03, or a time such as 2026-03-03T10:00 (local time; "
            "2026-03-03T10:00Z or +01:00 for another zone)"
        ) from None
    span = Span(start, end)
    if span.start > now():
        raise InputError(f"time {str(at)!r}: {span} is in the future; expected a time up to now")
    return span


def stamp(when: datetime) -> str:
    """A time for people: local, with the zone."""
    return f"{when.astimezone():{_TIME} %Z}"


def now() -> datetime:
    """The time now, UTC."""
    return datetime.now(UTC)


def _parsed(at: When) -> date | datetime:
    if isinstance(at, datetime):
        return datetime.fromisoformat(at.isoformat())  # of pandas' class too, whose `astimezone` is another
    if isinstance(at, date):
        return at
    try:
        return date.fromisoformat(at.strip())
    except ValueError:
        return datetime.fromisoformat(at.strip())


def _named(model: RegisteredModel, alias: str) -> int | None:
    version = model.aliases.get(alias)
    return None if version is None else int(version)


def who() -> str:
    """MLFLOW_TRACKING_USERNAME, else the user of the operating system."""
    try:
        return os.environ.get("MLFLOW_TRACKING_USERNAME", "").strip() or getpass.getuser()
    except (ImportError, KeyError, OSError):  # a container may run under a number that has no name
        return "unknown"
