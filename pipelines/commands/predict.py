"""`thermodrift predict`: the thermal error of a recorded run from a stored model."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from data.errors import InputError, check_suffix
from data.files import check_folder
from data.units import error_column, in_error_unit
from pipelines.commands import load_settings

if TYPE_CHECKING:
    import pandas as pd

    from data.batch import Batch
    from pipelines.settings import Settings
    from pipelines.store.model_store import StoredModel

_NAMED = 3  # flagged runs in the summary line
_STATED = ("expected_S_um", "expected_S_bound90_um", "expected_S_alone_um")  # by the training, kept with the model


def load_model(model_uri: str, settings: Settings) -> StoredModel:
    """The model behind ``models:/NAME@champion``, ``models:/NAME/3``, ``runs:/RUN/model`` or a local folder.

    A name alone means its champion, without one its provisional version. A local folder needs no MLflow.

    Raises:
        InputError: unknown name, alias, version, run or folder, with the closest.
        WorkError: the store does not answer.
    """
    from pipelines.store import model_store

    return model_store.load(model_folder(model_uri, settings))


def model_folder(model_uri: str, settings: Settings) -> Path:
    """The local folder of its files; downloaded where the store is remote. Raises as `load_model`."""
    if not model_uri.startswith(("models:/", "runs:/")):
        if not Path(model_uri).is_dir():
            raise InputError(
                f"model {model_uri!r}: no such folder; expected models:/NAME@champion, models:/NAME/VERSION, "
                "runs:/RUN/model or the folder of a stored model"
            )
        return Path(model_uri)
    from pipelines.store import lookups
    from pipelines.store.model_store import registered, verified

    if model_uri.startswith("runs:/"):
        return _run_folder(model_uri, settings)
    named = registered(model_uri)
    if named is None:
        raise InputError(f"model {model_uri!r}: expected models:/NAME@alias or models:/NAME/VERSION")
    known = lookups.kept(settings)
    place = known.place(*named)
    if place is None:
        from pipelines.store.registry import look_up

        place = look_up(*named, known, settings)
    return verified(Path(place.folder), place.sha256)


def _run_folder(model_uri: str, settings: Settings) -> Path:
    from mlflow.exceptions import MlflowException

    from pipelines.store.registry import local_folder
    from pipelines.store.tracking import open_store

    run_id = model_uri.removeprefix("runs:/").split("/")[0]
    try:
        open_store(settings).get_run(run_id)
    except MlflowException:
        raise InputError(f"model {model_uri!r}: no run {run_id!r} in {settings.store_name}") from None
    return Path(local_folder(model_uri, settings))


def predict_file(model_uri: str, file: Path, settings: Settings) -> pd.DataFrame:
    """Predicted error of every batch in a raw recording, read and checked by the machine file that the model carries.

    Returns:
        The table of `predict_batches`.

    Raises:
        InputError: unknown model, a file that cannot be read, a missing input; one line each.
    """
    from data.account import Account
    from pipelines.jobs.recordings import checked_files

    model = load_model(model_uri, settings)
    batches = checked_files(model.machine, [Path(file)], need_error=False, channels=model.channels())
    table = predict_batches(model, batches)
    if table is None:
        raise InputError(f"recording {file}: no batch in it that machine {model.machine.machine} can read")
    table.attrs["account"] = Account.of(batches).as_dict()
    return table


def predict_batches(model: StoredModel, batches: Iterable[Batch]) -> pd.DataFrame | None:
    """Predicted error of batches, batch after batch; None without any.

    Returns:
        batch_id, time_s (s), for an error along an axis position_mm, predicted_um (relative to the batch's start; NaN
        where an input or the position is missing), outside_region (the row extrapolates), outside_of (which
        quantities), distance (in widths of the trained range), authority (the share of the correction that is sent at
        this distance), of the whole run expected_S_um, bound90_S_um (nine runs in ten stay below) and flagged (why the
        run is unlike those that the bound comes from, empty where it is not), unit (of the error; where it is not um,
        predicted_error, expected_S_error and bound90_S_error take the place of the columns in um), simulated (model or
        recording), standing (of the model: champion, provisional or refused).

    Raises:
        InputError: an input of the model is missing.
    """
    import pandas as pd

    tables = []
    unit = model.machine.channels[model.family.target].unit
    for batch in batches:
        predicted = model.predict(batch)
        outside, distance, run = model.outside(batch), model.distance(batch), model.run_error(batch, predicted)
        along = str(model.family.fitted.get("along", ""))
        tables.append(pd.DataFrame({
            "batch_id": batch.batch_id, "time_s": batch.time_s,
            **({"position_mm": batch.masked(along)} if along else {}), "predicted_um": predicted,
            "outside_region": [bool(o) for o in outside], "outside_of": outside, "distance": distance,
            "authority": model.weight(distance),
            **run._asdict(), "unit": unit, "simulated": model.simulated or batch.simulated, "standing": model.standing,
        }))  # fmt: skip
    if not tables:
        return None
    names = {n: error_column(n, unit) for n in ("predicted_um", "expected_S_um", "bound90_S_um")}
    table = pd.concat(tables, ignore_index=True).rename(columns=names)
    table.attrs["training"] = {k: float(model.info[k]) for k in _STATED if k in model.info}
    return table


def summary(table: pd.DataFrame) -> str:
    """One line on the error to expect, and a warning where runs are flagged or rows lie outside the trained region.

    Args:
        table: of `predict_batches`.
    """
    from models.selection.trust import quantity_label
    from reports.labels import count

    unit = str(table["unit"].iloc[0])
    runs = table.groupby("batch_id", sort=False).first()
    runs = runs.rename(columns={error_column(c, unit): c for c in ("expected_S_um", "bound90_S_um")})
    expected, most = (_between(runs[c]) for c in ("expected_S_um", "bound90_S_um"))
    number = f"expect S {expected}, 90 % below {most}" if expected else "no expected error is stored; train again"
    stated = _stated(table.attrs.get("training", {})) if expected else ""
    parts = [f"{count(len(runs), 'run')}: {number}"]
    if (standing := table["standing"].iloc[0]) != "champion":
        parts.insert(0, f"{standing} model")
    flagged = runs[runs["flagged"] != ""]
    for run in flagged[:_NAMED].itertuples():
        may = f": error may exceed {run.bound90_S_um:.2g} µm" if expected else ""
        parts.append(f"run {run.Index} is unlike the training ({run.flagged}){may}")
    if len(flagged) > _NAMED:
        parts.append(f"and {len(flagged) - _NAMED} more, see column flagged")
    if (rows := table["outside_region"]).any():
        every = (n for text in table.loc[rows, "outside_of"].unique() for n in text.split(", "))
        names = dict.fromkeys(map(quantity_label, every))
        parts.append(f"{rows.sum()} of {len(rows)} rows are outside the trained range ({', '.join(names)})")
    warns = "warning: " if len(parts) > 1 else ""
    return in_error_unit(f"{warns}{'; '.join(parts)}{stated}", unit)


def _stated(training: Mapping[str, float]) -> str:
    """What the training stated, which is of another model or of any run; "" where the model keeps none."""
    S_um, bound_um, alone_um = (training.get(k, math.nan) for k in _STATED)
    if not math.isfinite(S_um):
        return ""
    choosing = f", with the cost of choosing a model ({alone_um:.2g} µm by this one alone)" * (S_um > alone_um)
    return (
        f". The training stated for any run of the next season S {S_um:.2g} µm, 90 % below {bound_um:.2g} µm{choosing}"
    )


def _between(values_um: pd.Series) -> str:
    """ "4.8 µm" or "4.8 to 7.2 µm"; empty where nothing is known."""
    texts = dict.fromkeys(f"{v:.2g}" for v in sorted(values_um.dropna()))
    ends = list(texts)[:: max(1, len(texts) - 1)]
    return f"{' to '.join(ends)} µm" if ends else ""


def as_cell(name: str) -> str:
    """A name as a spreadsheet takes it for text: one that begins like a formula gets an apostrophe before it."""
    return f"'{name}" if re.match(r"[=@+\-\t\r](?![\d.]*$)", name) else name


def predict(
    file: Annotated[Path, typer.Argument(help="a raw recording of the model's machine")],
    model: Annotated[str, typer.Option("--model", help="models:/NAME, models:/NAME/3, runs:/… or a folder")],
    to: Annotated[Path | None, typer.Option("--out", help=".csv or .parquet; default: CSV on standard output")] = None,
) -> None:
    """Predict the error of a recording, with the error to expect; runs unlike the training are flagged."""
    from pipelines import console

    settings = load_settings()
    if to is not None:
        check_suffix("--out", to, (".csv", ".parquet"))
        check_folder(to.parent, (), overwrite=True)
    table = predict_file(model, file, settings)
    if to is not None and to.suffix == ".parquet":
        table.to_parquet(to, index=False)
    else:
        of_names = {"batch_id": table["batch_id"].map(as_cell)}
        table.assign(**of_names).to_csv(sys.stdout if to is None else to, index=False)
    if table["simulated"].any():
        console.note("SIMULATED model or recordings")
    console.note(summary(table))
    console.note(table.attrs["account"]["summary"])
