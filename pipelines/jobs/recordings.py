"""The batches that a command works on: from `--recordings`, from files alone, or from the lake."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from data.batch import Batch
from data.checks import check_machine, checked
from data.errors import InputError, closest
from data.held import check_channels
from data.ingest import IngestReport, id_prefix, ingest
from data.lake import Lake
from data.machine import Machine
from data.recording import read_batches, recording_files
from pipelines.caller import Say
from pipelines.settings import load


@dataclass(frozen=True)
class Gathered:
    """Checked batches, and the report of their ingest; None where they come from the lake."""

    batches: tuple[Batch, ...]
    ingested: IngestReport | None = None


def home_lake() -> Lake:
    """The lake that `mlflow.yml` or THERMODRIFT_LAKE names, by default in `home()`."""
    settings = load()
    return Lake(settings.lake, settings.lake_key)


def check_recordings(recordings: Sequence[Path]) -> None:
    """Raises InputError where one of them does not exist."""
    missing = [str(p) for p in recordings if not p.exists()]
    if missing:
        raise InputError(f"--recordings {', '.join(missing)}: no such file or folder; give existing ones")


def load_batches(lake: Lake, machine: Machine) -> list[Batch]:
    """A machine's batches from the lake, with the checks that need several batches and the user's overrules.

    Raises:
        InputError: the lake has no batch of the machine, or has batches with other channels than the machine file.
    """
    batches = lake.load_all(machine.machine)
    check_channels(batches, machine, lake)
    return check_machine(batches, machine)


def checked_files(
    machine: Machine, paths: Iterable[Path], need_error: bool = True, channels: Collection[str] | None = None
) -> list[Batch]:
    """The batches of `read_files`, with the findings of all checks, as if they came from the lake."""
    batches = [checked(b, machine) for path in paths for b in read_files(machine, path, need_error, channels)]
    return check_machine(batches, machine)


def played_files(machine: Machine, paths: Iterable[Path]) -> list[Batch]:
    """`checked_files` for a rehearsal: errors are masked, sensors as recorded, since a control gets their faults."""
    errors = {None, *machine.names("error")}
    every = checked_files(machine, paths)
    return [b.with_findings(tuple(f for f in b.findings if f.channel in errors or not f.masks)) for b in every]


def read_files(
    machine: Machine, path: Path, need_error: bool = True, channels: Collection[str] | None = None
) -> Iterator[Batch]:
    """The batches of a file, or of all files in a folder that `recording.files` names, with the ids that an ingest
    gives them; without the findings of the checks. `channels` are those that are needed, see `read_batches`.

    Raises:
        InputError: nothing there, or a file that cannot be used.
    """
    files = [path]
    if path.is_dir():
        files, _ = recording_files(path, machine)
        if not files:
            raise InputError(
                f"{path}: no recording of {machine.machine} there; recording.files takes "
                f"{', '.join(machine.recording.files)}"
            )
    for file in files:
        for batch in read_batches(file, machine, need_error, channels):
            yield replace(batch, batch_id=id_prefix(file, path) + batch.batch_id)


def gather_batches(machine: Machine, recordings: Sequence[Path], batch_ids: Sequence[str], say: Say) -> Gathered:
    """The batches to work on, from the lake, where `--recordings` are put first.

    Args:
        recordings: files and folders; empty: every batch of the machine that the lake holds.
        batch_ids: which of them; empty: all.

    Raises:
        InputError: no such file or folder, no recording that can be used, an unknown batch.
        WorkError: the lake cannot be written.
    """
    check_recordings(recordings)
    lake = home_lake()
    report: IngestReport | None = None
    if recordings:
        report = ingest(list(recordings), machine, lake, progress=say)
        if not any(r.stored_as for r in report.rows):
            raise InputError(f"--recordings: no recording of {machine.machine} could be used{_reason(report, machine)}")
    held = load_batches(lake, machine)
    if report is not None:
        ingested = {r.stored_as for r in report.rows}
        held = [b for b in held if b.batch_id in ingested]
    ids = [b.batch_id for b in held]
    for name in batch_ids:
        if name not in ids:
            raise InputError(f"--batches: no batch {name!r} of {machine.machine}; {closest(name, ids)}")
    return Gathered(tuple(b for b in held if not batch_ids or b.batch_id in batch_ids), report)


def _reason(report: IngestReport, machine: Machine) -> str:
    left_out = [r.reason for r in (*report.quarantined, *report.waiting, *report.rows) if r.reason]
    if left_out:
        return f"; {left_out[0]}"
    return (
        f"; {len(report.ignored)} other files there, the machine file takes "
        f"{', '.join(machine.recording.files)}; give another folder or correct recording.files"
    )
