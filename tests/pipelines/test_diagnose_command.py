"""`thermodrift diagnose` as a user meets it: what lies in OUT, what the screen says, one line of trouble."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from data.errors import WorkError
from data.machine import load_machine
from diagnosis.findings.schema import read_findings
from diagnosis.result import Diagnosis
from pipelines.jobs import diagnosing
from reports.diagnosis.first_screen import claim
from tests.toys.command import Call, Done, in_process
from tests.toys.diagnoser import NOTE, PLAN, Toy, write_machine, write_recordings
from tests.toys.diagnosis import toy_diagnosis
from twin.compile import compile_network
from twin.schema import twin_part

NAME = "sample-diagnosed"
Diagnosed = Callable[..., Done]


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a machine file and three recordings; tests leave it as it is."""
    folder = tmp_path_factory.mktemp("diagnose")
    write_machine(folder / "m.yml", NAME)
    write_recordings(folder / "in")
    return folder


@pytest.fixture
def call(store: Any, store_home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Call:
    """`thermodrift ARGS` in this process, in the session's home, on a wide screen."""
    monkeypatch.setenv("THERMODRIFT_HOME", str(store_home))
    monkeypatch.setattr("rich.console.Console.width", 200)
    return in_process(monkeypatch, capsys)


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> Toy:
    """What diagnoses in these tests."""
    toy = Toy()
    monkeypatch.setattr(diagnosing, "library_diagnosis", lambda: toy)
    return toy


@pytest.fixture
def diagnose(call: Call, toy: Toy, given: Path, tmp_path: Path) -> Diagnosed:
    """`thermodrift diagnose` on these recordings, into tmp_path/out."""
    common = ("diagnose", "--machine", given / "m.yml", "--recordings", given / "in", "--out", tmp_path / "out")
    return functools.partial(call, *common)


def held(folder: Path) -> dict[str, bytes]:
    """All that a folder holds, hidden files too."""
    return {p.name: p.read_bytes() for p in folder.iterdir()}


def one_line(done: Done) -> str:
    """The last line on standard error; nothing is on standard output."""
    assert "Traceback" not in done.err and done.out == ""
    return done.err.strip().splitlines()[-1].removeprefix("thermodrift: ")


def test_a_finding_becomes_files_and_sentences(diagnose: Diagnosed, toy: Toy, given: Path, tmp_path: Path) -> None:
    done = diagnose("--seed", 7)
    assert done.code == 0, done.err
    out = tmp_path / "out"
    assert set(held(out)) == {"findings.json", "inputs.json", "machine.yml", "report.html"}
    found = read_findings(out / "findings.json")
    assert (found.machine, found.verdict, found.batches) == (NAME, "explained", ("b0", "b1", "b2"))
    assert "<!doctype html>" in (out / "report.html").read_text(encoding="utf-8").lower()
    (got,) = toy.calls
    assert (got["batches"], got["seed"]) == (["b0", "b1", "b2"], 7)
    assert got["processes"] >= 1
    lines = done.out.splitlines()
    assert lines[0] == f"{NAME}: diagnosis of 3 batches  (simulated recordings)"
    assert lines[1] == "The simulation left out one effect; with it noise alone is left."
    assert lines[2].startswith("1. 97 %, extremely likely: heat to the floor at bed, conductance 10.2 W/K (90 %: ")
    z = next(line.split() for line in lines if line.split()[:2] == ["z", "µm"])
    rms = found.fit.left_out_rms
    assert z[2] == "12" and float(z[3]) == pytest.approx(rms.before["z_um"], abs=0.06)
    assert float(z[4]) == pytest.approx(rms.after["z_um"], abs=0.06) and float(z[5]) == pytest.approx(1.2, abs=0.01)
    assert "left-out batches that improve: 11 of 12" in lines
    assert f"{out / 'report.html'}: the report, one page" in lines
    assert done.err.splitlines()[-4:] == [f"diagnose {NAME}: 3 batches", "baseline", "write", "track"]


def test_the_new_machine_file_is_used_as_it_is(diagnose: Diagnosed, given: Path, tmp_path: Path) -> None:
    assert diagnose("--no-report").code == 0
    file = tmp_path / "out" / "machine.yml"
    network = compile_network(machine := load_machine(file))
    name = "exposures.bed-floor_sink_bed.conductance"
    assert network.parameters[network.index(name)].value == 10.2
    calibrated = twin_part(machine).calibrated
    assert calibrated is not None and calibrated.batches == ("b0", "b1", "b2") and calibrated.simulated
    assert calibrated.left_out_rms.keys() >= {"z_um", "bed_K"}
    assert calibrated.words == "diagnosis: explained; left_out_rms: over all rows of 12 left-out batches"
    old, new = (p.read_text(encoding="utf-8") for p in (given / "m.yml", file))
    assert f"    # {NOTE}\n    floor_sink_bed:" in new
    assert [line for line in old.splitlines() if line not in new] == []


def test_json_is_one_document(diagnose: Diagnosed, toy: Toy, tmp_path: Path) -> None:
    toy.verdict = "undecidable"
    done = diagnose("--json", "--no-report", "--batches", "b2, b0")
    assert (done.code, done.err) == (0, "")
    told = json.loads(done.out, parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))
    out = tmp_path / "out"
    assert told["diagnosis"] == json.loads((out / "findings.json").read_text(encoding="utf-8"))
    assert told["diagnosis"]["batches"] == ["b0", "b2"]
    assert set(told["files"]) == {"findings.json", "inputs.json", "machine.yml", "next_run.yml"}
    assert told["out"] == str(out) and told["quarantined"] == [] and told["trouble"] == "" and told["run_id"]
    assert (out / "next_run.yml").read_text(encoding="utf-8") == PLAN
    assert told["diagnosis"]["next_experiment"]["file"] == "next_run.yml"


def test_the_next_run_is_told(diagnose: Diagnosed, toy: Toy, tmp_path: Path) -> None:
    toy.verdict = "undecidable"
    lines = diagnose("--no-report").out.splitlines()
    text = claim(toy_diagnosis("undecidable").findings.findings[0])[1]
    verdict = "Something is missing, but these recordings do not show what."
    assert lines[1:3] == [verdict, f"1. 52 %, more likely than not: {text}"]
    run = next(line for line in lines if line.startswith("next run: "))
    assert run.startswith("next run: Night stop: 3 h of spindle at 4000 rpm, then everything off") and "; 12 h" in run
    assert "note: Fewer than 4 batches: no probability above 80 % is stated." in lines
    assert f"{tmp_path / 'out' / 'next_run.yml'}: the next run's plan" in lines


def test_a_second_run_replaces_only_when_asked(diagnose: Diagnosed, toy: Toy, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert diagnose("--no-report").code == 0
    before = held(out)
    again = diagnose()
    assert again.code == 2 and len(toy.calls) == 1 and held(out) == before
    assert one_line(again) == f"{out / 'findings.json'} exists; give another --out, or --overwrite to replace it"
    toy.verdict = "consistent"
    (out / "mine.txt").write_text("mine", encoding="utf-8")
    done = diagnose("--overwrite", "--no-report")
    assert done.code == 0
    assert set(held(out)) == {
        "findings.json",
        "inputs.json",
        "mine.txt",
    }  # nothing was found: the old machine file would mislead
    assert "Consistent: no missing effect is supported by these runs." in done.out and "machine.yml" not in done.out
    assert "an effect above the limits below would be claimed" in done.out


def test_what_is_of_another_machine_stays(
    diagnose: Diagnosed, toy: Toy, call: Call, given: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    assert diagnose("--no-report").code == 0
    other = write_machine(tmp_path / "other.yml", "other-machine")
    done = call("diagnose", "--machine", other, "--recordings", given / "in", "--out", out, "--overwrite")
    assert done.code == 2 and len(toy.calls) == 1
    assert one_line(done) == (
        f"{out / 'findings.json'}: is a diagnosis of {NAME}, not of other-machine; give another --out"
    )
    (out / "findings.json").write_text("[]", encoding="utf-8")
    done = diagnose("--overwrite")
    assert (done.code, one_line(done)) == (
        2, f"{out / 'findings.json'}: is there and is no findings file of a diagnosis; give another --out",
    )  # fmt: skip


def test_the_machine_file_itself_is_not_overwritten(call: Call, toy: Toy, given: Path, tmp_path: Path) -> None:
    own = write_machine(tmp_path / "machine.yml", NAME)
    done = call("diagnose", "--machine", own, "--recordings", given / "in", "--out", tmp_path, "--overwrite")
    assert done.code == 2 and not toy.calls
    assert one_line(done) == f"--out {tmp_path}: its machine.yml is the machine file to diagnose; give another --out"


def test_without_a_twin_part_the_drafted_network_is_the_machine_file(
    call: Call, toy: Toy, given: Path, tmp_path: Path
) -> None:
    file = write_machine(tmp_path / "bare.yml", "sample-bare", twin=False)
    out, toy.verdict = tmp_path / "out", "consistent"
    done = call("diagnose", "--machine", file, "--recordings", given / "in", "--out", out, "--no-report")
    assert done.code == 0, done.err
    assert (
        "sample-bare: diagnosis of 3 batches against a drafted network: the machine file has no twin part" in done.out
    )
    text = (out / "machine.yml").read_text(encoding="utf-8")
    assert "by a diagnosis of 3 batches: the file had no twin part\ntwin:" in text
    assert text.startswith(file.read_text(encoding="utf-8").rstrip("\n"))
    assert compile_network(load_machine(out / "machine.yml")).bodies
    toy.verdict = "explained"
    done = call("diagnose", "--machine", file, "--out", out, "--overwrite", "--no-report")  # the lake is the default
    assert done.code == 0, done.err
    assert "floor_sink_bed" in twin_part(load_machine(out / "machine.yml")).mechanisms


def test_work_that_fails_leaves_the_folder_as_it_was(
    diagnose: Diagnosed, toy: Toy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    assert diagnose("--no-report").code == 0
    before = held(out)

    def stuck(d: Diagnosis) -> Diagnosis:
        raise WorkError("diagnosis of sample-diagnosed: no fit stays finite")

    toy.change = stuck
    done = diagnose("--overwrite")
    assert (done.code, one_line(done)) == (1, "diagnosis of sample-diagnosed: no fit stays finite")
    assert held(out) == before

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    toy.change = Toy().change
    monkeypatch.setattr("reports.diagnosis.page.write_diagnosis_report", full)
    done = diagnose("--overwrite")
    assert done.code == 1 and held(out) == before
    assert one_line(done) == (f"{out}: cannot be written ([Errno 28] No space left on device); give another --out")


def test_findings_outlive_a_machine_file_that_cannot_be_written(diagnose: Diagnosed, toy: Toy, tmp_path: Path) -> None:
    toy.change = lambda d: replace(d, values={"bodies.bed.capacty": 1.0}, added={})
    done = diagnose("--no-report")
    out = tmp_path / "out"
    assert done.code == 1 and set(held(out)) == {"findings.json", "inputs.json"}
    last = done.err.strip().splitlines()[-1]
    assert f"machine file {out / 'machine.yml'}: no twin parameter 'bodies.bed.capacty'; did you mean" in last
    assert last.endswith(f"; the findings stand in {out}") and "left out one effect" in done.out


def test_what_is_not_tracked_is_told(
    diagnose: Diagnosed, call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> str:
        raise WorkError("tracking store sqlite:///x: database is locked")

    with monkeypatch.context() as patch:
        patch.setattr("pipelines.store.tracking.log_record", broken)
        done = diagnose("--no-report")
    out = tmp_path / "out"
    said = one_line(done)
    assert done.code == 1 and said.startswith("tracking store sqlite:///x: database is locked; 1 results wait in ")
    assert said.endswith(f" delivers them; the diagnosis is written to {out}")
    assert (out / "findings.json").exists()
    assert "delivered diagnosis of " in call("status").err  # it waited


def test_a_recording_that_cannot_be_used_is_told(call: Call, toy: Toy, given: Path, tmp_path: Path) -> None:
    write_recordings(tmp_path / "in")
    (tmp_path / "in" / "bad.csv").write_text("nothing\n", encoding="utf-8")
    args = ("diagnose", "--machine", given / "m.yml", "--recordings", tmp_path / "in", "--out", tmp_path / "out")
    done = call(*args, "--no-report")
    assert done.code == 0
    assert "files in quarantine: 1, not used; " in done.out and "bad.csv" in done.out


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (("--recordings", "absent"), "--recordings absent: no such file or folder; give existing ones"),
        (("--seed", "-1"), "--seed: got -1, expected 0 or more"),
        (("--batches", "b9"), f"--batches: no batch 'b9' of {NAME}; did you mean 'b2'? Allowed: b0, b1, b2"),
        (("--out", "{in}/b0.csv"), "b0.csv: is a file, expected a folder; give another --out"),
        (("--out", "{in}/b0.csv/deep"), "cannot be written (Not a directory); give another folder"),
        (("--machine", "absent.yml"), "machine file absent.yml: cannot be read"),
        (("--machine", "{in}/../bare.yml", "--recordings", "{in}/../empty"), "of bare could be used; 1 other files"),
        (("--machine", "{in}/../twisted.yml"), "twisted.yml: unknown key 'twin.sensers'; did you mean 'sensors'?"),
        (("--machine", "{in}/../lathe.yml"), "no recording of lathe could be used; "),
    ],
)  # fmt: skip
def test_bad_input_is_one_line(
    call: Call, toy: Toy, given: Path, tmp_path: Path, args: tuple[str, ...], words: str
) -> None:
    text = (given / "m.yml").read_text(encoding="utf-8")
    (given / "empty").mkdir(exist_ok=True)
    (given / "empty" / "readme.txt").write_text("no recording", encoding="utf-8")
    write_machine(given / "bare.yml", "bare", twin=False)
    (given / "twisted.yml").write_text(text.replace("\n  sensors:", "\n  sensers:"), encoding="utf-8")
    (given / "lathe.yml").write_text(
        text.replace(f"machine: {NAME}", "machine: lathe").replace("timestamp, unit", "clock, unit"), encoding="utf-8"
    )
    chosen: dict[str, object] = {"--machine": given / "m.yml", "--recordings": given / "in", "--out": tmp_path / "out"}
    chosen |= dict(zip(args[::2], (a.replace("{in}", str(given / "in")) for a in args[1::2]), strict=True))
    done = call("diagnose", *(part for pair in chosen.items() for part in pair))
    assert done.code == 2 and not toy.calls
    assert words in one_line(done)


def test_status_names_the_last_diagnosis(diagnose: Diagnosed, toy: Toy, call: Call, tmp_path: Path) -> None:
    toy.verdict = "consistent"
    assert diagnose("--no-report").code == 0
    toy.verdict = "explained"
    assert diagnose("--no-report", "--overwrite").code == 0
    done = call("status")
    own = [line for line in done.out.split("Last diagnosis of each machine")[1].splitlines() if f" {NAME} " in line]
    assert len(own) == 1 and own[0].endswith("3 batches, simulated: explained; floor sink, node bed (97 %)")
    told = json.loads(call("status", "--json").out)["diagnoses"]
    last = [d for d in told if d["machine"] == NAME][:2]
    assert [d["verdict"] for d in last] == ["explained", "consistent"] and last[1]["probability"] is None
