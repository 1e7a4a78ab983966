"""Baselines: mean error over the time since the start (and the position along an axis), and zero."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Self

import numpy as np

from data.arrays import Array
from data.sweeps import position_bins
from features.design import Design
from models.base import Family, Plain
from models.numerics.batches import too_few_rows
from models.program import Builder

_NEED = 1  # rows


class MeanCurve(Family):
    """The mean over the training batches of the error at the same time since the start.

    Beyond the longest batch the last value holds; between recorded times it is interpolated. `fitted`: time_s (t,),
    error_um (t,). A channel along an axis has one curve for each position, and between positions it is on a line:
    then `fitted` has along (the position channel), position_mm (m,), and curve k is at first[k] : first[k + 1].
    """

    key = "mean_curve"
    summary = "mean error curve of the training batches over the time since the start"
    source = "baseline"
    uses_inputs = False
    rank = 1

    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        """One fitted copy per fold.

        Raises:
            InputError: no recorded error in a fold.
        """
        position_mm = design.position_mm(design.along) if design.along else np.zeros(len(design.y_um))
        known = np.isfinite(design.y_um) & np.isfinite(position_mm)
        time_s, out = np.round(design.time_s, 6), []
        for fold in folds:
            rows = np.flatnonzero(known & np.isin(design.group, list(fold)))
            if len(rows) < _NEED:
                raise too_few_rows(self.key, design, sorted(set(fold)), len(rows), _NEED)
            bins = position_bins(position_mm[rows])
            at, which = np.unique(bins + 1j * time_s[rows], return_inverse=True)  # by position, then by time
            count = np.bincount(which)
            learned: Plain = {"time_s": at.imag, "error_um": np.bincount(which, design.y_um[rows]) / count}
            if design.along:
                places, first = np.unique(at.real, return_index=True)
                place = np.searchsorted(places, bins)
                mean_mm = np.bincount(place, position_mm[rows]) / np.bincount(place)
                learned |= {"along": design.along, "position_mm": mean_mm, "first": np.append(first, len(count))}
            out.append(self._learned(design, learned))
        return out

    def respond(self, design: Design, batches: Sequence[int]) -> list[Array]:
        time_s, error_um = self.fitted["time_s"], self.fitted["error_um"]
        if "along" not in self.fitted:
            return [np.interp(design.time_s[design.rows(k)], time_s, error_um) for k in batches]
        curves = [slice(a, b) for a, b in pairwise(self.fitted["first"].tolist())]
        position_mm = design.position_mm(self.fitted["along"])
        out = []
        for k in batches:
            rows = design.rows(k)
            at_s = design.time_s[rows]
            table_um = np.array([np.interp(at_s, time_s[c], error_um[c]) for c in curves])
            out.append(_on_line(position_mm[rows], self.fitted["position_mm"], table_um))
        return out

    def operations(self, b: Builder) -> Sequence[int]:
        clock = b.add("clock", [], 1)
        return [b.add("curve", [clock], 1, knots=self.fitted["time_s"], values=self.fitted["error_um"])]

    def n_parameters(self) -> int:
        """Values of the curves."""
        return len(self.fitted.get("error_um", ()))


def _on_line(at_mm: Array, position_mm: Array, table_um: Array) -> Array:
    """Row by row (n,) the table (m, n) at the row's position, linear between the m positions, held beyond; NaN there
    where there is none."""
    if len(position_mm) == 1:
        return np.where(np.isfinite(at_mm), table_um[0], np.nan)
    left = np.clip(np.searchsorted(position_mm, at_mm) - 1, 0, len(position_mm) - 2)
    share = np.clip((at_mm - position_mm[left]) / (position_mm[left + 1] - position_mm[left]), 0.0, 1.0)
    row = np.arange(len(at_mm))
    return np.asarray((1.0 - share) * table_um[left, row] + share * table_um[left + 1, row])


class Zero(Family):
    """Predicts 0 µm: the baseline of every model."""

    key = "zero"
    summary = "no model: predicts zero error"
    source = "baseline"
    uses_inputs = False
    rank = 0

    def fit_design(self, design: Design, train: Sequence[int]) -> Self:
        return self._learned(design, {})

    def respond(self, design: Design, batches: Sequence[int]) -> list[Array]:
        return [np.zeros(len(design.time_s[design.rows(k)])) for k in batches]

    def operations(self, b: Builder) -> Sequence[int]:
        return [b.constant(0.0)]
