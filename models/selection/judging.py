"""Scoring of one family: every distinct set of inputs and fold, fitted and scored once."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from data.arrays import Array
from data.errors import InputError
from features.design import Design
from models.base import Family
from models.metrics import batch_scores, coverage, residual_std_um
from models.protocols import Fold
from models.selection.result import CERTAINTY, SCORES

Inputs = tuple[str, ...]
KEPT = ("forward", "leave-batch-out", "leave-season-out", "leave-speed-out")  # protocols whose predictions are kept
_AT_ONCE_BYTES = 128 * 2**20
_FITTED_ON, _FITTED_ON_ITERATIVE = 100, 4  # training batches, evenly chosen, that fitting accuracy is taken from


@dataclass(frozen=True)
class _Column:
    """One fitted model's predictions and, where available, their standard deviations: by batch, (n_k,)."""

    inputs: Inputs
    fold: int
    predicted_um: dict[int, Array]
    sd_um: dict[int, Array]
    fitting_S_um: float | None
    n_parameters: int


@dataclass
class FamilyScores:
    """Every distinct (inputs, fold) of one family, with its scores on every tested batch."""

    column: dict[tuple[Inputs, int], int]
    tested: dict[str, Array]  # score -> (columns, K), NaN where a batch is not tested
    fit_S_um: Array  # (columns,), over the training batches, at most 100 of them, 4 of an iterative family
    kept: dict[int, Array]  # column -> predictions on the rows of the batches that its fold tests, in their order
    n_parameters: NDArray[np.int64]  # (columns,)
    failures: list[tuple[str, str]]  # protocol and what could not be fitted
    keep: frozenset[int]  # folds whose predictions are kept

    @classmethod
    def run(
        cls,
        design: Design,
        family: Family,
        folds: Sequence[Fold],
        needed: Sequence[tuple[Design, list[int]]],
        protocols: Sequence[str],
        keep: bool = True,
    ) -> FamilyScores:
        """Fit and score the folds of all protocols together, since they share most of the work.

        Args:
            needed: each distinct subset of the design's inputs with the folds it is wanted for.
            protocols: of every fold; where a subset cannot be fitted, each protocol's folds are tried by themselves.
            keep: whether to keep the predictions under the protocols of `KEPT`.
        """
        kept = frozenset(i for i, p in enumerate(protocols) if keep and p in KEPT)
        total = sum(len(which) for _, which in needed)
        tested = {name: np.full((total, design.n_batches), np.nan) for name in [*SCORES, *CERTAINTY, "n_rows"]}
        out = cls({}, tested, np.full(total, np.nan), {}, np.zeros(total, np.int64), [], kept)
        most = _FITTED_ON if family.closed_form else _FITTED_ON_ITERATIVE
        trained = [f.train[:: -(-len(f.train) // most)] for f in folds]
        pending: list[_Column] = []
        waiting = 0
        subsets = family.fit_subsets(
            [sub for sub, _ in needed], [[folds[i].train for i in which] for _, which in needed]
        )
        for (sub, which), fitted in zip(needed, subsets, strict=True):
            columns, failures = _columns_or_failures(sub, family, fitted, which, folds, trained, protocols)
            out.failures += failures
            pending += columns
            waiting += sum(p.nbytes for c in columns for p in c.predicted_um.values())
            if waiting > _AT_ONCE_BYTES:
                out._judge(design, folds, trained, pending)
                pending, waiting = [], 0
        out._judge(design, folds, trained, pending)
        return out

    @classmethod
    def of_predictions(cls, design: Design, predicted: Sequence[Mapping[int, Array]]) -> FamilyScores:
        """Of one model per fold, given its predictions (n_k,) of every batch k that the fold tests."""
        empty = {name: np.full((len(predicted), design.n_batches), np.nan) for name in [*SCORES, *CERTAINTY, "n_rows"]}
        kept = {f: np.concatenate(list(own.values())) for f, own in enumerate(predicted)}
        nothing = np.full(len(predicted), np.nan)
        out = cls({}, empty, nothing, kept, np.zeros(len(predicted), np.int64), [], frozenset(kept))
        for f, own in enumerate(predicted):
            for k, values in own.items():
                for name, got in batch_scores(design.y_um[design.rows(k)], values[:, None]).items():
                    out.tested[name][f, k] = got[0]
        return out

    def parameters(self, folds: range) -> int:
        """The most numbers learned from any set of inputs, each on the first of these folds that it is wanted for."""
        first: dict[Inputs, int] = {}
        for (inputs, fold), column in self.column.items():
            if fold in folds:
                first.setdefault(inputs, column)
        return int(self.n_parameters[list(first.values())].max())

    def _judge(
        self, design: Design, folds: Sequence[Fold], trained: Sequence[Sequence[int]], pending: Sequence[_Column]
    ) -> None:
        first = len(self.column)
        fit_S: list[list[float]] = [[] for _ in pending]
        columns_of: dict[int, list[int]] = {}
        for c, column in enumerate(pending):
            for k in column.predicted_um:
                columns_of.setdefault(k, []).append(c)
            if column.fold in self.keep:
                self.kept[first + c] = np.concatenate([column.predicted_um[k] for k in folds[column.fold].test])
        for k, columns in columns_of.items():
            y = design.y_um[design.rows(k)]
            tests = [c for c in columns if k in folds[pending[c].fold].test]
            fits = [c for c in columns if pending[c].fitting_S_um is None and k in trained[pending[c].fold]]
            if tests:
                at = first + np.array(tests)
                for name, values in batch_scores(y, _stacked(pending, tests, k)).items():
                    self.tested[name][at, k] = values
            if sure := [c for c in tests if pending[c].sd_um]:
                sd_um = np.column_stack([pending[c].sd_um[k] for c in sure])
                for name, values in coverage(y, _stacked(pending, sure, k), sd_um).items():
                    self.tested[name][first + np.array(sure), k] = values
            if fits:
                for c, S_um in zip(fits, residual_std_um(y[:, None] - _stacked(pending, fits, k)), strict=True):
                    fit_S[c].append(S_um)
        for c, column in enumerate(pending):
            own = [S_um for S_um in fit_S[c] if np.isfinite(S_um)]
            fitted = column.fitting_S_um
            self.fit_S_um[first + c] = fitted if fitted is not None else sum(own) / max(1, len(own))
            self.n_parameters[first + c] = column.n_parameters
            self.column[column.inputs, column.fold] = first + c

    def left_out(self, folds: Sequence[Fold], columns: NDArray[np.int64]) -> NDArray[np.float32]:
        """Predictions (n,) of one cell, µm, fold after fold on the rows of the batches that it tests."""
        return np.concatenate([self.kept[int(c)] for _, c in zip(folds, columns, strict=True)]).astype(np.float32)


def _columns_or_failures(
    design: Design,
    family: Family,
    fitted: list[Family] | InputError,
    which: Sequence[int],
    folds: Sequence[Fold],
    trained: Sequence[Sequence[int]],
    protocols: Sequence[str],
) -> tuple[list[_Column], list[tuple[str, str]]]:
    """The columns of a subset, and the protocols whose folds cannot be fitted on it, with the reason."""
    try:
        if isinstance(fitted, InputError):
            raise fitted
        return _columns(design, fitted, which, folds, trained), []
    except InputError as error:
        own = dict.fromkeys(protocols[i] for i in which)
        if len(own) == 1:
            return [], [(next(iter(own)), f"{len(design.inputs)} points: {error}")]
    columns: list[_Column] = []
    failures: list[tuple[str, str]] = []
    for protocol in own:
        some = [i for i in which if protocols[i] == protocol]
        (alone,) = family.fit_subsets([design], [[folds[i].train for i in some]])
        more, failed = _columns_or_failures(design, family, alone, some, folds, trained, protocols)
        columns, failures = columns + more, failures + failed
    return columns, failures


def _columns(
    design: Design,
    fitted: Sequence[Family],
    which: Sequence[int],
    folds: Sequence[Fold],
    trained: Sequence[Sequence[int]],
) -> list[_Column]:
    """A family fitted on one set of inputs for some of the folds, with its predictions on what they test."""
    family = fitted[0]
    own_S_um = family.fitting_S_um(design, fitted, [trained[i] for i in which])
    wanted = [folds[i].test if own_S_um is not None else tuple({*folds[i].test, *trained[i]}) for i in which]
    predicted = family.predict_folds(design, fitted, wanted)
    out = []
    for c, (i, model) in enumerate(zip(which, fitted, strict=True)):
        test = folds[i].test
        sd_um = dict(zip(test, model.sd_um(design, test), strict=True)) if model.has_sd else {}
        fitting = None if own_S_um is None else float(own_S_um[c])
        by_batch = dict(zip(wanted[c], predicted[c], strict=True))
        out.append(_Column(design.inputs, i, by_batch, sd_um, fitting, model.n_parameters()))
    return out


def _stacked(pending: Sequence[_Column], columns: Sequence[int], k: int) -> Array:
    return np.column_stack([pending[c].predicted_um[k] for c in columns])


def left_out_by_fold(
    design: Design, folds: Sequence[Fold], predicted_um: Array
) -> list[dict[int, tuple[Array, Array]]]:
    """Kept predictions (rows, m) of m cells, cut into what was recorded (n,) and predicted (n, m) of every batch.

    Returns:
        per fold the batches that it tests.
    """
    found, at = [], 0
    for fold in folds:
        own = {}
        for k in fold.test:
            y_um = design.y_um[design.rows(k)]
            own[k], at = (y_um, predicted_um[at : at + len(y_um)]), at + len(y_um)
        found.append(own)
    return found


def score_table(
    batch_ids: Sequence[str], folds: Sequence[Fold], judged: FamilyScores, columns: NDArray[np.int64], protocol: str
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Scores and their summary for C cells, given each cell's column per fold, `columns` (C, F).

    Returns:
        R rows per cell, cell after cell: a row per fold and tested batch, or for train-on-one a row per fold, summed up
        over the batches that it tests; and one row per cell: accuracy S_mean, robustness S_std, the other scores.
    """
    names = [*SCORES, *CERTAINTY]
    if protocol == "train-on-one":
        fold_names, ids = [f.name for f in folds], ["*"] * len(folds)
        own, place = np.unique(columns, return_inverse=True)
        tested = {name: values[own] for name, values in judged.tested.items()}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # the mean of an empty slice is NaN, as intended
            # max |e| is the greatest of all, every other score a mean over the tested batches.
            per_fold = {n: (np.nanmax if n == "max_abs_um" else np.nanmean)(tested[n], axis=1) for n in names}
            per_fold["S_std_um"] = np.nanstd(tested["S_um"], axis=1, ddof=1)
            per_fold["n_rows"] = np.nansum(tested["n_rows"], axis=1)
        values = {name: column[place].reshape(columns.shape) for name, column in per_fold.items()}
        fit_S_um = judged.fit_S_um[columns]
        spread = values["S_std_um"].mean(axis=1)
    else:
        fold_index = np.concatenate([np.full(len(f.test), i) for i, f in enumerate(folds)])
        batch_index = np.concatenate([f.test for f in folds])
        fold_names, ids = [folds[i].name for i in fold_index], [batch_ids[k] for k in batch_index]
        picked = columns[:, fold_index]
        values = {name: judged.tested[name][picked, batch_index] for name in [*names, "n_rows"]}
        fit_S_um = judged.fit_S_um[picked]
        spread = values["S_um"].std(axis=1, ddof=1) if len(fold_index) > 1 else np.full(len(columns), np.nan)
    values["fit_S_um"] = fit_S_um
    rows = {"fold": np.tile(np.array(fold_names, object), len(columns)), "batch_id": np.tile(ids, len(columns))}
    means = {n: (values[n].max if n == "max_abs_um" else values[n].mean)(axis=1) for n in [*names[1:], "fit_S_um"]}
    summary = {"S_mean_um": values["S_um"].mean(axis=1), "S_std_um": spread, **means, "n_batches": len(fold_names)}
    return pd.DataFrame({**rows, **{n: v.ravel() for n, v in values.items()}}), pd.DataFrame(summary)
