"""`thermodrift diagnose`: recordings and a machine file into findings, a report, a new machine file, the next run."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Protocol

from data.batch import Batch
from data.errors import InputError, WorkError
from data.files import check_folder, staged
from data.ingest import IngestReport
from data.machine import Machine, load_machine
from diagnosis.export.machine_file import diagnosed_text, drafted_text
from diagnosis.findings.schema import Findings, as_json
from diagnosis.result import Diagnosis
from pipelines.caller import RETRIES, Caller, DirectCaller, Done
from pipelines.recordings import Gathered, check_recordings, gather_batches
from pipelines.settings import Settings, home
from twin.calibration.calibrated_file import Origin
from twin.compile import compile_network

Say = Callable[[str], None]
REPORT, PLAN, MACHINE, FINDINGS = "report.html", "next_run.yml", "machine.yml", "findings.json"
FILES = (REPORT, PLAN, MACHINE, FINDINGS)  # the last one says that the others are complete


class Diagnose(Protocol):
    """What does the work: `diagnosis.diagnose.diagnose`, or a toy in its place."""

    def __call__(
        self,
        machine: Machine,
        batches: list[Batch],
        *,
        seed: int,
        processes: int,
        cache: Path | None,
        progress: Done | None,
    ) -> Diagnosis: ...


@dataclass(frozen=True)
class DiagnosisRequest:
    """What to diagnose. `recordings` empty: what the lake holds. `batch_ids` empty: all of them."""

    machine_file: Path
    out: Path
    recordings: tuple[Path, ...] = ()
    batch_ids: tuple[str, ...] = ()
    seed: int = 0
    report: bool = True
    overwrite: bool = False


@dataclass(frozen=True)
class DiagnosisOutcome:
    """A diagnosis, the files in the folder `out` by name, and the run that tracks it.

    `trouble`: why there is no new machine file though something was found; empty where all went well.
    """

    diagnosis: Diagnosis
    out: Path
    files: Mapping[str, Path]
    run_id: str
    ingested: IngestReport | None = None
    trouble: str = ""

    @property
    def words(self) -> str:
        """``diagnosed: explained (floor_sink at bed), var/diagnoses/…``."""
        f = self.diagnosis.findings
        found = ", ".join(f"{x.mechanism} at {x.where.name}" for x in f.findings)
        return f"diagnosed: {f.verdict.replace('_', ' ')}{f' ({found})' if found else ''}, {self.out}"


def dated_folder(name: str) -> Path:
    """Where a diagnosis goes that nobody gave a folder: `home()`/diagnoses/NAME-DATE-TIME."""
    return home() / "diagnoses" / f"{name}-{datetime.now():%Y%m%d-%H%M%S}"


def diagnose_file(
    request: DiagnosisRequest,
    settings: Settings,
    say: Say = lambda text: None,
    done: Done | None = None,
    caller: Caller | None = None,
    work: Diagnose | None = None,
) -> DiagnosisOutcome:
    """Diagnose a machine on recordings, write OUT and track it as a run.

    Everything that can be wrong with files and options is looked at before the work starts. OUT changes only once the
    work is done.

    Args:
        caller: how the steps are run; here and now by default.
        work: another diagnosis than the library's.

    Raises:
        InputError: a file, batch or option that cannot be used.
        WorkError: the diagnosis failed, OUT cannot be written, or the store does not answer.
    """
    machine, text = check_diagnosis(request)
    caller = caller or DirectCaller()
    gather = partial(gather_batches, machine, batch_ids=request.batch_ids, say=say)
    gathered: Gathered = caller.map("ingest", gather, [request.recordings], retries=RETRIES)[0]
    batches = list(gathered.batches)
    say(f"diagnose {machine.machine}: {len(batches)} batches")
    found = caller.map("diagnose", partial(_diagnosed, machine, batches, request.seed, say, done), [work])[0]
    say("write")
    files, trouble = write_diagnosis(found, request.out, text, request.report)
    say("track")
    track = partial(_track, found, batches, request, settings, say)
    run_id = caller.map("track", track, [files], retries=RETRIES)[0]
    return DiagnosisOutcome(found, request.out, files, run_id, gathered.ingested, trouble)


def check_diagnosis(request: DiagnosisRequest) -> tuple[Machine, str]:
    """The machine and the text of its file; makes the folder OUT.

    Raises:
        InputError: an option, file or folder that cannot be used.
    """
    if request.seed < 0:
        raise InputError(f"--seed: got {request.seed}, expected 0 or more")
    check_recordings(request.recordings)
    machine = load_machine(request.machine_file)
    if machine.twin is not None:
        compile_network(machine, f"machine file {request.machine_file}")
    files = [request.out / name for name in reversed(FILES)]
    own = request.out / MACHINE
    if own.exists() and own.samefile(request.machine_file):
        raise InputError(f"--out {request.out}: its {MACHINE} is the machine file to diagnose; give another --out")
    if not request.out.is_file():
        _check_same_machine(request.out / FINDINGS, machine.machine)
    check_folder(request.out, files, request.overwrite)
    return machine, request.machine_file.read_text(encoding="utf-8")


def write_diagnosis(d: Diagnosis, out: Path, text: str, report: bool = True) -> tuple[dict[str, Path], str]:
    """Fill OUT, all files or none; gives them by name, and why the machine file is missing where it should be there.

    Args:
        text: of the machine file that was diagnosed.

    Raises:
        WorkError: OUT cannot be written; what stood there is unchanged.
    """
    from reports.diagnosis.page import write_diagnosis_report

    machine_file, trouble = None, ""
    try:
        machine_file = new_machine_file(d, text, f"machine file {out / MACHINE}", datetime.now().astimezone())
    except (InputError, WorkError) as error:  # the findings are worth having all the same
        trouble = str(error)
    with staged(out, FILES) as scratch:
        (scratch / FINDINGS).write_text(as_json(_naming_plan(d)), encoding="utf-8")
        if machine_file is not None:
            (scratch / MACHINE).write_text(machine_file, encoding="utf-8")
        if d.plan_text is not None:
            (scratch / PLAN).write_text(d.plan_text, encoding="utf-8")
        if report:
            write_diagnosis_report(scratch / REPORT, d)
        names = [name for name in reversed(FILES) if (scratch / name).exists()]
    return {name: out / name for name in names}, trouble


def new_machine_file(d: Diagnosis, text: str, where: str, when: datetime) -> str | None:
    """The user's machine file with what was drafted, refined and found; None where nothing was.

    Raises:
        InputError, WorkError: it cannot be written into this text, or does not read back.
    """
    if not (d.drafted or d.added or d.findings.findings):
        return None
    f = d.findings
    if d.drafted:
        note = f"Drafted {when:%Y-%m-%d} by a diagnosis of {len(f.batches)} batches: the file had no twin part"
        text = drafted_text(text, d.part_before, where, note)
    if not (d.added or d.values):
        return text
    rms = {k: v for k, v in f.fit.left_out_rms.after.items() if v is not None}
    words = f"diagnosis: {f.verdict.replace('_', ' ')}"
    if rms:
        words += f"; left_out_rms: over all rows of {f.fit.batches} left-out batches"
    origin = Origin(f.batches, when.isoformat(timespec="seconds"), d.simulated, rms, words)
    return diagnosed_text(text, where, d.values, d.intervals, d.added, d.notes, origin)


def _naming_plan(d: Diagnosis) -> Findings:
    """The findings, whose next run names the plan that lies beside them."""
    run = d.findings.next_experiment
    if run is None:
        return d.findings
    named = run.model_copy(update={"file": PLAN if d.plan_text is not None else None})
    return d.findings.model_copy(update={"next_experiment": named})


def _diagnosed(
    machine: Machine, batches: list[Batch], seed: int, say: Say, done: Done | None, work: Diagnose | None
) -> Diagnosis:
    last = ""

    def told(step: str, n: int, of: int) -> None:
        nonlocal last
        if of and done is not None:
            done(step, n, of)
        elif not of and step != last:
            say(step)
            last = step

    work = work or library_diagnosis()
    cache = home() / "diagnosis_cache"
    return work(machine, batches, seed=seed, processes=os.cpu_count() or 1, cache=cache, progress=told)


def library_diagnosis() -> Diagnose:
    """The product's own diagnosis; imported late, because it takes a while."""
    from diagnosis.diagnose import diagnose

    return diagnose


def _track(
    d: Diagnosis,
    batches: list[Batch],
    request: DiagnosisRequest,
    settings: Settings,
    say: Say,
    files: Mapping[str, Path],
) -> str:
    from pipelines.diagnosis_tracking import log_diagnosis

    params = {"machine_file": request.machine_file.name, "seed": request.seed}
    try:
        return log_diagnosis(d, batches, files, settings, params=params, say=say)
    except WorkError as error:
        raise WorkError(f"{error}; the diagnosis is written to {request.out}, and not tracked") from None


def _check_same_machine(path: Path, machine: str) -> None:
    """Raises InputError where a findings file of another machine, or something else of that name, is there."""
    if not path.exists():
        return
    try:
        before = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        before = None
    if not isinstance(before, dict) or "machine" not in before:
        raise InputError(f"{path}: is there and is no findings file of a diagnosis; give another --out")
    if before["machine"] != machine:
        raise InputError(f"{path}: is a diagnosis of {before['machine']}, not of {machine}; give another --out")
