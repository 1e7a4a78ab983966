"""The page of a fleet: alerts, and a row per machine and channel, worst first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import groupby
from pathlib import Path
from typing import Any

from reports.labels import count
from reports.rendering import write_page

_SCALE = 1.5  # of the drift strip: its end, in 90 % bounds


@dataclass(frozen=True)
class Drift:
    """Newer runs against the promise, as positions 0..100: dots, the expected S, the 90 % bound."""

    dots: tuple[float, ...]
    expected: float
    bound: float
    beyond: bool
    label: str


@dataclass(frozen=True)
class FleetCell:
    """A value and a smaller line below it; `bad` where it is the reason of an alert."""

    text: str
    below: str = ""
    bad: bool = False


@dataclass(frozen=True)
class FleetRow:
    """A machine's channel."""

    machine: str
    channel: str
    simulated: bool
    state: str  # alert, none (no champion, at best provisional) or ok
    state_label: str
    champion: FleetCell
    seen: FleetCell
    expected: FleetCell
    newer: FleetCell
    drift: Drift | None
    outside: FleetCell
    sensors: FleetCell
    next_run: FleetCell
    failure: FleetCell


@dataclass(frozen=True)
class FleetPage:
    """What the template shows."""

    title: str
    simulated: bool  # every row
    summary: str
    figures: tuple[tuple[str, str, str], ...]  # label, number, below
    alerts: tuple[tuple[str, tuple[tuple[str, str], ...]], ...]  # machine -> (channel, reason)
    rows: tuple[FleetRow, ...]
    unknown: tuple[str, ...]
    fleets: tuple[str, ...]


def write_fleet_page(
    path: Path,
    rows: Sequence[Mapping[str, Any]],
    alerts: Sequence[tuple[str, str, str]],
    fleets: Sequence[Mapping[str, Any]],
    now: datetime,
) -> None:
    """Write the page; rows and fleets as `pipelines.fleet_view` makes them, alerts as (machine, channel, reason).

    Raises:
        InputError: another suffix than .html, or no place to write.
    """
    write_page(path, "fleet", fleet_page(rows, alerts, fleets, now), (".html",))


def fleet_page(
    rows: Sequence[Mapping[str, Any]],
    alerts: Sequence[tuple[str, str, str]],
    fleets: Sequence[Mapping[str, Any]],
    now: datetime,
) -> FleetPage:
    """The page's content, see `write_fleet_page`."""
    machines = {r["machine"] for r in rows}
    alerted = {machine for machine, _, _ in alerts}
    without = sum(r["version"] is None for r in rows)
    failed = {r["machine"] for r in rows if r["last_run"] and not r["last_run"]["ok"]}
    figures = (
        ("machines", str(len(machines)), f"{count(len(rows), 'channel')}"),
        ("with an alert", str(len(alerted)), count(len(alerts), "alert")),
        ("without a champion", str(without), "channels"),
        ("last retraining failed", str(len(failed)), "machines"),
    )
    summary = (
        f"{count(len(alerts), 'alert')} on {len(alerted)} of {count(len(machines), 'machine')}."
        if alerts else f"No alert on {count(len(machines), 'machine')}."
    )  # fmt: skip
    grouped = tuple((m, tuple((c, said) for _, c, said in own)) for m, own in groupby(alerts, key=lambda a: a[0]))
    unknown = tuple(f"{r['machine']} {r['channel']}: {r['unknown']}" for r in rows if r["unknown"])
    served = tuple(
        f"{f['source']}: {count(f['machines'], 'machine')}, {'served now' if f['served'] else 'not served now'}"
        for f in fleets
    )
    simulated = bool(rows) and all(r["simulated"] for r in rows if r["n_seen"])
    made = tuple(_row(r, now) for r in rows)
    return FleetPage("Fleet", simulated, summary, figures, grouped, made, unknown, served)


def _row(r: Mapping[str, Any], now: datetime) -> FleetRow:
    has = r["version"] is not None
    state = "alert" if r["alerts"] else "ok" if has else "none"
    lacking = "none" if r["provisional"] is None else f"v{r['provisional']} provisional"
    badge = "ok" if has else "no champion" if r["provisional"] is None else "provisional"
    label = count(len(r["alerts"]), "alert") if r["alerts"] else badge
    newer, bound = r["newer_S_mean_um"], r["bound90_S_um"]
    drifted = newer is not None and bound is not None and newer > bound
    seen = r["last_seen"] or ""
    return FleetRow(
        r["machine"], r["channel"], r["simulated"], state, label,
        FleetCell(f"v{r['version']} {r['family']}", _days(r["age_days"])) if has else FleetCell(lacking, r["reason"]),
        FleetCell(seen[:10] or ("not known" if has else ""), _days(r["seen_days_ago"]) if seen else "",
                  "old_champion" in r["rules"]),
        FleetCell(*_expected(r)),
        FleetCell(f"{newer:.3g} µm" if newer is not None else "not measured" if has else "",
                  count(len(r["newer_S_um"]), "run") if newer is not None else "", drifted),
        _drift(r),
        FleetCell(f"{r['outside_runs']} of {r['of_runs']}" if r["outside_runs"] is not None else
                  "not known" if has else "", r["outside_why"], "inputs_outside" in r["rules"]),
        FleetCell(", ".join(r["sensors"]) or ("none failed" if r["n_seen"] else ""), "", bool(r["sensors"])),
        FleetCell(*_next(r, now)),
        FleetCell(*_failure(r)),
    )  # fmt: skip


def _expected(r: Mapping[str, Any]) -> tuple[str, str]:
    if r["expected_S_um"] is None:
        return ("not known", "") if r["version"] is not None else ("", "")
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


def _drift(r: Mapping[str, Any]) -> Drift | None:
    expected, bound, S_um = r["expected_S_um"], r["bound90_S_um"], r["newer_S_um"]
    if not expected or not bound or not S_um:
        return None
    end = _SCALE * bound

    def at(value_um: float) -> float:
        return round(100 * min(value_um / end, 1.0), 1)

    label = f"S of {count(len(S_um), 'newer run')}: {', '.join(f'{s:.3g}' for s in S_um)} µm; bound {bound:.3g} µm"
    return Drift(tuple(at(s) for s in S_um), at(expected), at(bound), max(S_um) > end, label)


def _days(days: float | None) -> str:
    if days is None:
        return "age not known"
    return "today" if days < 1 else f"{count(round(days), 'day')} ago"
