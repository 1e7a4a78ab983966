"""Physics of no listed mechanism: whether an answer says so, and what it says drives it."""

from __future__ import annotations

import re
from collections.abc import Mapping

from twin.diagnosis.telling.findings import Finding, Findings
from twin.proof.scoring.answer_key import TrueTerm
from twin.proof.scoring.matching import spot
from twin.proof.scoring.names import UNLISTED, counted_as
from twin.proof.scoring.places import near

JOINING = {"and", "times", "with", "x"}


def flagged(findings: Findings) -> bool:
    """Whether the verdict or a finding says that something is in no list."""
    return findings.verdict == "unlisted" or any(counted_as(f.mechanism) == UNLISTED for f in findings.findings)


def driver_right(findings: Findings, term: TrueTerm, body_of: Mapping[str, str]) -> bool:
    """Whether an unlisted finding at the place or beside it names every channel that drives the term."""
    drivers = set(re.findall(r"[A-Za-z_]\w*", term.driver or "")) - JOINING
    return any(
        counted_as(f.mechanism) == UNLISTED and near(spot(f), term, body_of) and drivers <= _words(f)
        for f in findings.findings
    )


def _words(finding: Finding) -> set[str]:
    told = [finding.statement, finding.equation, finding.when.regime, str(finding.evidence.get("follows", ""))]
    return set(re.findall(r"[A-Za-z_]\w*", " ".join([*told, *finding.parameters])))
