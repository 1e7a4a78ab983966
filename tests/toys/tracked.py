"""A training or a diagnosis tracked in one call, without the steps around it."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
from mlflow.tracking import MlflowClient

from data.batch import Batch
from diagnosis.result import Diagnosis
from models.selection.promotion import choose
from models.selection.result import GridResult
from pipelines.settings import Settings
from pipelines.store import registry, tracking
from tests.toys.training import machine_yaml, toy_batches, toy_model, toy_result


def log_training(
    result: GridResult,
    settings: Settings,
    figures: dict[str, bytes] | None = None,
    params: dict[str, Any] | None = None,
    say: Any = lambda text: None,
) -> str:
    """The training's id (the parent run's)."""
    with tempfile.TemporaryDirectory() as scratch:
        tracking.training_files(Path(scratch), result, figures or {})
        record = tracking.training_record(result, settings.promotion, params)
        return tracking.log_record(record, Path(scratch), settings, say)


def log_diagnosis(
    d: Diagnosis,
    batches: Sequence[Batch],
    files: Mapping[str, Path],
    settings: Settings,
    params: Mapping[str, Any] | None = None,
) -> str:
    """The id of a diagnosis' run."""
    with tempfile.TemporaryDirectory() as scratch:
        for path in files.values():
            shutil.copy(path, scratch)
        return tracking.log_record(tracking.diagnosis_record(d, batches, params), Path(scratch), settings)


def client_of(settings: Settings) -> MlflowClient:
    return MlflowClient(settings.store_uri, registry_uri=settings.store_uri)


def newcomer(
    settings: Settings,
    machine: str,
    S_um: Sequence[float],
    *,
    yaml: str = "",
    batches_given: bool = False,
    findings: Sequence[Mapping[str, Any]] = (),
    **choice: Any,
) -> registry.Newcomer:
    """A tracked training over len(S_um) batches, ready for a promotion; `choice` changes what was chosen."""
    batches = toy_batches(machine, len(S_um))
    result = toy_result(batches, {"none|zero|0": [50.0] * len(S_um), "none|mlr|2": S_um})
    if findings:
        result = replace(result, findings=pd.DataFrame([dict(f) for f in findings]))
    training_id, (model, region) = log_training(result, settings), toy_model(batches)
    chosen, known = replace(choose(result, settings.promotion), **choice), batches if batches_given else ()
    return registry.Newcomer(result, chosen, model, yaml or machine_yaml(machine), training_id, region, known)
