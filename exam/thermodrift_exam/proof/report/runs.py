"""The record of all sealed proofs: one row per sealed root in runs.csv, the goal table of each in goals/ROOT.csv.

Every figure is text with the digits and in the unit of the published page, so that the page repeats it exactly.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pandas as pd

from data.errors import InputError
from data.files import write_atomic
from reports.labels import NOTHING
from thermodrift_exam.proof.report import labels
from thermodrift_exam.proof.report.labels import table_line
from thermodrift_exam.proof.report.tables import ProofRun, counted, goal_rows
from thermodrift_exam.proof.scoring.goal_table import WANTED
from thermodrift_exam.proof.scoring.outcomes import visible_physics
from thermodrift_exam.proof.scoring.tables import OF_RECORDINGS


@dataclass(frozen=True)
class Figure:
    """A column of the record: the measure, its unit, and whether the number of cases stands next to it.

    `of` is the column of the goal table: the measured value, or that of the model that knows the truth.
    """

    column: str
    measure: str
    unit: str = "%"
    n_column: str = ""
    of: Literal["value", "informed"] = "value"


FIGURES = (
    Figure("false_alarms_percent", "false alarms, nothing missing"),
    Figure("detection_percent", "detection, visible"),
    Figure("mechanism_percent", "mechanism first, one visible effect"),
    Figure("mechanism_truth_known_percent", "mechanism first, one visible effect", of="informed"),
    Figure("both_of_two_percent", "two visible effects: both named", n_column="both_of_two_n"),
    Figure("true_claims_of_two_percent", "two effects: claims that are true"),
    Figure("unlisted_percent", "unlisted: flagged", n_column="unlisted_n"),
    Figure("amplitude_error_median_percent", "amplitude error, median"),
    Figure("interval_coverage_percent", "90 % intervals that cover, at least"),
    Figure("calibration_error", "probabilities: expected calibration error", unit=""),
    Figure("time_median_s", "time of one case, median", unit="s"),
)
RUN_COLUMNS = (
    "root", "suite", "plants", "status", "sealed_utc", "opened_utc", "source_digest", "cases", "counted", "failed",
    "goals_met", "goals", *(c for f in FIGURES for c in (f.column, f.n_column) if c), "visible_effects", "missed",
    "missed_by_search", "claims", "false_claims", "note",
)  # fmt: skip
GOAL_COLUMNS = (
    "measure", "goal", "plant", "value", "interval90", "n", "met", "truth_known", "truth_known_n",
)  # fmt: skip
OPENED = "opened"  # also "opened in part"; roots without a result are lost or withdrawn
_COUNTS = (  # name, part, whole
    ("visible effects missed by the search", "missed_by_search", "visible_effects"),
    ("false claims", "false_claims", "claims"),
)
_GOAL = {w.measure: w.label for w in WANTED}


def read_runs(path: Path) -> pd.DataFrame:
    """The record with the columns `RUN_COLUMNS`, all text; a cell without a value is empty.

    Raises:
        InputError: the file cannot be read, or lacks a column.
    """
    try:
        table = pd.read_csv(path, dtype=str, keep_default_na=False)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); give the record of sealed proofs") from None
    lacking = [c for c in RUN_COLUMNS if c not in table.columns]
    if lacking:
        raise InputError(f"{path}: got no column {', '.join(lacking)}, expected {', '.join(RUN_COLUMNS)}")
    return table[list(RUN_COLUMNS)]


def record_run(path: Path, run: ProofRun) -> pd.DataFrame:
    """Add an opened proof to the record, or replace its row (the note stays); returns the record.

    The goal table goes to ``goals/ROOT.csv`` next to the record, ROOT being the first eight digits.

    Raises:
        InputError: the record cannot be read; OSError: a file cannot be written.
    """
    table = read_runs(path)
    row = run_row(run)
    before = table[table["root"] == run.root]
    row["note"] = str(before["note"].iloc[0]) if len(before) else ""
    new = pd.DataFrame([row], columns=list(RUN_COLUMNS))
    table = pd.concat([table[table["root"] != run.root], new]).sort_values("sealed_utc", ignore_index=True)
    goals = path.parent / "goals" / f"{run.root[:8]}.csv"
    goals.parent.mkdir(exist_ok=True)
    write_atomic(goals, _csv(published_goals(run)))
    write_atomic(path, _csv(table))
    return table


def run_row(run: ProofRun) -> dict[str, str]:
    """The row of an opened proof, without its note."""
    goals, missed, claims = run.table("goals"), run.table("missed"), run.table("claims")
    met, short, _ = counted(goals)
    row = {
        "root": run.root, "suite": run.suite, "plants": " ".join(run.plants), "status": OPENED,
        "sealed_utc": _minute(run.sealed), "opened_utc": _minute(run.opened), "source_digest": run.source_digest,
        "cases": f"{run.cases}", "counted": f"{len(run.table('outcomes'))}", "failed": f"{len(run.failed)}",
        "goals_met": f"{met}", "goals": f"{met + short}",
    }  # fmt: skip
    whole = {r.measure: r for r in goal_rows(goals, ())}
    for figure in FIGURES:
        own = whole.get(figure.measure)
        cell = None if own is None else own.whole if figure.of == "value" else own.informed
        row[figure.column] = "" if cell is None else _empty(cell.value).removesuffix(f" {figure.unit}")
        if figure.n_column:
            row[figure.n_column] = "" if cell is None else cell.n
    if len(missed):
        by_search = int((~missed["reason"].isin(OF_RECORDINGS)).sum())
        row |= {"visible_effects": f"{len(visible_physics(run.table('terms')))}", "missed": f"{len(missed)}",
                "missed_by_search": f"{by_search}"}  # fmt: skip
    if len(claims):
        row |= {"claims": f"{len(claims)}", "false_claims": f"{int((~claims['true'].astype(bool)).sum())}"}
    return dict.fromkeys(RUN_COLUMNS, "") | row


def published_goals(run: ProofRun) -> pd.DataFrame:
    """The goal table as the page shows it, columns `GOAL_COLUMNS`, a row per measure and group of plants."""
    groups = run.goal_columns
    rows = []
    for g in goal_rows(run.table("goals"), groups):
        known = (_empty(g.informed.value), g.informed.n)
        by_plant = [(p, c, ("", "")) for p, c in zip(groups, g.plants, strict=True)]
        for name, cell, informed in [("all", g.whole, known), *by_plant]:
            interval = cell.interval if name == "all" else ""
            rows.append((g.measure, g.goal, name, _empty(cell.value), interval, cell.n, cell.met, *informed))
    return pd.DataFrame(rows, columns=list(GOAL_COLUMNS))


def runs_markdown(table: pd.DataFrame, plants: str) -> str:
    """The table of all opened proofs of these plants, their notes, and the roots that have no result.

    Args:
        table: columns `RUN_COLUMNS`.
        plants: as in its column "plants".
    """
    own = table[table["plants"] == plants]
    opened = own["status"].str.startswith(OPENED)
    return "\n".join([*_opened(own[opened].to_dict("records")), *_closed(own[~opened].to_dict("records"))]) + "\n"


def _opened(records: list[dict[Any, Any]]) -> list[str]:
    rows = [
        ["measure", "goal", *(r["root"][:8] for r in records)],
        ["---", *["---:"] * (len(records) + 1)],
        ["sealed", NOTHING, *(r["sealed_utc"][:10] for r in records)],
        ["cases that count", NOTHING, *(r["counted"] for r in records)],
        ["goals met", NOTHING, *(_of(r, "goals_met", "goals") for r in records)],
    ]
    for figure in FIGURES:
        known = figure.of == "informed"
        heads = [f"the same, {labels.INFORMED}", NOTHING] if known else [figure.measure, _GOAL[figure.measure]]
        rows.append([*heads, *(_shown(r, figure) for r in records)])
    for name, part, whole in _COUNTS:
        rows.append([name, NOTHING, *(_of(r, part, whole) for r in records)])
    notes = [f"- `{r['root'][:8]}`: {r['note']}" for r in records if r["note"]]
    return [*map(table_line, rows), *(["", *notes] if notes else [])]


def _closed(records: list[dict[Any, Any]]) -> list[str]:
    if not records:
        return []
    rows = [["root", "sealed", "status", "reason"], ["---"] * 4]
    rows += [[f"`{r['root']}`", labels.stamp(r["sealed_utc"]), r["status"], r["note"]] for r in records]
    return ["", "Sealed roots without a result:", "", *map(table_line, rows)]


def _shown(record: dict[Any, Any], figure: Figure) -> str:
    value = record[figure.column]
    if not value:
        return NOTHING
    n = f" (n {record[figure.n_column]})" if figure.n_column else ""
    return f"{value} {figure.unit}".strip() + n


def _of(record: dict[Any, Any], part: str, whole: str) -> str:
    return f"{record[part]} of {record[whole]}" if record[part] else NOTHING


def _minute(utc: str) -> str:
    return f"{pd.Timestamp(utc):%Y-%m-%dT%H:%MZ}" if utc else ""


def _empty(shown: str) -> str:
    return "" if shown == NOTHING else shown


def _csv(table: pd.DataFrame) -> str:
    out = io.StringIO()
    table.to_csv(out, index=False, lineterminator="\n")
    return out.getvalue()
