"""Thermal error of a recorded run from a stored model: registry, run or folder, from any working directory."""

from __future__ import annotations

import re
from pathlib import Path

import pandas as pd
from mlflow.exceptions import MlflowException

from data.errors import InputError
from pipelines import model_store
from pipelines.model_log import local_folder
from pipelines.model_store import StoredModel
from pipelines.registry import CHAMPION, find_version
from pipelines.settings import Settings
from pipelines.tracking import open_store, store_errors

_REGISTERED = re.compile(r"^models:/(?P<name>[^/@]+)(?:@(?P<alias>.+)|/(?P<version>.+))?$")


def load_model(model_uri: str, settings: Settings) -> StoredModel:
    """The model behind ``models:/NAME@champion``, ``models:/NAME/3``, ``runs:/RUN/model`` or a local folder.

    A name alone means its champion.

    Raises:
        InputError: unknown name, alias, version, run or folder, with the closest.
        WorkError: the store does not answer.
    """
    if model_uri.startswith("models:/"):
        match = _REGISTERED.match(model_uri)
        if match is None:
            raise InputError(f"model {model_uri!r}: expected models:/NAME@alias or models:/NAME/VERSION")
        with store_errors(settings):
            client = open_store(settings)
            version = find_version(client, match["name"], match["alias"] or match["version"] or CHAMPION)
        return model_store.load(Path(local_folder(version.source, settings)))
    if model_uri.startswith("runs:/"):
        run_id = model_uri.removeprefix("runs:/").split("/")[0]
        try:
            open_store(settings).get_run(run_id)
        except MlflowException:
            raise InputError(f"model {model_uri!r}: no run {run_id!r} in {settings.store_uri}") from None
        return model_store.load(Path(local_folder(model_uri, settings)))
    folder = Path(model_uri)
    if not folder.is_dir():
        raise InputError(
            f"model {model_uri!r}: no such folder; expected models:/NAME@champion, models:/NAME/VERSION, "
            "runs:/RUN/model or the folder of a stored model"
        )
    return model_store.load(folder)


def predict_file(model_uri: str, file: Path, settings: Settings) -> pd.DataFrame:
    """Predicted error of every batch in a raw recording, read by the machine file that the model carries.

    Returns:
        batch_id, time_s (s), for an error along an axis position_mm, predicted_um (µm, relative to the batch's start;
        NaN where an input or the position is missing),
        outside_region (the row extrapolates), outside_of (which quantities), distance (how far, in widths of the
        trained range), expected_S_um (what left-out batches so far away were left with; NaN where nobody measured it),
        simulated (model or recording).

    Raises:
        InputError: unknown model, a file that cannot be read, a missing input; one line each.
    """
    from data.recording import read_batches

    model = load_model(model_uri, settings)
    tables = []
    for batch in read_batches(Path(file), model.machine, need_error=False):
        predicted = model.predict(batch)
        outside, distance = model.outside(batch), model.distance(batch)
        along = str(model.family.fitted.get("along", ""))
        tables.append(pd.DataFrame({
            "batch_id": batch.batch_id, "time_s": batch.time_s,
            **({"position_mm": batch.masked(along)} if along else {}), "predicted_um": predicted,
            "outside_region": [bool(o) for o in outside], "outside_of": outside, "distance": distance,
            "expected_S_um": model.expected_S_um(distance), "simulated": model.simulated or batch.simulated,
        }))  # fmt: skip
    if not tables:
        raise InputError(f"recording {file}: no batch in it that machine {model.machine.machine} can read")
    return pd.concat(tables, ignore_index=True)
