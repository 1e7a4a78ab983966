"""`thermodrift ingest`: recordings into the lake."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from data.errors import InputError, WorkError
from pipelines import console
from pipelines.options import Json, MachineFile

if TYPE_CHECKING:
    import pandas as pd

    from data.ingest import IngestReport


SHOWN = 5  # names of ignored files per reason


def print_ingest(report: IngestReport) -> None:
    """One line of totals, then one per file in quarantine, batch left out, waiting file and reason to ignore files."""
    console.line("ingest   " + ", ".join(f"{k}: {v}" for k, v in ingest_totals(report).items()))
    for row in report.waiting:
        console.line(f"  waiting: {row.reason}")
    for row in (r for r in report.rows if r.status in ("duplicate", "withdrawn")):
        console.line(f"  left out: {row.file} ({row.batch_id}): {row.reason}")
    reasons: dict[str, list[str]] = {}
    for file, reason in report.ignored:
        reasons.setdefault(reason, []).append(file.name.replace("\n", "\\n"))
    for reason, names in reasons.items():
        more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
        console.line(f"  ignored, {reason}: {', '.join(names[:SHOWN])}{more}")
    for row in report.quarantined:
        folder, _, name = row.file.rpartition("/")
        where = "" if row.reason.startswith(row.file) else f"{folder}/" if folder else ""
        console.line(f"  quarantine: {where}{row.reason if name in row.reason else f'{name}: {row.reason}'}")


def print_findings(found: pd.DataFrame) -> None:
    """One line per check and channel with its batches; `found` as `data.batch.finding_table`."""
    for (check, channel), part in found.fillna({"channel": "all channels"}).groupby(["check", "channel"], sort=False):
        ids = sorted(part["batch_id"].astype(str).unique())
        shown = ", ".join(ids if len(ids) <= 4 else [*ids[:3], "…", ids[-1]])
        masked = part["masks"] & (part["overruled"] == "")
        state = "masked" if masked.all() else "partly masked" if masked.any() else "noted, not masked"
        count = f"{len(ids)} batch{'es' if len(ids) > 1 else ''}"
        console.line(f"  {str(check).replace('_', ' ')}: {channel} in {count} ({shown}), {state}")


def ingest_totals(report: IngestReport) -> dict[str, int]:
    """Counts of batches by status, of findings, rows and files."""
    states = Counter(r.status.replace("_", " ") for r in report.batches)
    return {
        **{f"batches {state}": n for state, n in states.items()},
        "findings": sum(r.findings for r in report.batches),
        "rows read": report.rows_in,
        "rows dropped": report.rows_dropped,
        "files in quarantine": len(report.quarantined),
        "files waiting": len(report.waiting),
        "files ignored": len(report.ignored),
    }


def ingest(
    paths: Annotated[list[Path], typer.Argument(help="recordings or folders of recordings")],
    machine: MachineFile,
    as_json: Json = False,
) -> None:
    """Read recordings into the lake; what cannot be used goes to quarantine with the reason."""
    from data.account import Account
    from data.batch import finding_table
    from data.ingest import ingest as ingest_paths
    from data.machine import load_machine
    from pipelines.jobs.recordings import home_lake, load_batches

    described = load_machine(machine)
    with console.progress(as_json) as (say, _):
        report = ingest_paths(paths, described, home_lake(), progress=say)
    stored = {r.stored_as for r in report.rows if r.stored_as}
    if as_json:
        console.print_json(console.records(report.as_frame()))
    else:
        print_ingest(report)
        print_findings(finding_table((r.batch_id, r.found) for r in report.batches))
    if stored:
        batches = load_batches(home_lake(), described)
        new = Account.of(b for b in batches if b.batch_id in stored)
        for line in ([new.rows] if new.rows_dropped or new.repeated else []) + Account.of(batches).large(stored):
            console.note(line)
    if not report.rows:
        raise InputError(
            f"{', '.join(map(str, paths))}: no recording there, {len(report.ignored)} other files; the machine file "
            f"takes {', '.join(described.recording.files)}; give another folder or correct recording.files"
        )
    if not report.batches and report.waiting:
        raise WorkError(f"no file was taken; still being written: {len(report.waiting)}; ingest again when complete")
    if not report.batches:
        raise InputError(f"no file could be used ({len(report.quarantined)} in quarantine); the reasons are above")
