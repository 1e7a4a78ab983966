"""A training tracked in one call, without the steps around it."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from models.result import GridResult
from pipelines import tracking
from pipelines.settings import Settings


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
