"""The shortfall of a proof: what was missed and claimed falsely, and whether data or search limit it."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from diagnosis.findings.report_data import percent
from evidence.proof.report.labels import key_label, plant_letter, plant_origin, simulated
from evidence.proof.report.tables import ProofRun
from evidence.proof.scoring.outcomes import NOTHING as NOT_NAMED
from evidence.proof.scoring.outcomes import visible_physics
from evidence.proof.scoring.tables import OF_RECORDINGS, REASONS
from reports.labels import NOTHING, count, number
from reports.layout import Column, Row, Table


def sentences(run: ProofRun) -> list[str]:
    """A sentence on visible effects, one on those that were missed, one on claims; those that the tables give."""
    terms, missed, claims = run.table("terms"), run.table("missed"), run.table("claims")
    said = []
    seen = visible_physics(terms)
    if {"gain_nats", "bar_nats"} <= set(terms.columns):
        stated = seen[seen["bar_nats"].notna()]
        enough = int((stated["gain_nats"] > stated["bar_nats"]).sum())
        said.append(
            f"Of {count(len(stated), 'visible effect')} that the true model states, {enough} gain what a claim takes "
            f"once all that is true is in the model."
        )
    if len(missed):
        recordings = int(missed["reason"].isin(OF_RECORDINGS).sum())
        said.append(
            f"{len(missed)} of {count(len(seen), 'visible effect')} have no claim; in {recordings} of them the "
            f"recordings do not favour the truth, in {len(missed) - recordings} the search fell short."
        )
    if len(claims):
        said.append(f"{int((~claims['true'].astype(bool)).sum())} of {count(len(claims), 'claim')} are not so.")
    return said


def tables(run: ProofRun, each: bool) -> list[Table]:
    """Those that say anything, without or with `each` missed effect."""
    missed, claims, out = run.table("missed"), run.table("claims"), []
    if len(missed):
        out.append(reasons(missed, run.plants))
        if each:
            out.append(missed_effects(missed, run.plants))
    if len(claims) and not claims["true"].all():
        out.append(false_claims(claims, run.plants))
    return out


def reasons(missed: pd.DataFrame, plants: Sequence[str]) -> Table:
    """Why visible effects were not named, counted by plant, and whether they are limited by the data or the search."""
    rows = []
    for reason in REASONS:
        own = missed[missed["reason"] == reason]
        limited_by = "data" if reason in OF_RECORDINGS else "search"
        rows.append(Row.of(reason, limited_by, *_by_plant(own, plants), f"{len(own)}"))
    columns = (Column("why", kind="wide"), Column("limited by"), *_plants("", plants), Column("all", kind="number"))
    notes = (
        "Gains are of the batches left out, in nats; the effect's own with all else that is true in the model. Data: "
        "these recordings, read by networks as coarse as the machine file's.",
    )
    return Table("Visible effects that no claim names", columns, tuple(rows), simulated(plants), notes=notes)


def missed_effects(missed: pd.DataFrame, plants: Sequence[str]) -> Table:
    """Each of them: what it gains, what a claim takes, what was reported instead and what that gains."""
    order = missed.assign(rank=missed["reason"].map(REASONS.index))
    rows = []
    for r in order.sort_values(["rank", "case"], ascending=[False, True]).to_dict("records"):
        reported = str(r["named_mechanism"])
        named = NOTHING if reported == NOT_NAMED else f"{key_label(reported)} at {key_label(str(r['named_place']))}"
        what = f"{key_label(str(r['effect']))} at {key_label(str(r['place']))}"
        gain, bar, other = (_nats(r[c]) for c in ("gain_nats", "bar_nats", "told_gain_nats"))
        rows.append(Row.of(str(r["case"]), plant_letter(str(r["plant"])), what, gain, bar, named, other))
    columns = (
        Column("case"), Column("plant"), Column("effect", kind="wide"), Column("gains", "nats", "number"),
        Column("a claim takes", "nats", "number"), Column("reported instead", kind="wide"),
        Column("that gains", "nats", "number"),
    )  # fmt: skip
    return Table("Each of them", columns, tuple(rows), simulated(plants))


def false_claims(claims: pd.DataFrame, plants: Sequence[str]) -> Table:
    """By mechanism, the worst first: how often it was claimed and was not so, and how sure the false claims were."""
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
        Column("false", kind="number"), Column("nothing was missing", kind="number"),
        Column("median probability of the false", kind="number"),
    )  # fmt: skip
    return Table("Claims that are not so", columns, tuple(rows), simulated(plants))


def _plants(said: str, plants: Sequence[str]) -> list[Column]:
    return [Column(f"{said}{plant_letter(p)}", plant_origin(p), "number", p) for p in plants]


def _by_plant(rows: pd.DataFrame, plants: Sequence[str]) -> list[str]:
    return [f"{int((rows['plant'] == p).sum())}" for p in plants]


def _nats(value: object) -> str:
    return NOTHING if pd.isna(value) else number(float(value), 0)  # type: ignore[call-overload, arg-type]
