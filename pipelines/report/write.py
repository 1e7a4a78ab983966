"""Write the report: collect, fill the template, put the file in place at once."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from html import escape
from pathlib import Path

from data.errors import InputError
from pipelines.report.extracts import best_per, protocols_of, scored
from pipelines.settings import Settings
from pipelines.tracking import Training

FORMATS = (".html", ".md")


def write_report(trainings: Sequence[Training], path: Path, settings: Settings) -> Path:
    """One page from tracked trainings; the suffix of `path`, .html or .md, decides the format.

    The folder is made; the file appears whole or not at all.

    Raises:
        InputError: no training given, or another suffix.
    """
    path = Path(path)
    if path.suffix not in FORMATS:
        raise InputError(f"report {path}: got suffix {path.suffix!r}, expected .html or .md")
    if not trainings:
        raise InputError(f"report {path}: got no training; give at least one tracked training")
    lines = []
    for t in trainings:
        lines.append(f"## {t.result.machine} {t.result.target}")
        protocol = protocols_of(t.result)[0]
        for row in best_per(scored(t.result, protocol, settings.promotion), "family").to_dict("records"):
            lines.append(f"{row['family']} {row['selector']} {row['S_mean_um']:.1f} ± {row['S_std_um']:.1f} µm")
    text = "\n".join(lines)
    if path.suffix == ".html":
        text = f"<!doctype html><meta charset=utf-8><title>report</title><pre>{escape(text)}</pre>"
    _write(path, text)
    return path


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, scratch = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}-", suffix=".part")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        umask = os.umask(0)
        os.umask(umask)
        Path(scratch).chmod(0o666 & ~umask)
        Path(scratch).replace(path)
    finally:
        Path(scratch).unlink(missing_ok=True)
