"""Views of the outcomes: by a column, confusion, worst cases, methods compared, missed effects and claims."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pandas as pd

from data.errors import InputError
from diagnosis.findings.schema import SCHEMA, Findings
from thermodrift_exam.proof.scoring.answer_key import AnswerKey, Stored
from thermodrift_exam.proof.scoring.goals import ONE, bootstrap, clopper_pearson
from thermodrift_exam.proof.scoring.matching import matches
from thermodrift_exam.proof.scoring.outcomes import NOTHING, outcomes, visible_physics
from thermodrift_exam.proof.scoring.true_model import TrueModel

BY = ("n", "visible", "right", "right_low90", "right_high90", "detected", "first_right", "place_exact", "place_near",
      "false_claims", "overlap", "amplitude_error", "closed", "seconds")  # fmt: skip


def by(outcomes: pd.DataFrame, column: str) -> pd.DataFrame:
    """One row a value of the column ("effect", "plant", "kind", "visible"), with the columns `BY`.

    `right` over all its cases; detection, mechanism and place are shares of the visible ones; false claims a case;
    the rest medians. Empty where there are none.
    """
    rows = {}
    for value, own in outcomes.groupby(column, dropna=False, sort=True):
        seen = own[own["visible"].fillna(False).astype(bool)]
        right = int(own["right"].sum())
        low, high = clopper_pearson(right, len(own))
        shares = {c: _mean(seen[c]) for c in ("detected", "first_right", "place_exact", "place_near")}
        middles = {c: _median(own[c]) for c in ("overlap", "amplitude_error", "closed", "seconds")}
        counts = {"n": len(own), "visible": len(seen), "false_claims": _mean(own["false_claims"])}
        rows[value] = {
            **counts,
            "right": right / len(own),
            "right_low90": low,
            "right_high90": high,
            **shares,
            **middles,
        }
    table = pd.DataFrame.from_dict(rows, orient="index", columns=list(BY))
    return table.rename_axis(column).reset_index()


def confusion(terms: pd.DataFrame, what: Literal["mechanism", "place"]) -> pd.DataFrame:
    """Of visible physics: the `true` name, the `named` one (or "nothing") and their `count`."""
    rows = visible_physics(terms)
    table = pd.DataFrame({"true": rows[what].astype(str), "named": rows[f"named_{what}"].astype(str)})
    return table.value_counts(sort=False).rename("count").reset_index()


def worst(outcomes: pd.DataFrame, most: int = 10) -> pd.DataFrame:
    """The worst wrong cases, the worst first: columns of the outcomes and `why`, one sentence."""
    wrong = outcomes[~outcomes["right"].fillna(False).astype(bool)].copy()
    wrong["why"] = [_why(row) for _, row in wrong.iterrows()]
    wrong["rank"] = [_badness(row) for _, row in wrong.iterrows()]
    order = wrong.sort_values(["rank", "limit_share", "case"], ascending=[False, False, True], na_position="last")
    return order.drop(columns="rank").head(most).reset_index(drop=True)


def _badness(row: pd.Series) -> float:
    """False alarms first, then false names by their probability, then missed effects."""
    if row["failed"]:
        return 5.0
    false = _number(row["false_claims"]) > 0
    if false and row["kind"] in ("nothing", "decoy"):
        return 4.0
    if false:
        return 2.0 + _number(row["probability"])
    return 1.0 if _true(row["visible"]) else 0.0


def _why(row: pd.Series) -> str:
    what = f"{row['effect']} in plant {row['plant']}"
    if row["failed"]:
        return f"{what}: the diagnosis failed."
    false = int(_number(row["false_claims"]))
    sure = f", probability {100 * _number(row['probability']):.0f} %" if pd.notna(row["probability"]) else ""
    if row["kind"] in ("nothing", "decoy") and false:
        return f"No physics is missing; {_claims(false)}{sure}."
    if _true(row["visible"]) and not _true(row["detected"]):
        return f"{what} was visible and is missed."
    if false and row["kind"] != "unlisted" and _true(row["flagged_unlisted"]) and not _true(row["first_right"]):
        there = ", at the right place" if _true(row["place_exact"]) else ""
        return f"{what} is listed and is reported as unlisted{there}."
    if false and not _true(row["first_right"]):
        held = "; the truth is in the reported set" if _true(row["in_set"]) else ""
        return f"{what} is named as something else{sure}{held}."
    if false:
        return f"{what} is named, with {_claims(false)}."
    if row["kind"] == "unlisted" and not _true(row["flagged_unlisted"]):
        return f"{what} is unlisted, and the answer does not say so."
    if _true(row["first_right"]) and not _true(row["place_exact"]):
        return f"{what} is named{' at a neighbouring place' if _true(row['place_near']) else ' at another place'}."
    if _number(row["visible_terms"]) > 1 and not _true(row["all_named"]):
        return f"{what}: not all of {int(_number(row['visible_terms']))} visible effects are named."
    return f"{what}: the answer does not name the effect (verdict {row['verdict']})."


def _claims(n: int) -> str:
    return "one false claim" if n == 1 else f"{n} false claims"


def _number(value: object) -> float:
    return 0.0 if pd.isna(value) else float(value)  # type: ignore[call-overload, arg-type]


def _true(value: object) -> bool:
    return bool(pd.notna(value) and value)  # type: ignore[call-overload]


def _mean(values: pd.Series) -> float:
    known = values.dropna()
    return float(known.astype(float).mean()) if len(known) else float("nan")


def _median(values: pd.Series) -> float:
    known = values.dropna()
    return float(known.astype(float).median()) if len(known) else float("nan")


COMPARED_COLUMNS = ("method", "group", "measure", "value", "low90", "high90", "n", "lead", "lead_low90", "lead_high90")
RIGHT, FIRST, ALARMS = "right answers", "mechanism first, one visible effect", "false alarms, nothing missing"


def compared(
    answers: Mapping[str, Mapping[str, Any]], stored: Mapping[str, Stored], truths: Mapping[str, TrueModel]
) -> pd.DataFrame:
    """One row a method and measure, over the cases that have replies of baselines; shares with exact 90 % intervals.

    Ablations, and the reference, count the cases that have any ablation.

    `group` is diagnosis, baseline or ablation. `lead`, of right answers only, is paired by case with a bootstrap
    interval: of the diagnosis over a baseline, of the full rules in the first round (reference) over an ablation.

    Raises:
        InputError: an answer key or a reply that cannot be read.
    """
    known = {name: own for name, own in stored.items() if own.replies is not None and name in answers}
    keys = {name: answers[name] for name in known}
    ablated = {name: own for name, own in known.items() if (own.replies or {}).get("ablations")}
    replies: dict[str, str] = {"diagnosis": "diagnosis"}
    for own in known.values():
        given = own.replies or {}
        replies |= {"reference": "ablation"} if "reference" in given else {}
        replies |= dict.fromkeys(given.get("baselines", {}), "baseline")
        replies |= dict.fromkeys(given.get("ablations", {}), "ablation")
    tables = {}
    for method, group in replies.items():
        among = ablated if group == "ablation" else known
        answered = among if method == "diagnosis" else _answered(among, method)
        tables[method] = _scored({name: keys[name] for name in among}, answered, truths)
    against = {"baseline": tables["diagnosis"], "ablation": tables.get("reference", tables["diagnosis"])}
    rows: list[dict[str, Any]] = []
    for method, group in replies.items():
        for measure, values in _measures(tables[method]).items():
            low, high = clopper_pearson(int(values.sum()), len(values))
            value = float(values.mean()) if len(values) else float("nan")
            row = {"method": method, "group": group, "measure": measure, "value": value, "low90": low, "high90": high}
            led = measure == RIGHT and group != "diagnosis" and method != "reference" and len(values)
            lead = _lead(against[group].loc[tables[method].index], tables[method]) if led else {}
            rows.append({**row, "n": len(values), **lead})
    return pd.DataFrame(rows, columns=list(COMPARED_COLUMNS))


def as_findings(reply: Mapping[str, Any], like: Findings) -> Findings:
    """A reply in the form of a diagnosis; indistinguishable candidates are equally probable.

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
    return Findings.from_json(raw, "replies of baselines")


def _answered(known: Mapping[str, Stored], method: str) -> dict[str, Stored]:
    """The stored answer with the reply of this method in place of the diagnosis; without a reply it has failed."""
    out = {}
    for name, own in known.items():
        given = own.replies or {}
        every = {**given.get("baselines", {}), **given.get("ablations", {}), "reference": given.get("reference")}
        reply = every.get(method)
        if reply is not None and own.findings is None:
            raise InputError(f"baselines of {name}: there are replies, but no findings; run the case again")
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


LITTLE = "the effect gains less than the threshold of a claim"
ALIKE = "another explanation that gains as much was reported"
PREFERRED = "another explanation that gains less was reported"
SILENT = "the effect gains more than the threshold, nothing was reported"
OF_RECORDINGS = (LITTLE, ALIKE)  # the others are limited by the search
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
    gain, bar, reported = (float("nan") if pd.isna(value) else float(value) for value in numbers)
    if gain <= bar:
        return LITTLE
    if row["named_mechanism"] == NOTHING:
        return SILENT
    return ALIKE if reported >= gain else PREFERRED
