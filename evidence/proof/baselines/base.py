"""Replies of baselines and ablations in the form of a diagnosis: a verdict and findings, the best first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from diagnosis.candidates.discretisation import never_reported, slack
from diagnosis.contracts import Candidate, Scored
from diagnosis.fitting.regression import Whitened
from diagnosis.screening.evidence import Evidence
from diagnosis.search.decision import Round

MIN_ALIKE_SHARE = 0.1  # of the first explanation's probability: less likely ones are not in the reported set


@dataclass(frozen=True)
class Claim:
    """One finding, its probability where the method has one, and the candidates that it cannot distinguish from it."""

    candidate: Candidate
    probability: float | None = None
    alike: tuple[Candidate, ...] = ()


@dataclass(frozen=True)
class Reply:
    """The reply of one method."""

    verdict: str
    claims: tuple[Claim, ...] = ()

    @classmethod
    def of(cls, claims: Sequence[Claim]) -> Reply:
        """A claim explains everything; no claim means that nothing is missing."""
        return cls("explained" if claims else "consistent", tuple(claims))

    def as_json(self, seconds: float) -> dict[str, Any]:
        found = []
        for c in self.claims:
            entry = _place(c.candidate)
            if c.probability is not None:
                entry["probability"] = round(c.probability, 4)
            alike = [_place(a) for a in c.alike]
            entry["alternatives"] = [a for k, a in enumerate(alike) if a != _place(c.candidate) and a not in alike[:k]]
            found.append(entry)
        return {"verdict": self.verdict, "findings": found, "seconds": round(seconds, 2)}


def _place(c: Candidate) -> dict[str, Any]:
    return {"mechanism": c.mechanism, "where": {"kind": c.where.kind, "name": c.where.name}}


TINY = 1e-12


@dataclass(frozen=True)
class PlainRows:
    """Residual (n,) of the fit and signatures (n, C) of what may be claimed, `batch` (n,) of every row.

    Each channel is in units of its own residual's rms and about its mean, so that micrometres and kelvins count alike.
    Amplitudes lie within `low` and `high` (C,).
    """

    scored: tuple[Scored, ...]
    residual: Array
    columns: Array
    batch: NDArray[np.int64]
    low: Array
    high: Array


def plain_rows(done: Round) -> PlainRows:
    """Of a round's fit, before any candidate."""
    news = beyond_slack(done)
    at = [s.column for s in news]
    evidence = done.screen.evidence
    residuals = done.before.problem.residuals(done.before.x, done.before.state.nuisance)
    channel = np.concatenate([b.channel for b in evidence.batches])
    residual = np.concatenate(residuals)
    columns = np.concatenate([b.restored(b.columns[:, at]) / b.scale[:, None] for b in evidence.batches])
    for c in np.unique(channel):
        own = channel == c
        rms = float(np.sqrt(np.mean(residual[own] ** 2))) + TINY
        residual[own] = (residual[own] - residual[own].mean()) / rms
        columns[own] = (columns[own] - columns[own].mean(axis=0)) / rms
    batch = np.repeat(np.arange(len(residuals)), [len(r) for r in residuals])
    moves = np.linalg.norm(columns, axis=0) > TINY
    kept = tuple(s for s, moving in zip(news, moves, strict=True) if moving)
    low, high = evidence.low[at][moves], evidence.high[at][moves]
    return PlainRows(kept, residual, columns[:, moves], batch, low, high)


def claimable(done: Round) -> list[Scored]:
    """Candidates with a signature, but those that any lumped network has some of."""
    loose = never_reported([s.candidate for s in done.screen.scored], done.before)
    return [s for s in done.screen.scored if s.column >= 0 and s.candidate.name not in loose]


def beyond_slack(done: Round) -> list[Scored]:
    """Those that are no lag, off-centre reading or length, which every lumped network shows without a fault.

    A diagnosis fits these with every candidate; a method without them would name nothing else.
    """
    loose = slack([s.candidate for s in done.screen.scored], done.before)
    return [s for s in claimable(done) if s.candidate.name not in loose]


def counted_in_full(evidence: Evidence) -> Evidence:
    """The same evidence with independent noise in every row."""
    memory = evidence.batches[0].memory
    white = np.ones(len(evidence.rows)) if memory is None else memory.white
    batches = tuple(_without_memory(b) for b in evidence.batches)
    return replace(evidence, batches=batches, weight=evidence.weight / white)


def without_nuisances(evidence: Evidence, residuals: Sequence[Array]) -> Evidence:
    """The same columns without fitted parameters, starts and offsets; the targets are the residuals of the fit."""
    batches = []
    for b, residual in zip(evidence.batches, residuals, strict=True):
        bare = replace(b, jacobian=np.zeros((len(residual), 1)), mixing=b.mixing[:, :0], damping=b.damping[:0])
        target, columns = b.innovations(residual * b.scale), b.innovations(b.restored(b.columns))
        batches.append(replace(bare, target=target, columns=columns))
    return replace(evidence, batches=tuple(batches))


def _without_memory(b: Whitened) -> Whitened:
    """A batch whose rows are taken as independent, its own unknowns integrated out again."""
    spread = np.sqrt(1.0 / (1.0 - b.damping) ** 2 - 1.0)
    plain = replace(b, mixing=b.mixing[:, :0], damping=b.damping[:0])
    mixing, s, _ = np.linalg.svd(plain.restored(b.mixing * spread), full_matrices=False)
    damping = 1.0 - 1.0 / np.sqrt(1.0 + s**2)
    rows = b.restored(np.column_stack([b.target, b.jacobian, b.columns]))
    rows = rows - mixing @ (damping[:, None] * (mixing.T @ rows))
    p = 1 + b.jacobian.shape[1]
    return replace(
        b, target=rows[:, 0], jacobian=rows[:, 1:p], columns=rows[:, p:], mixing=mixing, damping=damping, memory=None
    )
