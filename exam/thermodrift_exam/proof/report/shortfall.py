"""The shortfall of a proof: missed effects and false claims, and whether data or search limit them."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from diagnosis.formatting import percent
from reports.labels import NOTHING, count, number
from reports.layout import Column, Row, Table
from thermodrift_exam.proof.report.labels import key_label, plant_letter, plant_origin, simulated
from thermodrift_exam.proof.report.tables import ProofRun
from thermodrift_exam.proof.scoring.outcomes import NOTHING as NOT_NAMED
from thermodrift_exam.proof.scoring.outcomes import visible_physics
from thermodrift_exam.proof.scoring.tables import OF_RECORDINGS, REASONS


def sentences(run: ProofRun) -> list[str]:
    """A sentence each on visible effects, missed effects and claims, as far as the tables give them."""
    terms, missed, claims = run.table("terms"), run.table("missed"), run.table("claims")
    said = []
    seen = visible_physics(terms)
    if {"gain_nats", "bar_nats"} <= set(terms.columns):
        stated = seen[seen["bar_nats"].notna()]
        enough = int((stated["gain_nats"] > stated["bar_nats"]).sum())
        said.append(
            f"Of {count(len(stated), 'visible effect')} that the true model contains, {enough} gain more than the "
            f"threshold of a claim."
        )
    if len(missed):
        recordings = int(missed["reason"].isin(OF_RECORDINGS).sum())
        said.append(
            f"{len(missed)} of {count(len(seen), 'visible effect')} have no claim: {recordings} are limited by the "
            f"data, {len(missed) - recordings} by the search."
        )
    if len(claims):
        said.append(f"{int((~claims['true'].astype(bool)).sum())} of {count(len(claims), 'claim')} are false.")
    return said


def tables(run: ProofRun, each: bool) -> list[Table]:
    """The tables that have rows, without or with `each` missed effect."""
    missed, claims, out = run.table("missed"), run.table("claims"), []
    if len(missed):
        out.append(reasons(missed, run.plants))
        if each:
            out.append(missed_effects(missed, run.plants))
    if len(claims) and not claims["true"].all():
        out.append(false_claims(claims, run.plants))
    return out


def reasons(missed: pd.DataFrame, plants: Sequence[str]) -> Table:
    """Reasons why visible effects are not named, by plant, and whether data or search limit them."""
    rows = []
    for reason in REASONS:
        own = missed[missed["reason"] == reason]
        limited_by = "data" if reason in OF_RECORDINGS else "search"
        rows.append(Row.of(reason, limited_by, *_by_plant(own, plants), f"{len(own)}"))
    columns = (Column("reason", kind="wide"), Column("limited by"), *_plants("", plants), Column("all", kind="number"))
    notes = (
        "Gains are those on left-out batches, in nats, with all other concealed effects in the model. Data: these "
        "recordings with networks as coarse as that of the machine file.",
    )
    return Table("Visible effects without a claim", columns, tuple(rows), simulated(plants), notes=notes)


def missed_effects(missed: pd.DataFrame, plants: Sequence[str]) -> Table:
    """Each missed effect: its gain, the threshold of a claim, the explanation reported instead and its gain."""
    order = missed.assign(rank=missed["reason"].map(REASONS.index))
    rows = []
    for r in order.sort_values(["rank", "case"], ascending=[False, True]).to_dict("records"):
        reported = str(r["named_mechanism"])
        named = NOTHING if reported == NOT_NAMED else f"{key_label(reported)} at {key_label(str(r['named_place']))}"
        what = f"{key_label(str(r['effect']))} at {key_label(str(r['place']))}"
        gain, bar, other = (_nats(r[c]) for c in ("gain_nats", "bar_nats", "told_gain_nats"))
        rows.append(Row.of(str(r["case"]), plant_letter(str(r["plant"])), what, gain, bar, named, other))
    columns = (
        Column("case"), Column("plant"), Column("effect", kind="wide"), Column("gain", "nats", "number"),
        Column("threshold", "nats", "number"), Column("reported instead", kind="wide"),
        Column("its gain", "nats", "number"),
    )  # fmt: skip
    return Table("Each visible effect without a claim", columns, tuple(rows), simulated(plants))


def false_claims(claims: pd.DataFrame, plants: Sequence[str]) -> Table:
    """By mechanism, the worst first: claims, false claims and the probability of the false claims."""
    false = claims[~claims["true"].astype(bool)]
    rows = []
    for mechanism, n in sorted(false["mechanism"].value_counts().items(), key=lambda one: (-one[1], str(one[0]))):
        own = false[false["mechanism"] == mechanism]
        nothing = int(own["kind"].isin(("nothing", "decoy")).sum())
        sure = percent(float(own["probability"].median()))
        every = int((claims["mechanism"] == mechanism).sum())
        rows.append(Row.of(key_label(str(mechanism)), f"{every}", *_by_plant(own, plants), f"{n}", f"{nothing}", sure))
    columns = (
        Column("mechanism", kind="wide"), Column("claims", kind="number"), *_plants("false, ", plants),
        Column("false", kind="number"), Column("nothing missing", kind="number"),
        Column("median probability of false claims", kind="number"),
    )  # fmt: skip
    return Table("False claims", columns, tuple(rows), simulated(plants))


def _plants(said: str, plants: Sequence[str]) -> list[Column]:
    return [Column(f"{said}{plant_letter(p)}", plant_origin(p), "number") for p in plants]


def _by_plant(rows: pd.DataFrame, plants: Sequence[str]) -> list[str]:
    return [f"{int((rows['plant'] == p).sum())}" for p in plants]


def _nats(value: object) -> str:
    return NOTHING if pd.isna(value) else number(float(value), 0)  # type: ignore[call-overload, arg-type]
