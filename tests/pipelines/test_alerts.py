"""Alerts: which rule is broken and why, and that a change of them reaches a webhook."""

from __future__ import annotations

import http.server
import json
import threading
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from data.files import write_atomic
from pipelines.commands.status import print_fleet
from pipelines.fleet import alerts, fleet_state
from pipelines.fleet.alerts import FleetView, alerts_of, machine_alerts
from pipelines.fleet.fleet_file import AlertRules, Fleet, FleetMachine
from pipelines.fleet.watching import SCHEMA

NOW = datetime(2026, 11, 25, 12, 0, tzinfo=UTC)
RULES = AlertRules()


def run_of(k: int, S_um: float | None = None, outside: bool = False) -> dict[str, Any]:
    start = (NOW - timedelta(days=30 - k)).isoformat()
    return {"batch_id": f"b{k}", "start": start, "newer": S_um is not None, "distance": 0.3 if outside else 0.0,
            "outside": outside, "why": "room 31 degC, trained 18 to 27" if outside else "", "S_um": S_um}  # fmt: skip


def state_of(*runs: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {
        "machine": "mill", "channel": "z", "model": "mill-z", "version": 3, "provisional": None, "cell": "none|ridge|2",
        "family": "ridge", "since": "", "trained_at": "2026-10-01T00:00:00+00:00", "reason": "", "simulated": False,
        "expected_S_um": 2.0,
        "bound90_S_um": 4.0, "expected_by": "forward", "n_seen": 6, "last_seen": "2026-09-30T08:00:00",
        "runs": list(runs), "sensors": [], "unknown": "", **more,
    }  # fmt: skip


def reasons(state: dict[str, Any], rules: AlertRules = RULES) -> dict[str, str]:
    return {a.rule: a.reason for a in alerts_of(state, rules, NOW)}


def test_a_champion_that_holds_raises_none() -> None:
    assert not reasons(state_of(run_of(1), run_of(2, 3.9), run_of(3, 4.0, outside=True), run_of(4, outside=True)))


def test_error_above_the_bound_of_the_training() -> None:
    (text,) = reasons(state_of(run_of(1, 3.0), run_of(2, 6.0))).values()
    assert text == "error S 4.5 µm in the 2 newest runs on average, above the 90 % bound of 4 µm (expected 2 µm)"
    many = [run_of(k, 9.0) for k in range(5)] + [run_of(k, 3.0) for k in range(5, 10)]
    assert not reasons(state_of(*many))  # the newest five decide
    assert not reasons(state_of(run_of(1, 9.0), bound90_S_um=None))


def test_inputs_outside_in_k_of_the_last_n_runs() -> None:
    runs = [run_of(k, outside=k in (0, 3, 4)) for k in range(6)]
    assert not reasons(state_of(*runs))  # one of them is not among the last five
    assert reasons(state_of(*runs), AlertRules(outside_runs=2)) == {
        "inputs_outside": "inputs outside the trained region in 2 of the last 5 runs (room 31 degC, trained 18 to 27)"
    }


def test_a_champion_older_than_a_season() -> None:
    old = reasons(state_of(last_seen="2026-06-01T08:00:00"))["old_champion"]
    assert old == "champion version 3 is older than a season: trained on runs up to 2026-06-01, 177 days ago"
    assert not reasons(state_of(last_seen="2026-06-01T08:00:00"), AlertRules(most_age_days=200))
    undated = reasons(state_of(last_seen="", trained_at="2026-06-01T00:00:00+00:00"))["old_champion"]
    assert "trained on 2026-06-01, 178 days ago" in undated  # the runs have no dates: the training has
    assert not reasons(state_of(last_seen="", trained_at=""))
    assert not reasons(state_of(last_seen="2025-06-01T08:00:00", simulated=True))  # its dates are made up
    assert not reasons(state_of(run_of(1, 99.0), version=None))


def test_a_failed_retraining_and_a_failed_sensor() -> None:
    failed = {"last": {"ok": False, "summary": "no share"}}
    sensor = {"batch_id": "b2", "channel": "front", "checks": ["frozen"], "share": 0.8, "input": True}
    before = {**sensor, "batch_id": "b1", "channel": "bed"}
    state = state_of(run_of(1), run_of(2), sensors=[before, sensor])
    found = machine_alerts("mill", [state, state_of(run_of(2), channel="x")], failed)
    assert [a.text for a in found] == [
        "mill: the last retraining failed: no share",
        "mill: sensor front failed in run b2 (frozen; 80 % of it without a value); the model of z uses it",
    ]
    assert not machine_alerts("mill", [state_of(run_of(2))], {"last": {"ok": True, "summary": ""}})


class Hook(http.server.ThreadingHTTPServer):
    """A webhook that keeps what it gets, and answers with `code`."""

    def __init__(self) -> None:
        self.got: list[dict[str, Any]] = []
        self.code = 200
        self.answered = threading.Event()
        super().__init__(("127.0.0.1", 0), _Handler)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/hook"

    def wait(self) -> None:
        assert self.answered.wait(30)
        self.answered.clear()


class _Handler(http.server.BaseHTTPRequestHandler):
    server: Hook

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.server.got.append(json.loads(body))
        self.send_response(self.server.code)
        self.end_headers()
        self.server.answered.set()

    def log_message(self, *given: object) -> None:
        pass


@pytest.fixture
def hook() -> Iterator[Hook]:
    with Hook() as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server
        server.shutdown()


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("THERMODRIFT_HOME", str(tmp_path))
    monkeypatch.delenv(alerts.WEBHOOK, raising=False)
    fleet_state.folder_of(tmp_path)
    return tmp_path


def keep(home: Path, *states: dict[str, Any]) -> None:
    write_atomic(home / "fleet" / "status.json", json.dumps({"schema": SCHEMA, "channels": states}))


def fleet_with(url: str | None) -> Fleet:
    return Fleet("/m/fleet.yml", (FleetMachine("mill", "/m/mill.yml", ("/in",)),), alerts=AlertRules(webhook=url))


def in_threads() -> None:
    for t in threading.enumerate():
        if t.name == "alerts":
            t.join(30)


def test_a_change_of_the_alerts_is_sent_once(home: Path, hook: Hook) -> None:
    fleet, said = fleet_with(hook.url), list[str]()
    last_seen = datetime.now(UTC).isoformat()
    keep(home, state_of(run_of(1, 9.0), last_seen=last_seen))
    alerts.after_run(home, fleet, "mill", said.append)
    hook.wait()
    in_threads()
    alerts.after_run(home, fleet, "mill", said.append)
    in_threads()
    (first,) = hook.got
    assert (first["schema"], first["machine"], first["cleared"]) == ("thermodrift.alerts/1", "mill", [])
    assert [(a["channel"], a["rule"]) for a in first["alerts"]] == [("z", "error_drift")]
    assert first["raised"][0].startswith("mill z: error S 9 µm in the newest run, above the 90 % bound of 4 µm")
    keep(home, state_of(run_of(1, 1.0), last_seen=last_seen))
    alerts.after_run(home, fleet, "mill", said.append)
    hook.wait()
    assert hook.got[1]["alerts"] == [] and hook.got[1]["cleared"] == first["raised"]
    assert [line.partition(":")[0] for line in said] == ["alert mill z", "no more"]


@pytest.mark.parametrize("trouble", ["code", "nobody"])
def test_what_could_not_be_sent_goes_after_the_next_run(home: Path, hook: Hook, trouble: str) -> None:
    said: list[str] = []
    keep(home, state_of(run_of(1, 9.0), last_seen=datetime.now(UTC).isoformat()))
    hook.code = 500
    alerts.after_run(home, fleet_with(hook.url if trouble == "code" else "http://127.0.0.1:9/x"), "mill", said.append)
    in_threads()
    lines = [line for line in said if "could not be sent" in line]
    assert len(lines) == 1 and ("HTTP 500" in lines[0]) == (trouble == "code")
    hook.code, hook.got = 200, []
    hook.answered.clear()
    alerts.after_run(home, fleet_with(hook.url), "mill", said.append)
    hook.wait()
    in_threads()
    assert len(hook.got) == 1 and len(hook.got[0]["raised"]) == 1
    assert [line for line in said if line.startswith("alert ")] == [said[0]]  # logged once


def test_the_environment_names_the_webhook_too(home: Path, hook: Hook, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(alerts.WEBHOOK, hook.url)
    keep(home, state_of(run_of(1, 9.0)))
    alerts.after_run(home, fleet_with(None), "mill", print)
    hook.wait()
    in_threads()
    assert hook.got


def test_an_address_that_hangs_is_given_up(hook: Hook, monkeypatch: pytest.MonkeyPatch) -> None:
    go = threading.Event()
    monkeypatch.setattr(_Handler, "do_POST", lambda self: go.wait(30))
    assert "timed out" in alerts.post(hook.url, {}, timeout_s=0.2)
    go.set()


def test_long_names_are_whole_in_the_table_of_status(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    unknown = ("expected_S_um", "bound90_S_um", "newer_S_mean_um", "provisional", "next_run", "outside_runs", "of_runs")
    row = {"machine": "q" * 40, "channel": "k" * 12, "version": 3, "family": "y" * 30, "alerts": [], "last_seen": "",
           "unknown": "", **dict.fromkeys(unknown)}  # fmt: skip
    print_fleet(FleetView([row], [], []))
    table = capsys.readouterr().out.partition("expect: ")[0]
    assert [table.count(letter) for letter in "qky…"] == [40, 12, 30, 0]
    assert max(map(len, table.splitlines())) <= 80
