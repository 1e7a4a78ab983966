"""`thermodrift predict`: the thermal error of a recorded run from a stored model."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from data.errors import InputError, check_suffix

if TYPE_CHECKING:
    import pandas as pd

    from data.batch import Batch
    from pipelines.model_store import StoredModel
    from pipelines.settings import Settings

_REGISTERED = re.compile(r"^models:/(?P<name>[^/@]+)(?:@(?P<alias>.+)|/(?P<version>.+))?$")


def load_model(model_uri: str, settings: Settings) -> StoredModel:
    """The model behind ``models:/NAME@champion``, ``models:/NAME/3``, ``runs:/RUN/model`` or a local folder.

    A name alone means its champion. A local folder needs no MLflow.

    Raises:
        InputError: unknown name, alias, version, run or folder, with the closest.
        WorkError: the store does not answer.
    """
    from pipelines import model_store

    if not model_uri.startswith(("models:/", "runs:/")):
        if not Path(model_uri).is_dir():
            raise InputError(
                f"model {model_uri!r}: no such folder; expected models:/NAME@champion, models:/NAME/VERSION, "
                "runs:/RUN/model or the folder of a stored model"
            )
        return model_store.load(Path(model_uri))
    from mlflow.exceptions import MlflowException

    from pipelines.registry import CHAMPION, find_version, local_folder
    from pipelines.tracking import open_store, store_errors

    if model_uri.startswith("runs:/"):
        run_id = model_uri.removeprefix("runs:/").split("/")[0]
        try:
            open_store(settings).get_run(run_id)
        except MlflowException:
            raise InputError(f"model {model_uri!r}: no run {run_id!r} in {settings.store_uri}") from None
        return model_store.load(Path(local_folder(model_uri, settings)))
    match = _REGISTERED.match(model_uri)
    if match is None:
        raise InputError(f"model {model_uri!r}: expected models:/NAME@alias or models:/NAME/VERSION")
    with store_errors(settings):
        client = open_store(settings)
        version = find_version(client, match["name"], match["alias"] or match["version"] or CHAMPION)
    return model_store.load(Path(local_folder(version.source, settings)))


def predict_file(model_uri: str, file: Path, settings: Settings) -> pd.DataFrame:
    """Predicted error of every batch in a raw recording, read by the machine file that the model carries.

    Returns:
        The table of `predict_batches`.

    Raises:
        InputError: unknown model, a file that cannot be read, a missing input; one line each.
    """
    from data.recording import read_batches

    model = load_model(model_uri, settings)
    table = predict_batches(model, read_batches(Path(file), model.machine, need_error=False))
    if table is None:
        raise InputError(f"recording {file}: no batch in it that machine {model.machine.machine} can read")
    return table


def predict_batches(model: StoredModel, batches: Iterable[Batch]) -> pd.DataFrame | None:
    """Predicted error of batches, batch after batch; None without any.

    Returns:
        batch_id, time_s (s), for an error along an axis position_mm, predicted_um (µm, relative to the batch's start;
        NaN where an input or the position is missing), outside_region (the row extrapolates), outside_of (which
        quantities), distance (in widths of the trained range), expected_S_um (S of left-out batches at that distance;
        NaN where it was not measured), simulated (model or recording).

    Raises:
        InputError: an input of the model is missing.
    """
    import pandas as pd

    tables = []
    for batch in batches:
        predicted = model.predict(batch)
        outside, distance = model.outside(batch), model.distance(batch)
        along = str(model.family.fitted.get("along", ""))
        tables.append(pd.DataFrame({
            "batch_id": batch.batch_id, "time_s": batch.time_s,
            **({"position_mm": batch.masked(along)} if along else {}), "predicted_um": predicted,
            "outside_region": [bool(o) for o in outside], "outside_of": outside, "distance": distance,
            "expected_S_um": model.expected_S_um(distance), "simulated": model.simulated or batch.simulated,
        }))  # fmt: skip
    return pd.concat(tables, ignore_index=True) if tables else None


def predict(
    file: Annotated[Path, typer.Argument(help="a raw recording of the model's machine")],
    model: Annotated[str, typer.Option("--model", help="models:/NAME@champion, models:/NAME/3, runs:/… or a folder")],
    to: Annotated[Path | None, typer.Option("--out", help=".csv or .parquet; default: CSV on standard output")] = None,
) -> None:
    """Predict the error of a recording; rows outside the trained region are marked."""
    from pipelines.settings import configure_environment, load

    configure_environment()
    if to is not None:
        check_suffix("--out", to, (".csv", ".parquet"))
    table = predict_file(model, file, load())
    if to is not None and to.suffix == ".parquet":
        table.to_parquet(to, index=False)
    else:
        table.to_csv(sys.stdout if to is None else to, index=False)
