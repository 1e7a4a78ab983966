"""The stored model as MLflow serves it: time_s and input channels in, predicted_um and outside_region out.

MLflow keeps this file next to the model's plain data and runs it at load, so that nothing is pickled.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mlflow
import pandas as pd
from mlflow.pyfunc import PythonModel, PythonModelContext

from pipelines import model_store


class CompensationModel(PythonModel):
    """See `pipelines.model_store.predict_frame`."""

    def load_context(self, context: PythonModelContext) -> None:
        self.stored = model_store.load(Path(context.artifacts["model.json"]).parent)

    def predict(self, context: Any, model_input: pd.DataFrame, params: dict[str, Any] | None = None) -> pd.DataFrame:
        """Predictions for a table, see `model_store.predict_frame`."""
        return model_store.predict_frame(self.stored, model_input)


mlflow.models.set_model(CompensationModel())
