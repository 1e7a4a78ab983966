"""`thermodrift diagnose --continue`: old and new recordings together, what changed, and one line where it cannot be."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch, Channel
from data.machine import load_machine
from diagnosis.findings.schema import read_findings
from diagnosis.result import Diagnosis
from pipelines.jobs import diagnosing
from pipelines.jobs.continuing import follows
from reports.diagnosis.first_screen import Continued
from reports.diagnosis.page import write_diagnosis_report
from tests.toys.command import Call, Done, in_process
from tests.toys.diagnoser import Toy, write_machine, write_recordings
from tests.toys.diagnosis import toy_diagnosis
from twin.run_plan import load_run_plan

NAME = "sample-continued"
PLAN = "name: an hour\nstages: [{hours: 1, spindle_rpm: 4000}]\nsurroundings: {room: 20 degC}\n"
Diagnosed = Callable[..., Done]


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A machine file, three recordings in `in`, two more in `more`, one of which the plan is followed by."""
    folder = tmp_path_factory.mktemp("continue")
    write_machine(folder / "m.yml", NAME)
    write_recordings(folder / "in", 5)
    (folder / "more").mkdir()
    for name in ("b3.csv", "b4.csv"):
        shutil.move(folder / "in" / name, folder / "more" / name)
    slow = folder / "more" / "b3.csv"
    slow.write_text(slow.read_text(encoding="utf-8").replace(",4000,", ",2500,"), encoding="utf-8")
    return folder


@pytest.fixture
def call(store: Any, store_home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Call:
    monkeypatch.setenv("THERMODRIFT_HOME", str(store_home))
    monkeypatch.setattr("rich.console.Console.width", 200)
    return in_process(monkeypatch, capsys)


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> Toy:
    toy = Toy("undecidable", lambda d: replace(d, plan_text=PLAN))
    monkeypatch.setattr(diagnosing, "library_diagnosis", lambda: toy)
    monkeypatch.setattr(
        "reports.diagnosis.page.write_diagnosis_report", partial(write_diagnosis_report, pictures=False)
    )
    return toy


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the first test leaves a copy of that diagnosis for the others."""
    return tmp_path_factory.mktemp("kept") / "out"


@pytest.fixture
def out(call: Call, toy: Toy, given: Path, tmp_path: Path, kept: Path) -> Path:
    """The folder of a diagnosis that could not tell, and proposed a run; then the toy explains."""
    folder = tmp_path / "out"
    if not kept.exists():
        done = call("diagnose", "--machine", given / "m.yml", "--recordings", given / "in", "--out", folder,
                    "--seed", 5, "--no-report")  # fmt: skip
        assert done.code == 0, done.err
        shutil.copytree(folder, kept)
    else:
        shutil.copytree(kept, folder)
    toy.verdict, toy.change = "explained", lambda d: d
    return folder


def one_line(done: Done) -> str:
    assert "Traceback" not in done.err and done.out == ""
    return done.err.strip().splitlines()[-1].removeprefix("thermodrift: ")


def test_old_and_new_recordings_are_diagnosed_together_and_the_change_is_said(
    call: Call, toy: Toy, given: Path, out: Path
) -> None:
    earlier = (out / "findings.json").read_bytes()
    done = call("diagnose", "--continue", out, "--recordings", given / "more")
    assert done.code == 0, done.err
    assert (toy.calls[-1]["machine"], toy.calls[-1]["seed"]) == (NAME, 5)
    assert toy.calls[-1]["batches"] == ["b0", "b1", "b2", "b3", "b4"]
    assert (out / "findings.1.json").read_bytes() == earlier
    assert read_findings(out / "findings.json").verdict == "explained" and not (out / "next_run.yml").exists()
    changed = [line.removeprefix("changed: ") for line in done.out.splitlines() if line.startswith("changed: ")]
    assert changed == [
        "Verdict: undecided → explained (b3 and b4 added, 5 recordings in all).",
        "First finding: heat to the floor at bed, 52\u202f% → 97\u202f%.",
        "The proposed run (night stop: 3 h of spindle at 4000 rpm, then everything off, doors shut, recorded for 9 h) "
        "is the recording b4.",
    ]
    page = (out / "report.html").read_text(encoding="utf-8")
    assert all(f"<li>{text}</li>" in page for text in changed)
    toy.verdict = "consistent"  # and once more: the next number, the earlier machine file
    more = write_recordings(given / "third", 6) / "b5.csv"
    done = call("diagnose", "--continue", out, "--recordings", more, "--json", "--no-report")
    assert done.code == 0, done.err
    answer = json.loads(done.out)
    assert set(answer["files"]) == {"findings.json", "inputs.json", "findings.2.json"}
    assert answer["continued"]["new"] == ["b5"] and answer["continued"]["before"]["verdict"] == "explained"
    assert answer["continued"]["changed"][1] == "First finding: heat to the floor at bed (97\u202f%) → none."
    assert len(toy.calls[-1]["batches"]) == 6


def test_it_works_on_what_came_from_the_lake(call: Call, toy: Toy, given: Path, out: Path, tmp_path: Path) -> None:
    lake = tmp_path / "lake"
    done = call("diagnose", "--machine", given / "m.yml", "--batches", "b0, b2", "--out", lake, "--no-report")
    assert done.code == 0, done.err
    (given / "m.yml").rename(given / "gone.yml")  # the text that was diagnosed is kept
    done = call("diagnose", "--continue", lake, "--recordings", given / "more" / "b3.csv", "--no-report")
    (given / "gone.yml").rename(given / "m.yml")
    assert done.code == 0, done.err
    assert toy.calls[-1]["batches"] == ["b0", "b2", "b3"]
    machine = load_machine(lake / "machine.yml")
    assert machine.machine == NAME and machine.twin is not None and "floor_sink_bed" in machine.twin["mechanisms"]


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (("--continue", "absent", "--recordings", "{more}"), "--continue absent: no such folder"),
        (("--continue", "{more}", "--recordings", "{more}"), "holds no findings.json, so no diagnosis"),
        (("--continue", "{old}", "--recordings", "{more}"), "has no inputs.json, which names its recordings"),
        (("--continue", "{out}"), "--continue: no new recordings; give them by --recordings"),
        (("--continue", "{out}", "--recordings", "absent"), "--recordings absent: no such file or folder"),
        (("--continue", "{out}", "--recordings", "{in}/b1.csv"), "--recordings: b1 is among the recordings of"),
        (("--continue", "{out}", "--recordings", "{copy}"), "--recordings: b1 is among the recordings of"),
        (("--continue", "{out}", "--recordings", "{more}", "--machine", "{other}"), f"is a diagnosis of {NAME}, and"),
        (("--continue", "{out}", "--recordings", "{alien}"), f"no recording of {NAME} could be used"),
        (("--continue", "{out}", "--recordings", "{more}", "--out", "x"), "--out: does not go with --continue"),
        (("--machine", "{other}"), "missing option --out; give it, or --continue the folder of an earlier"),
    ],
)  # fmt: skip
def test_what_cannot_be_continued_is_one_line(
    call: Call, toy: Toy, given: Path, out: Path, tmp_path: Path, args: tuple[str, ...], words: str
) -> None:
    shutil.copytree(out, tmp_path / "old")
    (tmp_path / "old" / "inputs.json").unlink()
    (tmp_path / "copy").mkdir()
    shutil.copy(given / "in" / "b1.csv", tmp_path / "copy" / "under_another_name.csv")
    (tmp_path / "alien").mkdir()
    (tmp_path / "alien" / "a.csv").write_text("clock,t1\n0,20\n60,21\n", encoding="utf-8")
    write_machine(tmp_path / "other.yml", "other-machine")
    places = {"in": given / "in", "more": given / "more", "out": out} | {
        name: tmp_path / name for name in ("old", "copy", "alien")
    }
    places["other"] = tmp_path / "other.yml"
    before, calls = {p.name: p.read_bytes() for p in out.iterdir()}, len(toy.calls)
    done = call("diagnose", *(a.format_map(places) for a in args))
    assert done.code == 2 and words in one_line(done)
    assert len(toy.calls) == calls and {p.name: p.read_bytes() for p in out.iterdir()} == before


def test_a_recording_that_the_lake_lost_is_named(call: Call, toy: Toy, given: Path, out: Path) -> None:
    assert call("lake", "withdraw", NAME, "b1", "--reason", "test").code == 0
    done = call("diagnose", "--continue", out, "--recordings", given / "more")
    assert call("lake", "restore", NAME, "b1").code == 0
    assert done.code == 2
    assert "b1 (it came from b1.csv) is not in the lake" in one_line(done) and "lake restore" in one_line(done)


def _batch(rpm: list[float], step_s: float = 300.0) -> Batch:
    time_s = np.arange(len(rpm)) * step_s
    channels = {"spindle_rpm": Channel("spindle_rpm", "driver", "rpm", 1.0)}
    return Batch(NAME, "b", pd.DataFrame({"time_s": time_s, "spindle_rpm": rpm}), channels)


def test_a_recording_follows_a_plan_by_its_drivers(given: Path, tmp_path: Path) -> None:
    path = tmp_path / "plan.yml"
    path.write_text(PLAN.replace("[{hours: 1, spindle_rpm: 4000}]", "[{hours: 2, spindle_rpm: 4000}, {hours: 1}]")
                    .replace("{hours: 1}", "{hours: 1, spindle_rpm: 0}"), encoding="utf-8")  # fmt: skip
    plan = load_run_plan(path, load_machine(given / "m.yml"))
    made = [4000.0] * 24 + [0.0] * 13
    assert follows(_batch(made), plan)
    assert follows(_batch([0.0] * 6 + [4060.0] * 25 + [0.0] * 14), plan)  # stood before, stopped one row late
    assert not follows(_batch([2000.0] * 24 + [0.0] * 13), plan)
    assert not follows(_batch([4000.0] * 18), plan)  # too short
    assert not follows(_batch([4000.0] * 37), plan)  # never stopped


def test_the_change_is_said_for_any_findings(toy: Toy) -> None:
    def said(before: Diagnosis, after: Diagnosis) -> list[str]:
        return Continued(before.findings, ("n",)).sentences(after.findings)

    quiet, found, tied = (toy_diagnosis(v) for v in ("consistent", "unlisted", "undecidable"))
    assert said(quiet, quiet) == [
        "Verdict: still consistent (n added, 12 recordings in all).", "First finding: none before and none now.",
    ]  # fmt: skip
    assert said(quiet, found)[1].startswith("First finding: none → missing heat of no listed mechanism at column_back")
    assert said(tied, found)[-1].endswith("is none of the new recordings.")
