"""The parts of exam/results/proof.md that an opened proof writes: its result, and the table of all sealed proofs."""

from __future__ import annotations

import re
from pathlib import Path

import pandas as pd

from data.errors import InputError
from data.files import write_atomic
from reports.labels import NOTHING
from thermodrift_exam.proof.report import labels, shortfall
from thermodrift_exam.proof.report.labels import table_line
from thermodrift_exam.proof.report.page import headline
from thermodrift_exam.proof.report.runs import record_run, runs_markdown
from thermodrift_exam.proof.report.tables import Cell, ProofRun, goal_rows, shortfalls

BEGIN, END = "<!-- result: written by thermodrift prove open --publish -->", "<!-- end of result -->"
_BLOCK = re.compile(f"{re.escape(BEGIN)}.*?{re.escape(END)}", re.DOTALL)
RUNS_BEGIN, RUNS_END = "<!-- runs: written by thermodrift prove open --publish from ", "<!-- end of runs -->"
_RUNS = re.compile(rf"({re.escape(RUNS_BEGIN)}(\S+) -->).*?{re.escape(RUNS_END)}", re.DOTALL)
NO_RUN = "No sealed proof has been run on this version yet, so there is no result to show."


def publish_proof(path: Path, run: ProofRun | None) -> None:
    """Put a run's result between the two markers of a Markdown file.

    Where the file also has a block of runs, whose first line names their record relative to the file, the run is added
    to the record and the block is rewritten. Nothing else of the file changes.

    Raises:
        InputError: a file cannot be read or written, has no pair of markers, or the run is of a development suite
            or opened in part.
    """
    if run is not None and (run.suite != "sealed" or run.partial):
        got = "a development suite" if run.suite != "sealed" else "a proof opened in part"
        raise InputError(f"--publish {path}: got {got}, expected a sealed suite with all answers; leave --publish out")
    try:
        text = path.read_text(encoding="utf-8")
        if len(_BLOCK.findall(text)) != 1:
            raise InputError(f"--publish {path}: expected one pair of lines {BEGIN} and {END}; put them where it goes")
        text = _BLOCK.sub(lambda _: f"{BEGIN}\n\n{proof_markdown(run)}\n{END}", text)
        record = record_of(path, text)
        if run is not None and record is not None:
            text = with_runs(text, record_run(record, run), " ".join(run.plants))
        write_atomic(path, text)
    except OSError as error:
        raise InputError(f"--publish {path}: cannot be read or written ({error.strerror}); give another file") from None


def record_of(path: Path, text: str) -> Path | None:
    """The record of sealed proofs that a page names; None where it has no block of runs."""
    block = _RUNS.search(text)
    return None if block is None else path.parent / block[2]


def with_runs(text: str, table: pd.DataFrame, plants: str) -> str:
    """The page with its block of runs written from the record (`runs.runs_markdown`)."""
    return _RUNS.sub(lambda m: f"{m[1]}\n\n{runs_markdown(table, plants)}\n{RUNS_END}", text)


def proof_markdown(run: ProofRun | None) -> str:
    """The block between the markers; without a run a sentence says so."""
    if run is None:
        return NO_RUN + "\n"
    goals = run.table("goals")
    lines = [f"**{headline(run)}** {labels.origin(run.plants)}".rstrip(), ""]
    lines += [f"{remark}\n" for remark in run.remarks]
    lines += [
        f"- Sealed root: `{run.root}`",
        f"- Sealed {labels.stamp(run.sealed)}, opened {labels.stamp(run.opened)}, thermodrift {run.version}",
        f"- Source that answered: `{run.source_digest}`",
        f"- Cases: {run.cases} sealed, {len(run.table('outcomes'))} count, {len(run.void)} void, "
        f"{len(run.failed)} failed (counted as wrong)",
        "",
    ]
    lines += _table(goals, run)
    short = shortfalls(goals)
    missed = [*(f"- {said}" for said in short), *_by_plant(goals, run.plants)]
    lines += ["", "Missed goals:", "", *missed] if missed else ["", "No goal is missed on any plant."]
    lines += _shortfall(run)
    return "\n".join(lines) + "\n"


def _table(goals: pd.DataFrame, run: ProofRun) -> list[str]:
    plants = run.goal_columns
    heads = [f"{labels.plant_label(p)} ({labels.plant_origin(p)})" for p in plants]
    cells = [
        "measure",
        "goal",
        f"all plants ({labels.origin(run.plants)})",
        "90 %",
        "n",
        "met",
        labels.INFORMED,
        *heads,
    ]
    out = [table_line(cells), table_line(["---", *["---:"] * 4, "---", *["---:"] * (len(heads) + 1)])]
    for g in goal_rows(goals, plants):
        met = {"yes": "yes", "no": "**no**"}.get(g.whole.met, NOTHING)
        interval, n = g.whole.interval or NOTHING, g.whole.n or NOTHING
        out.append(
            table_line([g.measure, g.goal, g.whole.value, interval, n, met, *map(_plant, [g.informed, *g.plants])])
        )
    return [*out, "", f"{labels.INFORMED.capitalize()}: {labels.meaning(labels.INFORMED)}"]


def _shortfall(run: ProofRun) -> list[str]:
    """Causes of missed goals: reasons by plant, and false claims by mechanism."""
    own = shortfall.tables(run, each=False)
    out = ["", " ".join(shortfall.sentences(run))] if own else []
    for table in own:
        heads = [f"{c.title} ({c.unit})" if c.unit else c.title for c in table.columns]
        rule = ["---:" if c.kind == "number" else "---" for c in table.columns]
        out += [
            "",
            f"{table.caption}, {labels.origin(run.plants)}:",
            "",
            table_line(heads),
            table_line(rule),
        ]
        out += [table_line([str(cell) for cell in row.cells]) for row in table.rows]
    return out


def _plant(cell: Cell) -> str:
    said = f"{cell.value} (n {cell.n})" if cell.n else cell.value
    return f"**{said}**" if cell.met == "no" else said


def _by_plant(goals: pd.DataFrame, plants: tuple[str, ...]) -> list[str]:
    """Goals that all plants together meet and one plant misses."""
    whole = set(goals.loc[(goals["plant"] == "all") & goals["met"].eq(False), "measure"])
    rest = goals[~goals["measure"].isin(whole)]
    return [f"- plant {labels.plant_letter(p)} alone, {said}" for p in plants for said in shortfalls(rest, p)]
