"""Runs of the tracking store: written as a whole from plain data, marked with the process that writes them.

A run is RUNNING while it is written and FINISHED as the last step, so that whatever else is found there was
interrupted. A killed process cannot close its runs; the next command that writes on the same computer does
(`close_interrupted`). A `Record` has an id of its own, and a store gets it once, however often it is written.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pandas as pd
import psutil
from mlflow.entities import Dataset, DatasetInput, Experiment, InputTag, Metric, Param, Run, RunStatus, RunTag
from mlflow.entities.model_registry import ModelVersion, RegisteredModel
from mlflow.exceptions import MlflowException
from mlflow.tracking import MlflowClient
from pydantic import BaseModel, ConfigDict

from data.files import from_json
from pipelines.settings import Settings
from pipelines.store.audit import who

PARENT = "mlflow.parentRunId"
_DIGEST_LENGTH = 36  # the store's limit; the whole digest goes into a tag
_PAGE = 1000  # runs that one answer of the store has
_AT_ONCE = 900  # the store takes 1000 metrics, parameters and tags in one call
_SAME_START_S = 30.0  # the clock may be set while a process runs; no number of a process returns that soon
_PROGRAM = "thermodrift"
DIAGNOSIS = "diagnosis"  # in the place of the error channel
_NOTE, _SHARED, _VIEW = "mlflow.note.content", "mlflow.sharedViewState.", "trainings"
_OF_CELL = ("family", "n_tsp", "selector")
_NAME, _STAR = "mlflow.runName", "★ "  # the star marks the training that the champion is of


class Entity(BaseModel):
    """What a parent and its children have: metrics as (name, value, step)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    tags: dict[str, str] = {}
    params: dict[str, str] = {}
    metrics: tuple[tuple[str, float, int], ...] = ()


class DatasetRecord(BaseModel):
    """A batch of the lake as a dataset input."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    digest: str
    source: str
    version: int
    n_rows: int


class Record(Entity):
    """A run with its children and inputs as plain data; its files are a folder next to it.

    `id` is unique for a piece of work; times are in ms since 1970 (UTC).
    """

    id: str
    kind: str  # training or diagnosis
    machine: str
    target: str  # error channel, or "diagnosis"
    simulated: bool
    started_ms: int
    ended_ms: int
    datasets: tuple[DatasetRecord, ...] = ()
    children: tuple[Entity, ...] = ()

    @property
    def common(self) -> dict[str, str]:
        """Tags of parent and children."""
        return {
            "simulated": yes_or_no(self.simulated), "machine": self.machine, "target": self.target, "record": self.id,
        }  # fmt: skip


def now_ms() -> int:
    """The time now in ms since 1970 (UTC)."""
    return int(time.time() * 1000)


def write_record(client: MlflowClient, settings: Settings, record: Record, files: Path) -> str:
    """Write a run with its children, its inputs and all of the folder `files`; returns its id.

    A record that the store has as a finished run is not written again. What an interrupted attempt has left is closed.
    A run is finished last: before, no list of this program has it.
    """
    experiment = experiment_id(client, settings, record.machine, record.target, record.simulated)
    # parent and children of every attempt, the newest first
    for run in client.search_runs([experiment], f"tags.record = '{record.id}'", max_results=1000):
        if run.info.status == "FINISHED" and PARENT not in run.data.tags:
            return str(run.info.run_id)
        if run.info.status == "RUNNING":
            _interrupt(client, run, "written again by a later attempt")
    own = origin()
    tags = {**own, **record.common, **record.tags, "kind": record.kind}
    run = client.create_run(experiment, start_time=record.started_ms, tags=tags, run_name=record.name)
    run_id, children = str(run.info.run_id), record.children
    with _closing(client, run_id):
        _log(client, run_id, record, record.ended_ms)
        client.log_artifacts(run_id, str(files))
        if record.datasets:
            client.log_inputs(run_id, datasets=[_dataset(d, record.kind) for d in record.datasets])
        for child in children:
            tags = {**own, **record.common, **child.tags, "kind": "cell", PARENT: run_id}
            made = client.create_run(experiment, start_time=record.started_ms, tags=tags, run_name=child.name)
            with _closing(client, made.info.run_id):
                _log(client, made.info.run_id, child, record.ended_ms)
                client.set_terminated(made.info.run_id, "FINISHED", record.ended_ms)
        client.set_terminated(run_id, "FINISHED", record.ended_ms)
    return run_id


def close_interrupted(client: MlflowClient) -> int:
    """Mark as killed what ended processes of this computer left running; returns the number of runs."""
    left = [r for r in _runs(client, "attributes.status = 'RUNNING'") if _is_gone(r)]
    for run in left:
        _interrupt(client, run, "its process ended before the run did")
    return len(left)


def finished_runs(client: MlflowClient, kind: str, newest: int | None = None, **tags: str | None) -> list[Run]:
    """Finished runs of a kind, newest first: all, or the `newest` so many. With tags of an experiment (machine, target)
    those of such ones alone. So the cost grows neither with the number of machines nor with their history."""
    found = _runs(client, f"tags.kind = '{kind}' and attributes.status = 'FINISHED'", newest or _PAGE, **tags)
    return list(islice(found, newest))


def experiment_id(client: MlflowClient, settings: Settings, machine: str, target: str, simulated: bool) -> str:
    """The experiment of a machine's error channel (or "diagnosis"), made where there is none.

    One that has another name, by earlier settings, gets the present one.
    """
    found = find_experiment(client, settings, machine, target)
    if found is not None:
        if found.lifecycle_stage == "deleted":
            client.restore_experiment(found.experiment_id)
        elif found.name != settings.experiment(machine, target):
            client.rename_experiment(found.experiment_id, settings.experiment(machine, target))
        tags = {"simulated": yes_or_no(simulated), **_page(str(found.experiment_id), machine, target)}
        for key, text in tags.items():
            if found.tags.get(key) != text and (key != _NOTE or _NOTE not in found.tags):  # a note may be the user's
                client.set_experiment_tag(found.experiment_id, key, text)
        return str(found.experiment_id)
    # quoted, since a store decodes an address: the name 50%2f is no folder
    where = f"{settings.artifacts_uri}/{artifact_folder(machine, target)}" if settings.artifacts_uri else None
    tags = {"simulated": yes_or_no(simulated), "machine": machine, "target": target, "kind": _PROGRAM}
    made = client.create_experiment(settings.experiment(machine, target), artifact_location=where, tags=tags)
    for key, text in _page(str(made), machine, target).items():
        client.set_experiment_tag(made, key, text)
    return str(made)


def find_experiment(client: MlflowClient, settings: Settings, machine: str, target: str) -> Experiment | None:
    """The experiment of a machine's error channel, by its name or by what it is of."""
    named = client.get_experiment_by_name(settings.experiment(machine, target))
    if named is not None:
        return named
    return next(iter(experiments(client, machine=machine, target=target)), None)


def _page(experiment: str, machine: str, target: str) -> dict[str, str]:
    """How MLflow's page shows an experiment: as trainings, with a note that leads to the list with the right columns.

    By itself the list has no column of a metric, and room for 17 characters of a run's name. `viewStateShareKey` names
    a view that is kept with the experiment.
    """
    metrics = ("S_mean_um", "S_std_um", "expected_S_um", "expected_S_bound90_um", "max_um", "score_um")
    columns = ["tags.`outcome`", *(f"metrics.`{m}`" for m in metrics), *(f"params.`{p}`" for p in _OF_CELL)]
    view = {
        "orderByKey": "attributes.start_time", "orderByAsc": False, "selectedColumns": columns,
        "columnOrder": ["attributes.`Run Name`", "runDateAndNestInfo", *columns, "duration"],
        "columnWidths": {
            "attributes.`Run Name`": 330, "metrics.`expected_S_um`": 125, "metrics.`expected_S_bound90_um`": 180,
        },
    }  # fmt: skip
    note = _note(experiment, f"Thermal error {target} of {machine}")
    tags = {"mlflow.experimentKind": "custom_model_development", _NOTE: note, _SHARED + _VIEW: json.dumps(view)}
    return tags if target != DIAGNOSIS else {**tags, _NOTE: f"Diagnoses of {machine}", _SHARED + _VIEW: "{}"}


def _note(experiment: str, about: str) -> str:
    """MLflow shows its first line, of some 80 characters."""
    link = f"#/experiments/{experiment}/runs?viewStateShareKey={_VIEW}&workflowType=machine_learning"
    return f"{about}. [Compare trainings]({link})"


def mark_champion(client: MlflowClient, training_id: str, version: str) -> None:
    """Show in MLflow's pages which training the champion is of: a star before its name, and a line in the note.

    A note that a user wrote stays as it is.
    """
    try:
        run = client.get_run(training_id)
    except MlflowException as error:
        if error.error_code not in ("RESOURCE_DOES_NOT_EXIST", "INVALID_PARAMETER_VALUE"):
            raise
        return  # the training is deleted for good; its version may still be champion
    if run.info.lifecycle_stage != "active":
        return
    experiment = client.get_experiment(run.info.experiment_id)
    for other in client.search_runs([run.info.experiment_id], f"attributes.run_name LIKE '{_STAR}%'"):
        client.set_tag(other.info.run_id, _NAME, str(other.info.run_name).removeprefix(_STAR))
    name = str(run.info.run_name).removeprefix(_STAR)
    client.set_tag(training_id, _NAME, _STAR + name)
    if f"viewStateShareKey={_VIEW}" in experiment.tags.get(_NOTE, ""):
        note = _note(run.info.experiment_id, f"{_STAR}Champion: version {version}, {name}")
        client.set_experiment_tag(run.info.experiment_id, _NOTE, note)


def artifact_folder(machine: str, target: str) -> str:
    """Where the files of an experiment are, below the artifacts' address."""
    return f"{machine}/{quote(target)}"


def dataset_records(batches: pd.DataFrame) -> tuple[DatasetRecord, ...]:
    """The lake's batches; `batches` has batch_id, digest, version, source, n_rows."""
    return tuple(
        DatasetRecord(
            name=str(row["batch_id"]), digest=str(row["digest"]), source=str(row.get("source", "")),
            version=int(row.get("version", 1)), n_rows=int(row["n_rows"]),
        )
        for row in batches.to_dict("records")
    )  # fmt: skip


def origin() -> dict[str, str]:
    """Tags that say who made a run, by which program and in which process."""
    program, _, commit = code_version().partition(" ")
    own = psutil.Process()
    process = {"host": platform.node(), "pid": own.pid, "started": _iso(own.create_time())}
    tags = {
        "code_version": code_version(), "process": json.dumps(process), "mlflow.user": who(),
        "mlflow.source.type": "LOCAL", "mlflow.source.name": _command(),
    }  # fmt: skip
    return tags | ({"mlflow.source.git.commit": commit.removesuffix("-dirty")} if program == "git" else {})


def started(run: Run) -> pd.Timestamp:
    """The start time, UTC."""
    return pd.Timestamp(run.info.start_time, unit="ms", tz="UTC")


@cache
def code_version() -> str:
    """The version of this program: ``git COMMIT`` of a checkout, -dirty with changes; else ``thermodrift VERSION``."""
    root = Path(__file__).resolve().parents[2]
    if (root / ".git").exists():  # an installation inside another project's checkout has none of its own
        command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, check=True, timeout=20,
                env={**os.environ, "GIT_OPTIONAL_LOCKS": "0"},
            )  # fmt: skip
            return f"git {done.stdout.strip()}"
        except (OSError, subprocess.SubprocessError):
            pass  # without git, or a checkout of another user: the package's version is what is known
    return f"{_PROGRAM} {version(_PROGRAM)}"


def yes_or_no(value: bool) -> str:
    """A flag as tags hold it."""
    return "true" if value else "false"


@contextmanager
def _closing(client: MlflowClient, run_id: str) -> Iterator[None]:
    """A run that fails is closed as FAILED, as far as the store still answers; what is raised stays the cause."""
    try:
        yield
    except BaseException:
        with suppress(Exception):
            client.set_terminated(run_id, "FAILED")
        raise


def _log(client: MlflowClient, run_id: str, what: Entity, at_ms: int) -> None:
    """In one call, or in a few where there are many metrics."""
    metrics = [Metric(key, value, at_ms, step) for key, value, step in what.metrics]
    for first in range(0, len(metrics) or 1, _AT_ONCE):
        params = [Param(k, v) for k, v in what.params.items()] if not first else []
        client.log_batch(run_id, metrics=metrics[first : first + _AT_ONCE], params=params)


def _dataset(batch: DatasetRecord, context: str) -> DatasetInput:
    source = json.dumps({"source": batch.source, "batch": batch.name, "version": batch.version})
    digest = batch.digest or f"v{batch.version}"
    dataset = Dataset(
        name=batch.name, digest=digest[:_DIGEST_LENGTH], source_type="thermodrift_lake", source=source,
        profile=json.dumps({"num_rows": batch.n_rows}),
    )  # fmt: skip
    return DatasetInput(dataset, [InputTag("mlflow.data.context", context), InputTag("digest", digest)])


def experiments(client: MlflowClient, **tags: str | None) -> list[Experiment]:
    """Every experiment of thermodrift, or those with these tags."""
    wanted = {"kind": _PROGRAM} | {k: v for k, v in tags.items() if v is not None}
    # MLflow's language of filters has no way to write a quote.
    which = " and ".join(f"tags.{k} = '{v}'" for k, v in wanted.items() if "'" not in v)
    return [e for e in _all(client.search_experiments, filter_string=which) if wanted.items() <= e.tags.items()]


def registered_models(client: MlflowClient) -> Iterator[RegisteredModel]:
    """Every registered model."""
    return _all(client.search_registered_models, max_results=1000)


def model_versions(client: MlflowClient, name: str | None = None) -> list[ModelVersion]:
    """Every version in the registry, or those of one model, the newest of a model first."""
    which = f"name = '{name}'" if name is not None and "'" not in name else None  # a filter cannot write a quote
    every = _all(client.search_model_versions, filter_string=which, max_results=10_000)
    return sorted((v for v in every if name in (None, v.name)), key=lambda v: -int(v.version))


def versions_by_model(client: MlflowClient) -> dict[str, list[ModelVersion]]:
    """Every version by the model's name, the newest first; in one query, where there are many models."""
    found: dict[str, list[ModelVersion]] = defaultdict(list)
    for v in model_versions(client):
        found[v.name].append(v)
    return found


def standing_versions(client: MlflowClient, model: RegisteredModel) -> list[ModelVersion]:
    """The versions that an alias names and the newest one, which may be neither; the cost does not grow with others."""
    named = {int(number) for number in model.aliases.values()}
    if "'" in model.name:  # a filter cannot write a quote
        every = model_versions(client, model.name)
        return [v for v in every if int(v.version) in named or v is every[0]]
    newest = client.search_model_versions(f"name = '{model.name}'", 1, ["version_number DESC"])
    others = named - {int(v.version) for v in newest}
    return [*newest, *(client.get_model_version(model.name, str(n)) for n in sorted(others, reverse=True))]


def _runs(client: MlflowClient, which: str, at_once: int = _PAGE, **tags: str | None) -> Iterator[Run]:
    if ids := [e.experiment_id for e in experiments(client, **tags)]:
        newest_first = ["attributes.start_time DESC"]
        yield from _all(client.search_runs, ids, which, max_results=at_once, order_by=newest_first)


def _all(search: Callable[..., Any], *args: Any, **more: Any) -> Iterator[Any]:
    """What a search of the client gives, page after page."""
    token = None
    while True:
        page = search(*args, page_token=token, **more)
        yield from page
        if not (token := page.token):
            return


def _interrupt(client: MlflowClient, run: Run, why: str) -> None:
    client.log_batch(run.info.run_id, tags=[RunTag("interrupted", why)])
    client.set_terminated(run.info.run_id, RunStatus.to_string(RunStatus.KILLED))


def _is_gone(run: Run) -> bool:
    """Whether the process of a run was one of this computer that has ended; of others nothing is known."""
    try:
        process = from_json(run.data.tags.get("process", ""))
        host, pid, began = process["host"], int(process["pid"]), pd.Timestamp(process["started"])
    except (ValueError, KeyError, TypeError):
        return False
    if host != platform.node():
        return False
    try:
        now = psutil.Process(pid)
        other = abs(now.create_time() - began.timestamp()) > _SAME_START_S
        return other or now.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True
    except psutil.AccessDenied:
        return False


def _iso(time_s: float) -> str:
    return pd.Timestamp(time_s, unit="s", tz="UTC").isoformat(timespec="milliseconds")


def _command() -> str:
    """``thermodrift train``; ``thermodrift`` where another program calls the library."""
    called, *rest = sys.argv or [""]
    own = Path(called).stem == _PROGRAM and rest and not rest[0].startswith("-")
    return f"{_PROGRAM} {rest[0]}" if own else _PROGRAM
