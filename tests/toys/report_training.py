"""Trainings for the tests of the report: a real, small grid, once per session, and promotions by hand."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pandas as pd

from data.batch import Batch, Finding
from models.protocols import PromotionRule
from models.selection.crossing import Crossing, Plan, cross_family
from models.selection.grid import run_grid
from models.selection.promotion import choose
from models.selection.result import GridResult, Training
from models.selection.trust import left_out_runs
from pipelines.settings import NamesPart, Settings

Maker = Callable[..., list[Batch]]
FAMILIES = ("zero", "mean_curve", "thermal_exponential", "mlr", "ridge")
HOSTILE = "b02 <script>alert('$x$')</script>|*_"
COMPARISON = {"n_batches": 28, "n_better": 21, "new_S_mean_um": 2.9, "old_S_mean_um": 3.5, "difference_um": 0.6,
              "low_um": 0.2, "high_um": 1.0, "p_value": 0.004, "better": True, "words": ""}  # fmt: skip


def settings(home: Path) -> Settings:
    """Settings that need no store."""
    return Settings(home, f"sqlite:///{home}/mlflow.db", None, NamesPart(), PromotionRule())


@cache
def results(make: Maker, k: int = 6, simulated: bool = True, findings: bool = False) -> dict[str, GridResult]:
    """The channels z and x of the toy machine; one batch has a name that HTML, Markdown and TeX would misread."""
    batches = [replace(b, simulated=simulated) for b in make(k=k, n=40, sensors=4)]
    batches[2] = replace(batches[2], batch_id=HOSTILE)
    if findings:
        found = (
            Finding("frozen", "t3", "t3 holds 21.4 °C <b>for 40 min</b>", 600.0, 3000.0),
            Finding("spike", "t1", "one spike of 3.2 K", 1200.0, 1200.0, overruled="checked & fine"),
            Finding("offset", "t2", "t2 starts 0.4 K off", masks=False),
        )
        batches[1] = batches[1].with_findings(found)
    plan = Plan(selectors=("none", "correlation", "pca_elimination"), families=FAMILIES, n_tsps=(1, 2, 4))
    return {t: judged(crossing, result) for t, (crossing, result) in run_grid(batches, ["z", "x"], plan).items()}


def judged(crossing: Crossing, result: GridResult) -> GridResult:
    """With the left-out runs and curves of the cell that the rule takes, as a training keeps them."""
    cell = choose(result, PromotionRule())
    known = cross_family(crossing, cell.family, [(cell.selector, cell.n_tsp)]).predictions
    kept = left_out_runs(crossing, (cell.selector, cell.family, cell.n_tsp), known)
    return replace(result, distances=kept.runs, curves=kept.curves)


def training(
    result: GridResult, promotion: dict[str, Any] | None = None, name: str = "t0", when: str = "2026-01-10"
) -> Training:
    """A tracked training as `tracking.load_training` gives it."""
    started = pd.Timestamp(f"{when} 08:00", tz="UTC")
    return Training(name, started, result.simulated, result, {}, promotion or {})


def promotion(cell: str, outcome: str = "champion", **changes: Any) -> dict[str, Any]:
    """What `registry.promote` records."""
    base = {"outcome": outcome, "name": "toy-z", "version": 3, "champion_version": 3, "cell": cell, "caution": "",
            "words": "toy-z version 3 is champion: …", "comparison": None, "against": 2, "obstacle": "",
            "forced": False, "nested_S_mean_um": float("nan"), "nested_S_std_um": float("nan")}  # fmt: skip
    return base | changes


def table_after(markdown: str, caption: str) -> list[list[str]]:
    """The cells of the Markdown table below a caption, head first, without the line of dashes."""
    lines = markdown.split(f"**{caption}**", 1)[1].splitlines()
    rows: list[list[str]] = []
    for line in lines[1:]:
        if line.startswith("|"):
            rows.append([c.strip() for c in line.replace("\\|", "\0").strip("|").split("|")])
        elif rows:
            break
    return [[c.replace("\0", "|").replace("\\", "") for c in r] for i, r in enumerate(rows) if i != 1]


def column(rows: Sequence[Sequence[str]], head: str) -> list[str]:
    """One column of such a table."""
    i = next(i for i, c in enumerate(rows[0]) if c.startswith(head))
    return [r[i] for r in rows[1:]]
