"""The command that reports: trainings compared, or recordings as thermal tests."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from data.errors import InputError
from pipelines import screen
from pipelines import settings as settings_module


def report(
    machine: Annotated[str, typer.Option("--machine", help="machine name; with --iso its file")],
    subjects: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[TRAININGS]...",
            help="training ids; default: the latest per channel. With --iso: files, folders "
            "or batch ids in the lake; default: every batch there",
        ),
    ] = None,
    iso: Annotated[
        bool, typer.Option("--iso", help="judge recordings as thermal tests in the style of ISO 230-3")
    ] = False,
    sheet: Annotated[Path | None, typer.Option(help="test sheet (.yml) for --iso: position, probes, tilts …")] = None,
    form: Annotated[str, typer.Option("--format", help="html or md; default: by --out, else html")] = "",
    to: Annotated[
        Path | None, typer.Option("--out", help="default: var/reports/MACHINE.html; with --iso a folder")
    ] = None,
) -> None:
    """A comparison report from tracked trainings; with --iso a thermal test's report from every recording."""
    settings_module.configure_environment()
    if form not in ("", "html", "md"):
        raise InputError(f"--format: got {form!r}, expected html or md")
    if iso:
        _thermal_tests(Path(machine), subjects or [], to, sheet, form)
        return
    if sheet is not None:
        raise InputError("--sheet: a test sheet belongs to a thermal test; add --iso")
    from pipelines import tracking
    from pipelines.request import REPORT_ENDINGS, check_ending
    from reports.comparison import write_report

    if to is not None:
        check_ending("--out", to, (f".{form}",) if form else REPORT_ENDINGS)

    settings = settings_module.load()
    ids = subjects
    if not ids:
        past = tracking.trainings(machine, None, settings)
        if past.empty:
            raise InputError(f"no training of {machine!r} is tracked; call `thermodrift train` first")
        ids = past.drop_duplicates("target")["training_id"].tolist()
    path = to or settings_module.home() / "reports" / f"{machine}.{form or 'html'}"
    write_report([tracking.load_training(i, settings) for i in ids], path, settings.promotion)
    screen.line(path)


def _thermal_tests(machine: Path, recordings: list[str], to: Path | None, sheet: Path | None, form: str) -> None:
    from data.lake import Lake
    from pipelines.thermal_tests import write_thermal_tests

    if form:
        raise InputError("--format: with --iso both forms are written; leave it out")
    home = settings_module.home()
    folder = to or home / "reports" / f"iso-{machine.stem}"
    with screen.progress(False) as (say, _):
        reports = write_thermal_tests(machine, recordings, folder, Lake(home / "lake"), sheet, say)
    for path in reports:
        screen.line(path)
