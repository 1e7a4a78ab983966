"""The stored model as MLflow serves it: time_s and input channels in, predicted_um and outside_region out.

MLflow keeps this file next to the model's plain data and runs it at load, so that nothing is pickled. Where
thermodrift is installed, the model predicts as it does there. Elsewhere its ONNX files do, with numpy, pandas and
onnxruntime alone.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import mlflow
import numpy as np
import pandas as pd
from mlflow.pyfunc import PythonModel, PythonModelContext

SERVED = ("serving.json", "model.onnx", "region.onnx")  # only of families that are programs
_SLACK = 0.05  # of a region's width, as in models.selection.trust


class CompensationModel(PythonModel):
    """See `pipelines.store.model_store.predict_frame`."""

    def load_context(self, context: PythonModelContext) -> None:
        folder = Path(context.artifacts["model.json"]).parent
        try:
            from pipelines.store import model_store
        except ImportError:
            self.predict_frame = Served(folder).predict
            return
        stored = model_store.load(folder)
        self.predict_frame = lambda table: model_store.predict_frame(stored, table)

    def predict(self, context: Any, model_input: pd.DataFrame, params: dict[str, Any] | None = None) -> pd.DataFrame:
        """Predictions for a table, see `model_store.predict_frame`."""
        return self.predict_frame(model_input)


class Served:
    """A model that needs nothing of thermodrift.

    Raises:
        RuntimeError: the family is no program and needs thermodrift, or a file is other than it was stored.
    """

    def __init__(self, folder: Path) -> None:
        stored = json.loads((folder / "model.json").read_text(encoding="utf-8"))
        if not (folder / "serving.json").exists():
            family = stored.get("family")
            raise RuntimeError(
                f"a model of the family {family} is no ONNX file; install thermodrift where it is to be loaded, or "
                "promote a model of another family"
            )
        for name in SERVED:
            noted = stored.get("sha256", {}).get(name)
            if hashlib.sha256((folder / name).read_bytes()).hexdigest() != noted:
                raise RuntimeError(
                    f"model folder {folder}: {name} is not the file that was promoted; load the model from the "
                    "registry again, or promote it again"
                )
        import onnxruntime

        self.stated = json.loads((folder / "serving.json").read_text(encoding="utf-8"))
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3  # errors alone
        options.intra_op_num_threads = 1  # a row is small
        self.model, self.region = (
            onnxruntime.InferenceSession(str(folder / name), options, ["CPUExecutionProvider"]) for name in SERVED[1:]
        )
        region = self.stated["region"]
        self.low, self.high, self.width = (np.array(region[k], float) for k in ("low", "high", "width"))
        self.pattern = {k: np.array(region[k], float) for k in ("centre", "directions", "least", "most", "spread")}

    def predict(self, table: pd.DataFrame) -> pd.DataFrame:
        """predicted_um (µm) and outside_region, in the row order of the table; a column batch_id cuts it into batches.

        Raises:
            ValueError: a column is missing, or the rows of a batch have another step than the model's.
        """
        absent = [c for c in ("time_s", *self.stated["required"]) if c not in table]
        if absent:
            raise ValueError(f"table: no column {', '.join(map(repr, absent))}; the model needs it")
        parts = [np.arange(len(table))]
        if "batch_id" in table and table["batch_id"].notna().any():
            parts = [np.asarray(rows) for rows in table.groupby("batch_id", sort=False).indices.values()]
        predicted, outside = np.full(len(table), np.nan), np.zeros(len(table), bool)
        for rows in parts:
            part = table.iloc[rows]
            self._check_step(part["time_s"].to_numpy(float))
            predicted[rows] = self._run(self.model, self.stated["channels"], part)[:, 0]
            beyond = self._beyond(self._run(self.region, self.stated["watched"], part)) > _SLACK
            outside[rows] = beyond | np.isnan(predicted[rows])
        return pd.DataFrame({"predicted_um": predicted, "outside_region": outside}, index=table.index)

    def _check_step(self, time_s: Any) -> None:
        step_s, rises_s = self.stated["step_s"], np.diff(time_s)
        if len(rises_s) and not np.allclose(rises_s, step_s, rtol=0.01):
            raise ValueError(
                f"table: 'time_s' rises by {rises_s.min():g} to {rises_s.max():g} s; the model steps by {step_s:g} s: "
                "bring the rows to that step, or install thermodrift, which takes any"
            )

    def _run(self, session: Any, channels: list[str], part: pd.DataFrame) -> Any:
        rows = np.column_stack([
            part[c].to_numpy(float) if c in part else np.full(len(part), np.nan) for c in channels
        ] or [np.empty((len(part), 0))])  # fmt: skip
        return session.run(None, {"rows": rows})[0]

    def _beyond(self, watched: Any) -> Any:
        """Distance (n,) from the trained region in its widths, 0 inside."""
        beyond = np.maximum(np.maximum(self.low - watched, watched - self.high), 0.0) / self.width
        far = np.nan_to_num(beyond, nan=0.0).max(axis=1, initial=0.0)
        points, p = self.stated["region"]["points"], self.pattern
        if len(points) > 1:
            scores = (watched[:, points] - p["centre"]) @ p["directions"]
            off = np.maximum(np.maximum(p["least"] - scores, scores - p["most"]), 0.0) / p["spread"]
            far = np.maximum(far, np.nan_to_num(off, nan=0.0).max(axis=1))
        return far


mlflow.models.set_model(CompensationModel())
