"""The yearly job as one list of steps: ingest → features → grid → track → promote → report, and a diagnosis if need be.

The steps are plain functions, which `pipelines.caller.DirectCaller` runs: here and now, or as tasks of a flow."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from data.account import Account
from data.batch import Batch
from data.checks import check_machine
from data.errors import InputError, WorkError, place_of
from data.held import check_channels
from data.ingest import IngestReport, ingest
from data.machine import Machine, load_machine
from models.selection import promotion
from models.selection.crossing import Crossing, FamilyResult, Plan, prepare, refit, unfitted, with_target
from models.selection.grid import Pools, Workers, assemble, local_pools, workers_for
from models.selection.outlook import Outlook, outlook
from models.selection.race import Job, Raced, drive
from models.selection.result import GridResult, Training
from models.selection.trust import Region, left_out_runs
from models.selection.updating import updated_scores
from pipelines import stopping
from pipelines.caller import RETRIES, DirectCaller, Say
from pipelines.jobs.recordings import home_lake, load_batches
from pipelines.jobs.request import TrainRequest, check_request
from pipelines.settings import Settings, home
from pipelines.store import registry, spool, tracking
from pipelines.store.checkpoint import Checkpoint
from pipelines.store.database import StoreOutage
from pipelines.store.runs import Record, code_version, now_ms
from reports.comparison import figure_pngs, write_report

if TYPE_CHECKING:
    from pipelines.jobs.diagnosing import DiagnosisOutcome


@dataclass(repr=False)
class TrainOutcome:
    """The results by channel, and where they are tracked, registered and reported."""

    machine: str
    simulated: bool
    ingested: IngestReport | None = None
    account: Account | None = None
    results: dict[str, GridResult] = field(default_factory=dict)
    training_ids: dict[str, str] = field(default_factory=dict)
    choices: dict[str, promotion.Choice] = field(default_factory=dict)
    outlooks: dict[str, Outlook] = field(default_factory=dict)  # the error of the choices to expect in the next season
    promotions: dict[str, registry.Promotion] = field(default_factory=dict)
    report: Path | None = None
    diagnosis: DiagnosisOutcome | None = None
    diagnosis_summary: str = ""  # why a diagnosis followed, and its verdict; else empty
    seconds: dict[str, float] = field(default_factory=dict)
    stopped: str = ""  # why nothing was trained
    postponed: str = ""  # why results wait in the spool for the tracking store; else empty
    records: dict[str, Record] = field(default_factory=dict)  # the trainings as they are tracked
    units: dict[str, str] = field(default_factory=dict)  # of the errors

    def __repr__(self) -> str:
        found = ", ".join(f"{t}: {c.family} on {c.n_tsp} by {c.selector}" for t, c in self.choices.items())
        return f"TrainOutcome({self.machine}, {found or self.stopped or 'nothing chosen'}, report {self.report})"


def train(
    request: TrainRequest,
    settings: Settings,
    caller: DirectCaller,
    say: Say = lambda text: None,
    pools: Pools = local_pools,
) -> TrainOutcome:
    """Run the yearly job.

    The tracking store is reached first, and gets what waits for it. If it goes away later, the results wait for it (see
    `pipelines.store.spool`). After any other failure, and when the process is killed, the crossing is kept until
    tracking, promotion and report are done: the same command goes on, and nothing is tracked twice.

    Args:
        caller: how the steps run.
        pools: where the grid, the part that takes the time, is computed.

    Raises:
        InputError: a request that cannot be served (see `check_request`), or too few batches to train on.
        WorkError: the tracking store does not answer at the start, or the disk does not take what is written.
    """
    machine, targets = check_request(request, settings)
    started_ms = now_ms()
    tracking.open_store(settings, say)
    spool.deliver(settings, partial(promote_waiting, settings), say)
    plan = request.plan.suited(machine)
    outcome = TrainOutcome(machine.machine, machine.simulated)
    outcome.units |= {t: machine.channels[t].unit for t in targets}
    clock = _Clock(outcome.seconds)
    lake = home_lake()
    if request.recordings:
        say(f"ingest {', '.join(p.name for p in request.recordings)}")
        work = partial(ingest, machine=machine, lake=lake)
        outcome.ingested = caller.map("ingest", work, [request.recordings], retries=RETRIES)[0]
        clock("ingest")
    with _naming_quarantine(outcome.ingested):
        batches = load_batches(lake, machine)
        _check_several(batches, machine)
    outcome.account = Account.of(batches)
    if request.only_if_new and _seen_before(request, machine.machine, targets, batches, settings):
        outcome.stopped = "the last training saw the same batches; nothing new to learn"
        return outcome
    say(f"features and selectors of {len(batches)} batches")
    with _naming_quarantine(outcome.ingested):
        prepared = caller.map("prepare", partial(prepare, batches, plan=plan, machine=machine), targets)
    crossings = dict(zip(targets, prepared, strict=True))
    clock("features")
    say("grid")
    checkpoint = Checkpoint(home() / "unfinished", crossings)
    checkpoint.resume(say)
    stopping.note(checkpoint.summary)
    with _kept(checkpoint):
        with Workers(crossings, request.workers or workers_for(plan.families), pools) as workers:

            def cross(jobs: list[Job]) -> list[FamilyResult]:
                return caller.map("grid", checkpoint.crossed(workers.cross, say), jobs)

            raced = drive(crossings, cross)
            for t in targets:
                outcome.results[t] = assemble(crossings[t], *raced[t])
            clock("grid")
            if all(settings.promotion.offered(set(r.cells["protocol"])) for r in outcome.results.values()):
                say("trust")
                _judge(outcome, crossings, raced, settings)
                clock("trust")
        say("track")
        token = checkpoint.token()
        for t in targets:
            outcome.records[t] = _record(outcome, plan, settings, t, f"{token}-{t}", started_ms)
        track = partial(_while_there, outcome, partial(_track, outcome, settings))
        caller.map("track", track, targets, retries=RETRIES)
        clock("track")
        if request.promote:
            say("promote")
            promote = partial(_promote, outcome, crossings, request.machine_file, settings)
            caller.map("promote", partial(_while_there, outcome, promote), targets, retries=RETRIES)
            clock("promote")
        say("report")
        stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
        path = request.report or home() / "reports" / f"{machine.machine}-{stamp}.html"
        outcome.report = caller.map("report", partial(_report, outcome, settings), [path])[0]
        clock("report")
        if outcome.postponed:
            for t in targets:
                spool.keep(settings, outcome.records[t], partial(_fill, outcome, request, t))
            outcome.postponed += f"; {spool.reminder(settings)}"
    checkpoint.remove()
    stopping.note(None)
    if machine.twin is not None:
        from pipelines.jobs import diagnosing  # its imports take seconds, and most trainings need none

        diagnose = partial(
            diagnosing.diagnose_if_grown, request.machine_file, ids=outcome.training_ids, settings=settings, say=say
        )
        outcome.diagnosis, outcome.diagnosis_summary = caller.map("diagnose", diagnose, [outcome.results])[0]
        clock("diagnose")
    _remember(outcome, settings)
    return outcome


def promote_tracked(
    training_id: str, machine_file: Path, cell: str, force: bool, settings: Settings
) -> registry.Promotion:
    """Promote a cell of a tracked training, refitted on the versions of the batches that it was judged on.

    Raises:
        InputError: unknown training or cell, another machine's file, or a batch version that the lake does not hold.
    """
    result = tracking.load_training(training_id, settings).result
    machine = load_machine(machine_file)
    if machine.machine != result.machine:
        raise InputError(f"training {training_id} is of {result.machine}, the machine file of {machine.machine}")
    lake = home_lake()
    batches = []
    for batch_id, digest in result.batches[["batch_id", "digest"]].astype(str).to_numpy():
        held = {v.digest: v.version for v in lake.versions(machine.machine, batch_id)}
        if digest not in held:
            raise InputError(f"the lake does not hold batch {batch_id} as training {training_id} saw it; train again")
        batches.append(lake.load(machine.machine, batch_id, held[digest]))
    check_channels(batches, machine, lake)
    batches = check_machine(batches, machine)
    choice = promotion.decide(result, settings.promotion, cell)
    family = unfitted(choice.family, result.stack).fit(batches, choice.inputs, result.target, machine)
    text = machine_file.read_text(encoding="utf-8")
    region = Region.of(batches, family.inputs)
    new = registry.Newcomer(result, choice, family, text, training_id, region, batches)
    return registry.promote(new, settings, force=force)


def promote_waiting(settings: Settings, training_id: str, machine_file: Path) -> registry.Promotion:
    """The promotion of a training that waited in the spool: the cell that the rule picks."""
    return promote_tracked(training_id, machine_file, "", False, settings)


def _check_several(batches: Sequence[Batch], machine: Machine) -> None:
    """Raises InputError where one recording is all there is, before anything is computed."""
    if len(batches) == 1 and machine.recording.split is None:
        raise InputError(
            f"{machine.machine}: got 1 batch(es), {batches[0].batch_id}, need at least 2; ingest more recordings, or"
            " cut a long one into runs by recording.split (driver, pause or every; `thermodrift describe` proposes one)"
        )


@contextmanager
def _naming_quarantine(ingested: IngestReport | None) -> Iterator[None]:
    """Add the files in quarantine to the error that too few batches are left to train on."""
    try:
        yield
    except InputError as error:
        refused = ingested.quarantined if ingested else []
        if not refused:
            raise
        raise InputError(f"{error}; files in quarantine: {len(refused)}, first {refused[0].reason}") from None


class _Clock:
    """Seconds per step."""

    def __init__(self, into: dict[str, float]) -> None:
        self.into, self.last = into, time.perf_counter()

    def __call__(self, step: str) -> None:
        now = time.perf_counter()
        self.into[step], self.last = round(now - self.last, 2), now


def _seen_before(
    request: TrainRequest, machine: str, targets: Sequence[str], batches: Sequence[Batch], settings: Settings
) -> bool:
    """Whether the last training of every channel saw these batches and, where one is due, has its promotion."""
    for target in targets:
        past = tracking.trainings(machine, target, settings, newest=1)
        if past.empty or (request.promote and not past.iloc[0]["promotion"]):
            return False
        last = tracking.load_training(str(past.iloc[0]["training_id"]), settings)
        if set(last.result.batches["digest"]) != {b.digest for b in with_target(batches, target)}:
            return False
    return True


def _judge(
    outcome: TrainOutcome,
    crossings: dict[str, Crossing],
    raced: dict[str, Raced],
    settings: Settings,
) -> None:
    """The chosen cells, the error to expect of them, and how far they may be trusted."""
    for t, result in list(outcome.results.items()):
        choice = outcome.choices[t] = promotion.decide(result, settings.promotion)
        cell = (choice.selector, choice.family, choice.n_tsp)
        left_out = left_out_runs(crossings[t], cell, raced[t].result.predictions, result.stack)
        outcome.results[t] = replace(result, distances=left_out.runs, curves=left_out.curves)
        if outcome.choices[t].standing == "provisional":  # its authority comes from the curves
            outcome.choices[t] = promotion.decide(outcome.results[t], settings.promotion)
        outcome.outlooks[t] = outlook(outcome.results[t], outcome.choices[t])
        readings = updated_scores(crossings[t], *cell, left_out.curves)
        outcome.results[t] = replace(outcome.results[t], readings=readings)
    none_um = {t: result.none_um(outcome.outlooks[t].protocol) for t, result in outcome.results.items()}
    order = sorted(none_um, key=lambda t: -np.nan_to_num(none_um[t]))
    tables: tuple[dict[str, Any], ...] = (outcome.results, outcome.choices, outcome.outlooks)
    for kept in tables:  # the largest error first
        kept.update([(t, kept.pop(t)) for t in order])


@contextmanager
def _kept(checkpoint: Checkpoint) -> Iterator[None]:
    """Name what is kept of the crossing in the error of a disk or a store that does not take what is written."""
    try:
        yield
    except OSError as error:
        where = place_of(error, checkpoint.folder)
        raise WorkError(f"{where}: {error.strerror or error}; {checkpoint.summary()}") from error
    except WorkError as error:
        raise WorkError(f"{error}; {checkpoint.summary()}") from error


def _record(
    outcome: TrainOutcome, plan: Plan, settings: Settings, target: str, record_id: str, started_ms: int
) -> Record:
    plain = {k: v if isinstance(v, tuple) else (v,) for k, v in asdict(plan).items() if not k.startswith("late")}
    params = {k: ", ".join(map(str, v or ("all",))) for k, v in plain.items()} | {"unit": outcome.units[target]}
    return tracking.training_record(
        outcome.results[target], settings.promotion, params, choice=outcome.choices.get(target), record_id=record_id,
        started_ms=started_ms,
    )  # fmt: skip


def _while_there(outcome: TrainOutcome, work: Callable[[str], None], target: str) -> None:
    """`work` on a channel until the store goes away: what is left waits, see `pipelines.store.spool`."""
    if not outcome.postponed:
        try:
            work(target)
        except StoreOutage as error:
            outcome.postponed = str(error)


def _track(outcome: TrainOutcome, settings: Settings, target: str) -> None:
    with TemporaryDirectory() as folder:
        _write_artifacts(outcome, target, Path(folder))
        outcome.training_ids[target] = tracking.log_record(outcome.records[target], Path(folder), settings)


def _write_artifacts(outcome: TrainOutcome, target: str, folder: Path) -> None:
    result = outcome.results[target]
    tracking.training_files(folder, result, figure_pngs(result))


def _promote(
    outcome: TrainOutcome, crossings: dict[str, Crossing], machine_file: Path, settings: Settings, target: str
) -> None:
    choice, crossing, result = outcome.choices[target], crossings[target], outcome.results[target]
    text = machine_file.read_text(encoding="utf-8")
    family = refit(crossing, choice.selector, choice.family, choice.n_tsp, result.stack)
    region = Region.of(crossing.batches, family.inputs)
    new = registry.Newcomer(result, choice, family, text, outcome.training_ids[target], region, crossing.batches)
    outcome.promotions[target] = registry.promote(new, settings)


def _remember(outcome: TrainOutcome, settings: Settings) -> None:
    """Where the versions of the training and the champions are, for the commands after it."""
    versions = {(p.name, v) for p in outcome.promotions.values() for v in (p.version, p.champion_version) if v}
    if versions and not outcome.postponed:
        with suppress(WorkError):  # the next command looks them up
            registry.remember(sorted(versions), settings)


def _report(outcome: TrainOutcome, settings: Settings, path: Path) -> Path:
    """Write the report, which every training keeps as an artifact."""
    written = write_report([_training(outcome, t) for t in outcome.results], path, settings.promotion)
    for target in outcome.records:
        _while_there(outcome, lambda t: tracking.attach(outcome.training_ids[t], written, settings), target)
    return written


def _fill(outcome: TrainOutcome, request: TrainRequest, target: str, item: Path) -> None:
    """What the store needs of a training that waits."""
    _write_artifacts(outcome, target, item / spool.ARTIFACTS)
    if outcome.report is not None:
        (item / spool.REPORT).mkdir()
        shutil.copy(outcome.report, item / spool.REPORT)
    if request.promote and target not in outcome.promotions:
        shutil.copyfile(request.machine_file, item / spool.MACHINE)


def _training(outcome: TrainOutcome, target: str) -> Training:
    """A training as `tracking.load_training` reads it, whether or not the store has it yet."""
    record, promoted = outcome.records[target], outcome.promotions.get(target)
    return Training(
        outcome.training_ids.get(target, record.id), pd.Timestamp(record.started_ms, unit="ms", tz="UTC"),
        record.simulated, outcome.results[target], dict(record.params),
        json.loads(json.dumps(promoted.as_dict())) if promoted is not None else {}, code_version(),
    )  # fmt: skip
