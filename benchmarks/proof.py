"""The outcomes of an opened proof as stored results, which the pages quote.

    python -m benchmarks.proof PROOF --table results/proof_kinds.csv

Stores a row for each case that counts: what was concealed, what is visible, named and claimed, and the time; and next
to it, as `..._compared.csv`, the diagnosis and its baselines on the same cases.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import pandas as pd

from benchmarks.results import write
from thermodrift_exam.proof.report.labels import method_label, plant_label
from thermodrift_exam.proof.scoring.outcomes import visible_physics


def cases_of(proof: Path) -> pd.DataFrame:
    """A row for each case that counts; `named` of the `visible` effects have their mechanism and place in a claim."""
    rows, terms = pd.read_csv(proof / "outcomes.csv"), pd.read_csv(proof / "terms.csv")
    named = visible_physics(terms).groupby("case")["found"].sum()
    return pd.DataFrame(
        {
            "case": rows["case"],
            "machine": rows["plant"].map(plant_label),
            "kind": rows["kind"],
            "concealed": rows["effect"],
            "verdict": rows["verdict"].fillna("failed"),
            "visible": rows["visible_terms"].fillna(0).astype(int),
            "named": rows["case"].map(named).fillna(0).astype(int),
            "claims": rows["claims"].fillna(0).astype(int),
            "false_claims": rows["false_claims"].fillna(0).astype(int),
            "called_unlisted": rows["flagged_unlisted"].fillna(False).astype(bool),
            "cpu_s": rows["case"].map(lambda case: _cpu_s(proof, case)),
        }
    )


def _cpu_s(proof: Path, case: str) -> float:
    run = json.loads((proof / "answers" / case / "run.json").read_text(encoding="utf-8"))
    return float(run["processor_seconds"] or "nan")  # a refused case has none


def methods_of(proof: Path) -> pd.DataFrame:
    """The diagnosis and its baselines: shares with exact 90 % intervals, and the lead over each, paired by case."""
    rows = pd.read_csv(proof / "compared.csv")
    rows = rows[rows["group"] != "ablation"].drop(columns="group")
    return rows.assign(method=rows["method"].map(method_label)).round(4)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("proof", type=Path, help="folder of an opened proof")
    parser.add_argument("--table", type=Path, required=True, help="where the rows go, .csv")
    given = parser.parse_args()
    command = f"python -m benchmarks.proof PROOF --table {given.table}"
    write(given.table, cases_of(given.proof), command)
    write(given.table.with_stem(f"{given.table.stem}_compared"), methods_of(given.proof), command)


if __name__ == "__main__":
    main()
