"""From an opened proof to what its report shows: ledger, protection, failures, the worst cases' series and windows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import pandas as pd

from pipelines.report.proof_run import TABLES, ProofRun
from pipelines.report.words import count
from twin.proof.sealing.examinee import SERIES
from twin.proof.sealing.examining import RUN
from twin.proof.sealing.folder import ProofFolder, read_json
from twin.proof.sealing.ledger import Entry
from twin.proof.sealing.opening import Opened

_OF_A_CASE = ("started", "answered")


def run_of(folder: ProofFolder, opened: Opened, tables: Mapping[str, pd.DataFrame]) -> ProofRun:
    """The report's input.

    Args:
        tables: by the keys of `proof_run.TABLES`, as scoring made them; ledger, series and windows are added here.

    Raises:
        InputError: an answer that cannot be read.
        WorkError: a table that lacks a column.
    """
    told = {case: read_json(folder.answers / case / RUN) for case in opened.counting}
    protections = pd.Series([str(r["isolation"]) for r in told.values()], dtype="string").value_counts()
    suite: Literal["development", "sealed"] = "sealed" if opened.commitment["suite"] == "sealed" else "development"
    worst = [str(c) for c in tables["worst"]["case"]] if "worst" in tables else []
    own = {
        "ledger": ledger_table(opened.entries),
        "series": series_of(folder.answers, worst),
        "windows": windows_of(opened.answers, worst),
    }
    return ProofRun(
        root=str(opened.commitment["root"]),
        suite=suite,
        cases=int(opened.commitment["number"]),
        sealed=str(opened.commitment["sealed"]),
        opened=opened.state.opened or "",
        version=str(opened.commitment["version"]),
        source_digest=opened.state.source or "",
        partial=opened.partial,
        isolation={str(k): int(n) for k, n in sorted(protections.items())},
        void=dict(opened.void),
        failed={case: str(r["error"]) for case, r in told.items() if r.get("error")},
        tables=own | dict(tables),
    )


def ledger_table(entries: Iterable[Entry]) -> pd.DataFrame:
    """Columns time, step, words; cases begun and answered in a row stand in one line."""
    rows: list[tuple[str, str, str]] = []
    answered: list[str] = []

    def close() -> None:
        if answered:
            rows.append((answered[-1], "answered", f"{count(len(answered), 'case')} since {_clock(answered[0])}"))
        answered.clear()

    for e in entries:
        if e.step in _OF_A_CASE:
            answered += [e.at] if e.step == "answered" else []
            continue
        close()
        rows.append((e.at, e.step, e.words))
    close()
    return pd.DataFrame(rows, columns=list(TABLES["ledger"]))


def series_of(answers: Path, cases: Sequence[str]) -> pd.DataFrame:
    """What the answering processes kept of these cases: recorded, before and after of a channel."""
    paths = {case: answers / case / SERIES for case in cases}
    parts = [pd.read_csv(path).assign(case=case) for case, path in paths.items() if path.exists()]
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=list(TABLES["series"]))


def windows_of(answers: Mapping[str, Mapping[str, Any]], cases: Sequence[str]) -> pd.DataFrame:
    """When the concealed effects of these cases work; no row for a case with one that always does."""
    rows: list[tuple[Any, ...]] = []
    for case in cases:
        active = [term["active"] for term in answers[case]["terms"]]
        if "always" not in active:
            rows += [(case, *window) for windows in active for window in windows]
    return pd.DataFrame(rows, columns=list(TABLES["windows"]))


def _clock(utc: str) -> str:
    return utc.replace("T", " ").removesuffix("Z")
