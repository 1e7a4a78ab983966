"""The command line. Exit codes: 0 done, 1 the work failed, 2 bad arguments or input (one clear line)."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from data.errors import InputError, WorkError, one_of
from pipelines import prove_command, report_command, reproduce_command, screen, twin_commands
from pipelines import settings as settings_module
from pipelines.options import Json, MachineFile, names, split

app = typer.Typer(
    name="thermodrift",
    help="Thermal error of machine tools: from a year of recordings to a promoted compensation model.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


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
    selectors: Annotated[str, typer.Option(help="selectors, comma separated; default: by effort")] = "",
    families: Annotated[str, typer.Option(help="model families, comma separated; default: by effort")] = "",
    effort: Annotated[str, typer.Option(help="what to cross unless named: quick, usual or complete")] = "usual",
    protocols: Annotated[str, typer.Option(help="protocols, comma separated; default: all")] = "",
    report: Annotated[Path | None, typer.Option(help="where the report goes")] = None,
    promote: Annotated[bool, typer.Option(help="promote the best cell")] = True,
    direct: Annotated[bool, typer.Option("--direct", help="without Prefect: same functions, same numbers")] = False,
    as_json: Json = False,
) -> None:
    """The main job: ingest → features → grid → track → promote → report."""
    settings_module.configure_environment()
    from data.registry import EFFORTS
    from features.selectors import SELECTORS
    from models import FAMILIES
    from models.crossing import Plan
    from models.protocols import PROTOCOLS
    from pipelines.request import TrainRequest, check_request

    settings = settings_module.load()
    plan = Plan(
        names(selectors, SELECTORS, "selector") if selectors else (),
        names(families, FAMILIES, "family") if families else (),
        names(protocols, PROTOCOLS, "protocol"),
        effort=one_of(effort, EFFORTS[:-1], "--effort"),
    )
    request = TrainRequest(machine, tuple(recordings or ()), split(channels), plan, report, promote)
    check_request(request, settings)  # before anything is started
    server = None
    if not direct:
        from pipelines.flows import start_server, train_in_flow

        server = start_server()
    from pipelines import training
    from pipelines.caller import DirectCaller

    with screen.progress(as_json) as (say, done):
        if direct:
            outcome = training.train(request, settings, DirectCaller(done=done), say)
        else:
            outcome = train_in_flow(request, settings, say, done, server)
    if as_json:
        screen.print_json(screen.outcome_dict(outcome))
    else:
        screen.print_outcome(outcome)


app.command()(report_command.report)


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


for command in (twin_commands.simulate, twin_commands.calibrate, twin_commands.diagnose):
    app.command()(command)
app.add_typer(prove_command.app, name="prove")
app.command()(reproduce_command.reproduce)


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
    from pipelines.diagnosis_tracking import diagnoses

    settings = settings_module.load()
    models, trainings = registry.status(settings), tracking.trainings(settings=settings)
    diagnosed = diagnoses(settings=settings)
    lake = Lake(settings_module.home() / "lake")
    held = {m: {"batches": len(lake.batch_ids(m)), "quarantined": len(lake.quarantined(m))} for m in lake.machines()}
    if as_json:
        tables = {"models": models, "trainings": trainings, "diagnoses": diagnosed}
        screen.print_json({**{k: screen.records(v) for k, v in tables.items()}, "lake": held})
    else:
        screen.print_status(models, trainings, diagnosed, held)


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


if __name__ == "__main__":
    main()
