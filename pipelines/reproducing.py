"""What `thermodrift reproduce --out` writes: the page, the same as Markdown, and the tidy tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from models.studies.result import StudyResult
from pipelines.out_folder import staged
from pipelines.report.reproduction import reproduction_page
from pipelines.report.write import template_environment

FILES = ("values.parquet", "figures.csv", "orderings.csv", "reproduction.md", "reproduction.html")


def write_results(results: Sequence[StudyResult], folder: Path) -> Path:
    """Write all files or none; returns the page's path. Every table says in a column that it is simulated.

    Raises:
        WorkError: the folder cannot be written.
    """
    page = reproduction_page(results)
    written = f"{pd.Timestamp.now('UTC'):%Y-%m-%d %H:%M} UTC"
    with staged(folder, FILES) as scratch:
        _together([r.table for r in results]).to_parquet(scratch / FILES[0], index=False)
        _together([r.figures() for r in results]).to_csv(scratch / FILES[1], index=False, lineterminator="\n")
        _together([r.orderings() for r in results]).to_csv(scratch / FILES[2], index=False, lineterminator="\n")
        for name in FILES[3:]:
            template = template_environment(name.endswith(".html")).get_template(f"{name}.j2")
            (scratch / name).write_text(template.render(page=page, written=written), encoding="utf-8")
    return folder / FILES[-1]


def _together(tables: Sequence[pd.DataFrame]) -> pd.DataFrame:
    return pd.concat(tables, ignore_index=True).assign(simulated=True)
