"""The diagnosis as a job: recordings and a machine file into findings, a report, a new machine file, the next run.

A training whose twin predicts new batches worse than before is followed by one (`diagnose_if_grown`)."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from data.account import Account
from data.batch import Batch
from data.errors import InputError, WorkError
from data.files import check_folder, from_json, staged
from data.ingest import IngestReport
from data.machine import Machine, load_machine
from diagnosis.export.machine_file import diagnosed_text, drafted_text
from diagnosis.findings.schema import Findings, as_json
from diagnosis.result import Diagnosis
from models.families import FAMILIES
from models.protocols import PromotionRule
from models.selection.promotion import judged, left_out
from models.selection.result import GridResult
from pipelines.caller import RETRIES, DirectCaller, Done, Say
from pipelines.jobs.inputs import INPUTS, Inputs
from pipelines.jobs.recordings import Gathered, check_recordings, gather_batches
from pipelines.settings import Settings, home
from pipelines.store import spool, tracking
from pipelines.store.runs import Record
from reports.diagnosis.first_screen import Continued
from twin.compile import compile_network
from twin.schema import Calibrated

REPORT, PLAN, MACHINE, FINDINGS = "report.html", "next_run.yml", "machine.yml", "findings.json"
FILES = (REPORT, PLAN, MACHINE, INPUTS, FINDINGS)  # the last one says that the others are complete


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

    `trouble`: why there is no new machine file though something was found, else empty. `continued`: the earlier
    diagnosis that this one continues.
    """

    diagnosis: Diagnosis
    out: Path
    files: Mapping[str, Path]
    run_id: str
    ingested: IngestReport | None = None
    trouble: str = ""
    continued: Continued | None = None

    @property
    def summary(self) -> str:
        """``diagnosed: explained (floor_sink at bed), var/diagnoses/…``."""
        f = self.diagnosis.findings
        found = ", ".join(f"{x.mechanism} at {x.where.name}" for x in f.findings)
        return f"diagnosed: {f.verdict.replace('_', ' ')}{f' ({found})' if found else ''}, {self.out}"


def dated_folder(name: str) -> Path:
    """The default folder of a diagnosis: `home()`/diagnoses/NAME-DATE-TIME."""
    return home() / "diagnoses" / f"{name}-{datetime.now():%Y%m%d-%H%M%S}"


def diagnose_file(
    request: DiagnosisRequest,
    settings: Settings,
    say: Say = lambda text: None,
    done: Done | None = None,
    caller: DirectCaller | None = None,
) -> DiagnosisOutcome:
    """Diagnose a machine on recordings, write OUT and track it as a run.

    Files and options are checked before the work starts. OUT changes only once the work is done.

    Args:
        caller: how the steps run; as plain calls by default.

    Raises:
        InputError: a file, batch or option that cannot be used.
        WorkError: the diagnosis failed, OUT cannot be written, or the store does not answer.
    """
    machine, text = check_diagnosis(request)
    caller = caller or DirectCaller()
    gather = partial(gather_batches, machine, batch_ids=request.batch_ids, say=say)
    gathered: Gathered = caller.map("ingest", gather, [request.recordings], retries=RETRIES)[0]
    return finished(request, machine, text, gathered, settings, say, done, caller)


def finished(
    request: DiagnosisRequest,
    machine: Machine,
    text: str,
    gathered: Gathered,
    settings: Settings,
    say: Say,
    done: Done | None,
    caller: DirectCaller,
    continued: Continued | None = None,
) -> DiagnosisOutcome:
    """The work on batches that are there: diagnose, write OUT, track.

    Args:
        text: of the machine file that is diagnosed.
        continued: the earlier diagnosis of OUT; its findings are kept there under another name.
    """
    batches = list(gathered.batches)
    say(f"diagnose {machine.machine}: {len(batches)} batches")
    found = caller.map("diagnose", partial(_diagnosed, machine, batches, request.seed, say), [done])[0]
    say("write")
    inputs = Inputs.of(machine.machine, request.machine_file, text, request.seed, batches)
    files, trouble = write_diagnosis(found, request.out, text, request.report, inputs, continued)
    say("track")
    options = {"machine_file": request.machine_file.name, "seed": request.seed}
    record = tracking.diagnosis_record(found, batches, options)
    try:
        run_id = caller.map("track", partial(_track, record, settings, say), [files], retries=RETRIES)[0]
    except WorkError as error:
        spool.keep(settings, record, lambda item: _copy(files, item / spool.ARTIFACTS))
        raise WorkError(f"{error}; {spool.reminder(settings)}; the diagnosis is written to {request.out}") from None
    return DiagnosisOutcome(found, request.out, files, run_id, gathered.ingested, trouble, continued)


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


def write_diagnosis(
    d: Diagnosis,
    out: Path,
    text: str,
    report: bool = True,
    inputs: Inputs | None = None,
    continued: Continued | None = None,
) -> tuple[dict[str, Path], str]:
    """Fill OUT, all files or none; returns them by name, and why the machine file is missing where one is due.

    Args:
        text: of the machine file that was diagnosed.
        inputs: what a later diagnosis needs to continue this one; without them it cannot.
        continued: the earlier diagnosis; its findings are kept as `findings.1.json`, `findings.2.json`, …

    Raises:
        WorkError: OUT cannot be written; what stood there is unchanged.
    """
    from reports.diagnosis.page import write_diagnosis_report

    machine_file, trouble = None, ""
    try:
        machine_file = new_machine_file(d, text, f"machine file {out / MACHINE}", datetime.now().astimezone())
    except (InputError, WorkError) as error:  # the findings are written all the same
        trouble = str(error)
    numbered = (f"findings.{k}.json" for k in count(1))
    kept = [] if continued is None else [next(name for name in numbered if not (out / name).exists())]
    with staged(out, [*kept, *FILES]) as scratch:
        for name in kept:
            (scratch / name).write_bytes((out / FINDINGS).read_bytes())
        (scratch / FINDINGS).write_text(as_json(_naming_plan(d)), encoding="utf-8")
        if machine_file is not None:
            (scratch / MACHINE).write_text(machine_file, encoding="utf-8")
        if d.plan_text is not None:
            (scratch / PLAN).write_text(d.plan_text, encoding="utf-8")
        if inputs is not None:
            (scratch / INPUTS).write_text(inputs.text, encoding="utf-8")
        if report:
            write_diagnosis_report(scratch / REPORT, d, continued=continued)
        names = [name for name in (*reversed(FILES), *kept) if (scratch / name).exists()]
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
    remarks = f"diagnosis: {f.verdict.replace('_', ' ')}"
    if rms:
        remarks += f"; left_out_rms: over all rows of {f.fit.batches} left-out batches"
    origin = Calibrated(
        batches=f.batches, when=when.isoformat(timespec="seconds"), simulated=d.simulated, left_out_rms=rms,
        words=remarks,
    )  # fmt: skip
    return diagnosed_text(text, where, d.values, d.intervals, d.added, d.notes, origin)


def _naming_plan(d: Diagnosis) -> Findings:
    """The findings, whose next run names the plan file next to them."""
    run = d.findings.next_experiment
    if run is None:
        return d.findings
    named = run.model_copy(update={"file": PLAN if d.plan_text is not None else None})
    return d.findings.model_copy(update={"next_experiment": named})


def _diagnosed(machine: Machine, batches: list[Batch], seed: int, say: Say, done: Done | None) -> Diagnosis:
    last = ""

    def progress(step: str, n: int, of: int) -> None:
        nonlocal last
        if of and done is not None:
            done(step, n, of)
        elif not of and step != last:
            say(step)
            last = step

    d = library_diagnosis()(machine, batches, seed=seed, processes=os.cpu_count() or 1, progress=progress)
    account = Account.of(batches)
    lost = "".join(account.warning(n) for n in machine.names("error"))
    stated = {"account": account.as_dict(), "statement": lost + d.findings.statement}
    return replace(d, findings=d.findings.model_copy(update=stated))


def library_diagnosis() -> Callable[..., Diagnosis]:
    """The library's diagnosis; imported here because its import takes seconds."""
    from diagnosis.diagnose import diagnose

    return diagnose


def _track(record: Record, settings: Settings, say: Say, files: Mapping[str, Path]) -> str:
    with TemporaryDirectory() as folder:
        _copy(files, Path(folder))
        return tracking.log_record(record, Path(folder), settings, say)


def _copy(files: Mapping[str, Path], folder: Path) -> None:
    for path in files.values():
        shutil.copy(path, folder)


def _check_same_machine(path: Path, machine: str) -> None:
    """Raises InputError where a findings file of another machine, or something else of that name, is there."""
    if not path.exists():
        return
    try:
        before = from_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        before = None
    if not isinstance(before, dict) or "machine" not in before:
        raise InputError(f"{path}: is there and is no findings file of a diagnosis; give another --out")
    if before["machine"] != machine:
        raise InputError(f"{path}: is a diagnosis of {before['machine']}, not of {machine}; give another --out")


@dataclass(frozen=True)
class Growth:
    """A twin family's left-out S of a channel: its mean in the last training, and now, on `n_new` new batches.

    Where no batch is new (`n_new` 0) it is the mean over all of them.
    """

    target: str
    family: str
    before_um: float
    after_um: float
    n_new: int

    @property
    def share(self) -> float:
        """0.25 for a quarter more."""
        return self.after_um / self.before_um - 1 if self.before_um > 0 else math.nan

    @property
    def summary(self) -> str:
        where = f"{self.n_new} new batch{'' if self.n_new == 1 else 'es'}" if self.n_new else "the same batches"
        return (
            f"{self.target}: left-out S of the family {self.family} is {self.after_um:.2f} µm on {where}, was "
            f"{self.before_um:.2f} µm ({100 * self.share:+.0f} %)"
        )


def greatest_growth(now: Mapping[str, GridResult], settings: Settings, ids: Mapping[str, str]) -> Growth | None:
    """The twin family and channel whose left-out error grew most since the last training; None without one before.

    A family that learns from the residual or the sensors hides what the physics lacks, so each counts for itself.

    Args:
        now: results by channel, just trained.
        ids: their trainings, which are tracked already and are not the last ones.

    Raises:
        WorkError: the store does not answer.
    """
    found: list[Growth] = []
    for result in now.values():
        families = [f for f in result.cells["family"].unique() if f in FAMILIES and FAMILIES[f].needs_twin]
        last = _last_result(result, settings, ids) if families else None
        if last is not None:
            found += [g for f in families if (g := growth(last, result, f, settings.promotion)) is not None]
    return max((g for g in found if math.isfinite(g.share)), key=lambda g: g.share, default=None)


def growth(before: GridResult, after: GridResult, family: str, rule: PromotionRule) -> Growth | None:
    """Of a family's best cells in two trainings; None where one of them has none with a finite score.

    New batches count by id and content, since the mean over all dilutes what a season has brought.
    """
    old, new = (_left_out_of(result, family, rule) for result in (before, after))
    if old is None or new is None:
        return None
    known = set(before.batches["digest"].astype(str))
    fresh = [s for digest, s in new if digest not in known]
    scores = fresh or [s for _, s in new]
    return Growth(after.target, family, float(np.mean([s for _, s in old])), float(np.mean(scores)), len(fresh))


def diagnose_if_grown(
    machine_file: Path,
    now: Mapping[str, GridResult],
    ids: Mapping[str, str],
    settings: Settings,
    say: Say = lambda text: None,
) -> tuple[DiagnosisOutcome | None, str]:
    """Diagnose on all batches of the lake where the error has grown by more than the settings allow.

    Returns the outcome and a summary, empty where nothing was to be done. A diagnosis that fails does not affect the
    training that it follows; the summary states why. It is written to `dated_folder`.
    """
    limit = settings.diagnose.when_error_grows_by
    if limit is None:
        return None, ""
    try:
        grown = greatest_growth(now, settings, ids)
        if grown is None or grown.share <= limit:
            return None, ""
        say(f"diagnose: {grown.summary}")
        machine = next(iter(now.values())).machine
        request = DiagnosisRequest(machine_file, dated_folder(machine))
        outcome = diagnose_file(request, settings, say)
    except (InputError, WorkError) as error:
        return None, f"not diagnosed: {error}"
    except Exception as error:
        return None, f"not diagnosed: {type(error).__name__}: {error}"
    return outcome, f"{grown.summary}; {outcome.summary}"


def _last_result(result: GridResult, settings: Settings, ids: Mapping[str, str]) -> GridResult | None:
    past = tracking.trainings(result.machine, result.target, settings)
    past = past[~past["training_id"].isin(list(ids.values()))]
    if past.empty:
        return None
    try:
        return tracking.load_training(str(past.iloc[0]["training_id"]), settings).result
    except InputError:  # its tables are gone
        return None


def _left_out_of(result: GridResult, family: str, rule: PromotionRule) -> list[tuple[str, float]] | None:
    """Digest and left-out S of every batch, by the family's best cell under the first protocol that scored it."""
    cells, scores = (t[t["family"] == family] for t in (result.cells, result.scores))
    run = rule.offered(set(cells["protocol"]))
    if not run:
        return None
    rule = rule.only(run[0])
    try:
        best = judged(replace(result, cells=cells, scores=scores), rule).nsmallest(1, "score_um").iloc[0]
    except InputError:  # the family has no finite score
        return None
    table = left_out(result, rule, str(best["selector"]), family, int(best["n_tsp"]))
    rows = [(str(d), float(s)) for d, s in zip(table["digest"], table["S_um"], strict=True) if np.isfinite(s)]
    return rows or None
