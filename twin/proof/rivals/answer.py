"""What a rival answers, in the words of a diagnosis: a verdict and findings, the best first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from twin.diagnosis.proposals.candidate import Candidate

WITHIN = 0.1  # of the first explanation's probability: what is less likely is told, but is not of the reported set


@dataclass(frozen=True)
class Claim:
    """One finding, its probability where the method has one, and what the method cannot tell from it."""

    candidate: Candidate
    probability: float | None = None
    alike: tuple[Candidate, ...] = ()


@dataclass(frozen=True)
class Reply:
    """Everything that one method says."""

    verdict: str
    claims: tuple[Claim, ...] = ()

    @classmethod
    def of(cls, claims: Sequence[Claim]) -> Reply:
        """Whatever is claimed explains all; nothing claimed means nothing is missing."""
        return cls("explained" if claims else "consistent", tuple(claims))

    def as_json(self, seconds: float) -> dict[str, Any]:
        found = []
        for c in self.claims:
            told = _place(c.candidate)
            if c.probability is not None:
                told["probability"] = round(c.probability, 4)
            alike = [_place(a) for a in c.alike]
            told["alternatives"] = [a for k, a in enumerate(alike) if a != _place(c.candidate) and a not in alike[:k]]
            found.append(told)
        return {"verdict": self.verdict, "findings": found, "seconds": round(seconds, 2)}


def _place(c: Candidate) -> dict[str, Any]:
    return {"mechanism": c.mechanism, "where": {"kind": c.where.kind, "name": c.where.name}}
