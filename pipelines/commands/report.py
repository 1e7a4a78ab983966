"""`thermodrift report`: trainings compared, or with --iso recordings judged as thermal tests."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from data.errors import InputError, check_suffix, closest
from pipelines import console
from pipelines.caller import Say
from pipelines.commands import load_settings
from pipelines.home import home

if TYPE_CHECKING:
    from data.batch import Batch
    from data.lake import Lake
    from data.machine import Machine


def write_comparison(machine: str, training_ids: Sequence[str], to: Path | None, form: str) -> Path:
    """Compare tracked trainings on one page; without ids the latest of every channel. Returns the page's path.

    Raises:
        InputError: a path whose suffix does not fit the form, an unknown training, or none tracked.
        WorkError: the store does not answer.
    """
    configured = load_settings()
    from pipelines.jobs.request import REPORT_SUFFIXES
    from pipelines.store import tracking
    from reports.comparison import write_report

    if to is not None:
        check_suffix("--out", to, (f".{form}",) if form else REPORT_SUFFIXES)
    ids = list(training_ids)
    if not ids:
        past = tracking.trainings(machine, None, configured)
        if past.empty:
            raise InputError(f"no training of {machine!r} is tracked; call `thermodrift train` first")
        ids = past.drop_duplicates("target")["training_id"].tolist()
    path = to or home() / "reports" / f"{machine}.{form or 'html'}"
    write_report([tracking.load_training(i, configured) for i in ids], path, configured.promotion)
    return path


def write_thermal_tests(
    machine_file: Path, recordings: Sequence[str], out: Path, lake: Lake, sheet_file: Path | None, say: Say
) -> list[Path]:
    """Write OUT/BATCH/report.html in the style of ISO 230-3 for every batch in the recordings; returns their paths.

    `recordings` are files, folders, or ids of batches that the lake holds; none: every batch of the machine there.
    What the checks mask is left out, as in a training.

    Raises:
        InputError: no such recording or batch, a file that cannot be read, a batch without displacement, a test sheet
            that names what is not there, or a folder that cannot be written.
    """
    from data.checks import check_machine
    from data.lakefile import safe_name
    from data.machine import load_machine
    from data.yaml_file import load_yaml
    from reports.twin.iso230_3 import TestSheet, write_iso_report

    machine = load_machine(machine_file)
    sheet = load_yaml(sheet_file, TestSheet, "test sheet") if sheet_file is not None else None
    batches = check_machine(list(_tested_batches(machine, recordings, lake)), machine)
    ids = [b.batch_id for b in batches]
    for name in ids:
        if ids.count(name) > 1:
            raise InputError(f"batch {name!r} comes twice in the recordings; leave one of them out")
    reports: list[Path] = []
    for batch in batches:
        say(f"{len(reports) + 1}/{len(batches)} {batch.batch_id}")
        reports.append(write_iso_report(batch, out / safe_name(batch.batch_id), sheet))
    return reports


def _tested_batches(machine: Machine, recordings: Sequence[str], lake: Lake) -> Iterator[Batch]:
    from data.checks import checked
    from pipelines.jobs.recordings import load_batches, read_files

    held = lake.batch_ids(machine.machine)
    if not recordings:
        if not held:
            raise InputError(
                f"the lake holds no batch of {machine.machine}; name recordings, or call `thermodrift ingest` first"
            )
        yield from load_batches(lake, machine)
    for name in recordings:
        if Path(name).exists():
            yield from (checked(b, machine) for b in read_files(machine, Path(name)))
        elif name in held:
            yield lake.load(machine.machine, name)
        else:
            known = f" of {machine.machine} in the lake; {closest(name, held)}" if held else " in the lake, it is empty"
            raise InputError(f"{name}: no such file or folder, and no batch{known}")


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
    if form not in ("", "html", "md"):
        raise InputError(f"--format: got {form!r}, expected html or md")
    if sheet is not None and not iso:
        raise InputError("--sheet: a test sheet belongs to a thermal test; add --iso")
    if not iso:
        console.line(write_comparison(machine, subjects or (), to, form))
        return
    if form:
        raise InputError("--format: with --iso both forms are written; leave it out")
    from pipelines.jobs.recordings import home_lake

    folder = to or home() / "reports" / f"iso-{Path(machine).stem}"
    with console.progress(False) as (say, _):
        for path in write_thermal_tests(Path(machine), subjects or (), folder, home_lake(), sheet, say):
            console.line(path)
