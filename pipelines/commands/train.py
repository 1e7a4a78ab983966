"""`thermodrift train`: the main job; its steps are in `pipelines.training`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from data.errors import one_of
from pipelines import console
from pipelines.commands.ingest import ingest_totals, print_findings, print_ingest
from pipelines.options import Json, MachineFile, names, split

if TYPE_CHECKING:
    import pandas as pd

    from pipelines.training import TrainOutcome

SHOWN = 8  # families on the leaderboard


def training_dict(outcome: TrainOutcome) -> dict[str, Any]:
    """The outcome for other programs; `best` are the five best cells by S_mean."""
    best = {
        t: r.cells[r.cells["protocol"] == _shown_protocol(r.cells)].nsmallest(5, "S_mean_um").to_dict(orient="records")
        for t, r in outcome.results.items()
    }
    return {
        "machine": outcome.machine,
        "simulated": outcome.simulated,
        "ingested": ingest_totals(outcome.ingested) if outcome.ingested else None,
        "trainings": outcome.training_ids,
        "best": best,
        "promotions": {t: p.summary for t, p in outcome.promotions.items()},
        "report": str(outcome.report) if outcome.report else None,
        "diagnosis": str(outcome.diagnosis.out) if outcome.diagnosis else None,
        "diagnosis_words": outcome.diagnosis_summary,
        "seconds": outcome.seconds,
        "stopped": outcome.stopped,
    }


def print_training(outcome: TrainOutcome) -> None:
    """Ingest, findings, leaderboards, promotions, report, diagnosis and seconds."""
    if outcome.ingested is not None:
        print_ingest(outcome.ingested)
    if outcome.stopped:
        console.line(outcome.stopped)
        return
    import pandas as pd

    found = [r.findings for r in outcome.results.values() if len(r.findings)]
    if found:
        console.line("findings")
        print_findings(pd.concat(found).drop_duplicates())
    label = "  (simulated recordings)" if outcome.simulated else ""
    for target, result in outcome.results.items():
        protocol = _shown_protocol(result.cells)
        _print_leaderboard(f"{outcome.machine} {target}: {protocol}{label}", result.cells, protocol)
    for target, training in outcome.training_ids.items():
        promotion = outcome.promotions.get(target)
        console.line(promotion.summary if promotion else f"training {target} {training}")
    console.line(f"report   {outcome.report}")
    if outcome.diagnosis_summary:
        console.line(f"diagnose {outcome.diagnosis_summary}")
    console.line("seconds  " + ", ".join(f"{k} {v:g}" for k, v in outcome.seconds.items()))


def _shown_protocol(cells: pd.DataFrame) -> str:
    ran = list(cells["protocol"].unique())
    return "leave-batch-out" if "leave-batch-out" in ran else str(ran[0])


def _print_leaderboard(title: str, cells: pd.DataFrame, protocol: str) -> None:
    """The best cell of each family, in µm; the baseline without a model is always shown."""
    rows = cells[cells["protocol"] == protocol]
    rows = rows.assign(score=rows["S_mean_um"] + rows["S_std_um"]).sort_values("score").drop_duplicates("family")
    columns = ("family", "selector", "n", "S mean", "S std", "max |e|", "stable")
    table = console.table(f"{title}, µm", *columns, left=columns[:2])
    shown = rows[(rows["family"] == "zero") | (rows["family"].isin(rows["family"].head(SHOWN)))]
    for row in shown.to_dict("records"):
        table.add_row(
            row["family"], row["selector"], str(row["n_inputs"]), f"{row['S_mean_um']:.2f}", f"{row['S_std_um']:.2f}",
            f"{row['max_abs_um']:.1f}", f"{row['tsp_stability']:.2f}",
        )  # fmt: skip
    console.out.print(table)


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
    from pipelines import settings

    settings.configure_environment()
    from data.registry import EFFORTS
    from features.selectors import SELECTORS
    from models import FAMILIES
    from models.crossing import Plan
    from models.protocols import PROTOCOLS
    from pipelines.training import TrainRequest, check_request

    configured = settings.load()
    plan = Plan(
        names(selectors, SELECTORS, "selector") if selectors else (),
        names(families, FAMILIES, "family") if families else (),
        names(protocols, PROTOCOLS, "protocol"),
        effort=one_of(effort, EFFORTS[:-1], "--effort"),
    )
    request = TrainRequest(machine, tuple(recordings or ()), split(channels), plan, report, promote)
    check_request(request, configured)  # before a server starts
    server = None
    if not direct:
        from pipelines.flows import start_server, train_in_flow

        server = start_server()
    from pipelines import training
    from pipelines.caller import DirectCaller

    with console.progress(as_json) as (say, done):
        if direct:
            outcome = training.train(request, configured, DirectCaller(done=done), say)
        else:
            outcome = train_in_flow(request, configured, say, done, server)
    if as_json:
        console.print_json(training_dict(outcome))
    else:
        print_training(outcome)
