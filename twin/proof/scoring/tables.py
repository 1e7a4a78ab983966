"""Other views of the outcomes: by a column, who is taken for whom, and the worst cases with a sentence why."""

from __future__ import annotations

from typing import Literal

import pandas as pd

from twin.proof.scoring.intervals import clopper_pearson
from twin.proof.scoring.outcomes import visible_physics

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
    """Of visible physics: what was `true`, what was `named` in its stead ("nothing" too) and how often, `count`."""
    rows = visible_physics(terms)
    table = pd.DataFrame({"true": rows[what].astype(str), "named": rows[f"named_{what}"].astype(str)})
    return table.value_counts(sort=False).rename("count").reset_index()


def worst(outcomes: pd.DataFrame, most: int = 10) -> pd.DataFrame:
    """So many cases that are not right, the worst first: columns of the outcomes and `why`, one sentence."""
    wrong = outcomes[~outcomes["right"].fillna(False).astype(bool)].copy()
    wrong["why"] = [_why(row) for _, row in wrong.iterrows()]
    wrong["rank"] = [_badness(row) for _, row in wrong.iterrows()]
    order = wrong.sort_values(["rank", "limit_share", "case"], ascending=[False, False, True], na_position="last")
    return order.drop(columns="rank").head(most).reset_index(drop=True)


def _badness(row: pd.Series) -> float:
    """A false alarm where nothing is missing first, then false names by how sure, then what was overlooked."""
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
    sure = f", {100 * _number(row['probability']):.0f} % sure" if pd.notna(row["probability"]) else ""
    if row["kind"] in ("nothing", "decoy") and false:
        return f"No physics was missing, yet {_claims(false)}{sure}."
    if _true(row["visible"]) and not _true(row["detected"]):
        return f"{what} was visible and overlooked."
    if false and row["kind"] != "unlisted" and _true(row["flagged_unlisted"]) and not _true(row["first_right"]):
        there = ", at the right place" if _true(row["place_exact"]) else ""
        return f"{what} is listed and was said to be in no list{there}."
    if false and not _true(row["first_right"]):
        held = "; the truth was in the reported set" if _true(row["in_set"]) else ""
        return f"{what} was taken for something else{sure}{held}."
    if false:
        return f"{what} was named, and beside it {_claims(false)}."
    if row["kind"] == "unlisted" and not _true(row["flagged_unlisted"]):
        return f"{what} is in no list, and the answer does not say so."
    if _true(row["first_right"]) and not _true(row["place_exact"]):
        return f"{what} was named{' at a neighbouring place' if _true(row['place_near']) else ' at another place'}."
    if _number(row["visible_terms"]) > 1 and not _true(row["all_named"]):
        return f"{what}: not all of {int(_number(row['visible_terms']))} visible effects were named."
    return f"{what}: the answer does not say what is missing (verdict {row['verdict']})."


def _claims(n: int) -> str:
    return "one thing was claimed that is not so" if n == 1 else f"{n} things were claimed that are not so"


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
