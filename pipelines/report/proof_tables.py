"""The tables of the proof's page: cases by kind, ledger, leak test, convergence, what does not count."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pandas as pd

from pipelines.report.layout import Column, Row, Table
from pipelines.report.proof_run import ProofRun
from pipelines.report.proof_words import KIND_WORDS, key_label, plant_label, plant_letter, plant_origin, simulated
from pipelines.report.words import NOTHING, number, p_words, percent

_RARE = 0.05


def cases(outcomes: pd.DataFrame, plants: Sequence[str]) -> Table:
    """How many cases of each kind stand on each plant, and how many answers were wholly right."""
    columns = [Column("what is concealed"), *(Column(plant_letter(p), plant_origin(p), "number", p) for p in plants),
               Column("all", kind="number"), Column("visible", kind="number")]  # fmt: skip
    judged = "right" in outcomes.columns and outcomes["right"].notna().any()
    columns += [Column("wholly right", kind="number")] if judged else []
    rows = []
    kinds = [k for k in KIND_WORDS if (outcomes["kind"] == k).any()]
    for kind in [*kinds, *sorted(set(outcomes["kind"]) - set(kinds)), ""]:
        own = outcomes[outcomes["kind"] == kind] if kind else outcomes
        right = own["right"].dropna().astype(bool) if judged else ()
        cells = [KIND_WORDS.get(kind, key_label(kind)) if kind else "all cases"]
        cells += [f"{int((own['plant'] == p).sum())}" for p in plants]
        cells += [f"{len(own)}", f"{int(own['visible'].eq(True).sum())}"]
        cells += [f"{int(sum(right))} of {len(right)}" if len(right) else NOTHING] if judged else []
        rows.append(Row(tuple(cells)))
    notes = (f"Plants: {'; '.join(f'{plant_label(p)} ({plant_origin(p)})' for p in plants)}.",)
    return Table("Cases by kind and plant", tuple(columns), tuple(rows), notes=notes)


def ledger(table: pd.DataFrame) -> Table:
    """What happened when, as the chained ledger holds it."""
    rows = [Row((_time(str(r["time"])), str(r["step"]), str(r["words"]))) for r in table.to_dict("records")]
    columns = (Column("UTC"), Column("step"), Column("what", kind="wide"))
    notes = ("Every line of the ledger holds the hash of the line before it.",)
    return Table("From sealing to opening", columns, tuple(rows), notes=notes)


def uncounted(run: ProofRun) -> Table | None:
    """Cases that are void or failed, and why; None where there is none."""
    rows = [Row((case, "void, left out", why)) for case, why in sorted(run.void.items())]
    rows += [Row((case, "failed, counts as wrong", why)) for case, why in sorted(run.failed.items())]
    if not rows:
        return None
    columns = (Column("case"), Column("it is"), Column("why", kind="wide"))
    return Table("Void and failed cases", columns, tuple(rows))


def leak(table: pd.DataFrame, plants: Sequence[str]) -> Table:
    """What a classifier makes of names, sizes and inputs alone; 0.5 is chance."""
    rows = [
        Row(
            (
                key_label(str(r["question"])),
                number(_float(r["auc"]), 2),
                _range(r["low90"], r["high90"], 2),
                number(_float(r["chance"]), 2),
                p_words(_float(r["p"])) if math.isfinite(_float(r["p"])) else NOTHING,
                f"{int(r['n'])}",
            )
        )
        for r in table.to_dict("records")
    ]
    columns = (
        Column("what the classifier is to tell", kind="wide"), Column("area under its curve", kind="number"),
        Column("90 %", kind="number"), Column("by chance", kind="number"),
        Column("chance does as well", kind="number"), Column("cases", kind="number"),
    )  # fmt: skip
    low = int((table["p"] < _RARE).sum())
    notes = (
        "It sees names, sizes, row counts, gaps and inputs, no temperature and no displacement. By chance: what it "
        "reaches when the answers are dealt anew.",
        f"Chance does as well in fewer than {percent(_RARE)} of the deals for {low} of {len(table)} questions; "
        f"chance alone would give about {_RARE * len(table):.1f}.",
    )
    return Table("Leak test", columns, tuple(rows), simulated(plants), notes=notes)


def convergence(table: pd.DataFrame) -> Table:
    """Errors of the plants' own numerics from the coarsest to the finest, with the observed orders; a row a study."""
    rows = []
    for (plant, quantity, refined), own in table.groupby(["plant", "quantity", "refined"], sort=False):
        unit = str(own["unit"].iloc[0])
        sizes = " → ".join(f"{_float(v):g}" for v in own["size"])
        errors = " → ".join(f"{_float(v):.2g}" for v in own["error"])
        orders = ", ".join(number(_float(v), 2) for v in own["order"].dropna())
        said = str(quantity).replace(", um", ", µm")
        rows.append(Row((plant_label(str(plant)), said, str(refined), f"{sizes} {unit}", errors, orders or NOTHING)))
    columns = (Column("plant"), Column("quantity", kind="wide"), Column("refined"), Column("size", kind="number"),
               Column("error", kind="number"), Column("observed orders", kind="number"))  # fmt: skip
    notes = ("An error is against a closed form or the finest of the study; the orders say how fast it falls.",)
    return Table("Do the plants' own numerics converge?", columns, tuple(rows), True, notes=notes)


def _range(low: object, high: object, digits: int) -> str:
    a, b = _float(low), _float(high)
    return f"{number(a, digits)} to {number(b, digits)}" if math.isfinite(a) and math.isfinite(b) else NOTHING


def _time(stamp: str) -> str:
    return stamp.replace("T", " ").removesuffix("Z").split("+")[0].split(".")[0]


def _float(value: object) -> float:
    return math.nan if value is None or pd.isna(value) else float(value)  # type: ignore[call-overload, arg-type]
