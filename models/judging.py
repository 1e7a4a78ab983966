"""Judging one family under one protocol: every distinct set of inputs and fold, each fitted and scored once."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from data.errors import InputError
from features.design import Design
from models.base import Family
from models.metrics import batch_scores, coverage
from models.protocols import Fold
from models.result import CERTAINTY, SCORES

Array = NDArray[np.float64]
Inputs = tuple[str, ...]
_COLUMNS_AT_ONCE_BYTES = 128 * 2**20
_FITTED_ON = 4  # training batches that an iterative family's fitting accuracy is taken from


@dataclass(frozen=True)
class _Column:
    """Predictions (n,) of one fitted model on a design's rows, and where it tells them their standard deviations."""

    inputs: Inputs
    fold: int
    predicted_um: Array
    sd_um: Array | None


@dataclass
class Judged:
    """Every distinct (inputs, fold) of one family under one protocol, with its scores on every tested batch."""

    column: dict[tuple[Inputs, int], int]
    tested: dict[str, Array]  # score -> (columns, K), NaN where a batch is not tested
    fit_S_um: Array  # (columns,), over the training batches, of an iterative family over four of them
    kept: dict[int, Array]  # column -> prediction on the fold's tested rows
    n_parameters: int
    failures: list[str]

    @classmethod
    def run(
        cls, design: Design, family: Family, folds: Sequence[Fold], needed: Sequence[tuple[Design, list[int]]]
    ) -> Judged:
        """Fit and judge. `needed`: each distinct subset of the design's inputs with the folds it is wanted for."""
        total = sum(len(which) for _, which in needed)
        tested = {name: np.full((total, design.n_batches), np.nan) for name in [*SCORES, *CERTAINTY, "n_rows"]}
        out = cls({}, tested, np.full(total, np.nan), {}, 0, [])
        pending: list[_Column] = []
        budget = max(1, _COLUMNS_AT_ONCE_BYTES // (8 * max(1, len(design.y_um))))
        trained = [f.train if family.closed_form else f.train[:: -(-len(f.train) // _FITTED_ON)] for f in folds]
        for sub, which in needed:
            try:
                fitted = family.fit_folds(sub, [folds[i].train for i in which])
                predicted = family.predict_folds(sub, fitted, [(*folds[i].test, *trained[i]) for i in which])
                sd_um = [
                    _sd_um(sub, f, folds[i].test) if f.tells_sd else None for f, i in zip(fitted, which, strict=True)
                ]
            except InputError as error:
                out.failures.append(f"{len(sub.inputs)} points: {error}")
                continue
            out.n_parameters = max(out.n_parameters, fitted[0].n_parameters())
            pending += [_Column(sub.inputs, i, predicted[:, c], sd_um[c]) for c, i in enumerate(which)]
            if len(pending) >= budget:
                out._judge(design, folds, trained, pending)
                pending = []
        out._judge(design, folds, trained, pending)
        return out

    def _judge(
        self, design: Design, folds: Sequence[Fold], trained: Sequence[Sequence[int]], pending: list[_Column]
    ) -> None:
        if not pending:
            return
        first = len(self.column)
        predicted = np.column_stack([p.predicted_um for p in pending])
        fold_of = np.array([p.fold for p in pending])
        told = np.array([p.sd_um is not None for p in pending])
        in_test = np.zeros((len(folds), design.n_batches), bool)
        in_train = np.zeros_like(in_test)
        for i, fold in enumerate(folds):
            in_test[i, list(fold.test)] = True
            in_train[i, list(trained[i])] = True
            if len(fold.test) == 1:
                rows = design.rows(fold.test[0])
                self.kept |= {first + int(c): predicted[rows, c] for c in np.flatnonzero(fold_of == i)}
        S_all = np.full((len(pending), design.n_batches), np.nan)
        for k in range(design.n_batches):
            rows = design.rows(k)
            y, p = design.y_um[rows], predicted[rows]
            e = y[:, None] - p
            ok = np.isfinite(e)
            n = ok.sum(axis=0)
            e = np.where(ok, e, 0.0)
            sse = np.einsum("ij,ij->j", e, e)
            with np.errstate(divide="ignore", invalid="ignore"):
                S_all[:, k] = np.where(n > 1, np.sqrt(sse / (n - 1)), np.nan)
            tests = in_test[fold_of, k]
            columns = np.flatnonzero(tests)
            if len(columns):
                for name, values in batch_scores(y, p[:, columns]).items():
                    self.tested[name][first + columns, k] = values
            sure = np.flatnonzero(tests & told)
            if len(sure):
                sd_um = np.column_stack([pending[c].sd_um[rows] for c in sure])  # type: ignore[index]
                for name, values in coverage(y, p[:, sure], sd_um).items():
                    self.tested[name][first + sure, k] = values
        self.fit_S_um[first : first + len(pending)] = _masked_mean(S_all, in_train[fold_of])
        for offset, column in enumerate(pending):
            self.column[column.inputs, column.fold] = first + offset

    def left_out(self, design: Design, folds: Sequence[Fold], columns: NDArray[np.int64]) -> NDArray[np.float32]:
        """Every batch's prediction by the fold that left it out, on all rows of the design, µm."""
        out = np.full(len(design.y_um), np.nan, np.float32)
        for fold, column in zip(folds, columns, strict=True):
            out[design.rows(fold.test[0])] = self.kept[int(column)]
        return out


def _sd_um(design: Design, fitted: Family, batches: Sequence[int]) -> Array:
    """Stated standard deviations (n,) on the rows of some batches, NaN on others."""
    out = np.full(len(design.y_um), np.nan)
    for k, sd_um in zip(batches, fitted.sd_um(design, batches), strict=True):
        out[design.rows(k)] = sd_um
    return out


def _masked_mean(values: Array, where: NDArray[np.bool_]) -> Array:
    ok = where & np.isfinite(values)
    with np.errstate(invalid="ignore"):
        return np.where(ok, values, 0.0).sum(axis=1) / np.maximum(ok.sum(axis=1), 1)


def score_table(
    batch_ids: Sequence[str], folds: Sequence[Fold], judged: Judged, columns: NDArray[np.int64], protocol: str
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Scores and their summary for C cells, given each cell's column per fold, `columns` (C, F).

    Returns:
        R rows per cell, cell after cell: a row per fold and tested batch, or for train-on-one a row per fold, summed up
        over the batches that it tests; and one row per cell: accuracy S_mean, robustness S_std, the other scores.
    """
    told = [*SCORES, *CERTAINTY]
    if protocol == "train-on-one":
        fold_names, ids = [f.name for f in folds], ["*"] * len(folds)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # a mean of nothing is NaN, and that is what is meant
            # max |e| is the greatest of all, every other score a mean over the tested batches.
            per_fold = {n: (np.nanmax if n == "max_abs_um" else np.nanmean)(judged.tested[n], axis=1) for n in told}
            per_fold["S_std_um"] = np.nanstd(judged.tested["S_um"], axis=1, ddof=1)
            per_fold["n_rows"] = np.nansum(judged.tested["n_rows"], axis=1)
        values = {name: column[columns] for name, column in per_fold.items()}
        fit_S_um = judged.fit_S_um[columns]
        spread = values["S_std_um"].mean(axis=1)
    else:
        fold_index = np.concatenate([np.full(len(f.test), i) for i, f in enumerate(folds)])
        batch_index = np.concatenate([f.test for f in folds])
        fold_names, ids = [folds[i].name for i in fold_index], [batch_ids[k] for k in batch_index]
        picked = columns[:, fold_index]
        values = {name: judged.tested[name][picked, batch_index] for name in [*told, "n_rows"]}
        fit_S_um = judged.fit_S_um[picked]
        spread = values["S_um"].std(axis=1, ddof=1) if len(fold_index) > 1 else np.full(len(columns), np.nan)
    values["fit_S_um"] = fit_S_um
    rows = {"fold": np.tile(np.array(fold_names, object), len(columns)), "batch_id": np.tile(ids, len(columns))}
    means = {n: (values[n].max if n == "max_abs_um" else values[n].mean)(axis=1) for n in [*told[1:], "fit_S_um"]}
    summary = {"S_mean_um": values["S_um"].mean(axis=1), "S_std_um": spread, **means, "n_batches": len(fold_names)}
    return pd.DataFrame({**rows, **{n: v.ravel() for n, v in values.items()}}), pd.DataFrame(summary)
