"""The batches that a command works on: what `--recordings` brings into the lake, or what the lake holds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from data.batch import Batch
from data.checks import check_machine
from data.errors import InputError, closest
from data.ingest import IngestReport, ingest
from data.lake import Lake
from data.machine import Machine
from pipelines.settings import home


@dataclass(frozen=True)
class Gathered:
    """The batches, checked, and what ingesting did; None where the lake's were asked for."""

    batches: tuple[Batch, ...]
    ingested: IngestReport | None = None


def check_recordings(recordings: Sequence[Path]) -> None:
    """Raises InputError where one of them does not exist."""
    missing = [str(p) for p in recordings if not p.exists()]
    if missing:
        raise InputError(f"--recordings {', '.join(missing)}: no such file or folder; give existing ones")


def gather_batches(
    machine: Machine, recordings: Sequence[Path], batch_ids: Sequence[str], say: Callable[[str], None]
) -> Gathered:
    """The batches to work on, from the lake, where `--recordings` are put first.

    Args:
        recordings: files and folders; empty: every batch of the machine that the lake holds.
        batch_ids: which of them; empty: all.

    Raises:
        InputError: no such file or folder, no recording that can be used, an unknown batch.
        WorkError: the lake cannot be written.
    """
    check_recordings(recordings)
    lake = Lake(home() / "lake")
    report: IngestReport | None = None
    if recordings:
        report = ingest(list(recordings), machine, lake, progress=say)
        if not report.batches:
            raise InputError(f"--recordings: no recording of {machine.machine} could be used{_reason(report, machine)}")
    held = check_machine(lake.load_all(machine.machine), machine)
    if report is not None:
        wanted = {r.batch_id for r in report.batches}
        held = [b for b in held if b.batch_id in wanted]
    ids = [b.batch_id for b in held]
    for name in batch_ids:
        if name not in ids:
            raise InputError(f"--batches: no batch {name!r} of {machine.machine}; {closest(name, ids)}")
    return Gathered(tuple(b for b in held if not batch_ids or b.batch_id in batch_ids), report)


def _reason(report: IngestReport, machine: Machine) -> str:
    if report.quarantined:
        return f"; {report.quarantined[0].reason}"
    return (
        f"; {len(report.ignored)} other files lie there, the machine file asks for "
        f"{', '.join(machine.recording.files)}; give another folder or correct recording.files"
    )
