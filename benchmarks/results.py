"""Stored results: a table as CSV, and next to it how it was made, as JSON. README and docs quote nothing else."""

from __future__ import annotations

import json
from datetime import date
from importlib.metadata import version
from pathlib import Path

import pandas as pd

from pipelines.store.runs import code_version


def write(path: Path, table: pd.DataFrame, command: str) -> None:
    """Store a table, the command that made it, the version and commit of the program, and the day."""
    made = {
        "schema": "thermodrift.result/1", "command": command, "version": version("thermodrift"),
        "code": code_version(), "date": date.today().isoformat(), "rows": len(table),
    }  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    table.to_csv(path, index=False)  # after `code_version`: a stored result is part of the code
    path.with_suffix(".json").write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")
