"""The fleet table as `thermodrift status` shows it: states, alerts, dates of runs and failures, worst first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pipelines import fleet_state
from pipelines.alerts import Alert, alerts_of, days_since, last_seen, machine_alerts, newer_S_um
from pipelines.fleet import AlertRules

Row = dict[str, Any]


@dataclass(frozen=True)
class FleetView:
    """A row per machine and channel, worst first, the alerts, and the fleets that were or are served."""

    rows: list[Row]
    alerts: list[Alert]
    fleets: list[dict[str, Any]]


def fleet_view(home: Path, channels: Sequence[Mapping[str, Any]], now: datetime | None = None) -> FleetView:
    """The view of `channels` (see `watching.refresh`) at `now`.

    A row: machine, channel, model, version (None: no champion), provisional (its version, None: there is none), cell,
    family, since, trained_at, age_days (since the training), reason, simulated, last_seen and seen_days_ago,
    expected_S_um, bound90_S_um, newer_S_um (a list), newer_S_mean_um, drift (of it to the bound), outside_runs,
    of_runs, outside_why, sensors, next_run, schedule, scheduled (a process serves it now), last_run and last_failure
    (began, ended, ok, summary), alerts (texts), rules (theirs), unknown.
    """
    now = now or datetime.now(UTC)
    plans: dict[str, dict[str, Any]] = {}
    fleets = []
    for kept, served in fleet_state.schedules(home):
        fleets.append({"source": kept["source"], "served": served, "machines": len(kept["machines"])})
        for name, machine in kept["machines"].items():
            if served or name not in plans:
                due = kept.get("next", {}).get(name) if served else None
                rules = AlertRules(**kept.get("alerts", {}))
                plans[name] = {"when": machine["when"], "next": due, "served": served, "rules": rules,
                               "channels": machine.get("channels", [])}  # fmt: skip
    states: dict[str, list[Mapping[str, Any]]] = {name: [] for name in plans}
    for state in channels:
        wanted = plans.get(state["machine"], {}).get("channels")
        modelled = state["version"] is not None or state["provisional"] is not None
        if modelled or not wanted or state["channel"] in wanted:  # nobody is to learn what the fleet file leaves out
            states.setdefault(state["machine"], []).append(state)
    rows, alerts = [], []
    for name, own in states.items():
        plan = plans.get(name, {"when": "", "next": None, "served": False, "rules": AlertRules()})
        run = fleet_state.read(home, name, "run")
        whole = machine_alerts(name, own, run)
        alerts += whole
        for k, state in enumerate(own or [_untrained(name)]):
            found = alerts_of(state, plan["rules"], now)
            alerts += found
            shown = [*found, *(whole if k == 0 else [])]
            texts, broken = [a.reason for a in shown], [a.rule for a in shown]
            more = {"alerts": texts, "rules": broken, "machine_alerts": len(whole)}
            rows.append(_row(state, plan, run, now) | more)
    rows.sort(key=_worst_first)
    order = {r["machine"]: k for k, r in reversed(list(enumerate(rows)))}
    alerts.sort(key=lambda a: order[a.machine])
    return FleetView(rows, alerts, fleets)


def _row(state: Mapping[str, Any], plan: Mapping[str, Any], run: Mapping[str, Any], now: datetime) -> Row:
    rules: AlertRules = plan["rules"]
    S_um, bound_um = newer_S_um(state, rules), state["bound90_S_um"]
    mean_um = sum(S_um) / len(S_um) if S_um else None
    known = [r for r in state["runs"][-rules.of_runs :] if r["distance"] is not None]
    outside = [r for r in known if r["outside"]]
    newest = state["runs"][-1]["batch_id"] if state["runs"] else None
    keys = ("machine", "channel", "model", "version", "provisional", "cell", "family", "since", "trained_at", "reason",
            "simulated", "last_seen", "expected_S_um", "bound90_S_um", "expected_by", "n_seen", "unknown")  # fmt: skip
    return {
        **{k: state[k] for k in keys},
        "age_days": days_since(state["trained_at"], now),
        "seen_days_ago": days_since(last_seen(state)[0], now),
        "newer_S_um": S_um, "newer_S_mean_um": mean_um,
        "drift": mean_um / bound_um if mean_um is not None and bound_um else None,
        "outside_runs": len(outside) if known else None, "of_runs": len(known),
        "outside_why": outside[-1]["why"] if outside else "",
        "sensors": sorted({s["channel"] for s in state["sensors"] if s["batch_id"] == newest}),
        "next_run": plan["next"], "schedule": plan["when"], "scheduled": plan["served"],
        "last_run": run.get("last"), "last_failure": run.get("failed"),
    }  # fmt: skip


def _untrained(machine: str) -> Mapping[str, Any]:
    """A machine of a fleet that has neither batches nor models."""
    texts = dict.fromkeys(
        ("channel", "model", "cell", "family", "since", "trained_at", "reason", "last_seen", "expected_by"), ""
    )
    return {**texts, "machine": machine, "version": None, "provisional": None, "simulated": False,
            "expected_S_um": None, "bound90_S_um": None, "n_seen": 0, "runs": [], "sensors": [],
            "unknown": "nothing ingested"}  # fmt: skip


def _worst_first(row: Row) -> tuple[Any, ...]:
    """Alerts, then no champion, then by drift; a machine's channels without an alert stay with the healthy ones."""
    troubles = len(row["alerts"])
    return -troubles, row["version"] is not None, -(row["drift"] or 0.0), row["machine"], row["channel"]
