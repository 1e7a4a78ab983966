"""A case of real recordings: its visible part and its answer key."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from data.batch import Batch, Channel
from data.checks import check_machine, checked
from data.machine import ChannelPart, Machine, Recording, load_machine
from data.recording import read_batches, recording_files
from plants.sample.sample_machine import FILE
from thermodrift_exam.plants.options import stream

SCHEMA = "thermodrift.proof_answer/1"
Place = tuple[str, str]  # kind and name
Window = list[Any]  # batch, start s, end s


@dataclass(frozen=True)
class RealCase:
    """Machine file and batches are the visible part of a case; `answer` is plain data."""

    machine: Machine
    batches: list[Batch]
    answer: dict[str, Any]

    def recordings(self) -> dict[str, str]:
        """File name -> CSV text of every run: a first line that says what it is, a lost sample an empty cell."""
        head = "# real recording, simulated response\n" if self.machine.simulated else "# real recording\n"
        return {
            f"{b.batch_id}.csv": head + str(b.table.to_csv(index=False, float_format="%.10g", lineterminator="\n"))
            for b in self.batches
        }


@dataclass(frozen=True)
class Term:
    """One true term of an answer key; `mechanism` None: no listed one.

    `also` are places that mean the same, `neighbours` bodies that touch the place, `parameters` values with units,
    `active` the windows in which it acts, `same_as` what the recordings cannot distinguish from it.
    """

    effect: str
    mechanism: str | None
    where: Place
    parameters: Mapping[str, tuple[float, str]] = field(default_factory=dict)
    also: Sequence[Place] = ()
    neighbours: Sequence[str] = ()
    words: str = ""
    size: float = 1.0
    active: str | list[Window] = "always"
    driver: str | None = None
    same_as: Sequence[tuple[str, Place]] = ()

    def plain(self) -> dict[str, Any]:
        """As the answer key states it."""
        return {
            "effect": self.effect, "mechanism": self.mechanism, "where": _place(self.where),
            "also": [_place(p) for p in self.also], "neighbours": list(self.neighbours),
            "parameters": {k: {"value": float(v), "unit": u} for k, (v, u) in self.parameters.items()},
            "words": self.words, "size": float(self.size), "limit_share": None, "decoy": False,
            "active": self.active, "driver": self.driver,
            "same_as": [{"mechanism": m, "where": _place(p)} for m, p in self.same_as],
        }  # fmt: skip


def answer(
    redraw: Mapping[str, Any], kind: str, machine: Machine, terms: Sequence[Term], words: str, **more: Any
) -> dict[str, Any]:
    """The answer key. `redraw` are plant, name and seed, which give the case again; the caller sets case and suite.

    `more` is what this kind of plant adds.
    """
    return {
        "schema": SCHEMA, "case": redraw["name"], "kind": kind, "plant": redraw["plant"], "suite": "development",
        "simulated": machine.simulated, "words": words, "machine": machine.machine, "seed": redraw["seed"],
        "terms": [t.plain() for t in terms], "idle_channels": [], "options": {}, "redraw": dict(redraw), **more,
    }  # fmt: skip


def windows(batches: Sequence[Batch], active: Sequence[NDArray[np.bool_]]) -> list[Window]:
    """Stretches of rows that are active, one mask (rows,) a batch; each ends where the next row begins."""
    out: list[Window] = []
    for batch, mask in zip(batches, active, strict=True):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
        time_s = np.append(batch.time_s, batch.time_s[-1])
        stretches = time_s[edges.reshape(-1, 2)]
        out += [[batch.batch_id, float(a), float(b)] for a, b in stretches if b > a]
    return out


def linked(twin: Mapping[str, Any], body: str) -> list[str]:
    """Bodies of a machine file's twin part that a link joins with this one."""
    ends = [key.split("-") for key in twin.get("links", {})]
    return sorted({b if a == body else a for a, b in ends if body in (a, b)})


def _place(place: Place) -> dict[str, str]:
    return dict(zip(("kind", "name"), place, strict=True))


MACHINES = FILE.parent
CLOCK = "%Y%m%d_%H%M"


@dataclass(frozen=True)
class Origin:
    """The folder of the recordings of a machine below the data folder, and the selection for a case.

    A case has rows every `rows_s` and `runs` runs (None: all). `unusable`: runs whose stop no driver records. `known`
    is added to the machine file, by dotted path below `twin`; a * stands for every part of that name's place.
    """

    folder: str
    rows_s: float
    runs: int | None = None
    unusable: tuple[str, ...] = ()
    known: Mapping[str, Any] = field(default_factory=dict)


# Known of the lathe's twin from its own runs, left-out: heat that differs by some 10 % from run to run, and errors far
# above the instruments' steps. Unstated, each would be the first finding of every case.
OF_THE_LATHE: Mapping[str, Any] = MappingProxyType({
    "mechanisms.bearings_viscous.parameters.lubrication.per_batch": 0.15,
    "mechanisms.programme.parameters.friction": {"value": 0.1, "per_batch": 0.1},
    "sensors.*.noise": "0.2 K",
    "errors.disp_x.noise": "4 um",
    "errors.disp_z.noise": "3 um",
})  # fmt: skip
ORIGINS: Mapping[str, Origin] = MappingProxyType({
    "lathe_gv1203": Origin("lathe_gv1203", 300.0, 8, ("20200706",), OF_THE_LATHE),
    "spindle_fl": Origin("spindle_fl", 120.0),
    "tclab_board": Origin("tclab", 2.0),
    "cell_30q": Origin("cell_30q", 10.0),
})  # fmt: skip


def there(machine: str, data: Path) -> bool:
    """Whether the recordings of a machine are in the data folder."""
    return (data / ORIGINS[machine].folder).is_dir()


def recorded(machine: str, data: Path, seed: int, step_s: float | None = None) -> tuple[Machine, list[Batch]]:
    """A machine file and the runs of a seed, on a grid of `step_s` (default: the rows that a case has).

    The machine file reads CSV tables with a column for every channel. What a check has masked is empty. Runs of which
    only the date is known begin at an hour that the seed draws; the others are numbered.

    Raises:
        InputError: no such folder, or a recording that cannot be read; one line.
    """
    origin = ORIGINS[machine]
    given, batches = _read(machine, data, step_s or origin.rows_s)
    usable = [b for b in batches if b.batch_id not in origin.unusable]
    rng = stream(seed, f"runs of {machine}")
    number = len(usable) if origin.runs is None else origin.runs
    chosen = [usable[k] for k in sorted(rng.choice(len(usable), number, replace=False).tolist())]
    minutes = 15 * rng.integers(6 * 4, 12 * 4, len(chosen))
    starts = [
        None if b.start is None else b.start + pd.Timedelta(minutes=int(m))
        for b, m in zip(chosen, minutes, strict=True)
    ]
    names = [f"run_{k:02d}" if t is None else f"{t:{CLOCK}}" for k, t in enumerate(starts, 1)]
    channels = {n: _column(c) for n, c in given.channels.items()}
    renamed = dict(zip((b.batch_id for b in chosen), names, strict=True))
    overrule = [
        rule.model_copy(update={"batch": renamed.get(rule.batch, rule.batch)})
        for rule in given.overrule
        if rule.batch == "*" or rule.batch in renamed
    ]
    recording = Recording(
        files=["*.csv"],
        step_s=origin.rows_s,
        max_gap_s=max(given.recording.max_gap_s, 3.0 * origin.rows_s),
        start_from_name=None if None in starts else CLOCK,
    )
    twin = copy.deepcopy(given.twin)
    for path, value in origin.known.items():
        *keys, last = path.split(".")
        for part in parts_at(twin, keys):
            part[last] = value
    update = {"recording": recording, "channels": channels, "ignore": [], "overrule": overrule, "twin": twin}
    plain = given.model_copy(update=update)
    own = plain.batch_channels()
    return plain, [_plain(b, name, t, own) for b, name, t in zip(chosen, names, starts, strict=True)]


def parts_at(part: Any, keys: Sequence[str]) -> list[Any]:
    """The parts of nested plain data below these keys, a * for any."""
    if not keys:
        return [part]
    below = part.values() if keys[0] == "*" else [part[keys[0]]]
    return [found for p in below for found in parts_at(p, keys[1:])]


@cache
def _read(machine: str, data: Path, step_s: float) -> tuple[Machine, list[Batch]]:
    given = load_machine(MACHINES / f"{machine}.yml")
    reading = given.model_copy(update={"recording": given.recording.model_copy(update={"step_s": step_s})})
    files, _ = recording_files(data / ORIGINS[machine].folder, reading)
    found = [b for f in files for b in read_batches(f, reading)]
    return given, check_machine([checked(b, reading) for b in found], reading)


def _column(part: ChannelPart) -> ChannelPart:
    """The channel as a column under its own name, in the unit that the batches have."""
    return part.model_copy(update={"column": None, "unit_in_file": None, "source": "file", "guessed": []})


def _plain(batch: Batch, name: str, start: pd.Timestamp | None, channels: Mapping[str, Channel]) -> Batch:
    table = pd.DataFrame({"time_s": batch.time_s} | {c: batch.masked(c) for c in channels})
    return replace(
        batch, batch_id=name, table=table, channels=channels, start=start, source="", digest="", repairs={},
        findings=(), labels={},
    )  # fmt: skip


def thinned(batch: Batch, rows_s: float) -> Batch:
    """The rows of a finer grid that fall on one of `rows_s`."""
    on_grid = np.isclose(batch.time_s % rows_s, 0.0, atol=1e-6)
    return replace(batch, table=batch.table[on_grid].reset_index(drop=True))
