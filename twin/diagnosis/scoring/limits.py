"""What these recordings would have shown: the least effect of every candidate, and what would absorb the rest of it."""

from __future__ import annotations

import numpy as np
import pandas as pd

from twin.diagnosis.diagnosis import COLUMNS
from twin.diagnosis.rounds.fitted import Fitted
from twin.diagnosis.scoring.screen import Scored, Screen, one_of_each
from twin.mechanisms import MECHANISMS

SURE = 1.64  # sd beyond the threshold: seen in 95 of 100 such sets of runs
NO_TRACE = 1e100  # sd of an amplitude that changes nothing that was recorded


def limits(fitted: Fitted, seen: Screen, threshold: float) -> pd.DataFrame:
    """Columns of the table `limits`, most sensitive first within each mechanism.

    The amplitude whose expected gain, half its square over its variance beside all that is recalibrated, reaches the
    threshold (the local power of a score test, Cox and Hinkley 1974, §9.3).
    """
    evidence = seen.evidence
    shadow = evidence.shadow
    own = np.sqrt(sum(np.einsum("np,np->p", b.jacobian, b.jacobian) for b in evidence.batches))
    names = [u.name for u in fitted.problem.unknowns]
    rows = []
    for s in one_of_each(seen.scored, _usual):
        c = s.candidate
        if s.column < 0 or c.mechanism not in MECHANISMS or not c.amplitudes:
            continue
        amplitude = max(s.amplitudes, key=lambda a: abs(s.amplitudes[a]))
        spec = MECHANISMS[c.mechanism].spec(amplitude)
        limit = s.sd * (np.sqrt(2.0 * threshold) + SURE)
        by = int(np.argmax(np.abs(shadow[: len(names), s.column]) * own[: len(names)]))
        unseen = limit > max(abs(spec.low), abs(spec.high)) or not np.isfinite(limit)
        rows.append(
            (c.mechanism, c.where.kind, c.where.name, c.words, np.nan if unseen else float(limit), spec.unit,
             s.absorbed, names[by] if s.absorbed > 0.3 else "")
        )  # fmt: skip
    table = pd.DataFrame(rows, columns=list(COLUMNS["limits"]))
    digits = table.assign(size=np.log(table["limit"]).round(9))  # what differs by rounding alone is of equal size
    return digits.sort_values(["mechanism", "size", "name", "words"], ignore_index=True).drop(columns="size")


def _usual(s: Scored) -> tuple[float, ...]:
    """Sorts the one at the usual value of its shape first, or, where that has no trace, the most sensitive."""
    return s.sd > NO_TRACE, bool(s.candidate.variant_of), s.sd
