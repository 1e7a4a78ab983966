"""The candidate whose signature looks most like the residual of the recalibrated network."""

from __future__ import annotations

import numpy as np
from scipy.stats import t as student

from twin.diagnosis.rounds.search import Search
from twin.proof.rivals.answer import Claim, Reply
from twin.proof.rivals.rows import plain_rows

SIGNIFICANT = 0.01  # for all candidates together (Bonferroni)
ALIKE = 0.95  # of the largest correlation: as good an explanation


def raw_correlation(done: Search) -> Reply:
    """Pearson's correlation over all rows and channels, of the sign that the candidate allows.

    Claimed if it is significant for independent rows; what correlates nearly as much is told as alike.
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
