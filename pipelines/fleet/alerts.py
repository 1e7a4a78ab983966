"""What needs attention in a fleet: alerts, which are rules over the state of a machine and its channels, each with its
reason; where their changes are sent; and the table that `thermodrift status` shows, worst first."""

from __future__ import annotations

import json
import os
import threading
import urllib.error
import urllib.request
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from pipelines.caller import Say
from pipelines.fleet import fleet_state, watching
from pipelines.fleet.fleet_file import AlertRules, Fleet

TIMEOUT_S = 10.0
WEBHOOK = "THERMODRIFT_WEBHOOK"
State = Mapping[str, Any]  # of a channel, see `watching.refresh`
Row = dict[str, Any]


@dataclass(frozen=True)
class Alert:
    """A rule that a machine or one of its channels (empty: all) breaks, and why."""

    machine: str
    channel: str
    rule: str
    reason: str

    @property
    def text(self) -> str:
        return f"{' '.join(filter(None, (self.machine, self.channel)))}: {self.reason}"


def alerts_of(state: State, rules: AlertRules, now: datetime) -> list[Alert]:
    """The alerts of a machine's channel."""
    if state["version"] is None:
        return []
    of_runs = state["runs"][-rules.of_runs :]
    found = {
        "error_drift": _error_drift(state, rules),
        "inputs_outside": _inputs_outside(of_runs, rules),
        "old_champion": _old_champion(state, rules, now),
    }
    return [Alert(state["machine"], state["channel"], rule, reason) for rule, reason in found.items() if reason]


def machine_alerts(machine: str, states: Sequence[State], run: Mapping[str, Any]) -> list[Alert]:
    """Alerts of a machine as a whole: its last retraining failed, sensors failed in its newest run."""
    found = []
    last = run.get("last")
    if last and not last["ok"]:
        found.append(Alert(machine, "", "retraining_failed", f"the last retraining failed: {last['summary']}"))
    newest = next((s["runs"][-1]["batch_id"] for s in states if s["runs"]), None)
    sensors = {f["channel"]: f for s in states for f in s["sensors"] if f["batch_id"] == newest}
    for name, f in sensors.items():
        checks = ", ".join(c.replace("_", " ") for c in f["checks"])
        used = sorted({s["channel"] for s in states if any(f["channel"] == o["channel"] and o["input"] and
                                                           o["batch_id"] == newest for o in s["sensors"])})  # fmt: skip
        reason = f"sensor {name} failed in run {newest} ({checks}; {100 * f['share']:.0f} % of it without a value)"
        reason += f"; the model of {', '.join(used)} uses it" if used else ""
        found.append(Alert(machine, "", f"sensor_failed {name}", reason))
    return found


def newer_S_um(state: State, rules: AlertRules) -> list[float]:
    """S of the champion on the newest runs that it was not trained on, at most `of_runs`."""
    return [r["S_um"] for r in state["runs"] if r["S_um"] is not None][-rules.of_runs :]


def last_seen(state: State) -> tuple[str, str]:
    """Up to when a champion knows its machine, and what that is: its newest run, else its training."""
    return (state["last_seen"], "trained on runs up to") if state["last_seen"] else (state["trained_at"], "trained on")


def days_since(text: str, now: datetime) -> float | None:
    """None where the date is not known; a date without a zone is local."""
    try:
        return float((now - datetime.fromisoformat(text).astimezone(UTC)).total_seconds() / 86400)
    except ValueError:
        return None


def _error_drift(state: State, rules: AlertRules) -> str:
    S_um, bound_um = newer_S_um(state, rules), state["bound90_S_um"]
    if not S_um or bound_um is None or (mean_um := sum(S_um) / len(S_um)) <= bound_um:
        return ""
    runs = "the newest run" if len(S_um) == 1 else f"the {len(S_um)} newest runs on average"
    expected = f" (expected {state['expected_S_um']:.3g} µm)" if state["expected_S_um"] is not None else ""
    return f"error S {mean_um:.3g} µm in {runs}, above the 90 % bound of {bound_um:.3g} µm{expected}"


def _inputs_outside(runs: Sequence[Mapping[str, Any]], rules: AlertRules) -> str:
    outside = [r for r in runs if r["outside"]]
    if len(outside) < rules.outside_runs:
        return ""
    return f"inputs outside the trained region in {len(outside)} of the last {len(runs)} runs ({outside[-1]['why']})"


def _old_champion(state: State, rules: AlertRules, now: datetime) -> str:
    if state["simulated"]:  # the dates of simulated recordings are made up
        return ""
    when, what = last_seen(state)
    days = days_since(when, now)
    if days is None or days <= rules.most_age_days:
        return ""
    return f"champion version {state['version']} is older than a season: {what} {when[:10]}, {days:.0f} days ago"


def after_run(home: Path, fleet: Fleet, machine: str, say: Say) -> None:
    """The alerts of a machine after a run: what changed is logged, and sent where there is a webhook."""
    current = {f"{a.channel}|{a.rule}": a for a in _current(home, fleet.alerts, machine)}
    kept = fleet_state.read(home, machine, "alerts")
    logged, sent = kept.get("logged", {}), kept.get("sent", {})
    for key in current.keys() - logged.keys():
        say(f"alert {current[key].text}")
    for key in logged.keys() - current.keys():
        say(f"no more: {logged[key]}")
    texts = {key: a.text for key, a in sorted(current.items())}
    fleet_state.write(home, machine, "alerts", {"logged": texts, "sent": sent})
    url = os.environ.get(WEBHOOK, "").strip() or fleet.alerts.webhook
    if url and texts.keys() != sent.keys():
        message = {
            "schema": "thermodrift.alerts/1", "machine": machine, "at": datetime.now(UTC).isoformat(timespec="seconds"),
            "alerts": [asdict(a) for a in current.values()],
            "raised": [texts[k] for k in sorted(texts.keys() - sent.keys())],
            "cleared": [sent[k] for k in sorted(sent.keys() - texts.keys())],
        }  # fmt: skip
        threading.Thread(
            target=_deliver, args=(home, machine, url, message, texts, say), name="alerts", daemon=True
        ).start()


def _current(home: Path, rules: AlertRules, machine: str) -> list[Alert]:
    states = [s for s in watching.kept_channels() if s["machine"] == machine]
    now = datetime.now(UTC)
    found = [a for s in states for a in alerts_of(s, rules, now)]
    return [*found, *machine_alerts(machine, states, fleet_state.read(home, machine, "run"))]


def _deliver(
    home: Path, machine: str, url: str, message: Mapping[str, Any], texts: Mapping[str, str], say: Say
) -> None:
    """In a thread: an address that does not answer keeps no machine waiting. What could not be sent goes next time."""
    trouble = post(url, message)
    if trouble:
        say(f"alerts of {machine} could not be sent to {urlsplit(url).hostname}: {trouble}; they are sent after the "
            "next run")  # fmt: skip
        return
    fleet_state.write(home, machine, "alerts", {"logged": dict(texts), "sent": dict(texts)})


def post(url: str, message: Mapping[str, Any], timeout_s: float = TIMEOUT_S) -> str:
    """HTTP POST of JSON; why it failed, empty where it did not."""
    body = json.dumps(message, ensure_ascii=False).encode()
    request = urllib.request.Request(url, body, {"Content-Type": "application/json"}, method="POST")
    try:
        with urllib.request.urlopen(request, timeout=timeout_s):
            return ""
    except urllib.error.HTTPError as error:
        return f"HTTP {error.code}"
    except (OSError, ValueError) as error:
        return str(getattr(error, "reason", error)) or type(error).__name__


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
    # alerts, then no champion, then by drift; a machine's channels without an alert stay with the healthy ones
    rows.sort(
        key=lambda r: (-len(r["alerts"]), r["version"] is not None, -(r["drift"] or 0.0), r["machine"], r["channel"])
    )
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
