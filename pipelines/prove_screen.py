"""What `thermodrift prove` shows: goals beside what was measured, what does not count, and where it lies."""

from __future__ import annotations

from typing import Any

import pandas as pd
from rich.box import SIMPLE_HEAD
from rich.table import Table

from evidence.proof.proving import ProofOutcome
from pipelines import screen
from reports.labels import count


def outcome_dict(outcome: ProofOutcome) -> dict[str, Any]:
    """What came of a proof, for machines."""
    r = outcome.run
    cases = r.table("outcomes")
    return {
        "root": r.root, "suite": r.suite, "sealed": r.sealed, "opened": r.opened, "version": r.version,
        "source_digest": r.source_digest, "partial": r.partial, "cases": r.cases, "scored": len(cases),
        "right": int(cases["right"].sum()), "isolation": dict(r.isolation), "void": dict(r.void),
        "failed": dict(r.failed), "goals": screen.records(r.table("goals")), "leak": screen.records(r.table("leak")),
        "files": {name: str(path) for name, path in outcome.files.items()},
    }  # fmt: skip


def print_outcome(outcome: ProofOutcome) -> None:
    """Goals over all plants, the leak test, then files."""
    r = outcome.run
    cases = r.table("outcomes")
    partial = ", opened before every case had an answer" if r.partial else ""
    label = "  (SIMULATED plants)" if cases["simulated"].any() else ""
    screen.out.print(f"proof of {count(r.cases, 'case')}, suite {r.suite}{partial}{label}", style="bold")
    screen.line(f"root     {r.root}")
    screen.line(f"right    {int(cases['right'].sum())} of {len(cases)} answers as a whole")
    for what, cases_of in (("void", r.void), ("failed", r.failed)):
        if cases_of:
            first, why = next(iter(cases_of.items()))
            screen.line(f"{what:8} {count(len(cases_of), 'case')}; {first}: {why}")
    goals = r.table("goals")
    screen.out.print(_goals(goals[goals["plant"] == "all"]))
    if len(r.table("leak")):
        screen.out.print(_leak(r.table("leak")))
    for path in outcome.files.values():
        screen.line(path)


def _goals(goals: pd.DataFrame) -> Table:
    table = _table("goals", "measure", "goal", "measured", "90 %", "n", "met")
    for g in goals.to_dict("records"):
        measured = "–" if pd.isna(g["value"]) else f"{g['value']:.3g}"
        sure = "" if pd.isna(g["low90"]) else f"{g['low90']:.3g} … {g['high90']:.3g}"
        met = "" if pd.isna(g["met"]) else "yes" if g["met"] else "no"
        table.add_row(str(g["measure"]), str(g["goal"]), measured, sure, str(g["n"]), met)
    return table


def _leak(leak: pd.DataFrame) -> Table:
    table = _table("leak test: names, sizes and inputs alone (chance: as far as dealt answers go)",
                   "question", "area", "90 %", "chance", "p", "cases")  # fmt: skip
    for row in leak.to_dict("records"):
        sure = f"{row['low90']:.2f} … {row['high90']:.2f}"
        table.add_row(
            str(row["question"]), f"{row['auc']:.2f}", sure, f"{row['chance']:.2f}", f"{row['p']:.2f}", str(row["n"])
        )
    return table


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, box=SIMPLE_HEAD, title_justify="left", pad_edge=False, show_edge=False)
    for k, name in enumerate(columns):
        table.add_column(name, justify="left" if k == 0 else "right", overflow="fold")
    return table
