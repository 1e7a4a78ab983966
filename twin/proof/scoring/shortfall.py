"""What the diagnosis owes and what the recordings owe: why visible effects were not named, and what was claimed.

The true model says what a perfect answer gains on the batches left out. Where that is less than a claim takes, or no
more than what was told gains, these recordings (with this file and such networks) do not say more; else the search
fell short.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pandas as pd

from twin.proof.scoring.answer_key import AnswerKey
from twin.proof.scoring.matching import matches
from twin.proof.scoring.outcomes import NOTHING, visible_physics
from twin.proof.scoring.stored import Stored

LITTLE = "the effect itself gains less than a claim takes"
ALIKE = "what was told instead gains as much as the effect"
PREFERRED = "something that gains less was told instead"
SILENT = "the effect gains enough, and nothing was told"
OF_RECORDINGS = (LITTLE, ALIKE)  # the others are the search's
REASONS = (*OF_RECORDINGS, PREFERRED, SILENT)

MISSED: Mapping[str, str] = {
    "case": "string", "plant": "string", "kind": "string", "effect": "string", "place": "string",
    "limit_share": "Float64", "gain_nats": "Float64", "bar_nats": "Float64", "named_mechanism": "string",
    "named_place": "string", "told_gain_nats": "Float64", "reason": "string",
}  # fmt: skip
CLAIMS: Mapping[str, str] = {
    "case": "string", "plant": "string", "kind": "string", "mechanism": "string", "place": "string",
    "probability": "Float64", "gain_nats": "Float64", "true": "boolean",
}  # fmt: skip


def missed(terms: pd.DataFrame) -> pd.DataFrame:
    """Visible physics that no finding claims, with the columns `MISSED`; `reason` is one of `REASONS`."""
    seen = visible_physics(terms)
    out = seen[~seen["found"].astype(bool)].copy()
    out["reason"] = [_reason(row) for _, row in out.iterrows()]
    return out[list(MISSED)].astype(dict(MISSED)).reset_index(drop=True)


def claims(answers: Mapping[str, Mapping[str, Any]], stored: Mapping[str, Stored]) -> pd.DataFrame:
    """Every finding, with the columns `CLAIMS`.

    Raises:
        InputError: an answer key of another schema.
    """
    rows = []
    for name in sorted(answers):
        key, own = AnswerKey.from_json(answers[name]), stored[name]
        found = matches(None if own.failed else own.findings, key, own.body_of)
        rows += [
            (name, key.plant, key.kind, f.mechanism, f.where.name, f.probability, f.evidence.get("gain_nats"),
             n not in found.false)
            for n, f in enumerate(found.findings)
        ]  # fmt: skip
    return pd.DataFrame(rows, columns=list(CLAIMS), dtype=object).astype(dict(CLAIMS))


def _reason(row: pd.Series) -> str:
    numbers = (row[c] for c in ("gain_nats", "bar_nats", "told_gain_nats"))
    gain, bar, told = (float("nan") if pd.isna(value) else float(value) for value in numbers)
    if gain <= bar:
        return LITTLE
    if row["named_mechanism"] == NOTHING:
        return SILENT
    return ALIKE if told >= gain else PREFERRED
