"""Ingest: read recordings, check them and store them in the lake; unusable files go to quarantine with the reason.

A batch from a file in a subfolder of the given folder is named by its path there (``2025/run1``), so that files of the
same name do not meet; otherwise by the file's name alone. The same measured values under two names are one batch.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from data.batch import Batch, Finding
from data.checks import check_batch, overruled
from data.errors import InputError, WorkError
from data.held import check_name
from data.lake import Lake
from data.lakefile import content_digest
from data.machine import Machine
from data.manifest import Staged, Stored
from data.recording import read_batches, recording_files, steers
from data.units import check_canonical

COMMIT_EVERY_S = 1.0
RECENT_S = 5.0  # a file that was changed later than this may still grow: copies and data loggers write more often
LOOK_AGAIN_S = 1.0  # time between the two looks at such a file
COLUMNS = (
    "file", "batch_id", "status", "version", "rows_in", "rows_stored", "rows_dropped", "findings", "reason",
    "stored_as",
)  # fmt: skip


@dataclass
class Ingested:
    """One batch of one file, or one file without a usable batch (`batch_id` "").

    `status`: new, unchanged, refreshed, healed, new_version, duplicate, withdrawn (see `data.manifest.Stored`);
    conflict: left out because another file of the same ingest gave other content under this id; quarantined: the file,
    or what was left of it, cannot be used; waiting: the file is still being written, the next ingest takes it.
    `stored_as` is the batch's id in the lake, "" if it is not there. Rows are rows of the recording: `rows_in` =
    `rows_stored` + `rows_dropped`; None if unknown. `found`: what the checks of one batch found, with the machine
    file's overrules.
    """

    file: str
    batch_id: str
    status: str
    version: int | None = None
    rows_in: int | None = None
    rows_stored: int = 0
    rows_dropped: int | None = None
    findings: int = 0
    reason: str = ""
    stored_as: str = ""
    found: tuple[Finding, ...] = ()


@dataclass
class IngestReport:
    """The outcome of an ingest, file by file in the order read; `ignored` are other files of the folders, and why."""

    machine: str
    rows: list[Ingested] = field(default_factory=list)
    ignored: list[tuple[Path, str]] = field(default_factory=list)

    @property
    def batches(self) -> list[Ingested]:
        return [r for r in self.rows if r.batch_id]

    @property
    def quarantined(self) -> list[Ingested]:
        return [r for r in self.rows if r.status in ("quarantined", "conflict")]

    @property
    def waiting(self) -> list[Ingested]:
        return [r for r in self.rows if r.status == "waiting"]

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
        """One row per batch or file without one, ignored files last; columns `COLUMNS`."""
        ignored = [Ingested(str(f), "", "ignored", reason=reason) for f, reason in self.ignored]
        frame = pd.DataFrame([asdict(r) for r in (*self.rows, *ignored)], columns=list(COLUMNS))
        return frame.astype({"version": "Int64", "rows_in": "Int64", "rows_dropped": "Int64"})


def ingest(
    paths: Sequence[Path],
    machine: Machine,
    lake: Lake,
    progress: Callable[[str], None] | None = None,
) -> IngestReport:
    """Bring files and directories into the lake, in memory bounded by one batch.

    A directory gives the files that `recording_files` finds; a file is read whatever its name. Files of the folder
    itself and with short names come first, so that ``run1.csv`` is stored and ``run1 (copy).csv`` is its duplicate. A
    file that grows between two looks, or while it is read, waits for the next ingest. A batch id that comes twice
    with different content is a conflict: the first one is stored, the second one is left out and its file goes to
    quarantine. `progress` gets one line per file.

    Raises:
        InputError: a path does not exist, a channel's unit cannot be kept, or the lake holds another machine under
            this name (see `data.held.check_name`); nothing has been stored then.
        WorkError: the lake cannot be written; what was stored before stays.
    """
    check_canonical({n: (c.role, c.unit) for n, c in machine.channels.items()}, f"machine file {machine.machine}")
    files, ignored = _collect(paths, machine)
    check_name(files, machine, lake)
    growing = _growing(files)
    run = _Run(machine, lake, IngestReport(machine.machine, ignored=ignored))
    for number, (file, folder) in enumerate(files.items(), 1):
        if progress:
            progress(f"{number}/{len(files)} {file.name}")
        if file in growing:
            run.wait_for(file)
        else:
            run.take(file, folder)
    run.commit()
    return run.report


def _look(file: Path) -> tuple[int, int] | None:
    """Size in bytes and time of the last change in ns; None where the file is gone."""
    try:
        seen = file.stat()
    except OSError:
        return None
    return seen.st_size, seen.st_mtime_ns


def _growing(files: Iterable[Path]) -> set[Path]:
    """Files that were changed lately and change again between two looks."""
    seen = {f: look for f in files if (look := _look(f)) and time.time() - look[1] / 1e9 < RECENT_S}
    if seen:
        time.sleep(LOOK_AGAIN_S)
    return {f for f, look in seen.items() if _look(f) != look}


class _Run:
    """One ingest under way."""

    def __init__(self, machine: Machine, lake: Lake, report: IngestReport) -> None:
        self.machine, self.lake, self.report = machine, lake, report
        self._first: dict[str, tuple[Path, str]] = {}  # batch id -> file and digest
        self._staged: list[tuple[Staged, Ingested]] = []
        self._refused: list[tuple[Path, str]] = []
        self._committed_at = time.monotonic()

    def wait_for(self, file: Path) -> None:
        reason = f"{file}: still being written; ingest it again when it is complete"
        self.report.rows.append(Ingested(str(file), "", "waiting", reason=reason))

    def take(self, file: Path, folder: str = "") -> None:
        """One file: every batch that can be used goes in, the first problem ends the file.

        `folder` comes before the ids of its batches.
        """
        before, staged_before, seen = len(self.report.rows), len(self._staged), _look(file)
        refused: list[str] = []
        try:
            for batch in _ahead(_checked(file, folder, self.machine)):
                if conflict := self._store(file, batch):
                    refused.append(conflict)
            if len(self.report.rows) == before:
                raise InputError(f"{file}: no batch in it; expected a recording of at least two rows")
        except InputError as error:
            read = sum(r.rows_in or 0 for r in self.report.rows[before:])
            rows = _count_rows(file, self.machine)
            left = None if rows is None else max(0, rows - read)
            self.report.rows.append(Ingested(str(file), "", "quarantined", None, left, 0, left, 0, str(error)))
            refused.insert(0, str(error))
        if _look(file) != seen:
            del self.report.rows[before:]
            self.lake.discard([s for s, _ in self._staged[staged_before:]])
            del self._staged[staged_before:]
            self._first = {i: first for i, first in self._first.items() if first[0] != file}
            self.wait_for(file)
            return
        self._refused += [(file, reason) for reason in refused]
        if time.monotonic() - self._committed_at > COMMIT_EVERY_S:
            self.commit()

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
        self._staged.append((staged, row))
        return None

    def commit(self) -> None:
        stored = self.lake.commit([s for s, _ in self._staged], distinct=True)
        for (_, row), result in zip(self._staged, stored, strict=True):
            _note(row, result)
        self._staged.clear()
        self.lake.quarantine_many(self._refused, self.machine.machine)
        self._refused.clear()
        self._committed_at = time.monotonic()


def _note(row: Ingested, result: Stored) -> None:
    """What the lake did with a staged batch."""
    row.status, row.version, row.stored_as = result.status, result.version, result.batch_id
    if result.left_out:
        row.version, row.rows_stored, row.rows_dropped, row.found, row.findings = None, 0, row.rows_in, (), 0
    if result.status == "duplicate":
        row.reason = f"the same measured values as batch {result.batch_id}, which is stored"
    elif result.status == "healed":
        row.reason = "the same content as before; its file in the lake was damaged or gone and is written anew"
    elif result.status == "withdrawn":
        row.stored_as = ""
        row.reason = (
            f"withdrawn: {result.reason}; restore with `thermodrift lake restore {result.machine} {result.batch_id}`"
        )
    elif result.replaces and Path(result.replaces).name != Path(row.file).name:
        row.reason = f"follows the version from {result.replaces}, which stays in the lake"


def _collect(paths: Sequence[Path], machine: Machine) -> tuple[dict[Path, str], list[tuple[Path, str]]]:
    """Files to read, each once, with what comes before the ids of their batches, and files to ignore."""
    missing = [str(p) for p in paths if not Path(p).exists()]
    if missing:
        raise InputError(
            f"{', '.join(missing)}: no such file or directory; nothing was read, give existing recordings or folders"
        )
    strange = next((p for p in map(Path, paths) if steers(p.name)), None)
    if strange is not None:
        raise InputError(f"{str(strange)!a}: a name with control characters; rename it")
    files: dict[Path, tuple[Path, str]] = {}
    ignored: dict[Path, tuple[Path, str]] = {}
    for path in map(Path, paths):
        wanted, others = recording_files(path, machine) if path.is_dir() else ([path], [])
        for file in wanted:
            files.setdefault(file.resolve(), (file, id_prefix(file, path)))
        ignored |= {f.resolve(): (f, reason) for f, reason in others}
    ordered = sorted(files.values(), key=lambda f: (f[1].count("/"), len(f[0].stem)))
    return dict(ordered), [f for key, f in ignored.items() if key not in files]


def id_prefix(file: Path, given: Path) -> str:
    """What comes before the id of a batch: the file's folder inside the given folder, with a slash, or nothing.

    Partitions of a lake (``year=2025``) do not count, so that its files keep their ids.
    """
    if file == given:
        return ""
    parts = file.parent.relative_to(given).parts
    return "".join(f"{part}/" for part in parts if "=" not in part)


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


def _checked(file: Path, folder: str, machine: Machine) -> Generator[Batch, None, None]:
    """The file's batches with their findings; whatever goes wrong in the file's reading is an InputError."""
    try:
        for batch in read_batches(file, machine):
            named = replace(batch, batch_id=folder + batch.batch_id)
            yield named.with_findings((*named.findings, *check_batch(named, machine)))
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
        with file.open("rb") as stream:
            rows = 0
            for line in stream:
                if b"\0" in line:
                    return None
                rows += bool(line.strip()) and not line.lstrip().startswith(b"#")
        return max(0, rows - machine.recording.header)
    except (OSError, pa.ArrowException):
        return None
