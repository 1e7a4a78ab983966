"""Drafts a machine file from recordings: what can be seen is written down, every guess is marked as one."""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data import guess
from data.errors import InputError
from data.groups import FILL_IN, Group, files_pattern, grouped, joint
from data.guess import Guess, PositionGroup
from data.machine import MAX_NAME, Form, Machine, Split, parse_machine
from data.recording import read_batches
from data.rows import cut_runs
from data.units import conversion, convert, quantity
from data.yaml_edit import flow

_MANY_DROPPED = 0.1  # of a recording's rows: the draft cannot be right
_IDLE_SHARE = 0.25  # of a temperature's span: below, the machine is idle
_PAUSE_S = 600.0  # the shortest pause between two runs
CHECK = "# check: "  # begins a comment of the draft that the user must read


@dataclass(frozen=True)
class Shown:
    """A column of a file: its first cells, what it becomes and why, and the first values in the unit of the lake."""

    column: str
    cells: tuple[str, ...]
    becomes: str
    numbers: tuple[float, ...] = ()


def drafted(
    files: Sequence[Path], form: Form | None = None, named: str = ""
) -> tuple[str, dict[str, list[Shown]], int]:
    """YAML text of a machine file for recordings of one machine, the columns of the first file of each kind, and how
    many runs there are.

    Files with the same columns are the recordings. Files or sheets with other columns are drafted as
    `recording.joined` where names, sheets or time stamps show that they belong to the recordings, and else left out.
    Every guess carries a comment ``# guessed: why`` and stands in the channel's ``guessed`` list; what is doubtful is a
    comment ``# check: …`` at the beginning. Values are taken from up to 20 tables and their first 200 000 rows. `form`
    overrides what is found of the files' layout. The machine is named by `named`, such as the stem of the machine
    file; without it by the recordings' folder. The draft is tried on the first recording.

    Raises:
        InputError: no files, or none holds a table of numbers.
    """
    if not files:
        raise InputError("describe: no files given, expected recordings of one machine; name at least one")
    groups, left_out = _belonging(*grouped(files, form))
    text = _write(groups, left_out, {p.name for p in files} - {p.name for p in groups[0].paths}, named)
    machine = parse_machine(text.replace(FILL_IN, "1 s"), "draft")
    if FILL_IN not in text and (trouble := _tried(groups[0].paths[0], machine)):
        text = f"{CHECK}{trouble}\n{text}"
    return text, {g.paths[0].name: _shown(g, machine) for g in groups}, len(groups[0].tables)


def _belonging(found: list[Group], left_out: list[str]) -> tuple[list[Group], list[str]]:
    """The recordings and the groups that are joined to them, and a line for each file that is left out."""
    main, *others = found
    groups = [main]
    for other in others:
        if (how := joint(main, other)) is not None:
            other.joint, other.key = how, _key(other, [g.key for g in groups[1:]])
            groups.append(other)
            continue
        first = next((p.name for p, _ in main.tables if p not in other.paths), main.paths[0].name)
        left_out += [
            f"{path.name}{f' sheet {table.sheet!r}' * (path in main.paths)}: its columns are others than those of"
            f" {first}"
            for path, table in other.tables
        ]
    return groups, left_out


def _tried(path: Path, machine: Machine) -> str:
    """What an ingest says against a draft: it refuses the recording, or drops a good part of it; else nothing."""
    read = dropped = 0
    try:
        for batch in read_batches(path, machine, need_error=False):
            read += batch.repairs["rows_in"]
            dropped += batch.repairs["rows_dropped"]
    except InputError as error:
        return f"ingest refuses this draft: {error}"
    return f"ingest drops {dropped} of {read} rows of {path.name}" if dropped > _MANY_DROPPED * read else ""


def _shown(group: Group, machine: Machine) -> list[Shown]:
    table = group.table
    parts = {part.column if part.column is not None else n: (n, part) for n, part in machine.channels.items()
             if part.source == group.key}  # fmt: skip
    name_of = {i: name for name, i in group.names.items()}
    out = []
    for i, column in enumerate(table.columns):
        cells = tuple(str(c) for c in table.cells[i])
        if i in (table.time, table.clock.date):
            out.append(Shown(column or str(i), cells, f"clock: {group.clock.why}"))
        elif (found := parts.get(table.key(i))) and i in name_of:
            name, part = found
            values = convert(
                group.rows[0].columns[name_of[i]][: len(cells)], part.unit_in_file or part.unit, part.unit, name
            )
            unit = f"{part.unit_in_file} → {part.unit}" if part.unit_in_file else part.unit
            out.append(Shown(column or str(i), cells, f"{part.role} {name}, {unit}", tuple(values.tolist())))
        else:
            along = "along an axis" if i in name_of else ""
            out.append(Shown(column or str(i), cells, along or f"left out: {table.left.get(i, 'no values')}"))
    return out


def notes(draft: str) -> list[str]:
    """What the user of a draft must check."""
    return [line.removeprefix(CHECK) for line in draft.splitlines() if line.startswith(CHECK)]


def _key(group: Group, taken: Sequence[str]) -> str:
    """A name for a group's files in the machine file."""
    kinds = {role.value for role in group.roles.values()}
    named = {"error": "errors", "temperature": "temperatures", "driver": "drivers"}
    name = next((named[k] for k in named if k in kinds and not kinds & {"temperature"} - {k}), "others")
    return name if name not in taken else f"{name}_{len(taken) + 1}"


def _write(groups: Sequence[Group], left_out: Sequence[str], others: set[str], named: str) -> str:
    main, *joined = groups
    linked = [_linked(g) for g in groups]
    channels: list[str] = []
    taken: list[str] = []
    for group, (along, _) in zip(groups, linked, strict=True):
        channels += _channels(group, along, taken)
    runs = _runs(main)
    files = [p.name for p in main.paths]
    given = named or main.paths[0].resolve().parent.name
    name = re.sub(r"[^a-z0-9_\-]+", "_", given.lower()).strip("_-")[:MAX_NAME] or "machine"
    origin = "the name of this file" if named else "guessed: the folder's name"
    doubts = [(g, note) for g in groups for note in (g.clock.note, *g.notes) if note]
    patterns = [next((g.joint.files for g in joined if g.joint and g.joint.files), None) or files_pattern(main.paths)]
    if fnmatch.filter(others, patterns[0]):  # those are no recordings
        patterns = files
    lines = [
        f"# Drafted from {len(files)} file{'s' * (len(files) > 1)}: {files[0]}{' … ' + files[-1] if files[1:] else ''}",
        f"# ({main.table.summary}). Look at every line marked 'guessed', correct it, and empty the guessed lists.",
        *(f"{CHECK}{f'{g.paths[0].name}: ' if joined else ''}{note}" for g, note in doubts),
        *(f"# left out: {line}" for line in left_out),
        f"machine: {flow(name)}  # {origin}",
        *(["simulated: true  # a line of the file says so"] if main.table.simulated else []),
        "recording:",
        f"  files: {flow(patterns)}  # guessed: the names of the files",
        f"  header: {flow(main.table.header)}",
        *(f"  {line}" for line in _layout(main)),
        *_steps(groups, min(step for _, step in linked)),
        *runs,
    ]
    if start := main.start_from_name:
        lines.append(f"  start_from_name: {flow(start)}  # guessed: the files or sheets are named by date")
    for k, group in enumerate(joined):
        assert group.joint is not None
        keys = {**group.joint.keys, **({} if group.table.header else {"header": False})}
        lines += ["  joined:"] * (k == 0) + [f"    {group.key}:  # guessed: {group.joint.why}"]
        layout = _layout(group)
        if main.table.time is None and group.table.time is None:
            layout.pop()  # the recording's step is theirs
        lines += [f"      {line}" for line in (*(f"{n}: {flow(v)}" for n, v in keys.items()), *layout)]
    lines += ["channels:", *channels]
    if ignored := dict(left for g in groups for left in _left(g)):
        lines.append(f"ignore: {flow([*ignored])}  # guessed: {'; '.join(ignored.values())}")
    return "\n".join(lines) + "\n"


def _layout(group: Group) -> list[str]:
    """Keys of the layout that reading does not find by itself, and the clock."""
    stated = group.table.form.model_dump(exclude={"time", "header"}, exclude_none=True)
    guessed = "" if group.clock.why.startswith("fill in") else "guessed: "
    return [*(f"{n}: {flow(v)}" for n, v in stated.items()), f"time: {group.clock.line}  # {guessed}{group.clock.why}"]


def _left(group: Group) -> list[tuple[str, str]]:
    """Columns of the file that are no channels, as the machine file names them, and why."""
    table = group.table
    return [(str(table.key(i)), f"{table.columns[i] or i}: {why}") for i, why in table.left.items()
            if table.header and i not in group.names.values()]  # fmt: skip


def _steps(groups: Sequence[Group], fine_s: float) -> list[str]:
    """The lines of the grid. The recordings, the first group, set its step; sweeps need `fine_s`, inf without any."""
    if groups[0].table.time is None:
        return []  # the rows are the grid
    intervals_s = [g.step_and_length[0] * g.clock.unit_s for g in groups if g.table.time is not None]
    step_s = guess.grid_step_s(intervals_s[0])
    slowest_s = guess.grid_step_s(max(intervals_s))
    words = f"samples are {intervals_s[0]:.4g} s apart (median)"
    gap = "5 steps" if step_s == slowest_s and fine_s >= step_s else "5 samples"
    if fine_s < step_s:
        step_s, words = fine_s, "each reading of a sweep takes a row"
    return [f"  step_s: {step_s:g}  # guessed: {words}", f"  max_gap_s: {5 * slowest_s:g}  # guessed: {gap}"]


def _runs(group: Group) -> list[str]:
    """Lines of a comment that proposes how to cut one long recording into runs, the first way that gives several."""
    if len(group.tables) > 1 or group.table.time is None or group.position_groups:
        return []
    rows, unit_s = group.longest, group.clock.unit_s
    seen = {n: guess.seen_range(rows.columns[n]) for n in group.names}
    gap_s = 5.0 * group.step_and_length[0] * unit_s
    factor, offset = 1.0, 0.0
    ways: list[dict[str, object]] = [{"driver": n} for n in group.named("driver") if seen[n][0] <= 0.05 * seen[n][1]]
    if not group.clock.note:  # no gap of summer time
        ways.append({"pause": f"{guess.grid_step_s(max(2 * gap_s, _PAUSE_S)):g} s"})
    for n in sorted(group.named("temperature"), key=lambda n: seen[n][0] - seen[n][1])[:1]:
        unit = group.unit(group.names[n])
        factor, offset = conversion(unit.value if unit else "degC", "degC", n)
        idle = factor * (seen[n][0] + _IDLE_SHARE * (seen[n][1] - seen[n][0])) + offset
        ways.append({"driver": n, "above": float(f"{idle:.3g}")})
    ways += [{"every": "24 h"}]
    for way in ways:
        split = Split.model_validate(way)
        still = 0.0 if split.above is None else (split.above - offset) / factor
        try:
            cut = [*cut_runs(iter([replace(rows, time_s=rows.time_s * unit_s)]), split, still, "")]
        except InputError:
            continue
        if len(cut) > 1:
            group.notes.append(f"one recording only; recording.split: {flow(way)} would cut it into {len(cut)} runs")
            return [f"  # split: {flow(way)}  # proposed: {len(cut)} runs from this one recording"]
    return []


def _linked(group: Group) -> tuple[dict[str, Guess], float]:
    """Error channel -> its position channel, and the grid step in s that their sweeps need (inf without sweeps)."""
    of_group = {i for g in group.position_groups for i in g.places}
    errors, positions = ([n for n in group.named(r) if group.names[n] not in of_group] for r in ("error", "position"))
    linked = guess.along_axis(errors, positions, group.longest)
    if not linked and not group.position_groups:
        return {}, np.inf
    sweeps = [group.longest.columns[g.value] for g in linked.values()]
    time_s = group.longest.time_s * group.clock.unit_s
    return linked, guess.sweep_step_s(time_s, sweeps, [len(g.places) for g in group.position_groups])


def _channels(group: Group, linked: dict[str, Guess], taken: list[str]) -> list[str]:
    """Lines of a group's channels; their names join `taken`."""
    lines: list[str] = []
    given = {f"{n}_{group.key}" if n in taken else n: n for n in group.names}
    name_of = {n: name for name, n in given.items()}
    of_group = {i for g in group.position_groups for i in g.places}
    source = {} if group.key == "file" else {"source": group.key}
    free = [name for name, key in given.items() if group.names[key] not in of_group]
    errors = {n: group.column(given[n]) for n in free if group.roles[given[n]].value == "error"}
    largest = iter(sorted(errors, key=lambda n: -np.ptp(guess.seen_range(errors[n]))))
    for name in (next(largest) if n in errors else n for n in free):
        key = given[name]
        i = group.names[key]
        values, role = group.column(key), group.roles[key]
        along = Guess(name_of[linked[key].value], linked[key].why) if key in linked else None
        unit = group.unit(i) or guess.unit(role.value, group.table.title(i), values)
        lines += _channel(name, role, unit, {"column": flow(group.table.key(i)), **source}, values, along)
        taken.append(name)
    key_of = {i: name for name, i in group.names.items()}
    for positions in group.position_groups:
        stacked = np.concatenate([r.columns[key_of[i]] for r in group.rows for i in positions.places])
        lines += _axis(positions, stacked, taken, source)
    return lines


def _axis(group: PositionGroup, values: NDArray[np.float64], taken: Sequence[str], source: dict[str, str]) -> list[str]:
    """Lines of the position channel and the error channel of columns that differ by a position."""
    before = group.pattern.partition("*")[0]
    stem = group.letter or re.sub(r"[^a-z]+", "_", before.lower()).strip("_") or "axis"
    position, error = f"{stem}_position", f"{stem}_axis" if stem != "axis" else "axis_error"
    if {position, error} & set(taken):
        position, error = f"{position}_2", f"{error}_2"
    role = Guess("error", f"{len(group.places)} columns whose names differ by a number")
    along = Guess(position, "the number in the names is taken for the position")
    unit = guess.unit("error", before, values)
    return [
        f"  {position}:",
        "    role: position  # guessed: from the names of the columns",
        "    unit: mm  # guessed: usual for positions",
        "    guessed: [role, unit]",
        *_channel(error, role, unit, {"columns": flow(group.pattern), **source}, values, along),
    ]


def _channel(
    name: str, role: Guess, unit: Guess, place: dict[str, str], values: NDArray[np.float64], along: Guess | None
) -> list[str]:
    """Lines of one channel; `place` is how the file finds it, range and resolution show in all `values`."""
    kept = {"temperature": "degC", "ambient": "degC", "error": "um"}.get(role.value, unit.value)
    kept = kept if quantity(kept) == quantity(unit.value) else unit.value
    rows = [("role", role.value, f"guessed: {role.why}")]  # key, its YAML, and why where it is guessed
    rows.append(("unit", flow(kept), f"guessed: {unit.why}" if kept == unit.value else "what the lake keeps"))
    rows += [(key, value, "") for key, value in place.items() if f"{key}: {value}" != f"column: {flow(name)}"]
    if along is not None:
        rows.append(("position", flow(along.value), f"guessed: {along.why}"))
    factor, offset = 1.0, 0.0
    if kept != unit.value:
        rows.append(("unit_in_file", flow(unit.value), f"guessed: {unit.why}"))
        factor, offset = conversion(unit.value, kept, name)
    if (step := guess.resolution(values)) is not None:
        rows.append(("resolution", f"{step * abs(factor):.6g}", "guessed: smallest step seen"))
    low, high = (v * factor + offset for v in guess.seen_range(values))
    if span := guess.plausible_range(role.value, low, high):
        rows.append(("range", flow([float(v) for v in span]), f"guessed: seen {low:.4g} to {high:.4g}, widened"))
    lines = [f"    {key}: {value}{f'  # {why}' * bool(why)}" for key, value, why in rows]
    return [f"  {flow(name)}:", *lines, f"    guessed: {flow([key for key, _, why in rows if why])}"]
