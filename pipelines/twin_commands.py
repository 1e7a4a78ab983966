"""The commands of the twin: simulate, calibrate, diagnose."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from data.errors import InputError, WorkError
from pipelines import screen
from pipelines import settings as settings_module
from pipelines.options import Json, MachineFile, split


def simulate(
    plans: Annotated[list[Path] | None, typer.Argument(help="run plans: stages (.yml) or tables over time")] = None,
    machine: Annotated[Path | None, typer.Option("--machine", help="machine file (.yml) with a twin part")] = None,
    sample_year: Annotated[bool, typer.Option("--sample-year", help="the built-in year of 30 batches")] = False,
    to: Annotated[Path | None, typer.Option("--out", help="folder; default: simulated, or sample_year")] = None,
    step: Annotated[float | None, typer.Option(help="seconds from row to row; default: the plan's step")] = None,
    noise: Annotated[bool, typer.Option("--noise", help="add noise and resolution of sensors and probes")] = False,
    seed: Annotated[int, typer.Option(help="of the noise, or of the sample year")] = 0,
    begins: Annotated[str, typer.Option(help="date and time of the first row; sunlight needs it")] = "",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace recordings of the same name")] = False,
    as_json: Json = False,
) -> None:
    """Simulate run plans by a machine file's twin, or the sample year; written as recordings, labelled simulated."""
    if sample_year:
        if plans or machine is not None:
            raise InputError("simulate: --sample-year has its own machine and plans; leave out --machine and PLANS")
        from plants.sample.sample_year import write_sample_year

        folder = to or Path("sample_year")
        files = write_sample_year(folder, seed=seed)
        screen.line(f"{folder}: {len(files)} simulated recordings of the sample machine, seed {seed}")
        return
    if not plans and machine is None:
        raise InputError(
            "simulate: got nothing to simulate; call `thermodrift simulate --sample-year --out FOLDER`, or "
            "`thermodrift simulate PLAN --machine FILE --out FOLDER`"
        )
    if not plans:
        raise InputError("simulate: got no run plan; name one or more (.yml with stages, or a table over time)")
    if machine is None:
        raise InputError("simulate: got a run plan and no machine; give its file by --machine")
    from pipelines.simulating import SimulationRequest, beginning, simulate_plans
    from pipelines.simulation_screen import outcome_dict, print_outcome

    folder = to or Path("simulated")
    request = SimulationRequest(machine, tuple(plans), folder, step, noise, seed, beginning(begins), overwrite)
    with screen.progress(as_json) as (say, done):
        outcome = simulate_plans(request, say, done)
    if as_json:
        screen.print_json(outcome_dict(outcome))
    else:
        print_outcome(outcome)


def calibrate(
    machine: MachineFile,
    to: Annotated[Path, typer.Option("--out", help="the calibrated machine file")],
    recordings: Annotated[
        list[Path] | None, typer.Option(help="files or folders to ingest and calibrate on; default: the lake")
    ] = None,
    batches: Annotated[str, typer.Option(help="batch ids, comma separated; default: all")] = "",
    starts: Annotated[int, typer.Option(help="starts of the fit: the priors' means, then draws from them")] = 1,
    leave_out: Annotated[
        bool, typer.Option("--leave-out/--no-leave-out", help="predict every batch by a fit on the others")
    ] = True,
    report: Annotated[bool, typer.Option(help="pictures of the fit beside --out, as .html")] = True,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace --out if it exists")] = False,
    as_json: Json = False,
) -> None:
    """Fit the machine file's free parameters to recordings: values with 90 % intervals, and what they are worth."""
    from pipelines.calibrating import CalibrationRequest, calibrate_file, outcome_dict, print_outcome

    request = CalibrationRequest(
        machine, to, tuple(recordings or ()), split(batches), starts, leave_out, report, overwrite
    )
    with screen.progress(as_json) as (say, done):
        outcome = calibrate_file(request, say, done)
    if as_json:
        screen.print_json(outcome_dict(outcome))
    else:
        print_outcome(outcome)


def diagnose(
    machine: MachineFile,
    to: Annotated[Path, typer.Option("--out", help="folder of report, findings and the new machine file")],
    recordings: Annotated[
        list[Path] | None, typer.Option(help="files or folders to ingest and diagnose on; default: the lake")
    ] = None,
    batches: Annotated[str, typer.Option(help="batch ids, comma separated; default: all")] = "",
    seed: Annotated[int, typer.Option(help="of everything that is drawn")] = 0,
    report: Annotated[bool, typer.Option(help="write report.html")] = True,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="replace an earlier diagnosis of this machine")
    ] = False,
    as_json: Json = False,
) -> None:
    """Why simulation and recordings differ: which physics is missing, where, when, and how much better it fits."""
    settings_module.configure_environment()
    from pipelines.diagnosing import DiagnosisRequest, diagnose_file

    settings = settings_module.load()
    request = DiagnosisRequest(machine, to, tuple(recordings or ()), split(batches), seed, report, overwrite)
    with screen.progress(as_json) as (say, done):
        outcome = diagnose_file(request, settings, say, done)
    from pipelines.diagnosis_screen import outcome_dict, print_outcome

    if as_json:
        screen.print_json(outcome_dict(outcome))
    else:
        print_outcome(outcome)
    if outcome.trouble:
        raise WorkError(f"{outcome.trouble}; the findings stand in {outcome.out}")
