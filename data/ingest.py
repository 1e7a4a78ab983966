"""Ingest: read recordings, check them and store them in the lake; unusable files go to quarantine with the reason."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from data.batch import Batch, Finding
from data.checks import check_batch, overruled
from data.errors import InputError, WorkError
from data.lake import Lake, Staged
from data.lakefile import content_digest
from data.machine import Machine
from data.recording import read_batches, recording_files
from data.units import check_canonical

COMMIT_EVERY_S = 1.0
COLUMNS = ("file", "batch_id", "status", "version", "rows_in", "rows_stored", "rows_dropped", "findings", "reason")


@dataclass
class Ingested:
    """One batch of one file, or one file in quarantine (`batch_id` "").

    `status`: new, unchanged, refreshed, new_version (see `data.lake`); conflict: left out because another file
    of the same ingest gave other content under this id; quarantined: the file, or what was left of it, cannot be
    used. Rows are rows of the recording: `rows_in` = `rows_stored` + `rows_dropped`; None if unknown.
    `found`: what the checks of one batch found, with the machine file's overrules.
    """

    file: str
    batch_id: str
    status: str
    version: int | None
    rows_in: int | None
    rows_stored: int
    rows_dropped: int | None
    findings: int
    reason: str = ""
    found: tuple[Finding, ...] = ()


@dataclass
class IngestReport:
    """What an ingest did, file by file in the order read; `ignored` are files that match no pattern."""

    machine: str
    rows: list[Ingested] = field(default_factory=list)
    ignored: list[Path] = field(default_factory=list)

    @property
    def batches(self) -> list[Ingested]:
        return [r for r in self.rows if r.batch_id]

    @property
    def quarantined(self) -> list[Ingested]:
        return [r for r in self.rows if r.status in ("quarantined", "conflict")]

    @property
    def rows_in(self) -> int:
        """Rows of all files that could be counted; = `rows_stored` + `rows_dropped`."""
        return sum(r.rows_in or 0 for r in self.rows)

    @property
    def rows_stored(self) -> int:
        """Rows of the recordings that stand in the lake."""
        return sum(r.rows_stored for r in self.rows)

    @property
    def rows_dropped(self) -> int:
        return sum(r.rows_dropped or 0 for r in self.rows)

    def as_frame(self) -> pd.DataFrame:
        """One row per batch or quarantined file, columns `COLUMNS`."""
        frame = pd.DataFrame([asdict(r) for r in self.rows], columns=list(COLUMNS))
        return frame.astype({"version": "Int64", "rows_in": "Int64", "rows_dropped": "Int64"})


def ingest(
    paths: Sequence[Path], machine: Machine, lake: Lake, progress: Callable[[str], None] | None = None
) -> IngestReport:
    """Bring files and directories into the lake, in memory bounded by one batch.

    A directory gives the files that match `machine.recording.files`, in sorted order; a file is read whatever its name.
    A batch id that comes twice with different content is a conflict: the first one is stored, the second one is left
    out and its file goes to quarantine. `progress` gets one line per file.

    Raises:
        InputError: a path does not exist, or a channel's unit cannot be kept; nothing has been read then.
        WorkError: the lake cannot be written; what was stored before stays.
    """
    check_canonical({n: (c.role, c.unit) for n, c in machine.channels.items()}, f"machine file {machine.machine}")
    files, ignored = _collect(paths, machine)
    run = _Run(machine, lake, IngestReport(machine.machine, ignored=ignored))
    for number, file in enumerate(files, 1):
        if progress:
            progress(f"{number}/{len(files)} {file.name}")
        run.take(file)
    run.commit()
    return run.report


class _Run:
    """One ingest under way."""

    def __init__(self, machine: Machine, lake: Lake, report: IngestReport) -> None:
        self.machine, self.lake, self.report = machine, lake, report
        self._first: dict[str, tuple[Path, str]] = {}  # batch id -> file and digest
        self._waiting: list[tuple[Staged, Ingested]] = []
        self._committed_at = time.monotonic()

    def take(self, file: Path) -> None:
        """One file: every batch that can be used goes in, the first problem ends the file."""
        before = len(self.report.rows)
        conflicts = []
        try:
            for batch in _ahead(_checked(file, self.machine)):
                if conflict := self._store(file, batch):
                    conflicts.append(conflict)
            if len(self.report.rows) == before:
                raise InputError(f"{file}: no batch in it; expected a recording of at least two rows")
        except InputError as error:
            seen = sum(r.rows_in or 0 for r in self.report.rows[before:])
            rows = _count_rows(file, self.machine)
            left = None if rows is None else max(0, rows - seen)
            self.report.rows.append(Ingested(str(file), "", "quarantined", None, left, 0, left, 0, str(error)))
            self.lake.quarantine(file, self.machine.machine, str(error))
        for reason in conflicts:
            self.lake.quarantine(file, self.machine.machine, reason)

    def _store(self, file: Path, batch: Batch) -> str | None:
        """Stage a batch; gives the reason if it contradicts an earlier one of this ingest."""
        digest = content_digest(batch)
        rows_in = batch.repairs.get("rows_in", batch.n_rows)
        dropped = batch.repairs.get("rows_dropped", 0)
        first_file, first_digest = self._first.setdefault(batch.batch_id, (file, digest))
        if digest != first_digest:
            reason = (
                f"{file}: batch {batch.batch_id!r} has other content than the batch of that id in {first_file}; "
                "the first one is stored, this one is left out; give one of them another name and ingest it again"
            )
            row = Ingested(
                str(file), batch.batch_id, "conflict", None, rows_in, 0, rows_in, len(batch.findings), reason
            )
            self.report.rows.append(row)
            return reason
        staged = self.lake.stage(batch, digest)
        row = Ingested(
            str(file), batch.batch_id, "staged", None, rows_in, rows_in - dropped, dropped, len(batch.findings),
            found=overruled(batch, self.machine.overrule).findings,
        )  # fmt: skip
        self.report.rows.append(row)
        self._waiting.append((staged, row))
        if time.monotonic() - self._committed_at > COMMIT_EVERY_S:
            self.commit()
        return None

    def commit(self) -> None:
        stored = self.lake.commit([s for s, _ in self._waiting])
        for (_, row), result in zip(self._waiting, stored, strict=True):
            row.status, row.version = result.status, result.version
            if Path(result.replaces).name != Path(row.file).name and result.replaces:
                row.reason = f"follows the version from {result.replaces}, which stays in the lake"
        self._waiting.clear()
        self._committed_at = time.monotonic()


def _collect(paths: Sequence[Path], machine: Machine) -> tuple[list[Path], list[Path]]:
    """Files to read, each once, and files to ignore."""
    missing = [str(p) for p in paths if not Path(p).exists()]
    if missing:
        raise InputError(
            f"{', '.join(missing)}: no such file or directory; nothing was read, give existing recordings or folders"
        )
    files: dict[Path, Path] = {}
    ignored: dict[Path, Path] = {}
    for path in map(Path, paths):
        wanted, others = recording_files(path, machine) if path.is_dir() else ([path], [])
        files |= {f.resolve(): f for f in wanted if f.resolve() not in files}
        ignored |= {f.resolve(): f for f in others}
    return list(files.values()), [f for key, f in ignored.items() if key not in files]


def _ahead(batches: Generator[Batch, None, None]) -> Generator[Batch, None, None]:
    """The batches, read ahead by one in a second thread while the caller stores the current one."""
    try:
        with ThreadPoolExecutor(1) as pool:
            coming = pool.submit(next, batches, None)
            while (batch := coming.result()) is not None:
                coming = pool.submit(next, batches, None)
                yield batch
    finally:
        batches.close()


def _checked(file: Path, machine: Machine) -> Generator[Batch, None, None]:
    """The file's batches with their findings; whatever goes wrong in the file's reading is an InputError."""
    try:
        for batch in read_batches(file, machine):
            yield batch.with_findings((*batch.findings, *check_batch(batch, machine)))
    except (InputError, WorkError):
        raise
    except Exception as error:  # an unforeseen kind of damage must not stop the other files
        reason = " ".join(str(error).split())
        raise InputError(
            f"{file}: cannot be used ({type(error).__name__}: {reason}); expected a recording as the machine file "
            f"of {machine.machine} describes it; export it again"
        ) from error


def _count_rows(file: Path, machine: Machine) -> int | None:
    """Data rows of an unusable file; None if they cannot be counted."""
    try:
        if file.suffix == ".parquet":
            return int(pq.ParquetFile(file).metadata.num_rows)
        if file.suffix not in (".csv", ".txt", ".tsv"):
            return None
        lines, last = 0, b"\n"
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                if b"\0" in block:
                    return None
                lines += block.count(b"\n")
                last = block
        lines += not last.endswith(b"\n")
        return max(0, lines - machine.recording.header)
    except (OSError, pa.ArrowException):
        return None
