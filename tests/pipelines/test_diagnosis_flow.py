"""A diagnosis through Prefect: the same files and run, one line where it fails, and retraining that tells of it."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from data.errors import InputError, WorkError
from diagnosis.findings.schema import read_findings
from pipelines.jobs import diagnosing
from pipelines.store.tracking import diagnoses
from tests.toys.diagnoser import Toy, write_machine, write_recordings

pytestmark = pytest.mark.integration


@pytest.fixture
def toy(store_home: Path, monkeypatch: pytest.MonkeyPatch) -> Toy:
    toy = Toy()
    monkeypatch.setenv("THERMODRIFT_HOME", str(store_home))
    monkeypatch.setattr(diagnosing, "library_diagnosis", lambda: toy)
    return toy


def test_a_flow_writes_and_tracks_what_the_command_does(
    flows: ModuleType, store: Any, toy: Toy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    machine = write_machine(tmp_path / "flow-diagnosed.yml", "flow-diagnosed")
    recordings = write_recordings(tmp_path / "in")
    words = flows.diagnose(str(machine), [str(recordings)])
    (out,) = (store.home / "diagnoses").glob("flow-diagnosed-*")
    assert words == f"diagnosed: explained (floor_sink at bed), {out}"
    assert read_findings(out / "findings.json").machine == "flow-diagnosed" and (out / "report.html").exists()
    assert diagnoses("flow-diagnosed", store)["verdict"].tolist() == ["explained"]
    assert f"flow-diagnosed: {words}" in capfd.readouterr().out
    monkeypatch.setattr("reports.diagnosis.page.write_diagnosis_report", lambda path, d, **_: None)
    toy.verdict = "consistent"
    assert flows.diagnose(str(machine), [], str(out)) == f"diagnosed: consistent, {out}"
    assert not (out / "machine.yml").exists()


def test_what_stops_it_is_one_line_and_is_not_tried_again(
    flows: ModuleType, toy: Toy, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    machine, recordings = write_machine(tmp_path / "m.yml", "flow-stuck"), write_recordings(tmp_path / "in")

    def stuck(d: Any) -> Any:
        raise WorkError("no fit stays finite")

    toy.change = stuck
    with pytest.raises(WorkError, match=r"^no fit stays finite$"):
        flows.diagnose(str(machine), [str(recordings)], str(tmp_path / "out"))
    with pytest.raises(InputError, match=r"absent: no such file or folder"):
        flows.diagnose(str(machine), [str(tmp_path / "absent")], str(tmp_path / "out"))
    shown = capfd.readouterr()
    assert len(toy.calls) == 1 and "Traceback" not in shown.out + shown.err
    assert "not diagnosed: no fit stays finite" in shown.out and "not diagnosed: --recordings" in shown.out


def test_retraining_tells_of_the_diagnosis(
    flows: ModuleType, toy: Toy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from pipelines.fleet import retraining

    monkeypatch.setattr(diagnosing, "diagnose_if_grown", lambda *_, **__: (None, "z: left-out S has grown; diagnosed"))
    machine = write_machine(tmp_path / "m.yml", "flow-season")
    words = retraining.retrain(
        str(machine), [str(write_recordings(tmp_path / "in"))], channels=["z"], selectors=["none"], families=["zero"]
    )
    assert words.startswith("flow-season-z version 1 is challenger: no trustworthy model")
    assert words.endswith("; z: left-out S has grown; diagnosed")
