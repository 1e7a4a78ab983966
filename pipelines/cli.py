"""The command line. Exit codes: 0 done, 1 the work failed, 2 bad arguments or input (one clear line)."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from data.errors import InputError, WorkError, closest
from pipelines import settings as settings_module

if TYPE_CHECKING:
    import pandas as pd

    from data.ingest import IngestReport
    from pipelines.training import TrainOutcome

app = typer.Typer(
    name="thermodrift",
    help="Thermal error of machine tools: from a year of recordings to a promoted compensation model.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
out = Console(soft_wrap=True)
err = Console(stderr=True, soft_wrap=True)

MachineFile = Annotated[Path, typer.Option("--machine", help="machine file (.yml)")]
Json = Annotated[bool, typer.Option("--json", help="print JSON instead of tables")]


@app.command()
def describe(
    files: Annotated[list[Path], typer.Argument(help="recordings of one machine")],
    to: Annotated[Path | None, typer.Option("--out", help="write the draft here instead of printing it")] = None,
) -> None:
    """Draft a machine file from recordings; every guess is marked."""
    from data.describe import draft_machine_file

    text = draft_machine_file(files)
    if to is None:
        sys.stdout.write(text)
        return
    if to.exists():
        raise InputError(f"{to} exists; give another --out or remove it first")
    to.write_text(text, encoding="utf-8")
    out.print(f"{to}: a draft; check every line marked 'guessed', then call `thermodrift ingest --machine {to} …`")


@app.command()
def ingest(
    paths: Annotated[list[Path], typer.Argument(help="recordings or folders of recordings")],
    machine: MachineFile,
    as_json: Json = False,
) -> None:
    """Read recordings into the lake; what cannot be used goes to quarantine with the reason."""
    from data.ingest import ingest as ingest_paths
    from data.lake import Lake
    from data.machine import load_machine

    described = load_machine(machine)
    with _progress(as_json) as (say, _):
        report = ingest_paths(paths, described, Lake(settings_module.home() / "lake"), progress=say)
    if as_json:
        _print_json(json.loads(report.as_frame().to_json(orient="records")))
    else:
        _print_ingest(report)
    if not report.batches:
        raise WorkError(f"none of the {len(report.quarantined)} file(s) could be used; the reasons are above")


@app.command()
def train(
    machine: MachineFile,
    recordings: Annotated[list[Path] | None, typer.Option(help="files or folders to ingest first")] = None,
    channels: Annotated[str, typer.Option(help="error channels, comma separated; default: all")] = "",
    selectors: Annotated[str, typer.Option(help="selectors, comma separated; default: all")] = "",
    families: Annotated[str, typer.Option(help="model families, comma separated; default: all")] = "",
    protocols: Annotated[str, typer.Option(help="protocols, comma separated; default: all")] = "",
    report: Annotated[Path | None, typer.Option(help="where the report goes")] = None,
    promote: Annotated[bool, typer.Option(help="promote the best cell")] = True,
    direct: Annotated[bool, typer.Option("--direct", help="without Prefect: same functions, same numbers")] = False,
    as_json: Json = False,
) -> None:
    """The main job: ingest → features → grid → track → promote → report."""
    settings_module.configure_environment()
    from data.machine import load_machine
    from features.selectors import SELECTORS
    from models import FAMILIES
    from models.protocols import PROTOCOLS

    # Arguments are judged before anything is started.
    load_machine(machine)
    settings = settings_module.load()
    chosen = (
        _names(selectors, SELECTORS, "selector"),
        _names(families, FAMILIES, "family"),
        _names(protocols, PROTOCOLS, "protocol"),
    )
    server = None
    if not direct:
        from pipelines.flows import start_server, train_in_flow

        server = start_server()
    from models.grid import Plan
    from pipelines import training

    targets = tuple(t for t in channels.split(",") if t)
    request = training.TrainRequest(machine, tuple(recordings or ()), targets, Plan(*chosen), report, promote)
    with _progress(as_json) as (say, done):
        if direct:
            outcome = training.train(request, settings, training.DirectCaller(done=done), say)
        else:
            outcome = train_in_flow(request, settings, say, done, server)
    if as_json:
        _print_json(_outcome_dict(outcome))
    else:
        _print_outcome(outcome)


@app.command()
def report(
    machine: Annotated[str, typer.Option("--machine", help="machine name")],
    trainings: Annotated[list[str] | None, typer.Argument(help="training ids; default: the latest per channel")] = None,
    form: Annotated[str, typer.Option("--format", help="html or md")] = "html",
    to: Annotated[Path | None, typer.Option("--out", help="default: var/reports/MACHINE.html")] = None,
) -> None:
    """A comparison report from tracked trainings."""
    settings_module.configure_environment()
    if form not in ("html", "md"):
        raise InputError(f"--format: got {form!r}, expected html or md")
    from pipelines import tracking
    from pipelines.report import write_report

    settings = settings_module.load()
    ids = trainings
    if not ids:
        past = tracking.trainings(machine, None, settings)
        if past.empty:
            raise InputError(f"no training of {machine!r} is tracked; call `thermodrift train` first")
        ids = past.drop_duplicates("target")["training_id"].tolist()
    path = to or settings_module.home() / "reports" / f"{machine}.{form}"
    write_report([tracking.load_training(i, settings) for i in ids], path, settings)
    out.print(str(path))


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

    out.print(escape(promote_tracked(training, machine, cell, force, settings_module.load()).words))


@app.command()
def rollback(model: Annotated[str, typer.Argument(help="registered model, MACHINE-CHANNEL")]) -> None:
    """Give the champion's place back to the previous champion."""
    settings_module.configure_environment()
    from pipelines import registry

    out.print(escape(registry.rollback(model, settings_module.load()).words))


@app.command()
def predict(
    file: Annotated[Path, typer.Argument(help="a raw recording of the model's machine")],
    model: Annotated[str, typer.Option("--model", help="models:/NAME@champion, models:/NAME/3, runs:/… or a folder")],
    to: Annotated[Path | None, typer.Option("--out", help=".csv or .parquet; default: CSV on standard output")] = None,
) -> None:
    """Predict the error of a recording; rows outside the trained region are marked."""
    settings_module.configure_environment()
    from pipelines.predict import predict_file

    table = predict_file(model, file, settings_module.load())
    if to is None:
        table.to_csv(sys.stdout, index=False)
    elif to.suffix == ".parquet":
        table.to_parquet(to, index=False)
    elif to.suffix == ".csv":
        table.to_csv(to, index=False)
    else:
        raise InputError(f"--out {to}: got the ending {to.suffix!r}, expected .csv or .parquet")


@app.command()
def simulate(
    sample_year: Annotated[bool, typer.Option("--sample-year", help="the built-in year of 30 batches")] = False,
    to: Annotated[Path, typer.Option("--out", help="folder for the CSV files")] = Path("sample_year"),
    seed: Annotated[int, typer.Option(help="another seed gives another year")] = 0,
) -> None:
    """Write simulated recordings, labelled so, as a measuring system would."""
    if not sample_year:
        raise InputError("simulate: got nothing to simulate; call `thermodrift simulate --sample-year --out FOLDER`")
    from data.sample_year import write_sample_year

    files = write_sample_year(to, seed=seed)
    out.print(f"{to}: {len(files)} simulated recordings of the sample machine, seed {seed}")


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
    out.print(f"retraining of {machine.stem} at '{cron}'; Ctrl-C ends it")
    serve_schedule(machine, recordings, cron)


@app.command()
def status(as_json: Json = False) -> None:
    """Which version runs on which machine: registered models, aliases, scores; and what the lake holds."""
    settings_module.configure_environment()
    from data.lake import Lake
    from pipelines import registry

    models = registry.status(settings_module.load())
    lake = Lake(settings_module.home() / "lake")
    held = {m: {"batches": len(lake.batch_ids(m)), "quarantined": len(lake.quarantined(m))} for m in lake.machines()}
    if as_json:
        _print_json({"models": json.loads(models.to_json(orient="records")), "lake": held})
        return
    _print_frame("Registered models", models)
    table = Table("machine", "batches", "quarantined files", title="Lake")
    for name, n in held.items():
        table.add_row(name, str(n["batches"]), str(n["quarantined"]))
    out.print(table)


def main() -> None:
    """Entry point: input errors are one line and exit code 2, failed work exit code 1."""
    try:
        code = app(standalone_mode=False)
        sys.exit(code if isinstance(code, int) else 0)
    except InputError as error:
        err.print(f"thermodrift: {escape(str(error))}", highlight=False)
        sys.exit(2)
    except WorkError as error:
        err.print(f"thermodrift: {escape(str(error))}", highlight=False)
        sys.exit(1)
    except (KeyboardInterrupt, typer.Abort):
        sys.exit(130)
    except Exception as error:
        # typer brings its own copy of click, so a usage error is told by what it can do.
        if not hasattr(error, "format_message"):
            raise
        err.print(f"thermodrift: {escape(error.format_message())}; see `thermodrift --help`", highlight=False)
        sys.exit(2)


Done = Callable[[str, int, int], None]


@contextmanager
def _progress(quiet: bool) -> Iterator[tuple[Callable[[str], None], Done]]:
    """One live line: what is being done, and how far the step is."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(30), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=err, transient=True, disable=quiet or not err.is_terminal) as bar:
        current = bar.add_task("starting", total=None)

        def say(text: str) -> None:
            if not quiet and not err.is_terminal:
                err.print(escape(text), highlight=False)
            bar.reset(current, description=text, total=None)

        def done(step: str, n: int, of: int) -> None:
            bar.update(current, description=step, completed=n, total=of)

        yield say, done


def _names(given: str, allowed: Any, kind: str) -> tuple[str, ...]:
    names = tuple(n for n in given.split(",") if n)
    for n in names:
        if n not in allowed:
            raise InputError(f"unknown {kind} {n!r}: {closest(n, allowed)}")
    return names or tuple(allowed)


def _print_json(value: Any) -> None:
    sys.stdout.write(json.dumps(value, indent=1, default=str) + "\n")


def _print_frame(title: str, frame: pd.DataFrame) -> None:
    table = Table(*map(str, frame.columns), title=title)
    for row in frame.itertuples(index=False):
        table.add_row(*(f"{v:.3g}" if isinstance(v, float) else escape(str(v)) for v in row))
    out.print(table)


def _ingest_totals(report: IngestReport) -> dict[str, int]:
    states = Counter(r.status.replace("_", " ") for r in report.batches)
    return {
        **{f"batches {state}": n for state, n in states.items()},
        "findings": sum(r.findings for r in report.batches),
        "rows read": report.rows_in,
        "rows dropped": report.rows_dropped,
        "files in quarantine": len(report.quarantined),
        "files ignored": len(report.ignored),
    }


def _print_ingest(report: IngestReport) -> None:
    out.print("ingest   " + ", ".join(f"{k} {v}" for k, v in _ingest_totals(report).items()), highlight=False)
    for row in report.quarantined:
        out.print(f"  quarantine: {escape(row.file)}: {escape(row.reason)}", highlight=False)


def _print_outcome(outcome: TrainOutcome) -> None:
    if outcome.stopped:
        out.print(outcome.stopped)
        return
    if outcome.ingested is not None:
        _print_ingest(outcome.ingested)
    label = "  (simulated recordings)" if outcome.simulated else ""
    for target, result in outcome.results.items():
        _print_leaderboard(f"{outcome.machine} {target}: leave-batch-out{label}", result.cells)
    for promotion in outcome.promotions.values():
        out.print(escape(promotion.words), highlight=False)
    out.print(f"report   {outcome.report}", highlight=False)
    out.print("seconds  " + ", ".join(f"{k} {v:g}" for k, v in outcome.seconds.items()), highlight=False)


def _print_leaderboard(title: str, cells: pd.DataFrame, top: int = 8) -> None:
    """Best cell of each family, in µm."""
    rows = cells[cells["protocol"] == "leave-batch-out"]
    rows = rows.assign(score=rows["S_mean_um"] + rows["S_std_um"]).sort_values("score")
    rows = rows.drop_duplicates("family")
    table = Table("family", "selector", "points", "S mean µm", "S std µm", "max |e| µm", "stability", title=title)
    baseline = rows[rows["family"] == "zero"]
    for row in [*rows.head(top).itertuples(), *baseline.itertuples()]:
        table.add_row(
            row.family, row.selector, str(row.n_inputs), f"{row.S_mean_um:.2f}", f"{row.S_std_um:.2f}",
            f"{row.max_abs_um:.1f}", f"{row.tsp_stability:.2f}",
        )  # fmt: skip
    out.print(table)


def _outcome_dict(outcome: TrainOutcome) -> dict[str, Any]:
    best = {
        t: r.cells[r.cells["protocol"] == "leave-batch-out"].nsmallest(5, "S_mean_um").to_dict(orient="records")
        for t, r in outcome.results.items()
    }
    return {
        "machine": outcome.machine,
        "simulated": outcome.simulated,
        "ingested": _ingest_totals(outcome.ingested) if outcome.ingested else None,
        "trainings": outcome.training_ids,
        "best": best,
        "promotions": {t: p.words for t, p in outcome.promotions.items()},
        "report": str(outcome.report) if outcome.report else None,
        "seconds": outcome.seconds,
        "stopped": outcome.stopped,
    }


if __name__ == "__main__":
    main()
