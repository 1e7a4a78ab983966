"""Whether what the lake holds under a machine's name fits its machine file: after a change of the file, and before an
ingest stores recordings, which may be those of another machine of the same name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from data.batch import Batch, Channel
from data.errors import InputError, WorkError
from data.lake import Lake
from data.lakefile import PARQUET, native_parquet
from data.machine import Machine
from data.recording import read_batches

_SHOWN = 3  # batches that a message names
_SENSED = ("temperature", "ambient", "error")


def check_channels(batches: Sequence[Batch], machine: Machine, lake: Lake) -> None:
    """Whether stored batches have the channels of the machine file: names, roles, units and positions.

    Raises:
        InputError: some have others; the differences, and what to do.
    """
    unfit = _unfit(batches, machine)
    if not unfit:
        return
    name = machine.machine
    raise InputError(
        f"machine file {name}: {len(unfit)} of {len(batches)} batches in the lake ({_few(unfit)}) have other channels; "
        f"{_differences(unfit, machine)}; ingest their recordings again with this machine file, or where these are "
        f"gone {_copies(lake, name)}, or withdraw them (`thermodrift lake withdraw {name} BATCH... --reason TEXT`)"
    )


def check_name(files: Mapping[Path, str], machine: Machine, lake: Lake) -> None:
    """Whether the recordings can be stored next to what the lake holds under the machine's name.

    Batches with other channels, or simulated ones next to recorded ones, are allowed only where the same recordings
    come again, all of them or nothing else: then the machine file has changed. Only the newest batch is read as long as
    it fits.

    Args:
        files: the recordings, with what comes before the ids of their batches.

    Raises:
        InputError: the lake holds another machine's batches under this name; what differs, and what to do.
    """
    name = machine.machine
    stems = {f: prefix + f.stem for f, prefix in files.items() if native_parquet(f) is None}
    try:
        if not stems or not lake.batch_ids(name):
            return
        held = {i: v[-1] for i, v in lake.contents(name).items() if v[-1].withdrawn is None}
        newest = lake.load(name, max(held, key=lambda i: held[i].stored_at))
        unfit = _unfit(lake.load_all(name), machine) if _unfit([newest], machine) else []
    except WorkError:  # a damaged file is healed by the ingest, which says what else is wrong
        return
    other_kind = [  # a Parquet file states itself whether it is simulated
        i for i, v in held.items() if v.simulated != machine.simulated and not v.source.lower().endswith(PARQUET)
    ]
    wrong = {b.batch_id for b in unfit} | set(other_kind)
    again = {f: [i for i in held if i == stem or i.startswith(f"{stem}-")] for f, stem in stems.items()}
    whole = wrong <= {i for ids in again.values() for i in ids} or all(again.values())
    if not wrong or (whole and _same_recordings({f: ids for f, ids in again.items() if ids}, files, machine, lake)):
        return
    kind, was = ("simulated", "recorded") if machine.simulated else ("recorded", "simulated")
    why = [f"have other channels ({_differences(unfit, machine)})"] * bool(unfit)
    why += [f"are {was}, and the machine file's are {kind}"] * bool(other_kind)
    raise InputError(
        f"machine file {name}: the lake holds {len(held)} batches under this name, of which {len(wrong)} "
        f"{' and '.join(why)}; nothing was stored. If they are of another machine, give this one a name of its own "
        f"(key machine); if only the machine file has changed, ingest all recordings together, or first "
        f"{_copies(lake, name)}"
    )


def _same_recordings(
    again: Mapping[Path, Sequence[str]], files: Mapping[Path, str], machine: Machine, lake: Lake
) -> bool:
    """Whether the first of these files that can be read has, in any channel, the values of a batch of its id."""
    for file, ids in again.items():
        try:
            new = next(read_batches(file, machine, need_error=False))
        except (InputError, StopIteration):
            continue
        batch_id = files[file] + new.batch_id
        if batch_id in ids:
            return _shares_values(new, lake.load(machine.machine, batch_id))
    return True


def _shares_values(new: Batch, old: Batch) -> bool:
    """Whether any measured channel of the one has the values of any of the other, whatever their names.

    Drivers do not count: a standard test has the same ones on every machine.
    """
    mine, theirs = ([b.values(n) for n in b.names(*_SENSED) if n in b.table.columns] for b in (new, old))
    moving = [a for a in mine if len(np.unique(a[np.isfinite(a)])) > 1]
    return any(len(a) == len(b) and np.allclose(a, b, equal_nan=True) for a in moving for b in theirs)


def _unfit(batches: Sequence[Batch], machine: Machine) -> list[Batch]:
    now = _meanings(machine.batch_channels())
    return [b for b in batches if _meanings(b.channels) != now]


def _differences(unfit: Sequence[Batch], machine: Machine) -> str:
    """What the channels of batches have else than the machine file."""
    now, then = _meanings(machine.batch_channels()), [_meanings(b.channels) for b in unfit]
    changes = [
        ("not stored", sorted({n for n in now if any(n not in c for c in then)})),
        ("no longer in the machine file", sorted({n for c in then for n in c if n not in now})),
        ("changed", sorted({f"{n} ({c[n]} → {now[n]})" for c in then for n in c if n in now and c[n] != now[n]})),
    ]
    return "; ".join(f"{kind}: {', '.join(names)}" for kind, names in changes if names)


def _meanings(channels: Mapping[str, Channel]) -> dict[str, str]:
    return {n: f"{c.role} in {c.unit}{f' along {c.position}' * bool(c.position)}" for n, c in channels.items()}


def _few(batches: Sequence[Batch]) -> str:
    ids = [b.batch_id for b in batches]
    return ", ".join(ids if len(ids) <= _SHOWN + 1 else [*ids[:_SHOWN], "…"])


def _copies(lake: Lake, name: str) -> str:
    return (
        f"their copies in the lake (`thermodrift ingest {lake.name}/machine={name} --machine FILE`; a renamed channel "
        "is empty then)"
    )
