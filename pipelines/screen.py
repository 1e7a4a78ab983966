"""What commands show: tables and lines on standard output, progress and trouble on standard error."""

from __future__ import annotations

import json
import math
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

if TYPE_CHECKING:
    import pandas as pd

    from data.ingest import IngestReport
    from pipelines.training import TrainOutcome

Done = Callable[[str, int, int], None]

out = Console(soft_wrap=True)
err = Console(stderr=True, soft_wrap=True)


def line(text: object) -> None:
    """One line of result, as it is."""
    out.print(escape(str(text)), highlight=False)


def trouble(text: object) -> None:
    """The one line that a command ends with when it could not do its work."""
    err.print(f"thermodrift: {escape(str(text))}", highlight=False)


@contextmanager
def progress(quiet: bool) -> Iterator[tuple[Callable[[str], None], Done]]:
    """One live line: what is being done, and how far the step is."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(30), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=err, transient=True, disable=quiet or not err.is_terminal) as bar:
        current = bar.add_task("starting", total=None)

        def say(text: str) -> None:
            if not quiet and not err.is_terminal:
                err.print(escape(text), highlight=False)
            bar.reset(current, description=escape(text), total=None)

        def done(step: str, n: int, of: int) -> None:
            bar.update(current, description=escape(step), completed=n, total=of)

        yield say, done


def print_json(value: Any) -> None:
    """Strict JSON: what is not a finite number is null."""
    sys.stdout.write(json.dumps(_finite(value), indent=1, default=str, allow_nan=False) + "\n")


def records(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """Rows of a table as plain data."""
    rows: list[dict[str, Any]] = json.loads(frame.to_json(orient="records", date_format="iso"))
    return rows


def print_ingest(report: IngestReport) -> None:
    line("ingest   " + ", ".join(f"{k}: {v}" for k, v in ingest_totals(report).items()))
    for row in report.quarantined:
        folder, _, name = row.file.rpartition("/")
        where = "" if row.reason.startswith(row.file) else f"{folder}/" if folder else ""
        line(f"  quarantine: {where}{row.reason if name in row.reason else f'{name}: {row.reason}'}")


def print_findings(found: pd.DataFrame) -> None:
    """What the checks found, a line per check and channel with the batches; `found` as `data.batch.finding_table`."""
    for (check, channel), part in found.fillna({"channel": "all channels"}).groupby(["check", "channel"], sort=False):
        ids = sorted(part["batch_id"].astype(str).unique())
        shown = ", ".join(ids if len(ids) <= 4 else [*ids[:3], "…", ids[-1]])
        masked = part["masks"] & (part["overruled"] == "")
        state = "masked" if masked.all() else "partly masked" if masked.any() else "noted, not masked"
        count = f"{len(ids)} batch{'es' if len(ids) > 1 else ''}"
        line(f"  {str(check).replace('_', ' ')}: {channel} in {count} ({shown}), {state}")


def ingest_totals(report: IngestReport) -> dict[str, int]:
    states = Counter(r.status.replace("_", " ") for r in report.batches)
    return {
        **{f"batches {state}": n for state, n in states.items()},
        "findings": sum(r.findings for r in report.batches),
        "rows read": report.rows_in,
        "rows dropped": report.rows_dropped,
        "files in quarantine": len(report.quarantined),
        "files ignored": len(report.ignored),
    }


def print_outcome(outcome: TrainOutcome) -> None:
    if outcome.ingested is not None:
        print_ingest(outcome.ingested)
    if outcome.stopped:
        line(outcome.stopped)
        return
    import pandas as pd

    found = [r.findings for r in outcome.results.values() if len(r.findings)]
    if found:
        line("findings")
        print_findings(pd.concat(found).drop_duplicates())
    label = "  (simulated recordings)" if outcome.simulated else ""
    for target, result in outcome.results.items():
        protocol = _shown_protocol(result.cells)
        _print_leaderboard(f"{outcome.machine} {target}: {protocol}{label}", result.cells, protocol)
    for target, training in outcome.training_ids.items():
        line(outcome.promotions[target].words if target in outcome.promotions else f"training {target} {training}")
    line(f"report   {outcome.report}")
    if outcome.diagnosis_words:
        line(f"diagnose {outcome.diagnosis_words}")
    line("seconds  " + ", ".join(f"{k} {v:g}" for k, v in outcome.seconds.items()))


def outcome_dict(outcome: TrainOutcome) -> dict[str, Any]:
    """What came of a training, for machines; `best` are the five best cells by S_mean."""
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
        "promotions": {t: p.words for t, p in outcome.promotions.items()},
        "report": str(outcome.report) if outcome.report else None,
        "diagnosis": str(outcome.diagnosis.out) if outcome.diagnosis else None,
        "diagnosis_words": outcome.diagnosis_words,
        "seconds": outcome.seconds,
        "stopped": outcome.stopped,
    }


def print_status(
    models: pd.DataFrame, trainings: pd.DataFrame, diagnoses: pd.DataFrame, lake: dict[str, dict[str, int]]
) -> None:
    """Lines and not tables: names, ids and reasons are long, and a terminal is 80 wide."""
    out.print("Lake", style="bold")
    for machine, held in lake.items():
        line(f"  {machine}: {held['batches']} batches, files in quarantine: {held['quarantined']}")
    if not lake:
        line("  empty; `thermodrift ingest` fills it")
    out.print("Registered models", style="bold")
    for m in _rows(models):
        alias = f" {m.aliases}" if m.aliases else ""
        line(
            f"  {m.name}/{m.version}{alias}: {m.cell}, {m.score_um:.2f} µm over {m.n_batches} batches{_label(m)}"
            f"{'' if m.trusted else ', not to be trusted'}; {m.reason}"
        )
    if models.empty:
        line("  none; `thermodrift train` promotes the first")
    out.print("Latest trainings", style="bold")
    for t in _rows(trainings.head(12)):
        became = f"; {t.promotion}" if t.promotion else ""
        line(
            f"  {t.training_id} {t.machine} {t.target} {t.started:%Y-%m-%d %H:%M}, {t.n_batches} batches"
            f"{_label(t)}: {t.best}{became}"
        )
    if trainings.empty:
        line("  none")
    if not diagnoses.empty:
        out.print("Last diagnosis of each machine", style="bold")
    for d in _rows(diagnoses.drop_duplicates("machine")):
        found = f"; {d.mechanism.replace('_', ' ')}, {d.where} ({100 * d.probability:.0f} %)" if d.mechanism else ""
        line(
            f"  {d.run_id} {d.machine} {d.started:%Y-%m-%d %H:%M}, {d.n_batches} batches{_label(d)}: "
            f"{d.verdict.replace('_', ' ')}{found}"
        )


def _rows(frame: pd.DataFrame) -> Iterator[Any]:
    yield from frame.itertuples()


def _label(row: Any) -> str:
    return ", simulated" if row.simulated else ""


def _shown_protocol(cells: pd.DataFrame) -> str:
    ran = list(cells["protocol"].unique())
    return "leave-batch-out" if "leave-batch-out" in ran else str(ran[0])


def _print_leaderboard(title: str, cells: pd.DataFrame, protocol: str, top: int = 8) -> None:
    """Best cell of each family, in µm; without any model comes last if it is not among them."""
    rows = cells[cells["protocol"] == protocol]
    rows = rows.assign(score=rows["S_mean_um"] + rows["S_std_um"]).sort_values("score")
    rows = rows.drop_duplicates("family")
    table = Table(title=f"{title}, µm", box=SIMPLE_HEAD, title_justify="left", pad_edge=False, show_edge=False)
    for name in ("family", "selector"):
        table.add_column(name, no_wrap=True)
    for name in ("n", "S mean", "S std", "max |e|", "stable"):
        table.add_column(name, justify="right", no_wrap=True)
    shown = rows[(rows["family"] == "zero") | (rows["family"].isin(rows["family"].head(top)))]
    for row in _rows(shown):
        table.add_row(
            row.family, row.selector, str(row.n_inputs), f"{row.S_mean_um:.2f}", f"{row.S_std_um:.2f}",
            f"{row.max_abs_um:.1f}", f"{row.tsp_stability:.2f}",
        )  # fmt: skip
    out.print(table)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
