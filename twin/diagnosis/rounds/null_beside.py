"""The structural null of one candidate where the fit has it: what structure would make of it were it not there.

A fit without it is bent: channels are given up, rows remember each other for long, and whatever structure does there
looks large. With the candidate in, parameters and noise stand where they belong; its size goes back among the columns,
and refined machines without it show what it would be given.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from twin.diagnosis.proposals.candidate import Candidate
from twin.diagnosis.proposals.slack import no_news
from twin.diagnosis.rounds.fitted import Fitted
from twin.diagnosis.rounds.null import Null, structural_null
from twin.diagnosis.scoring.evidence import Evidence
from twin.diagnosis.scoring.screen import alone, proposed, screen

TINY = 1e-12
FAR = 10.0  # times the size that was found: no machine without it is given more


def null_beside(before: Fitted, after: Fitted, c: Candidate, seed: int) -> tuple[Null, float] | None:
    """The null, with amplitudes of `c` in its own unit, and the log density of batches left out with `c`.

    None where `c` adds no size of its own to the fit: a value that is doubted, labels that are swapped.
    """
    own = _sizes(before, after, c)
    if not own:
        return None
    every = proposed(after)
    seen, loose = screen(after, every), no_news(every, after)
    evidence = _as_column(seen.evidence, after, own)
    columns = seen.columns({*loose, c.name})
    columns[c.name] = evidence.batches[0].columns.shape[1] - 1
    return structural_null(after, evidence, columns, seed), float(alone(after, after.memory).base_score()[0])


def _sizes(before: Fitted, after: Fitted, c: Candidate) -> list[int]:
    """Numbers of the unknowns that the candidate added, its shape aside."""
    if c.part is None or c.mechanism == "coarse_network":
        return []
    known = {u.name for u in before.problem.unknowns}
    new = [k for k, u in enumerate(after.problem.unknowns) if u.name not in known]
    return [k for k in new if after.problem.unknowns[k].name.rpartition(".")[2] not in c.shape]


def _as_column(evidence: Evidence, after: Fitted, own: list[int]) -> Evidence:
    """The largest of these unknowns as one column more, per unit of its value; all of them no parameters any more."""
    unknowns, network = after.problem.unknowns, after.problem.network
    value = {k: float(after.values[network.index(unknowns[k].name)]) for k in own}
    norm = {k: sum(float(b.jacobian[:, k] @ b.jacobian[:, k]) for b in evidence.batches) for k in own}
    most = max(own, key=lambda k: norm[k])
    slope = {"log": value[most], "logit": value[most] * (1.0 - value[most])}.get(unknowns[most].scale, 1.0)
    unit = unknowns[most].spread * max(slope, TINY)
    batches = tuple(
        replace(
            b,
            jacobian=np.delete(b.jacobian, own, axis=1),
            columns=np.column_stack([b.columns, b.jacobian[:, most] / unit]),
        )
        for b in evidence.batches
    )
    bound = FAR * max(abs(value[most]), TINY)
    low = -bound if unknowns[most].scale == "linear" else 0.0
    return replace(evidence, batches=batches, low=np.append(evidence.low, low), high=np.append(evidence.high, bound))
