"""Outcomes: one row per case and one row per true term, from the keys, the stored answers, and the true models.

Cells that do not apply are empty. A failed diagnosis counts as wrong without findings.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from diagnosis.findings.schema import Finding, Findings
from thermodrift_exam.proof.scoring.answer_key import AnswerKey, Stored, TrueTerm
from thermodrift_exam.proof.scoring.matching import (
    UNLISTED,
    Matches,
    always,
    counted_as,
    driver_right,
    exact,
    flagged,
    found_amplitude,
    matches,
    means,
    names_term,
    near,
    overlap,
    reported_set,
    spot,
    true_amplitude,
)
from thermodrift_exam.proof.scoring.true_model import TrueModel


def error_level(rms: Mapping[str, float | None], noise: Mapping[str, float | None]) -> float | None:
    """Root of the mean over channels of (left-out rms / noise)²; None where no channel has both."""
    ratios = [
        value / floor
        for key, value in rms.items()
        if value is not None and (floor := noise.get(key)) is not None and floor > 0
    ]
    return float(np.sqrt(np.mean(np.square(ratios)))) if ratios else None


def closed(before: float | None, after: float | None, true: float | None) -> float | None:
    """Error reduction in units of the true model's; at most 1, None where the true model is no better."""
    if before is None or after is None or true is None or before <= true:
        return None
    return min(1.0, 1.0 - (after - true) / (before - true))


OUTCOMES: Mapping[str, str] = {
    "case": "string", "kind": "string", "plant": "string", "suite": "string", "simulated": "boolean",
    "effect": "string", "verdict": "string", "failed": "boolean", "seconds": "Float64", "claims": "Int64",
    "false_claims": "Int64", "visible": "boolean", "terms": "Int64", "visible_terms": "Int64", "detected": "boolean",
    "first_right": "boolean", "in_set": "boolean", "set_size": "Int64", "place_exact": "boolean",
    "place_near": "boolean", "overlap": "Float64", "amplitude_error": "Float64", "interval_covers": "boolean",
    "closed": "Float64", "all_named": "boolean", "flagged_unlisted": "boolean", "driver_right": "boolean",
    "set_holds_truth": "boolean", "settled": "boolean", "probability": "Float64", "right": "boolean",
    "error_before": "Float64", "error_after": "Float64", "error_true": "Float64", "error_floor": "Float64",
    "limit_share": "Float64",
}  # fmt: skip
TERMS: Mapping[str, str] = {
    "case": "string", "kind": "string", "plant": "string", "effect": "string", "mechanism": "string",
    "place": "string", "visible": "boolean", "limit_share": "Float64", "decoy": "boolean",
    "named_mechanism": "string", "named_place": "string", "found": "boolean", "amplitude_true": "Float64",
    "amplitude_found": "Float64", "low90": "Float64", "high90": "Float64", "gain_nats": "Float64",
    "bar_nats": "Float64", "told_gain_nats": "Float64", "informed_amplitude": "Float64", "informed_low90": "Float64",
    "informed_high90": "Float64",
}  # fmt: skip
NOTHING = "nothing"


def outcomes(
    answers: Mapping[str, Mapping[str, Any]], stored: Mapping[str, Stored], truths: Mapping[str, TrueModel]
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Tables with the columns `OUTCOMES` and `TERMS`, cases in the order of their names.

    `answers` are keys as the vault's JSON gives them; a case without a true model has its visibility left empty.

    Raises:
        InputError: an answer key of another schema.
    """
    cases, terms = [], []
    for name in sorted(answers):
        key, own, truth = AnswerKey.from_json(answers[name]), stored[name], truths.get(name)
        found = matches(None if own.failed else own.findings, key, own.body_of)
        rows = [_term_row(key, k, found, truth) for k in range(len(key.terms))]
        cases.append(outcome(key, own, truth, found, rows))
        terms += rows
    return _table(cases, OUTCOMES), _table(terms, TERMS)


def visible_physics(terms: pd.DataFrame) -> pd.DataFrame:
    """The true terms (columns `TERMS`) that are visible and physics, without decoys."""
    return terms[terms["visible"].fillna(False).astype(bool) & ~terms["decoy"].astype(bool)]


def outcome(
    key: AnswerKey, stored: Stored, truth: TrueModel | None, found: Matches, rows: list[dict[str, Any]]
) -> dict[str, Any]:
    """One case; `rows` are its terms'."""
    findings = None if stored.failed else stored.findings
    physics = [r for r in rows if not r["decoy"]]
    seen = [r for r in physics if r["visible"] is True]
    known = truth is not None and bool(physics) and (bool(seen) or all(r["visible"] is not None for r in physics))
    limits = [r["limit_share"] for r in physics if r["limit_share"] is not None]
    named = physics or rows
    out: dict[str, Any] = {
        "case": key.case,
        "kind": key.kind,
        "plant": key.plant,
        "suite": key.suite,
        "simulated": key.simulated,
        "effect": "+".join(r["effect"] for r in named) or NOTHING,
        "failed": stored.failed,
        "seconds": stored.seconds,
        "visible": bool(seen) if known else None,
        "terms": len(physics),
        "visible_terms": len(seen) if known else None,
        "limit_share": min(limits, default=None),
        "all_named": bool(seen) and all(r["found"] for r in seen) if known else None,
        "right": False,
        **_errors(findings, truth),
    }
    if findings is None:
        lost = dict.fromkeys(("detected", "first_right", "in_set", "place_exact", "place_near"), False)
        return out | (lost if physics else {})
    first = findings.findings[0] if findings.findings else None
    groundless = findings.verdict != "consistent" and first is None and not key.terms
    out |= {
        "verdict": findings.verdict,
        "claims": len(findings.findings),
        "false_claims": len(found.false) + groundless,
        "detected": findings.verdict != "consistent" if physics else None,
        "flagged_unlisted": flagged(findings),
        "probability": first.probability if first is not None else None,
        **_first(key, stored, first),
        **_matched(key, stored, found),
    }
    if key.kind == "unlisted":
        out["driver_right"] = any(driver_right(findings, t, stored.body_of) for t in key.physics if t.driver)
    if key.kind == "confounded":
        out["set_holds_truth"] = _holds(findings, key, stored)
        out["settled"] = _settled(key, stored, findings)
    if key.kind != "one":
        out["closed"] = None
    out["right"] = _right(key, out, seen, found)
    return out


def _first(key: AnswerKey, stored: Stored, first: Finding | None) -> dict[str, Any]:
    """The first finding, compared with the term that it matches best."""
    if first is None:
        lost = dict.fromkeys(("first_right", "in_set", "place_exact", "place_near"), False)
        return lost if key.physics else {}
    place = spot(first)
    reported = reported_set(first)
    same = [t for t in key.terms if means(first.mechanism, t)]
    at = same or list(key.physics)
    return {
        "first_right": bool(same),
        "in_set": any(means(m, t) for m, _ in reported for t in key.terms),
        "set_size": len(reported),
        "place_exact": any(exact(place, t) for t in at) if key.terms else None,
        "place_near": any(near(place, t, stored.body_of) for t in at) if key.terms else None,
    }


def _matched(key: AnswerKey, stored: Stored, found: Matches) -> dict[str, Any]:
    """Time windows and amplitude of the first term of the key that is found."""
    for term, n in zip(key.terms, found.of_term, strict=True):
        if n is None or term.decoy:
            continue
        finding = found.findings[n]
        whole = always(stored.length_s)
        reported = list(finding.when.windows) or whole
        true = whole if term.active == "always" else list(term.active)
        size = true_amplitude(term)
        value, low, high = found_amplitude(finding, term)
        return {
            "overlap": overlap(reported, true, stored.length_s) if stored.length_s else None,
            "amplitude_error": abs(value - size) / abs(size) if size and value is not None else None,
            "interval_covers": low <= size <= high if size and low is not None and high is not None else None,
        }
    return {}


def _errors(findings: Findings | None, truth: TrueModel | None) -> dict[str, Any]:
    before = after = None
    if findings is not None:
        rms = findings.fit.left_out_rms
        before, after = (error_level(given, rms.noise_floor) for given in (rms.before, rms.after))
    true, floor = (truth.error_true, truth.error_floor) if truth is not None else (None, None)
    return {
        "error_before": before,
        "error_after": after,
        "error_true": true,
        "error_floor": floor,
        "closed": closed(before, after, true),
    }


def _holds(findings: Findings, key: AnswerKey, stored: Stored) -> bool:
    """Whether the reported set of a finding holds the true term by the key's own name, place included."""
    return any(
        counted_as(m) == counted_as(t.mechanism) and near(place, t, stored.body_of)
        for f in findings.findings
        for m, place in reported_set(f)
        for t in key.physics
    )


def _settled(key: AnswerKey, stored: Stored, findings: Findings) -> bool | None:
    """Whether the reported set contains the truth alone after the proposed run; no run is needed if it does before.

    Names of the same law count as one: no run can distinguish them.
    """
    if not any(_tied(f, key) for f in findings.findings):
        return None
    if stored.again is None:
        return None if findings.next_experiment is not None else False
    given = stored.again.findings
    if not given or _tied(given[0], key):
        return False
    return any(names_term(given[0].mechanism, spot(given[0]), t, stored.body_of) for t in key.physics)


def _tied(finding: Finding, key: AnswerKey) -> bool:
    """Whether its reported set contains several explanations."""

    def name(mechanism: str) -> str:
        return next((str(t.mechanism) for t in key.physics if means(mechanism, t)), mechanism)

    return len({(name(m), place) for m, place in reported_set(finding)}) > 1


def _right(key: AnswerKey, out: Mapping[str, Any], seen: list[dict[str, Any]], found: Matches) -> bool:
    """Whether the answer is entirely right: every visible term by its mechanism at its place, and no false claim.

    Confounded: the reported set contains the truth. Unlisted: reported as such, at the place or adjacent. Invisible
    effects and decoys need not be reported.
    """
    if out["false_claims"]:
        return False
    if key.kind == "confounded":
        return bool(out["set_holds_truth"]) or not seen
    if key.kind == "nothing":
        return out["verdict"] == "consistent"
    if key.kind == "unlisted":
        return all(r["found"] for r in seen) and (bool(out["flagged_unlisted"]) or not seen)
    visible = {r["number"] for r in seen}
    return all(
        n is not None and exact(spot(found.findings[n]), t)
        for k, (t, n) in enumerate(zip(key.terms, found.of_term, strict=True))
        if k in visible
    )


def _term_row(key: AnswerKey, k: int, found: Matches, truth: TrueModel | None) -> dict[str, Any]:
    term = key.terms[k]
    n = found.of_term[k]
    nearest = n if n is not None else found.instead[k]
    finding = found.findings[nearest] if nearest is not None else None
    value, low, high = found_amplitude(found.findings[n], term) if n is not None else (None, None, None)
    informed = truth.sizes[k] if truth is not None else (None, None, None)
    return {
        "number": k,
        "case": key.case,
        "kind": key.kind,
        "plant": key.plant,
        "effect": term.effect,
        "mechanism": term.mechanism or UNLISTED,
        "place": term.where.name,
        "visible": truth.visible[k] if truth is not None else None,
        "limit_share": term.limit_share,
        "decoy": term.decoy,
        "named_mechanism": _named(finding, term) if finding is not None else NOTHING,
        "named_place": finding.where.name if finding is not None else NOTHING,
        "found": n is not None,
        "amplitude_true": true_amplitude(term),
        "amplitude_found": value,
        "low90": low,
        "high90": high,
        "gain_nats": truth.gain_nats[k] if truth is not None else None,
        "bar_nats": truth.bar_nats[k] if truth is not None else None,
        "told_gain_nats": finding.evidence.get("gain_nats") if finding is not None else None,
        "informed_amplitude": informed[0],
        "informed_low90": informed[1],
        "informed_high90": informed[2],
    }


def _named(finding: Finding, term: TrueTerm) -> str:
    """By the key's own name where both mean the same."""
    return (term.mechanism or UNLISTED) if means(finding.mechanism, term) else counted_as(finding.mechanism)


def _table(rows: list[dict[str, Any]], columns: Mapping[str, str]) -> pd.DataFrame:
    table = pd.DataFrame(rows, columns=list(columns), dtype=object)
    return table.astype(dict(columns))
