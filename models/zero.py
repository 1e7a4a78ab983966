"""No model: the error as it would stand without compensation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np

from features.design import Design
from models.base import Array, Family


class Zero(Family):
    """Predicts 0 µm: the line that every model has to beat."""

    key = "zero"
    words = "no model: predicts zero error"
    source = "baseline"
    effort = "quick"
    uses_inputs = False
    rank = 0

    def fit_design(self, design: Design, train: Sequence[int]) -> Self:
        return self._learned(design, {})

    def predict_design(self, design: Design, batches: Sequence[int]) -> list[Array]:
        return [np.zeros(len(design.time_s[design.rows(k)])) for k in batches]
