"""A fitted model into MLflow as a registered version, and back from wherever MLflow keeps it."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from importlib.metadata import version as installed
from pathlib import Path
from typing import Any

import mlflow
import pandas as pd
from mlflow.exceptions import MlflowException
from mlflow.models import ModelSignature
from mlflow.tracking import MlflowClient
from mlflow.types import ColSpec, Schema

from models.base import Family
from models.trust import Region, Rise
from pipelines import model_store, pyfunc_model
from pipelines.settings import Settings
from pipelines.tracking import open_store, store_errors

_PACKAGES = ("mlflow", "numpy", "pandas", "scipy", "scikit-learn", "pydantic", "PyYAML")


def log_version(
    client: MlflowClient,
    name: str,
    family: Family,
    machine_yaml: str,
    region: Region,
    rise: Rise | None,
    info: dict[str, Any],
    tags: dict[str, str],
    training_id: str,
) -> str:
    """Log a fitted model below its training's run and make a registered version of it; returns its number.

    Models from code: MLflow keeps `pyfunc_model.py` and the plain files of `model_store`; nothing is pickled.
    """
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        model_store.save(folder, family, machine_yaml, region, info, rise)
        stored = model_store.load(folder)
        channels = stored.channels()
        drivers = [d for d in stored.machine.names("driver") if d not in channels]
        signature = ModelSignature(
            inputs=Schema([
                ColSpec("double", "time_s"), *(ColSpec("double", c) for c in channels),
                *(ColSpec("double", d, required=False) for d in drivers), ColSpec("string", "batch_id", required=False),
            ]),
            outputs=Schema([ColSpec("double", "predicted_um"), ColSpec("boolean", "outside_region")]),
        )  # fmt: skip
        with mlflow.start_run(run_id=training_id):
            logged = mlflow.pyfunc.log_model(
                name="model",
                python_model=str(Path(pyfunc_model.__file__).resolve()),
                artifacts={f: str(folder / f) for f in model_store.FILES},
                signature=signature,
                input_example=_example(stored, [*channels, *drivers]),
                pip_requirements=_requirements(family),
            )
    try:
        client.create_registered_model(name, tags={"machine": tags["machine"], "target": tags["target"]})
    except MlflowException as error:
        if error.error_code != "RESOURCE_ALREADY_EXISTS":
            raise
    made = client.create_model_version(name, logged.model_uri, run_id=training_id, tags=tags, model_id=logged.model_id)
    return str(made.version)


def local_folder(uri: str, settings: Settings) -> str:
    """Where the files of a model lie on this machine; fetched if the store is elsewhere."""
    open_store(settings)
    with store_errors(settings):
        return str(mlflow.artifacts.download_artifacts(artifact_uri=uri, tracking_uri=settings.store_uri))


def _example(stored: model_store.StoredModel, channels: Sequence[str]) -> pd.DataFrame:
    """Three rows in the middle of each channel's plausible range."""
    step_s = stored.machine.recording.step_s
    columns: dict[str, list[float]] = {"time_s": [0.0, step_s, 2 * step_s]}
    for c in channels:
        low, high = stored.machine.channels[c].range or (20.0, 20.0)
        columns[c] = [0.5 * (low + high)] * 3
    return pd.DataFrame(columns)


def _requirements(family: Family) -> list[str]:
    torch = ("torch",) if hasattr(sys.modules[type(family).__module__], "torch") else ()
    return [f"{p}=={installed(p).partition('+')[0]}" for p in (*_PACKAGES, *torch)]
