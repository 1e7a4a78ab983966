"""`thermodrift status`: every machine and channel with its champion, drift and alerts; models, trainings, the lake."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from urllib.parse import quote

import typer

from pipelines import console
from pipelines.commands import load_settings
from pipelines.home import home
from pipelines.options import Json

if TYPE_CHECKING:
    from pipelines.fleet.alerts import FleetView, Row

TRAININGS_SHOWN = 12
ALERT_CODE = 3


def print_fleet(view: FleetView) -> None:
    """A table that fits into 80 columns, with long names in several lines, the alerts, and what is not known; nothing
    where there is no machine."""
    if not view.rows:
        return
    from rich.table import Table

    table = Table(box=None, padding=(0, 1, 0, 0), pad_edge=False, title="Fleet", title_justify="left",
                  title_style="bold")  # fmt: skip
    for name, side, width in (
        ("", "left", 1), ("machine", "left", 17), ("", "left", 4), ("champion", "left", 14), ("seen to", "left", 10),
        ("expect µm", "right", 11), ("newer", "right", 7), ("out", "right", 3), ("next", "left", 5),
    ):  # fmt: skip
        table.add_column(name, justify=side, max_width=width, overflow="fold")  # type: ignore[arg-type]
    for r in view.rows:
        table.add_row(*_cells(r))
    console.out.print(table)
    console.line("expect: S in the next season < 90 % bound; newer: S in runs after the training;")
    console.line("out: of the last runs those outside the trained region; next: run, month-day")
    if view.alerts:
        console.out.print("Alerts", style="bold")
    for a in view.alerts:
        console.line(f"  {a.text}")
    for r in view.rows:
        if r["unknown"] and r["unknown"] != "nothing ingested":
            console.line(f"  {r['machine']} {r['channel']}: not known: {r['unknown']}")
    for f in view.fleets:
        if not f["served"]:
            console.line(f"{f['source']} is not served now, so its next runs are not known")


def _cells(r: Row) -> tuple[str, ...]:
    standing_in = "none" if r["provisional"] is None else f"v{r['provisional']} provisional"
    champion = f"v{r['version']} {r['family']}" if r["version"] is not None else standing_in
    expect, bound, newer = (r[k] for k in ("expected_S_um", "bound90_S_um", "newer_S_mean_um"))
    due = datetime.fromisoformat(r["next_run"]).astimezone() if r["next_run"] else None
    return (
        "!" if r["alerts"] else "", r["machine"], r["channel"], champion, r["last_seen"][:10] or "–",
        f"{expect:.3g} < {bound:.3g}" if expect is not None and bound is not None else "–",
        f"{newer:.3g}" if newer is not None else "–",
        f"{r['outside_runs']}/{r['of_runs']}" if r["outside_runs"] is not None else "–", f"{due:%m-%d}" if due else "–",
    )  # fmt: skip


def print_status(status: Mapping[str, Any]) -> None:
    """Lines instead of tables: names, ids and reasons are longer than a console's 80 columns allow."""
    console.out.print("Lake", style="bold")
    for machine, held in status["lake"].items():
        console.line(f"  {machine}: {held['batches']} batches, files in quarantine: {held['quarantined']}")
    if not status["lake"]:
        console.line("  empty; `thermodrift ingest` fills it")
    _print_models(status["models"])
    _print_trainings(status["trainings"])
    _print_diagnoses(status["diagnoses"])


def _print_models(models: Sequence[Mapping[str, Any]]) -> None:
    console.out.print("Registered models", style="bold")
    for m in models:
        alias = f" {m['aliases']}" if m["aliases"] else ""
        score = f"score {m['score_um']:.2f} µm" if m["score_um"] is not None else "no score"
        badge = ", no trustworthy model" if m["standing"] == "refused" else ""
        console.line(
            f"  {m['name']}/{m['version']}{alias}: {m['expected'] or score}; {m['cell']} over "
            f"{m['n_batches']} batches{_label(m)}{badge}; {m['reason']}"
        )
    if not models:
        console.line("  none; `thermodrift train` promotes the first")


def _print_trainings(trainings: Sequence[Mapping[str, Any]]) -> None:
    console.out.print("Latest trainings", style="bold")
    for t in trainings[:TRAININGS_SHOWN]:
        became = f"; {t['promotion']}" if t["promotion"] else ""
        console.line(
            f"  {t['training_id']} {t['machine']} {t['target']} {_minute(t['started'])}, {t['n_batches']} batches"
            f"{_label(t)}: {t['best']}{became}"
        )
    if not trainings:
        console.line("  none")


def _print_diagnoses(diagnoses: Sequence[Mapping[str, Any]]) -> None:
    last = {d["machine"]: d for d in reversed(diagnoses)}
    if last:
        console.out.print("Last diagnosis of each machine", style="bold")
    for d in sorted(last.values(), key=lambda d: d["started"], reverse=True):
        sure = f" ({100 * d['probability']:.0f} %)" if d["probability"] is not None else ""
        found = f"; {d['mechanism'].replace('_', ' ')}, {d['where']}{sure}" if d["mechanism"] else ""
        console.line(
            f"  {d['run_id']} {d['machine']} {_minute(d['started'])}, {d['n_batches']} batches{_label(d)}: "
            f"{d['verdict'].replace('_', ' ')}{found}"
        )


def _minute(text: str) -> str:
    return f"{datetime.fromisoformat(text):%Y-%m-%d %H:%M}"


def _label(row: Mapping[str, Any]) -> str:
    return ", simulated" if row["simulated"] else ""


def status(
    as_json: Json = False,
    html: Annotated[Path | None, typer.Option(help="write the fleet as one page, .html")] = None,
    alert: Annotated[bool, typer.Option("--alert", help=f"exit code {ALERT_CODE} where there is an alert")] = False,
) -> None:
    """Which champion runs on which machine, whether it still holds, and what needs attention; models, the lake."""
    from pipelines.fleet import watching

    _deliver()
    found = watching.warm() or _gathered(as_json)
    from pipelines.fleet.alerts import fleet_view

    view = fleet_view(Path(found["home"]), found["channels"])
    if html is not None:
        from reports.fleet import write_fleet_page

        shown = [(a.machine, a.channel, a.reason) for a in view.alerts]
        pages = newest_reports({r["machine"] for r in view.rows}, html)
        write_fleet_page(html, view.rows, shown, view.fleets, datetime.now(UTC), pages)
    if as_json:
        tables = {k: found[k] for k in ("models", "trainings", "diagnoses", "lake", "as_of")}
        alerts = [a.__dict__ for a in view.alerts]
        console.print_json({**tables, "fleet": view.rows, "alerts": alerts, "fleets": view.fleets})
    else:
        console.line(f"home {found['home']}")
        print_fleet(view)
        print_status(found)
        if html is not None:
            console.line(f"page {html}")
    if alert:
        for a in view.alerts:
            console.note(f"alert {a.text}")
        if view.alerts:
            raise typer.Exit(ALERT_CODE)


def newest_reports(machines: Iterable[str], page: Path) -> dict[str, str]:
    """By machine the newest report that `train` wrote into the home, as a link from the page."""
    found = {}
    for machine in machines:
        named = re.compile(rf"{re.escape(machine)}-\d{{8}}-\d{{6}}\.html")
        own = sorted(p for p in (home() / "reports").glob("*.html") if named.fullmatch(p.name))
        if own:
            found[machine] = quote(os.path.relpath(own[-1], page.resolve().parent))
    return found


def _deliver() -> None:
    """What the tracking store does not have yet, see `pipelines.store.spool`."""
    if not any((home() / "spool").glob("[0-9]*")):
        return
    configured = load_settings()
    from pipelines.jobs.training import promote_waiting
    from pipelines.store import spool

    spool.deliver(configured, partial(promote_waiting, configured), console.note)


def _gathered(quiet: bool) -> dict[str, Any]:
    settings = load_settings()
    from pipelines.fleet.watching import refresh

    with console.progress(quiet) as (say, _):
        return refresh(settings, say)
