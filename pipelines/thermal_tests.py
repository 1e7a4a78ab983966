"""`thermodrift report --iso`: recordings judged as thermal tests, one report a batch, in the style of ISO 230-3."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from data.batch import Batch
from data.checks import check_machine
from data.errors import InputError, closest
from data.lake import Lake
from data.lakefile import safe_name
from data.machine import Machine, load_machine
from data.recording import read_batches, recording_files
from data.yaml_file import load_yaml
from reports.twin.iso230_3 import TestSheet, write_iso_report

Say = Callable[[str], None]


def write_thermal_tests(
    machine_file: Path, recordings: Sequence[str], out: Path, lake: Lake, sheet_file: Path | None, say: Say
) -> list[Path]:
    """Write OUT/BATCH/report.html for every batch in the recordings; returns their paths.

    `recordings` are files, folders, or ids of batches that the lake holds; none: every batch of the machine there.
    What the checks mask is left out, as in a training.

    Raises:
        InputError: no such recording or batch, a file that cannot be read, a batch without displacement, a test sheet
            that names what is not there, or a folder that cannot be written.
    """
    machine = load_machine(machine_file)
    sheet = load_yaml(sheet_file, TestSheet, "test sheet") if sheet_file is not None else None
    batches = check_machine(list(_batches(machine, recordings, lake)), machine)
    ids = [b.batch_id for b in batches]
    for name in ids:
        if ids.count(name) > 1:
            raise InputError(f"batch {name!r} comes twice in the recordings; leave one of them out")
    reports: list[Path] = []
    for batch in batches:
        say(f"{len(reports) + 1}/{len(batches)} {batch.batch_id}")
        reports.append(write_iso_report(batch, out / safe_name(batch.batch_id), sheet))
    return reports


def _batches(machine: Machine, recordings: Sequence[str], lake: Lake) -> Iterator[Batch]:
    held = lake.batch_ids(machine.machine)
    if not recordings:
        if not held:
            raise InputError(
                f"the lake holds no batch of {machine.machine}; name recordings, or call `thermodrift ingest` first"
            )
        yield from lake.load_all(machine.machine)
    for name in recordings:
        path = Path(name)
        if path.is_dir():
            files, _ = recording_files(path, machine)
            if not files:
                raise InputError(
                    f"{path}: no recording of {machine.machine} there; recording.files asks for "
                    f"{', '.join(machine.recording.files)}"
                )
            for file in files:
                yield from read_batches(file, machine)
        elif path.exists():
            yield from read_batches(path, machine)
        elif name in held:
            yield lake.load(machine.machine, name)
        else:
            known = f" of {machine.machine} in the lake; {closest(name, held)}" if held else " in the lake, it is empty"
            raise InputError(f"{name}: no such file or folder, and no batch{known}")
