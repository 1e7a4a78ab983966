"""Alerts: rules over the state of a machine and its channels, each with its reason, and where changes are sent."""

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

from pipelines import fleet_state, watching
from pipelines.caller import Say
from pipelines.fleet import AlertRules, Fleet

TIMEOUT_S = 10.0
WEBHOOK = "THERMODRIFT_WEBHOOK"
State = Mapping[str, Any]  # of a channel, see `watching.refresh`


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
