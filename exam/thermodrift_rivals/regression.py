"""The candidate whose signature correlates most with the residual of the recalibrated network."""

from __future__ import annotations

import warnings

import numpy as np
from scipy.stats import t as student
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import Lasso, LassoCV
from sklearn.model_selection import GroupKFold

from diagnosis.search.search import Search
from thermodrift_rivals.base import Claim, PlainRows, Reply, plain_rows

SIGNIFICANT = 0.01  # for all candidates together (Bonferroni)
ALIKE = 0.95  # of the largest correlation: as good an explanation


def raw_correlation(done: Search) -> Reply:
    """Pearson's correlation over all rows and channels, of the sign that the candidate allows.

    Claimed if significant for independent rows; candidates of nearly equal correlation are reported as alike.
    """
    rows = plain_rows(done.rounds[0])
    size = np.linalg.norm(rows.residual) * np.linalg.norm(rows.columns, axis=0)
    r = (rows.residual @ rows.columns) / size
    strength = np.where(((r > 0) & (rows.high > 0)) | ((r < 0) & (rows.low < 0)), np.abs(r), 0.0)
    if not len(strength):
        return Reply.of([])
    best = int(np.argmax(strength))
    dof = len(rows.residual) - 2
    statistic = strength[best] * np.sqrt(dof / max(1.0 - strength[best] ** 2, 1e-12))
    if 2.0 * student.sf(statistic, dof) * len(strength) > SIGNIFICANT:
        return Reply.of([])
    order = [int(k) for k in np.argsort(-strength) if strength[k] >= ALIKE * strength[best]]
    alike = tuple(rows.scored[k].candidate for k in order if k != best)
    return Reply.of([Claim(rows.scored[best].candidate, alike=alike)])


MOST = 200  # signatures, those that correlate most (sure independence screening, Fan and Lv 2008)
PENALTIES, FOLDS = 30, 5
SHARE = 0.3  # of the largest contribution: a lasso keeps small coefficients next to every strong one


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
