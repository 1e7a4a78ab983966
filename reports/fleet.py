"""The page of a fleet: alerts, and a row per machine and channel, worst first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from types import MappingProxyType
from typing import Any

from reports.labels import count, family_label
from reports.layout import Cell, Column, Gauge, Items, Page, Row, Section, Table, Text
from reports.rendering import write_page

_SCALE = 1.5  # of the drift strip: its end, in 90 % bounds


def write_fleet_page(
    path: Path,
    rows: Sequence[Mapping[str, Any]],
    alerts: Sequence[tuple[str, str, str]],
    fleets: Sequence[Mapping[str, Any]],
    now: datetime,
    pages: Mapping[str, str] = MappingProxyType({}),
) -> None:
    """Write the page; rows and fleets as `pipelines.fleet.alerts` makes them, alerts as (machine, channel, reason).

    `pages` are the newest reports of trainings by machine, as links from the page.

    Raises:
        InputError: another suffix than .html, or no place to write.
    """
    write_page(path, fleet_page(rows, alerts, fleets, now, pages), (".html",))


def fleet_page(
    rows: Sequence[Mapping[str, Any]],
    alerts: Sequence[tuple[str, str, str]],
    fleets: Sequence[Mapping[str, Any]],
    now: datetime,
    pages: Mapping[str, str] = MappingProxyType({}),
) -> Page:
    """The page, see `write_fleet_page`."""
    machines = {r["machine"] for r in rows}
    alerted = {machine for machine, _, _ in alerts}
    without = sum(r["version"] is None for r in rows)
    failed = {r["machine"] for r in rows if r["last_run"] and not r["last_run"]["ok"]}
    summary = (
        f"{count(len(alerts), 'alert')} on {len(alerted)} of {count(len(machines), 'machine')}."
        if alerts else f"No alert on {count(len(machines), 'machine')}."
    )  # fmt: skip
    champions = f"{without} without a champion" if without else "each with a champion"
    of = f"{count(len(rows), 'channel')}, {champions}"
    of += f"; the last retraining of {count(len(failed), 'machine')} failed." if failed else "."
    unknown = tuple(f"{r['machine']} {r['channel']}: {r['unknown']}" for r in rows if r["unknown"])
    served = tuple(
        f"{f['source']}: {count(f['machines'], 'machine')}, {'served now' if f['served'] else 'not served now'}."
        for f in fleets
    )
    recorded = [r["simulated"] for r in rows if r["unknown"] != "nothing ingested"]
    simulated = bool(recorded) and all(recorded)
    said = Items(tuple(f"{' '.join(filter(None, (machine, channel)))}: {why}" for machine, channel, why in alerts))
    sections = [Section("alerts", "Alerts", (said,))] if alerts else []
    table = Table("", _COLUMNS, tuple(_row(r, now, simulated, pages) for r in rows), notes=(_NOTE,), look="stacked")
    sections.append(Section("fleet", "Machines and channels, worst first", (table,), "Machines and channels"))
    if unknown:
        sections.append(Section("unknown", "Not known", tuple(Text(said, "note") for said in unknown)))
    top = (Text(summary, "lead"), Text(of))
    return Page("thermodrift status", f"Fleet: {summary}", top, tuple(sections), served, simulated, "Fleet")


_COLUMNS = (
    Column("machine, channel"), Column("champion"), Column("knows runs up to"), Column("error to expect, S"),
    Column("in newer runs, S"), Column("runs outside the trained region"), Column("failed sensors"),
    Column("next run"), Column("last failure"),
)  # fmt: skip
_NOTE = (
    "S is the standard deviation of what a compensation leaves of the error. The strip: green to the 90 % bound that "
    "was promised at the training (black), the expected S as a short green line, a dot for each run that is newer than "
    "the training. A run is outside where its inputs leave the region of the training runs by more than 5 % of its "
    "width."
)


def _row(r: Mapping[str, Any], now: datetime, simulated: bool, pages: Mapping[str, str]) -> Row:
    """A machine's channel: alert, none (no champion, at best provisional) or ok."""
    stands_in, champion = r["provisional"] is not None, r["version"] is not None
    has = champion or stands_in
    state = "alert" if r["alerts"] else "ok" if champion else "none"
    family = family_label(r["family"]) if r["family"] else ""
    stands = Cell(f"v{r['version']} {family}", _days(r["age_days"]))
    if not champion:
        lacking = f"v{r['provisional']} provisional" if stands_in else "none"
        stands = Cell(lacking, "; ".join(filter(None, (family, r["reason"]))))
    badge = "ok" if champion else "provisional" if stands_in else "no champion"
    label = count(len(r["alerts"]), "alert") if r["alerts"] else badge
    newer, bound = r["newer_S_mean_um"], r["bound90_S_um"]
    drifted = newer is not None and bound is not None and newer > bound
    seen = r["last_seen"] or ""
    return Row.of(
        Cell(f"{r['machine']} {r['channel']}", chip=(label, state), simulated=r["simulated"] and not simulated,
             link=pages.get(r["machine"], "")),
        stands,
        Cell(seen[:10] or ("not known" if has else ""), _days(r["seen_days_ago"]) if seen else "",
             "old_champion" in r["rules"]),
        Cell(*_expected(r)),
        Cell(f"{newer:.3g} µm" if newer is not None else "not measured" if has else "",
             count(len(r["newer_S_um"]), "run") if newer is not None else "", drifted, gauge=_drift(r)),
        Cell(f"{r['outside_runs']} of {r['of_runs']}" if r["outside_runs"] is not None else
             "not known" if has else "", r["outside_why"], "inputs_outside" in r["rules"]),
        Cell(", ".join(r["sensors"]) or ("none failed" if r["n_seen"] else ""), "", bool(r["sensors"])),
        Cell(*_next(r, now)),
        Cell(*_failure(r)),
        look=state,
    )  # fmt: skip


def _expected(r: Mapping[str, Any]) -> tuple[str, str]:
    if r["expected_S_um"] is None:
        return ("not known", "") if r["version"] or r["provisional"] else ("", "")
    bound = f"90 % below {r['bound90_S_um']:.3g}" if r["bound90_S_um"] is not None else ""
    return f"{r['expected_S_um']:.3g} µm", bound


def _next(r: Mapping[str, Any], now: datetime) -> tuple[str, str]:
    if r["next_run"]:
        due = datetime.fromisoformat(r["next_run"]).astimezone()
        return f"{due:%Y-%m-%d %H:%M}", r["schedule"]
    if r["scheduled"]:
        return r["schedule"], ""
    return "not known", f"{r['schedule']}; not served now" if r["schedule"] else "in no fleet"


def _failure(r: Mapping[str, Any]) -> tuple[str, str, bool]:
    if not r["last_failure"]:
        return ("none known", "", False) if r["last_run"] else ("no run known", "", False)
    when = datetime.fromisoformat(r["last_failure"]["ended"]).astimezone()
    return f"{when:%Y-%m-%d %H:%M}", r["last_failure"]["summary"], not r["last_run"]["ok"]


def _drift(r: Mapping[str, Any]) -> Gauge | None:
    """Newer runs against the promise."""
    expected, bound, S_um = r["expected_S_um"], r["bound90_S_um"], r["newer_S_um"]
    if not expected or not bound or not S_um:
        return None

    def at(value_um: float) -> float:
        return round(100 * min(value_um / (_SCALE * bound), 1.0), 1)

    label = f"S of {count(len(S_um), 'newer run')}: {', '.join(f'{s:.3g}' for s in S_um)} µm; bound {bound:.3g} µm"
    marks = (("expected", at(expected)), ("bound", at(bound)))
    return Gauge((0.0, at(bound)), marks, tuple(at(s) for s in S_um), label, "drift")


def _days(days: float | None) -> str:
    if days is None:
        return "age not known"
    return "today" if days < 1 else f"{count(round(days), 'day')} ago"
