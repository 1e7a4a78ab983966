"""Trainings and diagnoses in MLflow.

A training: an experiment per machine and error channel, a parent run, a child run per model. The parent run keeps the
whole `GridResult` as Parquet, so that a report is made from tracked runs alone. A diagnosis: one run in the machine's
experiment "diagnosis", with every file of OUT as an artifact.
"""

from __future__ import annotations

import json
import math
import os
import platform
import re
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any
from urllib.parse import quote

import mlflow
import numpy as np
import pandas as pd
from filelock import FileLock
from mlflow.entities import Dataset, DatasetInput, InputTag, Metric, Param, Run, RunTag
from mlflow.exceptions import MlflowException
from mlflow.tracking import MlflowClient

from data.batch import Batch
from data.errors import InputError, WorkError
from diagnosis.result import Diagnosis
from models import FAMILIES
from models.outlook import outlook
from models.promotion import choose, judged
from models.protocols import PromotionRule
from models.result import GridResult, Training
from pipelines.audit import CHAMPION
from pipelines.caller import Say
from pipelines.settings import Settings, load

_DIGEST_LENGTH = 36  # the store's limit; the whole digest goes into a tag
_METRICS_AT_ONCE = 900  # the store takes 1000 metrics, parameters and tags in one call


def experiment_id(client: MlflowClient, settings: Settings, machine: str, target: str, simulated: bool) -> str:
    """The experiment of a machine's error channel (or "diagnosis"), made where there is none."""
    name = settings.experiment(machine, target)
    found = client.get_experiment_by_name(name)
    if found is not None:
        if found.lifecycle_stage == "deleted":
            client.restore_experiment(found.experiment_id)
        if found.tags.get("simulated") != yes_or_no(simulated):
            client.set_experiment_tag(found.experiment_id, "simulated", yes_or_no(simulated))
        return str(found.experiment_id)
    # quoted, since a store decodes an address: the name 50%2f is no folder
    where = f"{settings.artifacts_uri}/{machine}/{quote(target)}" if settings.artifacts_uri else None
    tags = {"simulated": yes_or_no(simulated), "machine": machine, "target": target, "kind": "thermodrift"}
    return str(client.create_experiment(name, artifact_location=where, tags=tags))


def dataset_inputs(batches: pd.DataFrame, context: str = "training") -> list[DatasetInput]:
    """The lake's batches as dataset inputs; `batches` has batch_id, digest, version, source, n_rows."""
    out = []
    for row in batches.to_dict("records"):
        digest, version = str(row["digest"]), row.get("version", 1)
        source = json.dumps({"source": str(row.get("source", "")), "batch": row["batch_id"], "version": int(version)})
        dataset = Dataset(
            name=str(row["batch_id"]), digest=digest[:_DIGEST_LENGTH] or f"v{version}", source_type="thermodrift_lake",
            source=source, profile=json.dumps({"num_rows": int(row["n_rows"])}),
        )  # fmt: skip
        tags = [InputTag("mlflow.data.context", context), InputTag("digest", digest or f"v{version}")]
        out.append(DatasetInput(dataset, tags))
    return out


def log_values(
    client: MlflowClient,
    run_id: str,
    metrics: Sequence[Metric],
    params: Mapping[str, str],
    tags: Mapping[str, str] | None = None,
) -> None:
    """Log in one call, or in a few where there are many metrics."""
    for first in range(0, len(metrics) or 1, _METRICS_AT_ONCE):
        chunk = list(metrics[first : first + _METRICS_AT_ONCE])
        own = [Param(k, v) for k, v in params.items()] if not first else []
        marks = [RunTag(k, v) for k, v in (tags or {}).items()] if not first else []
        client.log_batch(run_id, metrics=chunk, params=own, tags=marks)


def finished_runs(client: MlflowClient, kind: str) -> list[Run]:
    """Finished runs of a kind over all experiments of thermodrift, newest first."""
    experiments = client.search_experiments(filter_string="tags.kind = 'thermodrift'")
    ids, token, runs = [e.experiment_id for e in experiments], None, []
    while ids:
        page = client.search_runs(
            ids, f"tags.kind = '{kind}' and attributes.status = 'FINISHED'", page_token=token,
            order_by=["attributes.start_time DESC"],
        )  # fmt: skip
        runs += page
        token = page.token
        if not token:
            break
    return runs


def started(run: Run) -> pd.Timestamp:
    """The start time, UTC."""
    return pd.Timestamp(run.info.start_time, unit="ms", tz="UTC")


@cache
def code_version() -> str:
    """The version of this program: ``git COMMIT`` of a checkout, -dirty with changes; else ``thermodrift VERSION``."""
    root = Path(__file__).resolve().parents[1]
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
    return f"thermodrift {version('thermodrift')}"


def yes_or_no(value: bool) -> str:
    """A flag as tags hold it."""
    return "true" if value else "false"


CELL_METRICS = (
    "S_mean_um", "S_std_um", "max_abs_um", "eta", "compensation_effect", "grey_degree", "rmse_um", "tsp_stability",
)  # fmt: skip
_GRID = "grid"

_OPENING = threading.Lock()  # MLflow's own lock on a first migration holds between processes only


def open_store(settings: Settings, say: Say = lambda text: None) -> MlflowClient:
    """A client of the tracking store; the first use makes the SQLite file, which takes seconds and is reported.

    Threads may call it at once.

    Raises:
        WorkError: the store does not answer, or is of an older MLflow.
    """
    file = settings.store_file
    with _OPENING, store_errors(settings):
        if file is not None and not file.exists():
            say(f"first use: making the tracking store {file} (takes some seconds, once)")
            _make_store(file)
        # MLflow looks up a logged model's files in the process-wide store, whatever store is requested.
        mlflow.set_tracking_uri(settings.store_uri)
        mlflow.set_registry_uri(settings.store_uri)
        client = MlflowClient(settings.store_uri, registry_uri=settings.store_uri)
        client.search_experiments(max_results=1)
    return client


def _make_store(file: Path) -> None:
    """All or nothing: MLflow cannot open a store whose first migration was interrupted."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(f"{file}.lock"), tempfile.TemporaryDirectory(dir=file.parent, prefix=".making-") as scratch:
        made = Path(scratch) / file.name
        MlflowClient(f"sqlite:///{made}").search_experiments(max_results=1)
        if not file.exists():  # made by another process meanwhile
            made.rename(file)


@contextmanager
def store_errors(settings: Settings) -> Iterator[None]:
    """Turn MLflow's errors into one line."""
    try:
        yield
    except MlflowException as error:
        text = str(error).splitlines()[0]
        if "out-of-date database schema" in text:
            text = f"it is of an older MLflow; make a copy, then run: mlflow db upgrade {settings.store_uri}"
        raise WorkError(f"tracking store {settings.store_uri}: {text}") from error


def log_training(
    result: GridResult,
    settings: Settings,
    *,
    figures: dict[str, bytes] | None = None,
    params: dict[str, Any] | None = None,
    say: Say = lambda text: None,
) -> str:
    """Track one training; returns its id (the parent run's).

    Parent run: the tables as Parquet under grid/, figures (file name -> bytes) under figures/, the lake's batches as
    dataset inputs. One child run per selector × family: metrics ``leave_batch_out/S_mean_um`` and so on with n_tsp
    as step, and ``leave_batch_out/fold_S_um`` at the best n_tsp with the fold's index as step.

    Raises:
        WorkError: the store does not answer.
    """
    client = open_store(settings, say)
    with store_errors(settings):
        experiment = experiment_id(client, settings, result.machine, result.target, result.simulated)
        common = {"simulated": yes_or_no(result.simulated), "machine": result.machine, "target": result.target}
        name = f"{result.machine} {result.target} {pd.Timestamp.now():%Y-%m-%d %H:%M}"
        tags = {**common, "kind": "training", "code_version": code_version()}
        run = client.create_run(experiment, tags=tags, run_name=name)
        parent = str(run.info.run_id)
        status = "FAILED"
        try:
            _log_parent(client, parent, result, settings.promotion, params or {})
            _log_files(client, parent, result, figures or {})
            client.log_inputs(parent, datasets=dataset_inputs(result.batches))
            for _, cells in result.cells.groupby(["selector", "family"], sort=False):
                _log_cells(client, run, {**common, "kind": "cell"}, cells, result, settings.promotion)
            status = "FINISHED"
        finally:
            client.set_terminated(parent, status)
    return parent


def trainings(machine: str | None = None, target: str | None = None, settings: Settings | None = None) -> pd.DataFrame:
    """Finished trainings, newest first: training_id, machine, target, started, n_batches, best, score_um, simulated,
    promotion (champion, challenger, unchanged or empty), model. Empty where there is none.

    Raises:
        WorkError: the store does not answer.
    """
    settings = settings or load()
    client = open_store(settings)
    with store_errors(settings):
        runs = finished_runs(client, "training")
    columns = ["training_id", "machine", "target", "started", "n_batches", "best", "score_um", "simulated",
               "promotion", "model"]  # fmt: skip
    table = pd.DataFrame([_training_row(r) for r in runs], columns=columns)
    for column, wanted in (("machine", machine), ("target", target)):
        if wanted is not None:
            table = table[table[column] == wanted]
    return table.reset_index(drop=True)


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
        raise InputError(f"training {training_id!r} is not in {settings.store_uri}; `thermodrift status` lists them")
    with store_errors(settings):
        folder = mlflow.artifacts.download_artifacts(
            run_id=training_id, artifact_path=_GRID, tracking_uri=settings.store_uri
        )
    try:
        result = GridResult.load(Path(folder))
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"training {training_id}: its tables in {folder} cannot be read ({error})") from None
    tags = run.data.tags
    promotion = json.loads(tags.get("promotion", "{}"))
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
    """Keep the outcome of the promotion on the training."""
    client.set_tag(training_id, "promotion", json.dumps(promotion, ensure_ascii=False))


def _log_parent(
    client: MlflowClient, run_id: str, result: GridResult, rule: PromotionRule, params: dict[str, Any]
) -> None:
    now = int(time.time() * 1000)
    metrics: dict[str, float] = {
        "n_batches": len(result.batches),
        "n_cells": len(result.cells),
        "n_findings": len(result.findings),
    }
    tags: list[RunTag] = []
    if rule.offered(set(result.cells["protocol"])):
        best = choose(result.cells, rule)
        expected = outlook(result, best)
        metrics |= {
            "expected_S_um": expected.S_um, "expected_S_bound90_um": expected.bound_um,
            "leave_batch_out_S_mean_um": expected.leave_batch_out_um, "best_score_um": best.score_um,
            "best_S_mean_um": best.S_mean_um, "best_S_std_um": best.S_std_um,
        }  # fmt: skip
        tags = [RunTag("best", best.name), RunTag("best_cell", best.cell)]
    client.log_batch(
        run_id,
        metrics=[Metric(k, float(v), now, 0) for k, v in metrics.items() if np.isfinite(v)],
        params=[Param(k, str(v)) for k, v in list(params.items())[:100]],
        tags=tags,
    )


def _log_files(client: MlflowClient, run_id: str, result: GridResult, figures: dict[str, bytes]) -> None:
    with tempfile.TemporaryDirectory() as scratch:
        result.save(Path(scratch) / _GRID)
        if figures:
            (Path(scratch) / "figures").mkdir()
        for name, content in figures.items():
            (Path(scratch) / "figures" / name).write_bytes(content)
        client.log_artifacts(run_id, scratch)


def _log_cells(
    client: MlflowClient,
    parent: Run,
    tags: dict[str, str],
    cells: pd.DataFrame,
    result: GridResult,
    rule: PromotionRule,
) -> None:
    """A child run for all cells of one selector and family."""
    selector, family = (str(cells[c].iloc[0]) for c in ("selector", "family"))
    now = int(time.time() * 1000)
    metrics: list[Metric] = []
    for row in cells.to_dict("records"):
        prefix = str(row["protocol"]).replace("-", "_")
        for name in CELL_METRICS:
            if np.isfinite(row[name]):
                metrics.append(Metric(f"{prefix}/{name}", float(row[name]), now, int(row["n_tsp"])))
    options = FAMILIES[family]().options() if family in FAMILIES else {}
    params = {"selector": selector, "family": family, **{f"option.{k}": str(v) for k, v in options.items()}}
    try:
        best = judged(cells, rule).nsmallest(1, "score_um").iloc[0]
    except InputError:  # no score under the rule
        best = None
    if best is not None:
        params |= {"best_n_tsp": str(best["n_tsp"]), "best_inputs": str(best["inputs"])[:6000]}
        metrics.append(Metric("best_score_um", float(best["score_um"]), now, int(best["n_tsp"])))
        s = result.scores
        picked = s[
            (s["protocol"].to_numpy() == best["protocol"]) & (s["selector"].to_numpy() == selector)
            & (s["family"].to_numpy() == family) & (s["n_tsp"].to_numpy() == best["n_tsp"])
        ]  # fmt: skip
        key = f"{str(best['protocol']).replace('-', '_')}/fold_S_um"
        per_fold = picked.groupby("fold", sort=False)["S_um"].mean()
        metrics += [Metric(key, float(v), now, i) for i, v in enumerate(per_fold) if np.isfinite(v)]
    tags = {**tags, "mlflow.parentRunId": parent.info.run_id, "selector": selector, "family": family}
    run_id = client.create_run(parent.info.experiment_id, tags=tags, run_name=f"{selector} × {family}").info.run_id
    log_values(client, run_id, metrics, params)
    client.set_terminated(run_id)


def _training_row(run: Run) -> dict[str, Any]:
    tags = run.data.tags
    promotion = json.loads(tags.get("promotion", "{}"))
    version = f"{promotion['name']} version {promotion['version']}" if promotion else ""
    return {
        "training_id": run.info.run_id,
        "machine": tags["machine"],
        "target": tags["target"],
        "started": started(run),
        "n_batches": int(run.data.metrics.get("n_batches", 0)),
        "best": tags.get("best", ""),
        "score_um": run.data.metrics.get("best_score_um", float("nan")),
        "simulated": tags.get("simulated") == "true",
        "promotion": promotion.get("outcome", ""),
        "model": version,
    }


DIAGNOSIS = "diagnosis"  # in an experiment's name, in the place of the error channel
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
_MAX_CHARACTERS = 5000  # characters of a parameter or tag; the store takes 6000


def log_diagnosis(
    d: Diagnosis,
    batches: Sequence[Batch],
    files: Mapping[str, Path],
    settings: Settings,
    *,
    params: Mapping[str, Any] | None = None,
    say: Say = lambda text: None,
) -> str:
    """Track one diagnosis; returns the run's id.

    Metrics: ``left_out_rms_before/z_um``, ``left_out_rms_after/z_um`` and ``noise_floor/z_um`` by channel, findings,
    probability (of the first one), batches, left_out_batches, left_out_batches_improved, seconds. Tags: verdict,
    mechanism, where, simulated, drafted. The batches are dataset inputs, `files` (name -> path) artifacts.

    Raises:
        WorkError: the store does not answer.
    """
    f = d.findings
    client = open_store(settings, say)
    with store_errors(settings):
        experiment = experiment_id(client, settings, f.machine, DIAGNOSIS, d.simulated)
        tags = {"machine": f.machine, "target": DIAGNOSIS, "kind": "diagnosis", "simulated": yes_or_no(d.simulated)}
        name = f"{f.machine} {DIAGNOSIS} {pd.Timestamp.now():%Y-%m-%d %H:%M}"
        run_id = str(client.create_run(experiment, tags=tags, run_name=name).info.run_id)
        status = "FAILED"
        try:
            now = int(time.time() * 1000)
            metrics = [Metric(k, v, now, 0) for k, v in _diagnosis_metrics(d).items() if math.isfinite(v)]
            shown = {k: str(v)[:_MAX_CHARACTERS] for k, v in {**_diagnosis_params(d), **(params or {})}.items()}
            log_values(client, run_id, metrics, shown, {k: v[:_MAX_CHARACTERS] for k, v in _diagnosis_tags(d).items()})
            client.log_inputs(run_id, datasets=dataset_inputs(_batch_table(batches), DIAGNOSIS))
            for path in files.values():
                client.log_artifact(run_id, str(path))
            status = "FINISHED"
        finally:
            client.set_terminated(run_id, status)
    return run_id


def diagnoses(machine: str | None = None, settings: Settings | None = None) -> pd.DataFrame:
    """Finished diagnoses, newest first, columns `COLUMNS`; mechanism and where of the first finding, else empty.

    Raises:
        WorkError: the store does not answer.
    """
    settings = settings or load()
    client = open_store(settings)
    with store_errors(settings):
        runs = finished_runs(client, "diagnosis")
    table = pd.DataFrame([_diagnosis_row(r) for r in runs], columns=list(DIAGNOSIS_COLUMNS))
    if machine is not None:
        table = table[table["machine"] == machine]
    return table.reset_index(drop=True)


def _diagnosis_metrics(d: Diagnosis) -> dict[str, float]:
    f = d.findings
    rms = f.fit.left_out_rms
    groups = {"left_out_rms_before": rms.before, "left_out_rms_after": rms.after, "noise_floor": rms.noise_floor}
    values: dict[str, float] = {
        f"{group}/{_metric_name(key)}": value
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


def _diagnosis_params(d: Diagnosis) -> dict[str, Any]:
    versions = {f"version.{name}": version(name) for name in _VERSIONS}
    batches = {"machine": d.findings.machine, "batches": ", ".join(d.findings.batches)}
    return {**batches, "version.python": platform.python_version(), **versions}


def _diagnosis_tags(d: Diagnosis) -> dict[str, str]:
    first = d.findings.findings[0] if d.findings.findings else None
    return {
        "verdict": d.findings.verdict,
        "mechanism": first.mechanism if first else "",
        "where": f"{first.where.kind} {first.where.name}" if first else "",
        "drafted": yes_or_no(d.drafted),
    }


def _batch_table(batches: Sequence[Batch]) -> pd.DataFrame:
    rows = [(b.batch_id, b.digest, b.version, b.source, b.n_rows) for b in batches]
    return pd.DataFrame(rows, columns=["batch_id", "digest", "version", "source", "n_rows"])


def _metric_name(key: str) -> str:
    """A name with only characters that the store takes."""
    return re.sub(r"[^\w\-. /:]", "_", key)


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
