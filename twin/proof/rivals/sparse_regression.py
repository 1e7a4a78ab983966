"""Sparse regression of the residual on all signatures at once: the lasso, its penalty by cross-validation over batches.

Tibshirani (1996); the penalty by the one-standard-error rule (Hastie, Tibshirani and Friedman 2009, §7.10), which
chooses nothing where nothing predicts other batches. Signs that a candidate does not allow are kept out.
"""

from __future__ import annotations

import warnings

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import Lasso, LassoCV
from sklearn.model_selection import GroupKFold

from twin.diagnosis.rounds.search import Search
from twin.proof.rivals.answer import Claim, Reply
from twin.proof.rivals.rows import PlainRows, plain_rows

MOST = 200  # signatures, those that correlate most (sure independence screening, Fan and Lv 2008)
PENALTIES, FOLDS = 30, 5
SHARE = 0.3  # of the largest contribution: a lasso leaves small ones beside every strong one


def sparse_regression(done: Search) -> Reply:
    """Every candidate whose contribution is at least `SHARE` of the largest, the largest first."""
    rows = plain_rows(done.rounds[0])
    if not len(rows.scored):
        return Reply.of([])
    signed, owner = _signed(rows)
    strongest = np.argsort(-(rows.residual @ signed), kind="stable")[:MOST]
    weight = _lasso(signed[:, strongest], rows)
    contribution = np.zeros(len(rows.scored))
    np.maximum.at(contribution, owner[strongest], weight)
    chosen = np.flatnonzero(contribution > SHARE * contribution.max(initial=0.0))
    chosen = chosen[np.argsort(-contribution[chosen], kind="stable")]
    return Reply.of([Claim(rows.scored[k].candidate) for k in chosen])


def _signed(rows: PlainRows) -> tuple[np.ndarray, np.ndarray]:
    """Signatures of length 1 in every direction that is allowed, and the number of each one's candidate."""
    unit = rows.columns / np.linalg.norm(rows.columns, axis=0)
    up, down = np.flatnonzero(rows.high > 0), np.flatnonzero(rows.low < 0)
    return np.hstack([unit[:, up], -unit[:, down]]), np.concatenate([up, down])


def _lasso(columns: np.ndarray, rows: PlainRows) -> np.ndarray:
    """Weights (C,), none negative."""
    folds = min(FOLDS, int(rows.batch.max()) + 1)
    if folds < 2:
        return np.zeros(columns.shape[1])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # the smallest penalties, which are not chosen
        cv = list(GroupKFold(folds).split(columns, groups=rows.batch))
        path = LassoCV(alphas=PENALTIES, cv=cv, positive=True, fit_intercept=False, max_iter=2000, tol=1e-3)
        path.fit(columns, rows.residual)
        mean = path.mse_path_.mean(axis=1)
        best = int(np.argmin(mean))
        error = path.mse_path_[best].std(ddof=1) / np.sqrt(folds)
        penalty = path.alphas_[mean <= mean[best] + error].max()
        chosen = Lasso(penalty, positive=True, fit_intercept=False, max_iter=10000).fit(columns, rows.residual)
    return np.asarray(chosen.coef_)
