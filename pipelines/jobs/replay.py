"""Replay of a year: recordings arrive one by one in a fresh home and are ingested, learned and promoted as a schedule
does it; every run is predicted by the champion that is in force when it arrives.

    OUT/arrivals.json   the plan of arrivals and what was asked for
    OUT/inbox/          the folder that recordings arrive in
    OUT/home/           lake, tracking store and artifacts of this replay alone
    OUT/progress.json   what is done; the same command goes on from there

The trainings are those of `pipelines.jobs.training.train` with `only_if_new`, which a schedule calls as well.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter

from data.account import Account
from data.batch import Batch
from data.checks import check_machine, checked
from data.errors import InputError
from data.files import from_json, write_atomic
from data.ingest import id_prefix
from data.lakefile import content_digest, encode, safe_name
from data.machine import Machine
from data.recording import read_batches, recording_files
from features.rises import zeroed_error_um
from models.metrics import residual_std_um
from models.selection.crossing import Plan
from models.selection.replay import Arrival, Replay, Retraining, Run, arrivals
from pipelines.caller import Caller, Done, Say
from pipelines.jobs.recordings import check_recordings
from pipelines.jobs.request import TrainRequest, check_request
from pipelines.jobs.training import TrainOutcome, train
from pipelines.settings import DiagnoseRule, Settings
from pipelines.store import model_store, registry, tracking
from pipelines.store.audit import CHAMPION

ARRIVALS, PROGRESS = "arrivals.json", "progress.json"
_SCALE = 10.0  # of errors that are "scaled": micrometres that were exported as tenths
_AGE_S = 60.0  # of a delivered file: the ingest looks twice at younger ones


@dataclass(frozen=True)
class ReplayRequest:
    """What to replay.

    Args:
        out: folder of the replay, which holds nothing else.
        targets: error channels; empty: all.
        start: runs of the first training. every: new runs from one training to the next.
        seed: of an arrival plan with disturbances; None: as recorded.
    """

    machine_file: Path
    recordings: tuple[Path, ...]
    out: Path
    targets: tuple[str, ...] = ()
    plan: Plan = field(default_factory=Plan)
    start: int = 8
    every: int = 4
    seed: int | None = None
    workers: int = 0  # processes of the grid; 0: as many as make it faster

    @property
    def home(self) -> Path:
        return (self.out / "home").resolve()

    @property
    def inbox(self) -> Path:
        return (self.out / "inbox").resolve()


@dataclass(frozen=True)
class Recording:
    """One run to be delivered: its batch, its file, the folder that this file was found in, and whether the file
    itself is delivered; else the run is written as the lake would, because its file holds several."""

    batch: Batch
    file: Path
    folder: Path
    own_file: bool

    @property
    def date(self) -> str:
        return "" if self.batch.start is None else self.batch.start.isoformat(timespec="minutes")


def check_replay(request: ReplayRequest, settings: Settings) -> tuple[Machine, tuple[str, ...]]:
    """The machine and the error channels.

    Raises:
        InputError: see `pipelines.jobs.request.check_request`; or numbers that make no replay.
    """
    check_recordings(request.recordings)
    for name, value, least in (("--start", request.start, 2), ("--every", request.every, 1)):
        if value < least:
            raise InputError(f"{name}: got {value}, expected {least} or more")
    train_request = TrainRequest(request.machine_file, request.recordings, request.targets, request.plan)
    return check_request(train_request, settings)


def settings_below(home: Path, settings: Settings) -> Settings:
    """The same names and rules on a store below `home`, and no diagnosis after a training."""
    store = f"sqlite:///{(home / 'mlflow.db').as_posix()}"
    artifacts = (home / "artifacts").as_uri()
    never = DiagnoseRule(when_error_grows_by=None)
    return replace(
        settings, home=home, store_uri=store, artifacts_uri=artifacts, diagnose=never, lake=str(home / "lake")
    )


@contextmanager
def at_home(folder: Path) -> Iterator[None]:
    """`pipelines.settings.home` is this folder in the context, and the lake is below it whatever `mlflow.yml` says."""
    wanted = {"THERMODRIFT_HOME": str(folder), "THERMODRIFT_LAKE": str(folder / "lake")}
    before = {name: os.environ.get(name) for name in wanted}
    os.environ.update(wanted)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def replay(
    request: ReplayRequest,
    settings: Settings,
    caller: Caller,
    say: Say = lambda text: None,
    done: Done = lambda step, n, of: None,
) -> Replay:
    """Deliver, learn, promote and predict, run after run; goes on where the same replay was stopped.

    Args:
        settings: names and rules; the store is always the one below OUT.

    Raises:
        InputError: see `check_replay`; too few runs; or OUT holds something else.
        WorkError: lake or store below OUT cannot be written.
    """
    machine, targets = check_replay(request, settings)
    recordings, left_out = read_year(machine, request.recordings)
    if len(recordings) <= request.start:
        raise InputError(
            f"replay of {machine.machine}: got {len(recordings)} runs, of which --start {request.start} are learned "
            f"first; expected more runs, or a smaller --start{f'; left out: {left_out[0]}' if left_out else ''}"
        )
    plan = arrivals(list(recordings), request.seed)
    progress = Progress.begin(request, plan)
    for a in plan:
        if a.how != "as recorded":
            say(f"arrival {a.number}: {a.summary}")
    own = settings_below(request.home, settings)
    with at_home(request.home):
        year = _Year(request, machine, targets, recordings, plan, own, caller, progress, say)
        for arrival in plan:
            if arrival.number > progress.arrived:
                year.take(arrival)
            done(f"run {arrival.batch_id}", arrival.number, len(plan))
    return Replay(
        machine.machine, machine.simulated, request.seed, request.start, request.every, request.plan.effort, plan,
        tuple(progress.retrainings), tuple(progress.runs), tuple(left_out),
        Account.of(check_machine([r.batch for r in recordings.values()], machine)).as_dict(),
    )  # fmt: skip


def read_year(machine: Machine, recordings: Sequence[Path]) -> tuple[dict[str, Recording], list[str]]:
    """Runs by id in the order of their recording (unknown dates last), and why files were left out."""
    found: dict[str, Recording] = {}
    left_out: list[str] = []
    for path in recordings:
        files = recording_files(path, machine)[0] if path.is_dir() else [path]
        for file in files:
            batches: list[Batch] = []
            try:
                batches.extend(read_batches(file, machine))
            except InputError as error:
                left_out.append(str(error))
            whole = len(batches) == 1 and not machine.recording.joined and machine.recording.split is None
            folder = path if path.is_dir() else path.parent
            for b in batches:
                named = replace(b, batch_id=id_prefix(file, path) + b.batch_id)
                found.setdefault(named.batch_id, Recording(named, file, folder, whole))
    ordered = sorted(found.values(), key=lambda r: (r.batch.start is None, r.date, r.batch.batch_id))
    return {r.batch.batch_id: r for r in ordered}, left_out


@dataclass
class Progress:
    """What is done, kept in OUT/progress.json."""

    file: Path
    arrived: int = 0
    fresh: int = 0  # new runs since the last training
    learned: bool = False
    retrainings: list[Retraining] = field(default_factory=list)
    runs: list[Run] = field(default_factory=list)

    @classmethod
    def begin(cls, request: ReplayRequest, plan: Sequence[Arrival]) -> Progress:
        """Make OUT, or go on with the same replay in it.

        Raises:
            InputError: OUT holds something else.
        """
        asked = {
            "machine_file_sha256": sha256(request.machine_file.read_bytes()).hexdigest(),
            "recordings": [str(p.resolve()) for p in request.recordings], "targets": list(request.targets),
            "plan": asdict(request.plan), "start": request.start, "every": request.every, "seed": request.seed,
            "arrivals": [asdict(a) for a in plan],
        }  # fmt: skip
        text = json.dumps(asked, indent=1, ensure_ascii=False)
        noted, file = request.out / ARRIVALS, request.out / PROGRESS
        if noted.is_file():
            known, wanted = _noted(noted), from_json(text)
            if other := [k for k in wanted if known.get(k) != wanted[k]]:
                raise InputError(
                    f"--out {request.out}: holds a replay with other {', '.join(other).replace('_', ' ')}; give the "
                    "same to go on with it, or another folder"
                )
            if not file.is_file():
                return cls(file)
            return TypeAdapter(Progress).validate_python({**_noted(file), "file": file})
        if request.out.exists() and (not request.out.is_dir() or any(request.out.iterdir())):
            raise InputError(f"--out {request.out}: holds something else than a replay; give another folder")
        for folder in (request.home, request.inbox):
            folder.mkdir(parents=True, exist_ok=True)
        write_atomic(noted, text)
        return cls(file)

    def write(self) -> None:
        plain = asdict(self)
        del plain["file"]
        write_atomic(self.file, json.dumps(plain, indent=1, ensure_ascii=False))


def _noted(file: Path) -> dict[str, object]:
    """What a replay wrote. Raises: InputError, it cannot be read."""
    try:
        return dict(from_json(file.read_bytes()))
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"{file}: cannot be read ({error}); begin the replay in another --out") from None


class _Year:
    """A replay under way."""

    def __init__(
        self, request: ReplayRequest, machine: Machine, targets: tuple[str, ...], recordings: dict[str, Recording],
        plan: Sequence[Arrival], settings: Settings, caller: Caller, progress: Progress, say: Say,
    ) -> None:  # fmt: skip
        self.request, self.machine, self.targets, self.recordings = request, machine, targets, recordings
        self.plan, self.settings, self.caller, self.progress, self.say = plan, settings, caller, progress, say
        self._models: dict[tuple[str, int], model_store.StoredModel] = {}

    def take(self, arrival: Arrival) -> None:
        """Deliver, predict, and train where it is time to."""
        p = self.progress
        deliver(arrival, self.recordings[arrival.batch_id], self.machine, self.request.inbox)
        if arrival.first and p.retrainings:
            p.runs += [self._run(arrival, t) for t in self.targets]
        p.fresh += arrival.new
        wanted = self.request.every if p.learned else self.request.start
        last = arrival.number == len(self.plan)
        if p.fresh >= wanted or (last and self._anything_since()):
            p.retrainings += self._retrain(arrival)
            p.fresh, p.learned = 0, True
        p.arrived = arrival.number
        p.write()

    def _anything_since(self) -> bool:
        since = max((r.arrival for r in self.progress.retrainings), default=0)
        return any(a.number > since and a.how != "again" for a in self.plan)

    def _retrain(self, arrival: Arrival) -> list[Retraining]:
        p, number = self.progress, len({r.number for r in self.progress.retrainings}) + 1
        arrived = [self.recordings[a.batch_id].date for a in self.plan if a.number <= arrival.number]
        self.say(f"training {number} after arrival {arrival.number}")
        before = {r.target: r.after for r in p.retrainings}
        begun_s = time.perf_counter()
        train_request = TrainRequest(
            self.request.machine_file,
            (self.request.inbox,),
            self.targets,
            self.request.plan,
            only_if_new=True,
            workers=self.request.workers,
        )
        outcome = train(train_request, self.settings, self.caller, self.say)
        seconds = round(time.perf_counter() - begun_s, 1)
        return [
            self._retraining(t, number, max(arrived), arrival.number, before.get(t), outcome, seconds)
            for t in self.targets
        ]

    def _retraining(
        self, target: str, number: int, date: str, arrival: int, before: int | None, outcome: TrainOutcome,
        seconds: float,
    ) -> Retraining:  # fmt: skip
        """As the registry has it: an interrupted replay may come here after the promotion was made."""
        past = tracking.trainings(self.machine.machine, target, self.settings, newest=1)
        training = tracking.load_training(str(past.iloc[0]["training_id"]), self.settings)
        n, why, version, kind = len(training.result.batches), outcome.stopped, None, "not trained"
        repeated = any(r.training_id == training.training_id for r in self.progress.retrainings)
        if (made := training.promotion) and not (outcome.stopped and repeated):
            version, kind = int(made["version"]), str(made["outcome"])
            why = str(made["words"])
        if target in outcome.promotions:
            kind = outcome.promotions[target].outcome
        after = self._champion(target)
        info = self._model(target, after).info if after is not None else {}
        expected, bound = (float(info.get(f"expected_S_{k}um", math.nan)) for k in ("", "bound90_"))
        return Retraining(
            target, number, date, arrival, n, before, after, version, kind, why, expected, bound,
            training.training_id, seconds,
        )  # fmt: skip

    def _champion(self, target: str) -> int | None:
        client = tracking.open_store(self.settings)
        name = self.settings.model(self.machine.machine, target)
        version = registry.find_model(client, name).aliases.get(CHAMPION)
        return None if version is None else int(version)

    def _model(self, target: str, version: int) -> model_store.StoredModel:
        if (target, version) not in self._models:
            client = tracking.open_store(self.settings)
            name = self.settings.model(self.machine.machine, target)
            found = registry.find_version(client, name, str(version))
            folder = registry.version_folder(found, self.settings)
            self._models[target, version] = model_store.load(folder)
        return self._models[target, version]

    @cached_property
    def _truth(self) -> dict[str, Batch]:
        """The recorded errors with the findings of the whole year: a faulty stretch of them judges no model."""
        known = check_machine([checked(r.batch, self.machine) for r in self.recordings.values()], self.machine)
        return {b.batch_id: b for b in known}

    def _run(self, arrival: Arrival, target: str) -> Run:
        """Predicted from the run as it was recorded, with the findings of this run alone, as `predict` would."""
        mine = [r for r in self.progress.retrainings if r.target == target]
        recording = self.recordings[arrival.batch_id]
        true_um = zeroed_error_um(self._truth[arrival.batch_id], target)
        champion, first = mine[-1].after, next((r.after for r in mine if r.after is not None), None)
        S_um, frozen_um, expected_um, bound_um, flagged, note = (math.nan,) * 4 + ("", "")
        if champion is None or first is None:
            note = "no champion"
        else:
            batch = checked(recording.batch, self.machine)
            try:
                model = self._model(target, champion)
                predicted_um = model.predict(batch)
                S_um = float(residual_std_um(true_um - predicted_um))
                expected_um, bound_um, flagged = model.run_error(batch, predicted_um)
                frozen_um = float(residual_std_um(true_um - self._model(target, first).predict(batch)))
            except InputError as error:
                note = str(error)
        none_um = float(residual_std_um(true_um))
        return Run(
            target, arrival.batch_id, recording.date, arrival.number, arrival.how, mine[-1].number, champion, S_um,
            frozen_um, none_um, expected_um, bound_um, flagged, note or ("" if math.isfinite(none_um) else "no error"),
        )  # fmt: skip


def deliver(arrival: Arrival, recording: Recording, machine: Machine, inbox: Path) -> None:
    """Put one arrival into the inbox; a correction takes the place of the faulty file."""
    as_lake = inbox / f"machine={machine.machine}" / f"{safe_name(recording.batch.batch_id)}.parquet"
    relative = recording.file.relative_to(recording.folder)
    plain = inbox / relative
    if arrival.how == "again":
        plain = inbox / "again" / relative
        as_lake = inbox / f"machine={machine.machine}" / "again" / as_lake.name
    target = plain if recording.own_file else as_lake
    for stale in (plain, as_lake):
        stale.unlink(missing_ok=True)
    if arrival.fault and arrival.fault != "empty":
        _put(as_lake, _encoded(faulty(recording.batch, arrival.fault)))
    elif arrival.fault:
        _put(target, b"")
    elif recording.own_file:
        _put(target, recording.file.read_bytes())
        _deliver_schedule(recording, machine, target.parent)
    else:
        _put(target, _encoded(recording.batch))


def faulty(batch: Batch, fault: str) -> Batch:
    """The batch with one of `models.selection.replay.FAULTS` that leaves something to read."""
    table = batch.table.copy()
    third = max(1, len(table) // 3)
    if fault == "cut":
        table = table.iloc[: max(2, len(table) // 2)].reset_index(drop=True)
    elif fault == "stuck":
        names = [n for n in batch.names("temperature") if np.isfinite(batch.values(n)).all()]
        for name in names[:1]:
            table.loc[third:, name] = table[name].iloc[third]
    elif fault == "scaled":
        for name in batch.names("error"):
            table[name] *= _SCALE
    return replace(batch, table=table, findings=(), repairs={})


def _encoded(batch: Batch) -> bytes:
    return bytes(encode(batch, content_digest(batch)))


def _deliver_schedule(recording: Recording, machine: Machine, folder: Path) -> None:
    """The schedule, which stands next to the recordings."""
    schedule = machine.recording.schedule
    if schedule is not None and (source := recording.file.parent / schedule.file).is_file():
        shutil.copyfile(source, folder / schedule.file)


def _put(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, content)
    then_s = time.time() - _AGE_S
    os.utime(path, (then_s, then_s))
