"""Models of a study trained on stated batches and judged on every batch of its design."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from features.design import Design
from features.selectors import SELECTORS
from models.base import Family
from models.metrics import residual_std_um

Array = NDArray[np.float64]
Inputs = tuple[str, ...]


def choices(design: Design, selector: str, trains: Sequence[Sequence[int]], n_tsp: int) -> list[Inputs]:
    """The inputs that a selector takes in every training set, from that set alone."""
    return [SELECTORS[selector]().select_design(design, train, [n_tsp])[n_tsp] for train in trains]


def predictions_um(design: Design, family: Family, trains: Sequence[Sequence[int]], inputs: Sequence[Inputs]) -> Array:
    """Predictions (n, F) on all rows by F models, model f fitted on the batches `trains[f]` with `inputs[f]`."""
    everything = range(design.n_batches)
    out = np.empty((len(design.y_um), len(trains)))
    for same in dict.fromkeys(inputs):
        which = [f for f, i in enumerate(inputs) if i == same]
        part = design.subset(same)
        fitted = family.fit_folds(part, [trains[f] for f in which])
        for f, batches in zip(which, family.predict_folds(part, fitted, [everything] * len(which)), strict=True):
            out[:, f] = np.concatenate(batches)
    return out


def residual_stds_um(design: Design, predicted_um: Array) -> Array:
    """S (F, K) in µm of F models on K batches."""
    error_um = design.y_um[:, None] - predicted_um
    return np.array(
        [[residual_std_um(error_um[design.rows(k), f]) for k in range(design.n_batches)]
         for f in range(predicted_um.shape[1])]
    )  # fmt: skip


def accuracy_and_robustness_um(S_um: Array, tested: NDArray[np.bool_]) -> tuple[float, float]:
    """Mean over the models of the mean and of the std (ddof 1) of S (F, K) over the batches each is tested on."""
    rows = [s[t] for s, t in zip(S_um, tested, strict=True)]
    return float(np.mean([r.mean() for r in rows])), float(np.mean([r.std(ddof=1) for r in rows]))
