"""The fleet file: the machines of one scheduling process, when each is retrained and how, and what raises an alert.

What is checked here needs the fleet file alone; `pipelines.fleet.retraining` checks it against the machine files, in a
process of its own, because the process that waits should stay small.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any, Literal, Self
from urllib.parse import urlsplit
from zoneinfo import ZoneInfo

from cronsim import CronSim, CronSimError
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, field_validator, model_validator

from data.errors import InputError, closest
from data.yaml_file import TimeZone, load_yaml
from features.selectors import SELECTORS
from models.families import FAMILIES

CRON = "0 5 * * 1"
SEASON_DAYS = 92.0
LIMIT_H = 24.0


def check_cron(text: str) -> None:
    """Raises ValueError where a text is no cron expression, or one that never fires."""
    try:
        next(CronSim(text, datetime.now(UTC)))
    except (CronSimError, StopIteration):
        raise ValueError(
            "expected five fields (minute hour day month weekday), such as '0 5 * * 1' for Mondays at 5:00"
        ) from None


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class When(_Part):
    """When a machine is retrained: exactly one of `cron`, `every_h` and `watch`.

    `watch`: when files in the folders of recordings have changed, as soon as none changed for `quiet_min`.
    """

    cron: str | None = None
    every_h: Annotated[float, Field(gt=0.0, le=24 * 366)] | None = None
    watch: Literal[True] | None = None
    quiet_min: Annotated[float, Field(ge=0.0, le=24 * 60)] = 5.0

    @field_validator("cron")
    @classmethod
    def _fires(cls, value: str | None) -> str | None:
        if value is not None:
            check_cron(value)
        return value

    @model_validator(mode="after")
    def _one(self) -> Self:
        given = [k for k in ("cron", "every_h", "watch") if getattr(self, k) is not None]
        if len(given) != 1:
            raise ValueError(f"expected one of cron, every_h and watch, got {' and '.join(given) or 'none'}")
        if "quiet_min" in self.model_fields_set and not self.watch:
            raise ValueError("quiet_min goes with watch alone")
        return self

    def next(self, after: datetime, zone: ZoneInfo) -> datetime | None:
        """The first date after `after`, with its time zone; None where it is not a matter of time."""
        if self.cron is not None:
            return next(CronSim(self.cron, after.astimezone(zone)))
        return None if self.every_h is None else (after + timedelta(hours=self.every_h)).astimezone(zone)

    @property
    def summary(self) -> str:
        if self.cron is not None:
            return f"cron {self.cron}"
        return "when recordings arrive" if self.every_h is None else f"every {self.every_h:g} h"


class AlertRules(_Part):
    """What raises an alert, and where a change of the alerts is sent.

    `outside_runs` of the last `of_runs` runs outside the trained region; a champion that has seen no run of the last
    `most_age_days`. `webhook`: an http or https address; THERMODRIFT_WEBHOOK in the environment overrides it.
    """

    webhook: str | None = None
    outside_runs: Annotated[int, Field(ge=1, le=100)] = 3
    of_runs: Annotated[int, Field(ge=1, le=100)] = 5
    most_age_days: Annotated[float, Field(gt=0.0)] = SEASON_DAYS

    @field_validator("webhook")
    @classmethod
    def _address(cls, value: str | None) -> str | None:
        if value is not None and (urlsplit(value).scheme not in ("http", "https") or not urlsplit(value).hostname):
            raise ValueError("expected an address such as https://alerts.example/thermodrift")
        return value

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if self.outside_runs > self.of_runs:
            raise ValueError(f"outside_runs {self.outside_runs} is more than of_runs {self.of_runs}")
        return self


class _Training(_Part):
    """How a machine is trained. Empty lists: all channels; families and selectors by effort. A run that takes longer
    than `limit_h` is ended, so that it does not keep the other machines waiting."""

    when: When = When(cron=CRON)
    effort: str = "usual"
    channels: tuple[str, ...] = ()
    families: tuple[str, ...] = ()
    selectors: tuple[str, ...] = ()
    limit_h: Annotated[float, Field(gt=0.0)] = LIMIT_H

    @field_validator("effort")
    @classmethod
    def _known_effort(cls, value: str) -> str:
        from models.selection.crossing import FINALISTS  # what only waits loads no numpy

        return _known((value,), tuple(FINALISTS))[0]

    @field_validator("families")
    @classmethod
    def _known_families(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        return _known(value, FAMILIES)

    @field_validator("selectors")
    @classmethod
    def _known_selectors(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        return _known(value, SELECTORS)


class _MachinePart(_Training):
    machine: str
    recordings: Annotated[list[str], Field(min_length=1)]


class _File(_Part):
    at_once: Annotated[int, Field(ge=1, le=64)] = 1
    timezone: TimeZone | None = None
    alerts: AlertRules = AlertRules()
    defaults: _Training = _Training()
    machines: Annotated[list[_MachinePart], Field(min_length=1)]


@dataclass(frozen=True)
class FleetMachine:
    """One machine: its file, the folders of its recordings (both absolute), when and how it is trained.

    `name` is that of the machine file once it has been read, until then the file's stem.
    """

    name: str
    file: str
    recordings: tuple[str, ...]
    when: When = field(default_factory=lambda: When(cron=CRON))
    effort: str = "usual"
    channels: tuple[str, ...] = ()
    families: tuple[str, ...] = ()
    selectors: tuple[str, ...] = ()
    limit_h: float = LIMIT_H

    @property
    def parameters(self) -> dict[str, Any]:
        """Those of `pipelines.fleet.retraining.retrain`."""
        lists = {k: list(getattr(self, k)) for k in ("recordings", "channels", "families", "selectors")}
        return {"machine_file": self.file, "effort": self.effort, **lists}


@dataclass(frozen=True)
class Fleet:
    """The machines that one process retrains; `source` is the fleet file, or the options that stand for one."""

    source: str
    machines: tuple[FleetMachine, ...]
    at_once: int = 1
    timezone: str = "UTC"
    alerts: AlertRules = field(default_factory=AlertRules)
    of_file: bool = True  # a fleet file; else the options of the command line

    def at(self, k: int) -> str:
        """Where the k-th machine stands, for error lines."""
        return f"fleet file {self.source}: key 'machines.{k}': " if self.of_file else ""

    @property
    def key(self) -> str:
        """A name for files about this fleet; the same whenever the same file is served."""
        stem = re.sub(r"\W+", "-", Path(self.source).stem)[:40]
        return f"{stem}-{hashlib.sha256(self.source.encode()).hexdigest()[:8]}"

    @property
    def zone(self) -> ZoneInfo:
        return ZoneInfo(self.timezone)

    def as_json(self) -> str:
        return TypeAdapter(Fleet).dump_json(self, exclude_unset=True).decode()

    @staticmethod
    def from_json(text: str) -> Fleet:
        return TypeAdapter(Fleet).validate_json(text)


def load_fleet(path: Path, timezone: str) -> Fleet:
    """Read and check a fleet file; its paths are relative to its folder. `timezone` is used where it names none.

    Raises:
        InputError: not readable, an unknown key, a wrong value, or a machine file given twice.
    """
    parsed = load_yaml(path, _File, "fleet file", every=True)
    machines = tuple(_machine(part, parsed.defaults, path.resolve().parent) for part in parsed.machines)
    files = [m.file for m in machines]
    if twice := next((k for k, file in enumerate(files) if file in files[:k]), None):
        where = f"fleet file {path}: key 'machines.{twice}.machine'"
        raise InputError(f"{where}: {files[twice]} is there twice; give each machine one entry")
    return Fleet(str(path.resolve()), machines, parsed.at_once, parsed.timezone or timezone, parsed.alerts)


def of_one(machine: Path, recordings: Iterable[Path], cron: str, timezone: str) -> Fleet:
    """A fleet of one machine, as the options of the command line state it.

    Raises:
        InputError: `cron` is no cron expression.
    """
    try:
        check_cron(cron)
    except ValueError as error:
        raise InputError(f"--cron: got {cron!r}, {error}") from None
    folders = tuple(str(r.resolve()) for r in recordings)
    one = FleetMachine(machine.stem, str(machine.resolve()), folders, When(cron=cron))
    return Fleet(str(machine.resolve()), (one,), timezone=timezone, of_file=False)


def _machine(part: _MachinePart, defaults: _Training, folder: Path) -> FleetMachine:
    def own(name: str) -> Any:
        return getattr(part if name in part.model_fields_set else defaults, name)

    file = (folder / Path(part.machine).expanduser()).resolve()
    recordings = tuple(str((folder / Path(r).expanduser()).resolve()) for r in part.recordings)
    how = {name: own(name) for name in _Training.model_fields}
    return FleetMachine(file.stem, str(file), recordings, **how)


def _known(values: tuple[str, ...], allowed: Iterable[str]) -> tuple[str, ...]:
    names = tuple(allowed)
    for v in values:
        if v not in names:
            raise ValueError(f"unknown {v!r}; {closest(v, names)}")
    return values
