"""Replies of baselines and ablations in the form of a diagnosis: a verdict and findings, the best first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from diagnosis.candidates.discretisation import slack
from diagnosis.contracts import Candidate, Scored
from diagnosis.search.claims import Round
from diagnosis.search.refits import odds_of
from twin.mechanisms import MECHANISMS


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
    problem = done.before.problem
    residuals = problem.residuals(done.before.x, done.before.fitted_nuisance)
    channel = np.concatenate([m.channel for m in problem.measured])
    residual = np.concatenate(residuals)
    columns = np.concatenate([x[:, at] for x in done.screen.signatures.columns])
    for c in np.unique(channel):
        own = channel == c
        rms = float(np.sqrt(np.mean(residual[own] ** 2))) + TINY
        residual[own] = (residual[own] - residual[own].mean()) / rms
        columns[own] = (columns[own] - columns[own].mean(axis=0)) / rms
    batch = np.repeat(np.arange(len(residuals)), [len(r) for r in residuals])
    moves = np.linalg.norm(columns, axis=0) > TINY
    kept = tuple(s for s, moving in zip(news, moves, strict=True) if moving)
    low, high = bounds(kept)
    return PlainRows(kept, residual, columns[:, moves], batch, low, high)


def bounds(scored: Sequence[Scored]) -> tuple[Array, Array]:
    """Least and largest amplitude (C,) of candidates, less the value at which each is off."""
    low = np.full(len(scored), -np.inf)
    for k, s in enumerate(scored):
        name = next(iter(s.amplitudes), "")
        off = s.candidate.amplitudes.get(name)
        if off is not None and MECHANISMS[s.candidate.mechanism].spec(name).low >= off:
            low[k] = 0.0
    return low, np.full(len(scored), np.inf)


def claimable(done: Round) -> list[Scored]:
    """Candidates with a signature, but those that any lumped network has some of."""
    own = odds_of(done.before, done.screen)
    return [s for s in done.screen.scored if s.candidate.name in own and not s.candidate.kind.is_unlisted]


def beyond_slack(done: Round) -> list[Scored]:
    """Those that are no lag, off-centre reading or length, which every lumped network shows without a fault.

    A diagnosis fits these with every candidate; a method without them would name nothing else.
    """
    loose = slack([s.candidate for s in done.screen.scored], done.before)
    return [s for s in claimable(done) if s.candidate.name not in loose]
