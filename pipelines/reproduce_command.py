"""The command that repeats published studies on simulated machines."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from data.errors import InputError, closest
from pipelines import screen
from pipelines.options import Json


def reproduce(
    study: Annotated[str, typer.Argument(help="a published study, or `all`")],
    seeds: Annotated[int, typer.Option(help="simulated machine-years")] = 20,
    to: Annotated[Path | None, typer.Option("--out", help="folder of the page and the tables")] = None,
    workers: Annotated[int | None, typer.Option(help="processes; default: one per core")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace an earlier page in --out")] = False,
    as_json: Json = False,
) -> None:
    """Repeat published studies on simulated machines: their figures beside ours, and which orderings hold."""
    from evidence.studies import STUDIES
    from evidence.studies.base import run_studies
    from evidence.studies.report import FILES, write_results
    from pipelines.reproduce_screen import outcome_dict, print_results

    if study != "all" and study not in STUDIES:
        raise InputError(f"unknown study {study!r}: {closest(study, [*STUDIES, 'all'])}")
    if workers is not None and workers < 1:
        raise InputError(f"--workers: got {workers}, expected 1 or more")
    if to is not None:
        from data.files import check_folder

        check_folder(to, [to / name for name in FILES], overwrite)
    with screen.progress(as_json) as (_, done):
        results = run_studies(
            tuple(STUDIES) if study == "all" else (study,), seeds, workers or os.cpu_count() or 1, done
        )
        page = write_results(list(results.values()), to) if to is not None else None
    if as_json:
        screen.print_json(outcome_dict(list(results.values()), page))
    else:
        print_results(list(results.values()), page)
