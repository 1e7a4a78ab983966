"""The page of a fleet: worst first, alerts in words, and nothing claimed that is not known."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from data.errors import InputError
from reports.fleet import fleet_page, write_fleet_page
from reports.layout import Items, Table, Text
from tests.toys.pages import blocks, section, unscripted

HEADS = ("name", "champion", "seen", "expected", "newer", "outside", "sensors", "next", "failure")

NOW = datetime(2026, 11, 25, 12, 0, tzinfo=UTC)
RUN = {"began": "2026-11-24T05:00:00+00:00", "ended": "2026-11-24T05:10:00+00:00", "ok": False, "summary": "no <share>"}


def row_of(machine: str, **more: Any) -> dict[str, Any]:
    return {
        "machine": machine, "channel": "z", "model": f"{machine}-z", "version": 3, "provisional": None,
        "cell": "none|ridge|2", "family": "ridge", "since": "", "trained_at": "", "reason": "", "simulated": False,
        "last_seen": "2026-11-01",
        "expected_S_um": 2.0, "bound90_S_um": 4.0, "expected_by": "forward", "n_seen": 6, "unknown": "",
        "age_days": 3.2, "seen_days_ago": 24.5, "newer_S_um": [], "newer_S_mean_um": None, "drift": None,
        "outside_runs": 0, "of_runs": 5, "outside_why": "", "sensors": [], "next_run": None, "schedule": "",
        "scheduled": False, "last_run": None, "last_failure": None, "alerts": [], "rules": [],
        "machine_alerts": 0, **more,
    }  # fmt: skip


DRIFTING = row_of(
    "mill", newer_S_um=[3.0, 9.0], newer_S_mean_um=6.0, drift=1.5, alerts=["error S 6 µm above"], rules=["error_drift"],
    last_run=RUN, last_failure=RUN, next_run="2026-11-30T04:00:00+00:00", schedule="cron 0 5 * * 1", scheduled=True,
)  # fmt: skip
UNKNOWN = row_of(
    "lathe", version=None, family="", last_seen="", expected_S_um=None, bound90_S_um=None, n_seen=0, age_days=None,
    seen_days_ago=None, outside_runs=None, of_runs=0, unknown="the lake has other channels",
)  # fmt: skip


def test_values_and_reasons() -> None:
    page = fleet_page([DRIFTING, row_of("hmc"), UNKNOWN], [("mill", "z", "error S 6 µm above")], [], NOW)
    (alerts,), (table,) = blocks(page, Items), blocks(page, Table)
    assert blocks(page, Text)[0].text == "1 alert on 1 of 3 machines."
    assert alerts.items == ("mill z: error S 6 µm above",)
    mill, hmc, lathe = (dict(zip(HEADS, r.cells, strict=True)) for r in table.rows)
    assert [r.look for r in table.rows] == ["alert", "ok", "none"]
    assert mill["newer"].alert and mill["newer"].text == "6 µm"
    assert mill["failure"].alert and mill["failure"].below == "no <share>"
    drift = mill["newer"].gauge
    assert drift is not None and drift.dots == (50.0, 100.0) and drift.band == (0.0, pytest.approx(66.7))
    assert dict(drift.marks) == {"expected": pytest.approx(33.3), "bound": pytest.approx(66.7)}
    assert (hmc["newer"].text, hmc["newer"].gauge, hmc["next"].text, hmc["failure"].text) == (
        "not measured", None, "not known", "no run known",
    )  # fmt: skip
    assert lathe["champion"].text == "none" and lathe["expected"].text == lathe["outside"].text == ""
    (doubted,) = blocks(fleet_page([UNKNOWN | {"provisional": 2}], [], [], NOW), Table)[0].rows
    assert (doubted.cells[0].chip, doubted.cells[1].text) == (("provisional", "none"), "v2 provisional")
    assert [b.text for b in section(page, "unknown").blocks] == ["lathe z: the lake has other channels"]


def test_the_page_is_whole_and_escaped(tmp_path: Path) -> None:
    path = tmp_path / "fleet.html"
    alerts = [("mill", "z", "error S 6 µm above"), ("mill", "", "the last retraining failed: no <share>")]
    fleets = [{"source": "/etc/fleet.yml", "served": True, "machines": 2}]
    write_fleet_page(path, [DRIFTING, row_of("hmc", simulated=True)], alerts, fleets, NOW, {"mill": "r/a%20b.html"})
    text = unscripted(path.read_text(encoding="utf-8"))
    assert "no &lt;share&gt;" in text and "<share>" not in text and text.count("SIMULATED") == 1
    assert "http" not in text.replace("http-equiv", "")  # nothing is loaded
    assert "2 machines, served now" in text
    assert text.count("<a href=") == 3 and '<a href="r/a%20b.html">mill z</a>' in text
    page = fleet_page([row_of("mill", simulated=True), row_of("hmc", simulated=True)], [], [], NOW)
    assert page.simulated  # then the title says so, and no row
    untrained = UNKNOWN | {"unknown": ""}
    assert not fleet_page([untrained], [], [], NOW).simulated  # recorded, whether or not a model has seen it
    assert fleet_page([untrained | {"simulated": True}], [], [], NOW).simulated
    assert not fleet_page([UNKNOWN | {"unknown": "nothing ingested"}], [], [], NOW).simulated
    with pytest.raises(InputError, match="unsupported file extension"):
        write_fleet_page(tmp_path / "fleet.md", [], [], [], NOW)


def test_an_empty_fleet(tmp_path: Path) -> None:
    page = fleet_page([], [], [], NOW)
    assert blocks(page, Text)[0].text == "No alert on 0 machines." and not blocks(page, Table)[0].rows
