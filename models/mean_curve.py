"""The mean run: what is known of the error from the clock alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np

from data.errors import InputError
from features.design import Design
from models.base import Array, Family

_NEED = 1  # rows


class MeanCurve(Family):
    """The mean over the training batches of the error at the same time since the start.

    Beyond the longest batch the last value holds; between recorded times it is interpolated. `fitted`: time_s (t,),
    error_um (t,).
    """

    key = "mean_curve"
    words = "mean error curve of the training batches over the time since the start"
    source = "baseline"
    effort = "quick"
    uses_inputs = False
    rank = 1

    def fit_design(self, design: Design, train: Sequence[int]) -> Self:
        return self.fit_folds(design, [train])[0]

    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        """One fitted copy per fold.

        Raises:
            InputError: no recorded error in a fold.
        """
        ok = np.isfinite(design.y_um)
        grid_s, place = np.unique(np.round(design.time_s[ok], 6), return_inverse=True)
        count = np.zeros((design.n_batches, len(grid_s)))
        total_um = np.zeros_like(count)
        np.add.at(count, (design.group[ok], place), 1.0)
        np.add.at(total_um, (design.group[ok], place), design.y_um[ok])
        out = []
        for fold in folds:
            train = sorted(set(fold))
            n = count[train].sum(axis=0)
            seen = n > 0
            if seen.sum() < _NEED:
                names = ", ".join(design.batch_ids[k] for k in train) or "(none)"
                raise InputError(
                    f"mean_curve: batches {names} have 0 usable rows (target {design.target!r} recorded and not "
                    f"masked), expected at least {_NEED}; add batches"
                )
            mean_um = total_um[train].sum(axis=0)[seen] / n[seen]
            out.append(self._learned(design, {"time_s": grid_s[seen], "error_um": mean_um}))
        return out

    def predict_design(self, design: Design, batches: Sequence[int]) -> list[Array]:
        time_s, error_um = self.fitted["time_s"], self.fitted["error_um"]
        return [np.interp(design.time_s[design.rows(k)], time_s, error_um) for k in batches]

    def n_parameters(self) -> int:
        """Values of the curve."""
        return len(self.fitted.get("error_um", ()))
