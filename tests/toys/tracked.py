"""A training or a diagnosis tracked in one call, without the steps around it."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from data.batch import Batch
from diagnosis.result import Diagnosis
from models.selection.result import GridResult
from pipelines.settings import Settings
from pipelines.store import tracking


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
