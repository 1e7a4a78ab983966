"""What does the demonstration of other seeds say?

    python -m benchmarks.demonstrations --seeds 20 --table results/demonstrations.csv

Runs `thermodrift demonstrate` for the seeds from 1, two side by side, and stores a row for each: what was concealed,
the outcome, the first claim with its probability, the left-out error after by before (mean over the channels), and,
where the effect was not named, the least of its kind that the page says would have been claimed at its place.
Seeds that are done are not done again; one whose diagnosis does not end is a row without an answer. Everything is
simulated.
"""

from __future__ import annotations

import argparse
import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.results import write
from data.errors import WorkError
from diagnosis.findings.schema import Findings
from reports.diagnosis.tables import by_channel, effect_label
from thermodrift_exam.plants.concealed import conceal
from thermodrift_exam.proof.demonstrating import Demonstration, demonstrate, key_of
from thermodrift_exam.proof.scoring.answer_key import TrueTerm
from thermodrift_exam.proof.scoring.matching import means


def row_of(seed: int, out: Path) -> dict[str, Any]:
    """The row of a seed, from its file where it is done already."""
    path = out / f"{seed}.json"
    if not path.exists():
        try:
            row = _row(demonstrate(seed, out / str(seed)))
        except WorkError as error:  # no answer is a row too
            row = {
                "seed": seed,
                "concealed": conceal(seed, None).answer["words"],
                "outcome": str(error).rpartition(": ")[2],
            }
        path.write_text(json.dumps(row, default=float))
    return dict(json.loads(path.read_text()))


def _row(done: Demonstration) -> dict[str, Any]:
    findings, rms = done.diagnosis.findings, by_channel(done.diagnosis.tables["rms"])
    first = next(iter(findings.findings), None)
    silent = done.judgement.outcome in ("missed", "wrong")
    return {
        "seed": done.seed, "concealed": done.answer["words"], "outcome": done.judgement.outcome,
        "claimed": effect_label(first) if first else "", "probability": round(first.probability, 2) if first else "",
        "left_share": round(float((rms["after"] / rms["before"]).mean()), 3),
        "stated_limit": _limit(findings, key_of(done.answer).terms[0]) if silent else "",
    }  # fmt: skip


def _limit(findings: Findings, term: TrueTerm) -> str:
    """The limit that is stated for an effect at its place, "none" where there is none."""
    for limit in findings.detection_limits:
        if means(limit.mechanism, term) and (limit.where.kind, limit.where.name) == (term.where.kind, term.where.name):
            return f"{limit.limit:.3g} {limit.unit}" if limit.limit is not None else "none"
    return "none"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=20, help="how many, from 1")
    parser.add_argument("--table", type=Path, required=True, help="where the rows go, .csv")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("var/demonstrations"))
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(given.workers) as pool:
        rows = []
        for row in pool.map(lambda seed: row_of(seed, given.out), range(1, given.seeds + 1)):
            rows.append(row)
            print(*row.values(), sep=" | ", flush=True)
    command = f"python -m benchmarks.demonstrations --seeds {given.seeds} --table {given.table}"
    write(given.table, pd.DataFrame(rows), command)


if __name__ == "__main__":
    main()
