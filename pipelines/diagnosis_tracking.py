"""Diagnoses in MLflow: a run each, in the machine's experiment "diagnosis", with every file of OUT as an artifact."""

from __future__ import annotations

import math
import platform
import re
import time
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pandas as pd
from mlflow.entities import Metric, Run

from data.batch import Batch
from diagnosis.result import Diagnosis
from pipelines.settings import Settings, load
from pipelines.tracking import (
    dataset_inputs,
    experiment_id,
    finished_runs,
    log_values,
    open_store,
    started,
    store_errors,
    yes_or_no,
)

TARGET = "diagnosis"  # stands where an experiment's name has the error channel
COLUMNS = ("run_id", "machine", "started", "n_batches", "verdict", "mechanism", "where", "probability", "simulated")
_PACKAGES = ("thermodrift", "numpy", "scipy", "pandas", "mlflow")
_LONGEST = 5000  # characters of a parameter or tag; the store takes 6000


def log_diagnosis(
    d: Diagnosis,
    batches: Sequence[Batch],
    files: Mapping[str, Path],
    settings: Settings,
    *,
    params: Mapping[str, Any] | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> str:
    """Track one diagnosis and give back the run's id.

    Metrics: ``left_out_rms_before/z_um``, ``left_out_rms_after/z_um`` and ``noise_floor/z_um`` by channel, findings,
    probability (of the first one), batches, left_out_batches, left_out_batches_improved, seconds. Tags: verdict,
    mechanism, where, simulated, drafted. The batches are dataset inputs, `files` (name -> path) artifacts.

    Raises:
        WorkError: the store does not answer.
    """
    f = d.findings
    client = open_store(settings, say)
    with store_errors(settings):
        experiment = experiment_id(client, settings, f.machine, TARGET, d.simulated)
        tags = {"machine": f.machine, "target": TARGET, "kind": "diagnosis", "simulated": yes_or_no(d.simulated)}
        name = f"{f.machine} {TARGET} {pd.Timestamp.now():%Y-%m-%d %H:%M}"
        run_id = str(client.create_run(experiment, tags=tags, run_name=name).info.run_id)
        status = "FAILED"
        try:
            now = int(time.time() * 1000)
            metrics = [Metric(k, v, now, 0) for k, v in _metrics(d).items() if math.isfinite(v)]
            told = {k: str(v)[:_LONGEST] for k, v in {**_params(d), **(params or {})}.items()}
            log_values(client, run_id, metrics, told, {k: v[:_LONGEST] for k, v in _tags(d).items()})
            client.log_inputs(run_id, datasets=dataset_inputs(_seen(batches), TARGET))
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
    table = pd.DataFrame([_row(r) for r in runs], columns=list(COLUMNS))
    if machine is not None:
        table = table[table["machine"] == machine]
    return table.reset_index(drop=True)


def _metrics(d: Diagnosis) -> dict[str, float]:
    f = d.findings
    rms = f.fit.left_out_rms
    groups = {"left_out_rms_before": rms.before, "left_out_rms_after": rms.after, "noise_floor": rms.noise_floor}
    told: dict[str, float] = {
        f"{group}/{_metric_name(key)}": value
        for group, values in groups.items()
        for key, value in values.items()
        if value is not None
    }
    told |= {"findings": len(f.findings), "batches": len(f.batches)}
    told |= {"left_out_batches": f.fit.batches, "left_out_batches_improved": f.fit.batches_improved}
    if f.seconds is not None:
        told["seconds"] = f.seconds
    if f.findings:
        told["probability"] = f.findings[0].probability
    return {k: float(v) for k, v in told.items()}


def _params(d: Diagnosis) -> dict[str, Any]:
    versions = {f"version.{name}": version(name) for name in _PACKAGES}
    batches = {"machine": d.findings.machine, "batches": ", ".join(d.findings.batches)}
    return {**batches, "version.python": platform.python_version(), **versions}


def _tags(d: Diagnosis) -> dict[str, str]:
    first = d.findings.findings[0] if d.findings.findings else None
    return {
        "verdict": d.findings.verdict,
        "mechanism": first.mechanism if first else "",
        "where": f"{first.where.kind} {first.where.name}" if first else "",
        "drafted": yes_or_no(d.drafted),
    }


def _seen(batches: Sequence[Batch]) -> pd.DataFrame:
    rows = [(b.batch_id, b.digest, b.version, b.source, b.n_rows) for b in batches]
    return pd.DataFrame(rows, columns=["batch_id", "digest", "version", "source", "n_rows"])


def _metric_name(key: str) -> str:
    """With the characters that the store takes."""
    return re.sub(r"[^\w\-. /:]", "_", key)


def _row(run: Run) -> dict[str, Any]:
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
