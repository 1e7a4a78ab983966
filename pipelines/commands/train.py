"""`thermodrift train`: the main job; its steps are in `pipelines.jobs.training`."""

from __future__ import annotations

import io
import math
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from data.errors import InputError, WorkError, one_of
from data.files import write_atomic
from data.units import error_column, in_error_unit, unit_label
from pipelines import console
from pipelines.commands import load_settings
from pipelines.commands.ingest import ingest_totals, print_ingest
from pipelines.options import Json, MachineFile, names, split

if TYPE_CHECKING:
    import pandas as pd

    from models.selection.promotion import Choice
    from pipelines.jobs.training import TrainOutcome

DETAILS = ".txt"  # next to the report
SHOWN = 8  # families on the leaderboard
_SHOWN_PROTOCOLS = {"forward": "forward", "leave-season-out": "season out", "leave-batch-out": "batch out"}


def training_dict(outcome: TrainOutcome) -> dict[str, Any]:
    """The outcome for other programs: the error to expect in the next season, and the five best cells by S_mean."""
    best = {}
    for t, r in outcome.results.items():
        cells = r.cells[r.cells["protocol"] == _shown_protocol(r.cells)].nsmallest(5, "S_mean_um")
        names = {c: error_column(c, outcome.units[t]) for c in map(str, cells) if c.endswith("_um")}
        best[t] = cells.rename(columns=names).to_dict(orient="records")
    return {
        "machine": outcome.machine,
        "units": outcome.units,
        "simulated": outcome.simulated,
        "ingested": ingest_totals(outcome.ingested) if outcome.ingested else None,
        "account": outcome.account.as_dict() if outcome.account else None,
        "trainings": outcome.training_ids,
        "expected": {t: o.as_dict() for t, o in outcome.outlooks.items()},
        "best": best,
        "promotions": {t: p.summary for t, p in outcome.promotions.items()},
        "report": str(outcome.report) if outcome.report else None,
        "diagnosis": str(outcome.diagnosis.out) if outcome.diagnosis else None,
        "diagnosis_words": outcome.diagnosis_summary,
        "seconds": outcome.seconds,
        "stopped": outcome.stopped,
        "postponed": outcome.postponed,
    }


def print_training(outcome: TrainOutcome) -> None:
    """One screen: a sentence for each error channel, what was lost, and where to look."""
    if outcome.stopped:
        if outcome.ingested is not None:
            print_ingest(outcome.ingested)
        console.line(outcome.stopped)
        return
    for target in outcome.results:
        console.line(in_error_unit(_sentence(outcome, target), outcome.units[target]))
    if outcome.ingested is not None and (outcome.ingested.quarantined or outcome.ingested.waiting):
        print_ingest(outcome.ingested)
    if outcome.account:
        console.line(outcome.account.summary)
    if outcome.postponed:
        console.line(f"postponed: {outcome.postponed}")
    if outcome.diagnosis_summary:
        console.line(f"diagnose {outcome.diagnosis_summary}")
    console.line(f"report   {outcome.report}")
    if outcome.report is not None:
        details, text = outcome.report.with_suffix(DETAILS), io.StringIO()
        with console.printing_to(text):
            print_details(outcome)
        write_atomic(details, text.getvalue())
        console.line(f"details  {details}")
    console.line("seconds  " + ", ".join(f"{k} {v:g}" for k, v in outcome.seconds.items()))


def _sentence(outcome: TrainOutcome, target: str) -> str:
    """The error to expect of a channel, what no model leaves, and the model with what became of it."""
    expected, choice = outcome.outlooks.get(target), outcome.choices.get(target)
    promotion = outcome.promotions.get(target)
    parts = [f"{_badge(outcome, target)}{expected.headline}"] if expected else []
    if choice:
        none_um = outcome.results[target].none_um(choice.protocol)
        parts += [f"no model {none_um:.3g} µm"] * math.isfinite(none_um) + [choice.name]
    if promotion is None:
        parts.append(f"training {outcome.training_ids.get(target, 'not tracked')}")
    elif promotion.outcome == "unchanged":
        parts.append(promotion.summary)
    else:
        uri = f"models:/{promotion.name}" if promotion.outcome == "provisional" else promotion.model_uri
        usable = f" (--model {uri})" if promotion.champion_version is None else ""
        parts.append(f"{promotion.name} version {promotion.version} is {promotion.outcome}{usable}")
    return f"{target}: {'; '.join(parts)}"


def _badge(outcome: TrainOutcome, target: str) -> str:
    """What was lost of a channel, and whether its choice is no champion."""
    choice = outcome.choices[target]
    few = f", {choice.lacking}" if choice.lacking else ""
    standing = f"provisional{few}; " if choice.standing == "provisional" else ""
    refused = f"no trustworthy model{few}; " if choice.caution and not standing else ""
    return f"{outcome.account.warning(target) if outcome.account else ''}{standing}{refused}"


def print_details(outcome: TrainOutcome) -> None:
    """Ingest, how sure the expected errors are, leaderboards, promotions and what failing sensors cost."""
    if outcome.ingested is not None:
        print_ingest(outcome.ingested)
    label = "  (simulated recordings)" if outcome.simulated else ""
    for target, expected in outcome.outlooks.items():
        text = f"{target}: {_badge(outcome, target)}{expected.summary}"
        console.line(in_error_unit(text, outcome.units[target]))
    for target, result in outcome.results.items():
        chosen = outcome.choices.get(target)
        _print_leaderboard(f"{outcome.machine} {target}{label}", result.cells, outcome.units[target], chosen)
    for target, result in outcome.results.items():
        _print_race(f"{outcome.machine} {target}{label}", result.race, outcome.units[target])
    for target in (t for t in outcome.results if t in outcome.training_ids):
        promotion = outcome.promotions.get(target)
        said = promotion.summary if promotion else f"training {target} {outcome.training_ids[target]}"
        console.line(in_error_unit(said, outcome.units[target]))
        if promotion and promotion.faults:
            console.line(f"  {promotion.faults}")


def _shown_protocol(cells: pd.DataFrame) -> str:
    """The protocol nearest to the next season."""
    from models.protocols import PROTOCOLS

    return next(p for p in PROTOCOLS if p in set(cells["protocol"]))


def _print_leaderboard(title: str, cells: pd.DataFrame, unit: str, chosen: Choice | None = None) -> None:
    """The chosen cell, marked, and the best cell of each family, S_mean ± S_std by protocol; the baseline without a
    model is always shown."""
    protocols = [p for p in _SHOWN_PROTOCOLS if (cells["protocol"] == p).any()] or [_shown_protocol(cells)]
    keys = ["selector", "family", "n_tsp"]
    rows = cells[cells["protocol"].isin(protocols)]
    worst = rows.assign(score=rows["S_mean_um"] + rows["S_std_um"].fillna(0.0)).groupby(keys, sort=False)["score"].max()
    best = worst.sort_values().reset_index()
    best["cell"] = best[keys].astype(str).agg("|".join, axis=1)
    own_cell = chosen.cell if chosen else ""
    best = best[(best["cell"] == own_cell) | ~best["family"].duplicated()]
    shown = {"zero", *best["family"].unique()[:SHOWN]}
    heads = [_SHOWN_PROTOCOLS.get(p, p) for p in protocols]
    names = ("family", "selector")
    table = console.table(f"{title}, S mean ± std, {unit_label(unit) or 1}", *names, "n", *heads, left=names)
    for row in best[(best["cell"] == own_cell) | best["family"].isin(shown)].to_dict("records"):
        own = rows[(rows[keys] == [row[k] for k in keys]).all(axis=1)].set_index("protocol")
        scores = [_score(own, p) for p in protocols]
        table.add_row(
            "* " * (row["cell"] == own_cell) + row["family"], row["selector"], str(own["n_inputs"].iloc[0]), *scores
        )
    console.out.print(table)


def _print_race(title: str, race: pd.DataFrame, unit: str) -> None:
    """What each family cost in the race, and what its best cell of its last round would have had to gain."""
    if race.empty:
        return
    cpu_s = race.drop_duplicates(["round", "family"]).groupby("family")["cpu_s"].sum()
    last = race.drop_duplicates("family", keep="last").set_index("family")["round"]
    own = race[race["round"] == race["family"].map(last)]
    best = own.sort_values("S_mean_um", kind="stable").drop_duplicates("family").set_index("family")
    names = ("family", "last round")
    table = console.table(f"{title}, race", *names, "CPU s", f"behind, {unit_label(unit) or 1}", left=names)
    for family, spent_s in cpu_s.sort_values(ascending=False).items():
        row = best.loc[str(family)]
        behind = f"{row['behind_um']:.2f}±{row['se_um']:.2f}" if row["behind_um"] > 0 else "leads"
        table.add_row(str(family), str(row["round"]), f"{spent_s:.2f}", behind)
    console.out.print(table)


def _score(own: pd.DataFrame, protocol: str) -> str:
    if protocol not in own.index:
        return "–"
    mean_um, std_um = (float(own[c][protocol]) for c in ("S_mean_um", "S_std_um"))
    return "±".join(  # without blanks: three protocols and the longest names fit into 80 columns
        f"{v:.2f}" if 0.05 < abs(v) < 9.995 else f"{v:.2g}" if v < 1 else f"{v:.1f}" for v in (mean_um, std_um)
    )


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
    engine: Annotated[str, typer.Option(help="what runs the steps: prefect, direct or dask; same numbers")] = "prefect",
    direct: Annotated[bool, typer.Option("--direct", help="the same as --engine direct: without Prefect")] = False,
    address: Annotated[
        str | None, typer.Option(help="of a Dask scheduler, tcp://…; default: worker processes of this computer")
    ] = None,
    as_json: Json = False,
) -> None:
    """The main job: ingest → features → grid → track → promote → report."""
    configured = load_settings()
    from features.selectors import SELECTORS
    from models.families import FAMILIES
    from models.protocols import PROTOCOLS
    from models.selection.crossing import FINALISTS, Plan
    from pipelines.engine import ENGINES, train_by
    from pipelines.jobs.request import TrainRequest, check_request

    one_of(engine, ENGINES, "--engine")
    if direct and engine not in ("prefect", "direct"):
        raise InputError(f"--direct is --engine direct; got --engine {engine} as well; give one of them")
    plan = Plan(
        names(selectors, SELECTORS, "selector") if selectors else (),
        names(families, FAMILIES, "family") if families else (),
        names(protocols, PROTOCOLS, "protocol"),
        effort=one_of(effort, FINALISTS, "--effort"),
    )
    request = TrainRequest(machine, tuple(recordings or ()), split(channels), plan, report, promote)
    check_request(request, configured)  # before a server starts
    if configured.store_file is None:
        from pipelines.store.tracking import open_store

        open_store(configured)
    with console.progress(as_json) as (say, done):
        outcome = train_by("direct" if direct else engine, request, configured, say, done, address)
    if as_json:
        console.print_json(training_dict(outcome))
    else:
        print_training(outcome)
    if not outcome.postponed:
        from pipelines.fleet import watching

        with suppress(InputError, WorkError):  # while MLflow is loaded; else the next `status` gathers it
            watching.refresh(configured)
