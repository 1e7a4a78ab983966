"""The batches that a command works on: from `--recordings`, from files alone, or from the lake."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from data.batch import Batch
from data.checks import check_machine
from data.errors import InputError, closest
from data.ingest import IngestReport, ingest
from data.lake import Lake
from data.machine import Machine
from data.recording import read_batches, recording_files
from pipelines.caller import Say
from pipelines.settings import home


@dataclass(frozen=True)
class Gathered:
    """Checked batches, and the report of their ingest; None where they come from the lake."""

    batches: tuple[Batch, ...]
    ingested: IngestReport | None = None


def home_lake() -> Lake:
    """The lake in `home()`."""
    return Lake(home() / "lake")


def check_recordings(recordings: Sequence[Path]) -> None:
    """Raises InputError where one of them does not exist."""
    missing = [str(p) for p in recordings if not p.exists()]
    if missing:
        raise InputError(f"--recordings {', '.join(missing)}: no such file or folder; give existing ones")


def load_batches(lake: Lake, machine: Machine) -> list[Batch]:
    """A machine's batches from the lake, with the checks that need several batches and the user's overrules.

    Raises:
        InputError: the lake has no batch of the machine.
    """
    return check_machine(lake.load_all(machine.machine), machine)


def read_files(machine: Machine, path: Path, need_error: bool = True) -> Iterator[Batch]:
    """The batches of a file, or of all files in a folder that `recording.files` names; without findings.

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
        yield from read_batches(file, machine, need_error)


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
        if not report.batches:
            raise InputError(f"--recordings: no recording of {machine.machine} could be used{_reason(report, machine)}")
    held = load_batches(lake, machine)
    if report is not None:
        ingested = {r.batch_id for r in report.batches}
        held = [b for b in held if b.batch_id in ingested]
    ids = [b.batch_id for b in held]
    for name in batch_ids:
        if name not in ids:
            raise InputError(f"--batches: no batch {name!r} of {machine.machine}; {closest(name, ids)}")
    return Gathered(tuple(b for b in held if not batch_ids or b.batch_id in batch_ids), report)


def _reason(report: IngestReport, machine: Machine) -> str:
    if report.quarantined:
        return f"; {report.quarantined[0].reason}"
    return (
        f"; {len(report.ignored)} other files there, the machine file takes "
        f"{', '.join(machine.recording.files)}; give another folder or correct recording.files"
    )
