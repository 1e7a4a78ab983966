"""Trainings and diagnoses in MLflow.

A training: an experiment per machine and error channel, a parent run, a child run per model. The parent run keeps the
whole `GridResult` as Parquet, so that a report is made from tracked runs alone. A diagnosis: one run in the machine's
experiment "diagnosis", with every file of OUT as an artifact.
"""

from __future__ import annotations

import json
import logging
import math
import platform
import re
import sqlite3
import threading
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mlflow
import numpy as np
import pandas as pd
from mlflow.entities import Run, RunTag
from mlflow.exceptions import MlflowException
from mlflow.tracking import MlflowClient
from requests import RequestException
from sqlalchemy.exc import SQLAlchemyError

from data.batch import Batch
from data.errors import InputError, WorkError, place_of
from data.files import from_json
from data.units import unit_label
from models.families import FAMILIES
from models.protocols import PromotionRule
from models.selection.outlook import outlook
from models.selection.promotion import Choice, choose, judged
from models.selection.result import GridResult, Training
from pipelines.caller import Say
from pipelines.settings import Settings, load, masked
from pipelines.store import database
from pipelines.store.audit import CHAMPION
from pipelines.store.database import StoreOutage
from pipelines.store.runs import (
    DIAGNOSIS,
    DatasetRecord,
    Entity,
    Record,
    close_interrupted,
    dataset_records,
    finished_runs,
    now_ms,
    started,
    write_record,
    yes_or_no,
)
from reports.labels import three_digits

if TYPE_CHECKING:
    from diagnosis.result import Diagnosis

# By n_tsp; the store takes most of a second for a thousand values, and the tables below grid/ have all scores.
CURVES = {"S_mean_um": "S_mean_um", "S_std_um": "S_std_um", "max_abs_um": "max_um", "tsp_stability": "tsp_stability"}
PLAIN = CURVES | {n: n for n in ("score_um", "eta", "compensation_effect", "grey_degree", "rmse_um")}  # best cell
_GRID = "grid"

logging.getLogger("urllib3.connectionpool").setLevel(logging.ERROR)  # every retry; an error is one line of ours
_OPENING = threading.Lock()  # MLflow's own lock on a first migration holds between processes only
_opened = set[str]()  # by this process


def open_store(settings: Settings, say: Say = lambda text: None) -> MlflowClient:
    """A client of the tracking store; the first use makes the SQLite file, which takes seconds and is reported.

    Threads may call it at once.

    Raises:
        InputError: the store is a database whose driver is not installed.
        WorkError: the store does not answer, or is of an older MLflow.
    """
    file = settings.store_file
    with _OPENING, store_errors(settings):
        if file is not None and not database.is_made(file):
            say(f"first use: making the tracking store {file} (takes some seconds, once)")
            database.make(file, lambda made: MlflowClient(f"sqlite:///{made}").search_experiments(max_results=1))
        own = settings.artifacts_uri
        if file is not None and own and settings.store_uri not in _opened and database.follow(file, own):
            say(f"the home has moved: addresses in the tracking store now lead to {own}")
        # MLflow looks up a logged model's files in the process-wide store, whatever store is requested.
        mlflow.set_tracking_uri(settings.store_uri)
        mlflow.set_registry_uri(settings.store_uri)
        with database.first_use(settings, say) if settings.store_uri not in _opened else nullcontext():
            client = MlflowClient(settings.store_uri, registry_uri=settings.store_uri)
            client.search_experiments(max_results=1)
        _opened.add(settings.store_uri)
    return client


@contextmanager
def store_errors(settings: Settings) -> Iterator[None]:
    """Turn the errors of MLflow and of what it writes to into one line.

    Raises:
        StoreOutage: a server does not answer or fails.
        WorkError: any other error of the store.
    """
    remote = settings.store_file is None
    try:
        yield
    except MlflowException as error:
        text = masked(" ".join(str(error).splitlines()[:1]))
        if "out-of-date database schema" in text:
            text = f"it is of an older MLflow; make a copy, then run: mlflow db upgrade {settings.store_name}"
        outage = remote and error.error_code in _OUTAGE
        raise (StoreOutage if outage else WorkError)(f"tracking store {settings.store_name}: {_brief(text)}") from error
    except (RequestException, SQLAlchemyError, sqlite3.Error) as error:
        text = _brief(masked(str(error).splitlines()[0]))
        raise (StoreOutage if remote else WorkError)(f"tracking store {settings.store_name}: {text}") from error
    except OSError as error:
        if error.errno is None:
            raise
        where = place_of(error, masked(settings.artifacts_uri or settings.store_uri))
        raise WorkError(f"{where}: cannot be written or read ({error.strerror or error})") from error


_OUTAGE = ("INTERNAL_ERROR", "TEMPORARILY_UNAVAILABLE", "RESOURCE_EXHAUSTED", "DEADLINE_EXCEEDED")  # not the input


def _brief(text: str) -> str:
    """What MLflow's client says of a connection, without the path of the request and the names of its classes."""
    if "failed with timeout" in text or "timed out" in text:
        return "does not answer in time"
    if "API request to" in text and "failed with exception" in text:
        refused = "Connection refused" in text
        return "does not answer" + (" (connection refused)" if refused else f" ({text.rpartition(': ')[2].strip(')')})")
    return text


def log_record(record: Record, files: Path, settings: Settings, say: Say = lambda text: None) -> str:
    """Track a record with its files; returns the id of its run, of which there is one however often this is called.

    Raises:
        StoreOutage: a server does not answer.
        WorkError: the store cannot be written.
    """
    client = open_store(settings, say)
    with store_errors(settings):
        close_interrupted(client)
        return write_record(client, settings, record, files)


def training_record(
    result: GridResult,
    rule: PromotionRule,
    params: Mapping[str, Any] | None = None,
    *,
    choice: Choice | None = None,
    record_id: str = "",
    started_ms: int | None = None,
) -> Record:
    """A training as a run: what its chosen cell reached as plain metrics and parameters, and a child per model.

    A child is a selector × family. Its plain metrics are those of its best cell under the protocol that decides; by
    n_tsp as step, ``leave_batch_out_by_n_tsp/S_mean_um`` and so on, and ``leave_batch_out_by_fold/S_um`` of the best
    cell with the fold's index as step. Plain names have the same meaning in parent and child.

    Args:
        choice: the chosen cell; without it the one that the rule picks, and no nested score.
        record_id: made up where there is none.
        started_ms: when the training began, ms since 1970; by default now.
    """
    ended_ms = now_ms()
    name = f"{pd.Timestamp.now():%Y-%m-%d %H:%M}"
    counts = {"n_batches": len(result.batches), "n_cells": len(result.cells), "n_findings": len(result.findings)}
    metrics: dict[str, float] = {}
    plain, tags = {k: str(v) for k, v in (params or {}).items()}, {}
    if rule.offered(set(result.cells["protocol"])):
        best = choice or choose(result, rule)
        expected = outlook(result, best)
        unit = unit_label(plain.get("unit", "um"))
        name = f"{three_digits(round(best.S_mean_um, 2))} ± {three_digits(round(best.S_std_um, 2))} {unit} "
        name += f"{best.family} {best.n_tsp} {best.selector}"  # MLflow's list shows the begin of a name
        metrics |= _cell_metrics(_judged_row(result, rule, best)) | {
            "nested_S_mean_um": best.nested_S_mean_um, "nested_S_std_um": best.nested_S_std_um,
            "expected_S_um": expected.S_um, "expected_S_bound90_um": expected.bound_um,
        }  # fmt: skip
        plain |= {
            "selector": best.selector,
            "family": best.family,
            "n_tsp": str(best.n_tsp),
            "inputs": ", ".join(best.inputs),
        }
        tags = {"best": best.name, "best_cell": best.cell, "trusted": yes_or_no(best.trusted)}
        tags["mlflow.note.content"] = best.summary + (f"; {best.caution}" if best.caution else "")
    values = tuple((k, _read(v), 0) for k, v in {**metrics, **counts}.items() if np.isfinite(v))
    groups = result.cells.groupby(["selector", "family"], sort=False)
    scores = result.scores.groupby(["selector", "family"], sort=False).indices
    best_of = _best_cells(result, rule)
    return Record(
        id=record_id or uuid.uuid4().hex, kind="training", machine=result.machine, target=result.target,
        simulated=result.simulated, name=name, tags=_short(tags), params=_short(plain), metrics=values,
        started_ms=started_ms or ended_ms, ended_ms=ended_ms, datasets=dataset_records(result.batches),
        children=tuple(
            _child(cells, result.scores.iloc[scores.get(key, [])], best_of.get(key)) for key, cells in groups
        ),
    )  # fmt: skip


def training_files(folder: Path, result: GridResult, figures: Mapping[str, bytes]) -> None:
    """What a training's run keeps as artifacts: its tables under grid/, and figures (file name -> bytes)."""
    result.save(folder / _GRID)
    if figures:
        (folder / "figures").mkdir()
    for name, content in figures.items():
        (folder / "figures" / name).write_bytes(content)


def trainings(
    machine: str | None = None,
    target: str | None = None,
    settings: Settings | None = None,
    newest: int | None = None,
) -> pd.DataFrame:
    """Finished trainings, or the `newest` so many, newest first.

    Returns:
        training_id, machine, target, started, n_batches, best, score_um, simulated, promotion (champion, provisional,
        challenger, unchanged or empty), model. Empty where there is none.

    Raises:
        WorkError: the store does not answer.
    """
    settings = settings or load()
    client = open_store(settings)
    with store_errors(settings):
        runs = finished_runs(client, "training", newest, machine=machine, target=target)
    columns = ["training_id", "machine", "target", "started", "n_batches", "best", "score_um", "simulated",
               "promotion", "model"]  # fmt: skip
    return pd.DataFrame([_training_row(r) for r in runs], columns=columns)


def load_training(training_id: str, settings: Settings) -> Training:
    """A training with all its tables.

    Raises:
        InputError: no such training.
    """
    client = open_store(settings)
    try:
        run = client.get_run(training_id)
    except MlflowException:
        run = None
    if run is None or run.data.tags.get("kind") != "training":
        raise InputError(f"training {training_id!r} is not in {settings.store_name}; `thermodrift status` lists them")
    with store_errors(settings):
        folder = mlflow.artifacts.download_artifacts(
            run_id=training_id, artifact_path=_GRID, tracking_uri=settings.store_uri
        )
    try:
        result = GridResult.load(Path(folder))
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"training {training_id}: its tables in {folder} cannot be read ({error})") from None
    tags = run.data.tags
    promotion = from_json(tags.get("promotion", "{}"))
    if promotion:
        with store_errors(settings):
            promotion["champion_version"] = _champion_now(client, promotion["name"])
    return Training(
        training_id, started(run), tags.get("simulated") == "true", result, dict(run.data.params), promotion,
        tags.get("code_version", ""),
    )  # fmt: skip


def _champion_now(client: MlflowClient, model: str) -> int | None:
    """The present champion: a later promotion or a roll-back may have replaced the one that a training recorded."""
    try:
        version = client.get_registered_model(model).aliases.get(CHAMPION)
    except MlflowException as error:
        if error.error_code != "RESOURCE_DOES_NOT_EXIST":
            raise
        return None
    return None if version is None else int(version)


def record_promotion(client: MlflowClient, training_id: str, promotion: dict[str, Any]) -> None:
    """Keep the outcome of the promotion on the training, also as plain tags for the list of runs."""
    tags = {
        "promotion": json.dumps(promotion, ensure_ascii=False), "outcome": str(promotion["outcome"]),
        "model": f"{promotion['name']} version {promotion['version']}",
    }  # fmt: skip
    client.log_batch(training_id, tags=[RunTag(k, v) for k, v in tags.items()])


def attach(training_id: str, path: Path, settings: Settings) -> None:
    """Add a file, such as the report, to the artifacts of a training.

    Raises:
        StoreOutage: a server does not answer.
        WorkError: the store cannot be written.
    """
    client = open_store(settings)
    with store_errors(settings):
        client.log_artifact(training_id, str(path), "report")


def _judged_row(result: GridResult, rule: PromotionRule, choice: Choice) -> pd.Series:
    """The chosen cell under the leading protocol."""
    own = {"selector": choice.selector, "family": choice.family, "n_tsp": choice.n_tsp}
    table = judged(result, rule)
    return table[(table[list(own)] == pd.Series(own)).all(axis=1)].iloc[0]


def _cell_metrics(row: pd.Series) -> dict[str, float]:
    """The plain metrics of a cell, a row of `judged`: the same in parent and child, so that a list compares them."""
    return {shown: _read(row[name]) for name, shown in PLAIN.items()} | {"n_tsp": float(row["n_tsp"])}


def _read(value: float) -> float:
    """Five digits: a list shows a number up to its last one. The tables below grid/ have all of them."""
    return float(f"{value:.5g}")


def _short(texts: Mapping[str, str]) -> dict[str, str]:
    return {k: v[:_MAX_CHARACTERS] for k, v in texts.items()}


def _best_cells(result: GridResult, rule: PromotionRule) -> dict[Any, pd.Series]:
    """The best cell by selector and family, of those that all of the rule's protocols have scored."""
    try:
        every = judged(result, rule)
    except InputError:  # no score under the rule
        return {}
    return {key: own.nsmallest(1, "score_um").iloc[0] for key, own in every.groupby(["selector", "family"], sort=False)}


def _child(cells: pd.DataFrame, scores: pd.DataFrame, best: pd.Series | None) -> Entity:
    """All cells of one selector and family, and their scores; `best` None: not all protocols of the rule scored one."""
    selector, family = (str(cells[c].iloc[0]) for c in ("selector", "family"))
    metrics: list[tuple[str, float, int]] = []
    for row in cells[["protocol", "n_tsp", *CURVES]].to_dict("records"):
        prefix = str(row["protocol"]).replace("-", "_")
        metrics += [(f"{prefix}_by_n_tsp/{to}", _read(row[name]), int(row["n_tsp"])) for name, to in CURVES.items()]
    options = FAMILIES[family]().options() if family in FAMILIES else {}
    params = {"selector": selector, "family": family, **{f"option.{k}": str(v) for k, v in options.items()}}
    if best is not None:
        params |= {"n_tsp": str(best["n_tsp"]), "inputs": str(best["inputs"]).replace("|", ", ")}
        # First, as the page of a run lists them.
        metrics = [*((name, value, 0) for name, value in _cell_metrics(best).items()), *metrics]
        picked = scores[(scores["protocol"] == best["protocol"]) & (scores["n_tsp"] == best["n_tsp"])]
        key = f"{str(best['protocol']).replace('-', '_')}_by_fold/S_um"
        metrics += [(key, _read(v), i) for i, v in enumerate(picked.groupby("fold", sort=False)["S_um"].mean())]
    finite = tuple(m for m in metrics if np.isfinite(m[1]))
    tags = {"selector": selector, "family": family}
    return Entity(name=f"{selector} × {family}", tags=tags, params=_short(params), metrics=finite)


def _training_row(run: Run) -> dict[str, Any]:
    tags = run.data.tags
    promotion = from_json(tags.get("promotion", "{}"))
    version = f"{promotion['name']} version {promotion['version']}" if promotion else ""
    return {
        "training_id": run.info.run_id,
        "machine": tags["machine"],
        "target": tags["target"],
        "started": started(run),
        "n_batches": int(run.data.metrics.get("n_batches", 0)),
        "best": tags.get("best", ""),
        "score_um": run.data.metrics.get("score_um", run.data.metrics.get("best_score_um", math.nan)),
        "simulated": tags.get("simulated") == "true",
        "promotion": promotion.get("outcome", ""),
        "model": version,
    }


DIAGNOSIS_COLUMNS = (
    "run_id",
    "machine",
    "started",
    "n_batches",
    "verdict",
    "mechanism",
    "where",
    "probability",
    "simulated",
)
_VERSIONS = ("thermodrift", "numpy", "scipy", "pandas", "mlflow")
_NO_NAME = re.compile(r"[^\w\-. /:]")  # characters that the store does not take in the name of a metric
_MAX_CHARACTERS = 5000  # characters of a parameter or tag; the store takes 6000


def diagnosis_record(d: Diagnosis, batches: Sequence[Batch], params: Mapping[str, Any] | None = None) -> Record:
    """A diagnosis as a run, whose artifacts are the files that it wrote.

    Metrics: ``left_out_rms_before/z_um``, ``left_out_rms_after/z_um`` and ``noise_floor/z_um`` by channel, findings,
    probability (of the first one), batches, left_out_batches, left_out_batches_improved, seconds. Tags: verdict,
    mechanism, where, simulated, drafted. The batches are dataset inputs.
    """
    f, now = d.findings, now_ms()
    versions = {f"version.{name}": version(name) for name in _VERSIONS} | {"version.python": platform.python_version()}
    known = {"machine": f.machine, "batches": ", ".join(f.batches), **versions, **(params or {})}
    metrics = tuple((k, v, 0) for k, v in _diagnosis_metrics(d).items() if math.isfinite(v))
    return Record(
        id=uuid.uuid4().hex, kind="diagnosis", machine=f.machine, target=DIAGNOSIS, simulated=d.simulated,
        name=f"{pd.Timestamp.now():%Y-%m-%d %H:%M} {f.verdict.replace('_', ' ')}", tags=_short(_diagnosis_tags(d)),
        params=_short({k: str(v) for k, v in known.items()}), metrics=metrics,
        started_ms=now - int(1000 * (f.seconds or 0.0)), ended_ms=now,
        datasets=tuple(
            DatasetRecord(name=b.batch_id, digest=b.digest, source=b.source, version=b.version, n_rows=b.n_rows)
            for b in batches
        ),
    )  # fmt: skip


def diagnoses(machine: str | None = None, settings: Settings | None = None) -> pd.DataFrame:
    """Finished diagnoses, newest first, columns `COLUMNS`; mechanism and where of the first finding, else empty.

    Raises:
        WorkError: the store does not answer.
    """
    settings = settings or load()
    client = open_store(settings)
    with store_errors(settings):
        runs = finished_runs(client, "diagnosis", machine=machine)
    return pd.DataFrame([_diagnosis_row(r) for r in runs], columns=list(DIAGNOSIS_COLUMNS))


def _diagnosis_metrics(d: Diagnosis) -> dict[str, float]:
    f = d.findings
    rms = f.fit.left_out_rms
    groups = {"left_out_rms_before": rms.before, "left_out_rms_after": rms.after, "noise_floor": rms.noise_floor}
    values: dict[str, float] = {
        f"{group}/{_NO_NAME.sub('_', key)}": value
        for group, by_channel in groups.items()
        for key, value in by_channel.items()
        if value is not None
    }
    values |= {"findings": len(f.findings), "batches": len(f.batches)}
    values |= {"left_out_batches": f.fit.batches, "left_out_batches_improved": f.fit.batches_improved}
    if f.seconds is not None:
        values["seconds"] = f.seconds
    if f.findings:
        values["probability"] = f.findings[0].probability
    return {k: float(v) for k, v in values.items()}


def _diagnosis_tags(d: Diagnosis) -> dict[str, str]:
    first = d.findings.findings[0] if d.findings.findings else None
    return {
        "verdict": d.findings.verdict,
        "mechanism": first.mechanism if first else "",
        "where": f"{first.where.kind} {first.where.name}" if first else "",
        "drafted": yes_or_no(d.drafted),
    }


def _diagnosis_row(run: Run) -> dict[str, Any]:
    tags, metrics = run.data.tags, run.data.metrics
    return {
        "run_id": run.info.run_id,
        "machine": tags["machine"],
        "started": started(run),
        "n_batches": int(metrics.get("batches", 0)),
        "verdict": tags.get("verdict", ""),
        "mechanism": tags.get("mechanism", ""),
        "where": tags.get("where", ""),
        "probability": metrics.get("probability", float("nan")),
        "simulated": tags.get("simulated") == "true",
    }
