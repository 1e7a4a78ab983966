"""The set that a finding reports: itself and the alternatives that it does not call far less likely."""

from __future__ import annotations

from twin.diagnosis.telling.findings import Finding
from twin.proof.rivals.answer import WITHIN
from twin.proof.scoring.answer_key import Spot


def reported_set(finding: Finding) -> list[tuple[str, Spot]]:
    """Mechanism and place of all that the finding reports, itself first."""
    least = WITHIN * finding.probability
    own = [(finding.mechanism, Spot(finding.where.kind, finding.where.name))]
    others = [(a.mechanism, Spot(a.where.kind, a.where.name)) for a in finding.alternatives if a.probability >= least]
    return list(dict.fromkeys([*own, *others]))
