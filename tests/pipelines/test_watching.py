"""The state of machines and channels: what drifted by how much, what failed, and when it is gathered again."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from data.ingest import ingest
from data.machine import load_machine
from features.rises import zeroed_error_um
from models.metrics import residual_std_um
from models.selection.crossing import Plan
from models.selection.trust import farthest, watched
from pipelines import settings
from pipelines.caller import DirectCaller
from pipelines.commands.status import newest_reports
from pipelines.fleet import fleet_state, watching
from pipelines.fleet.alerts import fleet_view
from pipelines.fleet.fleet_file import Fleet, FleetMachine
from pipelines.jobs import training
from pipelines.jobs.recordings import home_lake, load_batches
from pipelines.jobs.request import TrainRequest
from pipelines.store import model_store, registry
from reports.fleet import write_fleet_page
from tests.toys.command import in_process
from tests.toys.small_year import recording, write_machine, write_year

NAME = "watched"
PLAN = Plan(("none",), ("zero", "ridge"), ("leave-batch-out",))
Call = Callable[..., Any]


def unlike(k: int) -> pd.DataFrame:
    """A recording under the conditions of the k-th, and no copy of it."""
    table = recording(k)
    rng = np.random.default_rng(100 + k)
    for column in ("front", "bed", "room", "z"):
        table[column] = (table[column] + rng.normal(0, 0.03, len(table))).round(2)
    return table


class Place:
    """A home with one trained machine, and three newer runs: as before, hot and drifting, with a broken sensor."""

    def __init__(self, folder: Path) -> None:
        self.home, self.incoming = folder / "home", folder / "in"
        self.machine = write_machine(folder / "m.yml", NAME)
        write_year(self.incoming, 6)
        self.settings = settings.load()
        request = TrainRequest(self.machine, (self.incoming,), ("z",), PLAN, report=folder / "r.html")
        self.outcome = training.train(request, self.settings, DirectCaller())
        newer = [unlike(3), unlike(4), unlike(2)]
        newer[1]["room"] += 0.002 * newer[1]["time_s"]
        newer[1]["z"] += 0.002 * newer[1]["time_s"]
        newer[2].loc[10:, "front"] = 250.0
        for k, table in enumerate(newer):
            table.to_csv(self.incoming / f"202509{14 + k}.csv", index=False)
        ingest([self.incoming], load_machine(self.machine), home_lake())

    def states(self) -> dict[str, dict[str, Any]]:
        return {s["channel"]: s for s in watching.refresh(self.settings)["channels"] if s["machine"] == NAME}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("watching")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("THERMODRIFT_HOME", str(folder / "home"))
        patch.chdir(folder)
        yield Place(folder)


def test_the_state_of_a_champion(place: Place) -> None:
    states = place.states()
    z, x = states["z"], states["x"]
    expected = place.outcome.outlooks["z"]
    assert (z["model"], z["version"], z["n_seen"], z["simulated"]) == (f"{NAME}-z", 1, 6, True)
    assert z["last_seen"] == "2025-06-14T00:00:00" and z["unknown"] == ""
    assert z["expected_S_um"] == pytest.approx(expected.S_um) and z["bound90_S_um"] == pytest.approx(expected.bound_um)
    assert x["version"] is None and x["expected_S_um"] is None and x["n_seen"] == 0


def test_drift_is_what_model_and_region_say_of_the_newer_runs(place: Place) -> None:
    runs = {r["batch_id"]: r for r in place.states()["z"]["runs"]}
    assert [r["newer"] for r in runs.values()] == [False] * 6 + [True] * 3
    client = registry.open_store(place.settings)
    source = registry.find_version(client, f"{NAME}-z", "champion").source
    model = model_store.load(Path(registry.local_folder(str(source), place.settings)))
    batches = {b.batch_id: b for b in load_batches(home_lake(), model.machine)}
    for batch_id in ("20250914", "20250915"):
        b = batches[batch_id]
        values = watched(b, model.family.inputs)
        distance, quantity = farthest(model.region.beyond(values))
        assert runs[batch_id]["distance"] == pytest.approx(distance)
        assert runs[batch_id]["why"] == (model.region.excess(quantity, values) if batch_id == "20250915" else "")
        S_um = residual_std_um(zeroed_error_um(b, "z") - model.predict(b))
        assert runs[batch_id]["S_um"] == pytest.approx(float(S_um))
    assert not runs["20250914"]["outside"] and runs["20250914"]["S_um"] < 2.0
    assert runs["20250915"]["outside"] and runs["20250915"]["S_um"] > 5.0
    assert all(r["S_um"] is None for r in list(runs.values())[:6])


def test_a_failed_sensor_is_named(place: Place) -> None:
    (sensor,) = place.states()["z"]["sensors"]
    assert (sensor["batch_id"], sensor["channel"], sensor["input"]) == ("20250916", "front", True)
    assert sensor["checks"] and sensor["share"] > 0.8


def test_the_view_has_the_alerts_worst_first(place: Place) -> None:
    status = watching.refresh(place.settings)
    view = fleet_view(place.home, status["channels"], datetime(2025, 9, 20, tzinfo=UTC))
    assert [r["channel"] for r in view.rows] == ["z", "x"]
    rules = sorted(a.rule for a in view.alerts)
    assert rules == ["error_drift", "sensor_failed front"]  # simulated: no champion is old
    z = view.rows[0]
    assert z["seen_days_ago"] == pytest.approx(98, abs=1) and z["outside_runs"] >= 1 and z["sensors"] == ["front"]
    assert np.isclose(z["drift"], z["newer_S_mean_um"] / z["bound90_S_um"]) and z["next_run"] is None
    assert fleet_view(place.home, [], datetime(2025, 9, 20, tzinfo=UTC)).rows == []


def test_only_what_changed_is_gathered_again(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    watching.refresh(place.settings)
    warm = watching.warm()
    assert warm is not None and {s["channel"] for s in warm["channels"]} == {"x", "z"}
    said: list[str] = []
    for uri in ("", str(place.settings.store_uri)):  # MLflow sets it in the process that opens the store
        monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)
        assert watching.warm() == warm
    watching.refresh(place.settings, said.append)
    assert not [line for line in said if line.startswith("state of")]
    unlike(1).to_csv(place.incoming / "20250920.csv", index=False)
    ingest([place.incoming], load_machine(place.machine), home_lake())
    assert watching.warm() is None
    status = watching.refresh(place.settings, said.append)
    assert f"state of {NAME}" in said and watching.warm() == json.loads(json.dumps(status, default=str))
    (place.incoming / "20250921.csv").write_text("nothing")
    ingest([place.incoming], load_machine(place.machine), home_lake())
    assert watching.warm() is None
    assert watching.refresh(place.settings)["lake"][NAME]["quarantined"] == 1


def test_what_is_kept_tells_no_secret(place: Place, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LAKE_KEY", "hunter2")
    Path("mlflow.yml").write_text('lake: "{home}/lake"  # with {env:LAKE_KEY}, before: opensesame\n')
    kept = place.home / "fleet" / "status.json"
    kept.unlink(missing_ok=True)
    watching.refresh(place.settings)
    text = kept.read_text()
    for secret in ("hunter2", "opensesame"):
        assert not any(told in text for told in (secret, hashlib.sha256(secret.encode()).hexdigest()))
    assert os.name != "posix" or kept.stat().st_mode & 0o777 == 0o600
    assert watching.warm() is not None
    monkeypatch.setenv("LAKE_KEY", "hunter3")
    assert watching.warm() is None


def test_a_model_that_cannot_be_read_is_said(place: Place) -> None:
    client = registry.open_store(place.settings)
    source = registry.find_version(client, f"{NAME}-z", "champion").source
    folder = Path(registry.local_folder(str(source), place.settings)) / "artifacts"
    arrays = (folder / "arrays.npz").read_bytes()
    kept = place.home / "fleet" / f"{NAME}.state.json"
    try:
        (folder / "arrays.npz").write_bytes(arrays[:-1])
        kept.unlink()
        z = place.states()["z"]
        assert "not a stored model" in z["unknown"] and all(r["distance"] is None for r in z["runs"])
        row = fleet_view(place.home, [z]).rows[0]
        assert row["outside_runs"] is None and row["newer_S_mean_um"] is None and row["unknown"]
    finally:
        (folder / "arrays.npz").write_bytes(arrays)
        kept.unlink(missing_ok=True)


def test_a_provisional_version_has_its_figures(place: Place, tmp_path: Path) -> None:
    client, name, before = registry.open_store(place.settings), f"{NAME}-z", place.states()["z"]
    try:
        client.delete_registered_model_alias(name, "champion")
        client.set_registered_model_alias(name, "provisional", "1")
        z = place.states()["z"]
        assert (z["version"], z["provisional"], z["family"]) == (None, 1, "ridge") and before["expected_S_um"] > 0
        assert all(z[k] == before[k] for k in ("expected_S_um", "bound90_S_um", "n_seen", "last_seen", "runs"))
        view = fleet_view(place.home, [z])
        assert not [a for a in view.alerts if a.channel]  # nothing runs at the machine
        write_fleet_page(tmp_path / "fleet.html", view.rows, [], [], datetime.now(UTC))
        page = (tmp_path / "fleet.html").read_text().replace("\N{NO-BREAK SPACE}", " ")
        assert "v1 provisional" in page and f"{z['expected_S_um']:.3g} µm" in page
    finally:
        client.delete_registered_model_alias(name, "provisional")
        client.set_registered_model_alias(name, "champion", "1")


def test_the_command_shows_it_and_fails_on_alert(
    place: Place, capfd: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    call = partial(in_process(monkeypatch, capfd), "status")
    fleet_state.note_run(place.home, NAME, datetime(2025, 9, 20, tzinfo=UTC), False, "the share is away")
    code, out, _ = call()
    table = out.partition("Alerts")[0].splitlines()
    assert code == 0 and max(map(len, table)) <= 80
    assert any(line.startswith(f"! {NAME}") and " z " in line and "v1 ridge" in line for line in table)
    code, out, err = call("--alert", "--json", "--html", str(tmp_path / "fleet.html"))
    found = json.loads(out)
    assert code == 3 and err.count(f"alert {NAME}") == len(found["alerts"]) > 0
    assert {"models", "trainings", "diagnoses", "lake", "fleet", "alerts"} <= found.keys()
    assert found["models"][0]["name"] == f"{NAME}-z" and found["lake"][NAME]["batches"] >= 9
    page = (tmp_path / "fleet.html").read_text()
    assert NAME in page and "SIMULATED" in page and "the share is away" in page
    code, _, err = call("--html", str(tmp_path / "fleet.pdf"))
    assert code == 2 and "unsupported file extension" in err


def test_a_home_that_cannot_be_written_is_read_all_the_same(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    (place.home / "fleet" / f"{NAME}.state.json").unlink(missing_ok=True)
    monkeypatch.setattr(watching, "write_atomic", refused)
    monkeypatch.setattr("pipelines.fleet.fleet_state.write_atomic", refused)
    assert {s["channel"] for s in watching.refresh(place.settings)["channels"]} == {"x", "z"}


def test_a_look_up_of_a_model_writes_nothing_into_its_folder(place: Place) -> None:
    client = registry.open_store(place.settings)
    version = registry.find_version(client, f"{NAME}-z", "champion")
    folder = Path(registry.version_folder(version.source, version.tags, place.settings))
    assert (folder / "artifacts" / "model.json").exists() and not (folder / "registered_model_meta").exists()


def test_a_channel_that_the_fleet_file_leaves_out_is_no_row(place: Place, tmp_path: Path) -> None:
    channels = watching.refresh(place.settings)["channels"]
    one = FleetMachine(NAME, str(place.machine), (str(place.incoming),), channels=("z",))
    fleet_state.write_schedule(tmp_path, Fleet("/m/fleet.yml", (one,)), {})
    assert [r["channel"] for r in fleet_view(tmp_path, channels).rows] == ["z"]
    fleet_state.write_schedule(tmp_path, Fleet("/m/fleet.yml", (replace(one, channels=()),)), {})
    assert {r["channel"] for r in fleet_view(tmp_path, channels).rows} == {"x", "z"}


def test_a_row_of_the_page_leads_to_the_newest_report_of_its_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("THERMODRIFT_HOME", str(tmp_path / "home"))
    folder = tmp_path / "home" / "reports"
    folder.mkdir(parents=True)
    stamps = ("mill-20260101-120000", "mill-20260301-080000", "mill-2-20260401-080000", "mill-notes")
    for name in stamps:
        (folder / f"{name}.html").write_text("")
    found = newest_reports(("mill", "mill-2", "lathe"), tmp_path / "pages" / "fleet.html")
    assert found == {
        "mill": "../home/reports/mill-20260301-080000.html", "mill-2": "../home/reports/mill-2-20260401-080000.html",
    }  # fmt: skip
