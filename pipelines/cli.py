"""The command line. Exit codes: 0 done, 1 the work failed, 2 bad arguments or input (one clear line)."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from data.errors import InputError, WorkError, closest
from pipelines import screen
from pipelines import settings as settings_module

app = typer.Typer(
    name="thermodrift",
    help="Thermal error of machine tools: from a year of recordings to a promoted compensation model.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
MachineFile = Annotated[Path, typer.Option("--machine", help="machine file (.yml)")]
Json = Annotated[bool, typer.Option("--json", help="print JSON instead of tables")]


@app.command()
def describe(
    files: Annotated[list[Path] | None, typer.Argument(help="recordings of one machine")] = None,
    to: Annotated[
        Path | None, typer.Option("--out", help="the draft's file, or the picture's (.svg, .png, .html)")
    ] = None,
    twin: Annotated[
        Path | None, typer.Option("--twin", help="draw this machine file's thermal network instead")
    ] = None,
    at: Annotated[
        list[str] | None, typer.Option("--at", help="with --twin: a driver that the watts are shown at, NAME=VALUE")
    ] = None,
) -> None:
    """Draft a machine file from recordings, every guess marked; or draw a machine file's twin."""
    if twin is not None:
        if files:
            raise InputError(f"--twin {twin}: draws a machine file and reads no recordings; leave out {files[0]}")
        from pipelines.describe_twin import describe_twin, print_twin

        print_twin(describe_twin(twin, to, at or ()))
        if to is not None:
            screen.line(to)
        return
    if not files:
        raise InputError("describe: got nothing to describe; name recordings, or a machine file as --twin MACHINE.yml")
    if at:
        raise InputError(f"--at {at[0]}: belongs to a twin's picture; add --twin MACHINE.yml")
    from data.describe import draft_machine_file

    text = draft_machine_file(files)
    if to is None:
        sys.stdout.write(text)
        return
    if to.exists():
        raise InputError(f"{to} exists; give another --out or remove it first")
    to.write_text(text, encoding="utf-8")
    screen.line(f"{to}: a draft; check every line marked 'guessed', then call `thermodrift ingest --machine {to} …`")


@app.command()
def ingest(
    paths: Annotated[list[Path], typer.Argument(help="recordings or folders of recordings")],
    machine: MachineFile,
    as_json: Json = False,
) -> None:
    """Read recordings into the lake; what cannot be used goes to quarantine with the reason."""
    from data.batch import finding_table
    from data.ingest import ingest as ingest_paths
    from data.lake import Lake
    from data.machine import load_machine

    described = load_machine(machine)
    with screen.progress(as_json) as (say, _):
        report = ingest_paths(paths, described, Lake(settings_module.home() / "lake"), progress=say)
    if as_json:
        screen.print_json(screen.records(report.as_frame()))
    else:
        screen.print_ingest(report)
        screen.print_findings(finding_table((r.batch_id, r.found) for r in report.batches))
    if not report.rows:
        raise InputError(
            f"{', '.join(map(str, paths))}: no recording there, {len(report.ignored)} other files; the machine file "
            f"asks for {', '.join(described.recording.files)}; give another folder or correct recording.files"
        )
    if not report.batches:
        raise InputError(f"no file could be used ({len(report.quarantined)} in quarantine); the reasons are above")


@app.command()
def train(
    machine: MachineFile,
    recordings: Annotated[list[Path] | None, typer.Option(help="files or folders to ingest first")] = None,
    channels: Annotated[str, typer.Option(help="error channels, comma separated; default: all")] = "",
    selectors: Annotated[str, typer.Option(help="selectors, comma separated; default: all")] = "",
    families: Annotated[str, typer.Option(help="model families, comma separated; default: what suits it")] = "",
    protocols: Annotated[str, typer.Option(help="protocols, comma separated; default: all")] = "",
    report: Annotated[Path | None, typer.Option(help="where the report goes")] = None,
    promote: Annotated[bool, typer.Option(help="promote the best cell")] = True,
    direct: Annotated[bool, typer.Option("--direct", help="without Prefect: same functions, same numbers")] = False,
    as_json: Json = False,
) -> None:
    """The main job: ingest → features → grid → track → promote → report."""
    settings_module.configure_environment()
    from features.selectors import SELECTORS
    from models import FAMILIES
    from models.crossing import Plan
    from models.protocols import PROTOCOLS
    from pipelines.request import TrainRequest, check_request

    settings = settings_module.load()
    chosen = (
        _names(selectors, SELECTORS, "selector"),
        _names(families, FAMILIES, "family") if families else (),  # none: what suits the machine
        _names(protocols, PROTOCOLS, "protocol"),
    )
    targets = _split(channels)
    request = TrainRequest(machine, tuple(recordings or ()), targets, Plan(*chosen), report, promote)
    check_request(request, settings)  # before anything is started
    server = None
    if not direct:
        from pipelines.flows import start_server, train_in_flow

        server = start_server()
    from pipelines import training

    with screen.progress(as_json) as (say, done):
        if direct:
            outcome = training.train(request, settings, training.DirectCaller(done=done), say)
        else:
            outcome = train_in_flow(request, settings, say, done, server)
    if as_json:
        screen.print_json(screen.outcome_dict(outcome))
    else:
        screen.print_outcome(outcome)


@app.command()
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
    from pipelines.report import write_report
    from pipelines.request import REPORT_ENDINGS, check_ending

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
    write_report([tracking.load_training(i, settings) for i in ids], path, settings)
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


@app.command()
def promote(
    training: Annotated[str, typer.Argument(help="training id, as `thermodrift status` lists it")],
    machine: MachineFile,
    cell: Annotated[str, typer.Option(help="selector|family|n_tsp; default: by the rule in mlflow.yml")] = "",
    force: Annotated[bool, typer.Option("--force", help="replace the champion though it is not beaten")] = False,
) -> None:
    """Promote a cell of a tracked training: refit on its batches, register, compare with the champion."""
    settings_module.configure_environment()
    from pipelines.training import promote_tracked

    screen.line(promote_tracked(training, machine, cell, force, settings_module.load()).words)


@app.command()
def rollback(model: Annotated[str, typer.Argument(help="registered model, MACHINE-CHANNEL")]) -> None:
    """Give the champion's place back to the previous champion."""
    settings_module.configure_environment()
    from pipelines import registry

    screen.line(registry.rollback(model, settings_module.load()).words)


@app.command()
def predict(
    file: Annotated[Path, typer.Argument(help="a raw recording of the model's machine")],
    model: Annotated[str, typer.Option("--model", help="models:/NAME@champion, models:/NAME/3, runs:/… or a folder")],
    to: Annotated[Path | None, typer.Option("--out", help=".csv or .parquet; default: CSV on standard output")] = None,
) -> None:
    """Predict the error of a recording; rows outside the trained region are marked."""
    settings_module.configure_environment()
    from pipelines.predict import predict_file
    from pipelines.request import check_ending

    if to is not None:
        check_ending("--out", to, (".csv", ".parquet"))

    table = predict_file(model, file, settings_module.load())
    if to is None:
        table.to_csv(sys.stdout, index=False)
    elif to.suffix == ".parquet":
        table.to_parquet(to, index=False)
    else:
        table.to_csv(to, index=False)


@app.command()
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
        from data.sample_year import write_sample_year

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


@app.command()
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
        machine, to, tuple(recordings or ()), _split(batches), starts, leave_out, report, overwrite
    )
    with screen.progress(as_json) as (say, done):
        outcome = calibrate_file(request, say, done)
    if as_json:
        screen.print_json(outcome_dict(outcome))
    else:
        print_outcome(outcome)


@app.command()
def schedule(
    machine: MachineFile,
    recordings: Annotated[list[Path], typer.Option(help="folders that new recordings arrive in")],
    cron: Annotated[str, typer.Option(help="when to look, as cron")] = "0 5 * * 1",
) -> None:
    """Serve retraining on a schedule: new batches are ingested and learned; runs until interrupted."""
    settings_module.configure_environment()
    from data.machine import load_machine
    from pipelines.flows import serve_schedule

    load_machine(machine)
    missing = [p for p in recordings if not p.exists()]
    if missing:
        raise InputError(f"--recordings {missing[0]}: no such file or folder")
    settings_module.load()
    serve_schedule(machine, recordings, cron, say=screen.line)


@app.command()
def status(as_json: Json = False) -> None:
    """Which version runs on which machine: registered models, aliases, scores; and what the lake holds."""
    settings_module.configure_environment()
    from data.lake import Lake
    from pipelines import registry, tracking

    settings = settings_module.load()
    models, trainings = registry.status(settings), tracking.trainings(settings=settings)
    lake = Lake(settings_module.home() / "lake")
    held = {m: {"batches": len(lake.batch_ids(m)), "quarantined": len(lake.quarantined(m))} for m in lake.machines()}
    if as_json:
        tables = {"models": screen.records(models), "trainings": screen.records(trainings)}
        screen.print_json({**tables, "lake": held})
    else:
        screen.print_status(models, trainings, held)


def main() -> None:
    """Entry point: input errors are one line and exit code 2, failed work exit code 1."""
    try:
        code = app(standalone_mode=False)
        sys.exit(code if isinstance(code, int) else 0)
    except InputError as error:
        screen.trouble(error)
        sys.exit(2)
    except WorkError as error:
        screen.trouble(error)
        sys.exit(1)
    except (KeyboardInterrupt, typer.Abort):
        sys.exit(130)
    except Exception as error:
        # typer brings its own copy of click, so a usage error is told by what it can do.
        if not hasattr(error, "format_message"):
            raise
        context = getattr(error, "ctx", None)
        asked = f"thermodrift {context.info_name}" if context is not None and context.parent else "thermodrift"
        screen.trouble(f"{error.format_message().rstrip('.')}; see `{asked} --help`")
        sys.exit(2)


def _split(given: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(n.strip() for n in given.split(",") if n.strip()))


def _names(given: str, allowed: Any, kind: str) -> tuple[str, ...]:
    names = _split(given)
    for n in names:
        if n not in allowed:
            raise InputError(f"unknown {kind} {n!r}: {closest(n, allowed)}")
    return names or tuple(allowed)


if __name__ == "__main__":
    main()
