"""The tables of an opened proof, for its page and as files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import pandas as pd

from data.registry import Registry
from thermodrift_exam.proof.judging import Judged
from thermodrift_exam.proof.report.tables import TABLES, ProofRun
from thermodrift_exam.proof.scoring.goal_table import goal_table, reliability
from thermodrift_exam.proof.scoring.outcomes import outcomes
from thermodrift_exam.proof.scoring.tables import claims, compared, confusion, missed, worst
from thermodrift_exam.proof.sealing.folder import Entry, ProofFolder
from thermodrift_exam.proof.sealing.opening import Opened

OF_CASES = ("started", "answered", "interrupted", "void")  # steps of the ledger that are counted, not listed


def tables_of(
    folder: ProofFolder, opened: Opened, judged: Mapping[str, Judged], leak: pd.DataFrame
) -> dict[str, pd.DataFrame]:
    """Every table derived from stored answers and keys, by its name on the page."""
    keys = {name: opened.answers[name] for name in judged}
    stored = {name: j.stored for name, j in judged.items()}
    truths = {n: j.truth for n, j in judged.items() if j.truth is not None}
    cases, terms = outcomes(keys, stored, truths)
    methods = compared(keys, stored, truths)
    ten = worst(cases)
    return {
        "ledger": ledger_table(opened.entries),
        "outcomes": cases,
        "terms": terms,
        "goals": goal_table(cases, terms, methods),
        "compared": methods,
        "reliability": reliability(cases)[0],
        "confusion_mechanism": confusion(terms, "mechanism"),
        "confusion_place": confusion(terms, "place"),
        "missed": missed(terms),
        "claims": claims(keys, stored),
        "leak": leak,
        "worst": ten,
        "series": _series(folder, ten["case"].tolist()),
        "windows": _windows(keys, ten["case"].tolist()),
    }


def proof_run(opened: Opened, judged: Mapping[str, Judged], tables: Mapping[str, pd.DataFrame]) -> ProofRun:
    """The input of the page of the proof."""
    c = opened.commitment
    runs = {name: j.stored.run for name, j in judged.items()}
    return ProofRun(
        root=c["root"],
        suite=c["suite"],
        cases=c["number"],
        sealed=c["sealed"],
        opened=opened.state.opened or "",
        version=c["version"],
        source_digest=opened.state.source,
        partial=opened.partial,
        until=opened.state.until,
        isolation=Counter(str(r["isolation"]) for r in runs.values()),
        void=opened.void,
        failed={name: str(r["error"]) for name, r in runs.items() if r.get("error")},
        tables=tables,
    )


def ledger_table(entries: Sequence[Entry]) -> pd.DataFrame:
    """Columns time, step, words: every step but those of single cases, which are counted until the next one."""
    rows: list[tuple[str, str, str]] = []
    counted: Counter[str] = Counter()
    last = ""
    for e in entries:
        if e.step in OF_CASES:
            counted[e.step] += 1
            last = e.at
            continue
        rows += _counts(counted, last)
        counted.clear()
        rows.append((e.at, e.step, e.summary))
    rows += _counts(counted, last)
    return pd.DataFrame(rows, columns=list(TABLES["ledger"]))


def _counts(counted: Mapping[str, int], at: str) -> Iterator[tuple[str, str, str]]:
    for step in OF_CASES[1:]:
        if n := counted.get(step):
            yield at, step, f"{n} case{'' if n == 1 else 's'}"


def _series(folder: ProofFolder, cases: Sequence[str]) -> pd.DataFrame:
    """Recorded, before and after of the worst channel of these cases."""
    files = {n: folder.answers / n / "series.csv" for n in cases}
    own = [pd.read_csv(path).assign(case=name) for name, path in files.items() if path.exists()]
    return pd.concat(own, ignore_index=True) if own else pd.DataFrame(columns=list(TABLES["series"]))


def _windows(keys: Mapping[str, Mapping[str, Any]], cases: Sequence[str]) -> pd.DataFrame:
    rows = [
        (name, *window)
        for name in cases
        for term in keys[name]["terms"]
        if term["active"] != "always"
        for window in term["active"]
    ]
    return pd.DataFrame(rows, columns=list(TABLES["windows"]))


# Called without arguments; gives the columns of the page's table.
STUDIES = Registry(
    "convergence study",
    {
        "elements": "thermodrift_exam.plants.convergence:elements_study",
        "volumes": "thermodrift_exam.plants.convergence:volumes_study",
    },
)


def convergence_of(plants: Sequence[str]) -> pd.DataFrame:
    """One row a plant, quantity and refinement; real recordings have none. Tens of seconds a plant."""
    studied = [STUDIES[p]() for p in plants if p in STUDIES]
    columns = list(TABLES["convergence"])
    return pd.concat(studied, ignore_index=True)[columns] if studied else pd.DataFrame(columns=columns)
