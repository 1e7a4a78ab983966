"""The diagnosis beside its rivals on the same cases: right answers, the first mechanism, false alarms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from data.errors import InputError
from twin.diagnosis.telling.findings import SCHEMA, Findings
from twin.proof.scoring.goals import ONE
from twin.proof.scoring.intervals import bootstrap, clopper_pearson
from twin.proof.scoring.outcomes import outcomes
from twin.proof.scoring.stored import Stored
from twin.proof.scoring.true_model import TrueModel

COLUMNS = ("method", "group", "measure", "value", "low90", "high90", "n", "lead", "lead_low90", "lead_high90")
RIGHT, FIRST, ALARMS = "right answers", "mechanism first, one visible effect", "false alarms, nothing missing"


def compared(
    answers: Mapping[str, Mapping[str, Any]], stored: Mapping[str, Stored], truths: Mapping[str, TrueModel]
) -> pd.DataFrame:
    """One row a method and measure, over the cases that have rivals; shares with exact 90 % intervals.

    `group` is diagnosis, baseline or ablation. `lead`, of right answers only, is paired by case with a bootstrap
    interval: of the diagnosis over a baseline, of the full rules in the first round (reference) over an ablation.

    Raises:
        InputError: an answer key or a rival's reply that cannot be read.
    """
    known = {name: own for name, own in stored.items() if own.rivals is not None and name in answers}
    keys = {name: answers[name] for name in known}
    replies: dict[str, str] = {"diagnosis": "diagnosis"}
    for own in known.values():
        given = own.rivals or {}
        replies |= {"reference": "ablation"} if "reference" in given else {}
        replies |= dict.fromkeys(given.get("baselines", {}), "baseline")
        replies |= dict.fromkeys(given.get("ablations", {}), "ablation")
    tables = {
        method: _scored(keys, known if method == "diagnosis" else _answered(known, method), truths)
        for method in replies
    }
    against = {"baseline": tables["diagnosis"], "ablation": tables.get("reference", tables["diagnosis"])}
    rows: list[dict[str, Any]] = []
    for method, group in replies.items():
        for measure, values in _measures(tables[method]).items():
            low, high = clopper_pearson(int(values.sum()), len(values))
            value = float(values.mean()) if len(values) else float("nan")
            row = {"method": method, "group": group, "measure": measure, "value": value, "low90": low, "high90": high}
            led = measure == RIGHT and group != "diagnosis" and method != "reference" and len(values)
            rows.append({**row, "n": len(values), **(_lead(against[group], tables[method]) if led else {})})
    return pd.DataFrame(rows, columns=list(COLUMNS))


def as_findings(reply: Mapping[str, Any], like: Findings) -> Findings:
    """A rival's reply as a diagnosis would have written it; what it cannot tell apart is equally probable.

    Raises:
        InputError: a reply that lacks something.
    """
    found = [
        {
            "mechanism": f["mechanism"], "where": f["where"], "probability": f.get("probability", 1.0),
            "statement": "", "alternatives": [
                {**a, "probability": f.get("probability", 1.0)} for a in f.get("alternatives", ())
            ],
        }
        for f in reply.get("findings", ())
    ]  # fmt: skip
    raw = {
        "schema": SCHEMA, "machine": like.machine, "batches": list(like.batches), "verdict": reply.get("verdict"),
        "findings": found, "fit": {"batches_improved": 0, "batches": len(like.batches)},
        "seconds": reply.get("seconds"),
    }  # fmt: skip
    return Findings.from_json(raw, "rivals file")


def _answered(known: Mapping[str, Stored], method: str) -> dict[str, Stored]:
    """What was stored, with this rival's reply in place of the diagnosis'; without one it has failed."""
    out = {}
    for name, own in known.items():
        given = own.rivals or {}
        every = {**given.get("baselines", {}), **given.get("ablations", {}), "reference": given.get("reference")}
        reply = every.get(method)
        if reply is not None and own.findings is None:
            raise InputError(f"rivals of {name}: there are replies, but no findings; run the case again")
        found = as_findings(reply, own.findings) if reply is not None and own.findings is not None else None
        out[name] = replace(own, findings=found, run={}, again=None)
    return out


def _scored(
    keys: Mapping[str, Mapping[str, Any]], stored: Mapping[str, Stored], truths: Mapping[str, TrueModel]
) -> pd.DataFrame:
    return outcomes(keys, stored, truths)[0].set_index("case", drop=False)


def _measures(table: pd.DataFrame) -> dict[str, pd.Series]:
    visible = table["visible"].fillna(False).astype(bool)
    nothing = table[table["kind"].isin(("nothing", "decoy"))]
    return {
        RIGHT: table["right"].astype(bool),
        FIRST: table[table["kind"].isin(ONE) & visible]["first_right"].fillna(False).astype(bool),
        ALARMS: nothing["false_claims"].dropna() > 0,
    }


def _lead(better: pd.DataFrame, other: pd.DataFrame) -> dict[str, float]:
    gap = better["right"].astype(float) - other["right"].astype(float)
    low, high = bootstrap(gap, lambda values: float(np.mean(values)))
    return {"lead": float(gap.mean()), "lead_low90": low, "lead_high90": high}
