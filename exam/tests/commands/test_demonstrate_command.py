"""`thermodrift demonstrate`: four lines, one page, one JSON document."""

from __future__ import annotations

import json
import re
from datetime import date
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from data.machine import Machine
from diagnosis.result import Diagnosis
from reports.diagnosis.page import write_diagnosis_report
from tests.toys.command import Call, in_process
from tests.toys.diagnosis import toy_diagnosis
from thermodrift_exam.commands.demonstrate import FIXED_SEED, seed_of
from thermodrift_exam.plants import concealed
from thermodrift_exam.proof import demonstrating

FLOOR_SEED = next(s for s in range(100) if concealed.drawn(s) == "floor_sink")


@pytest.fixture
def call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Call:
    """`thermodrift ARGS` with a made-up diagnosis of two runs."""
    full = concealed.conceal

    def answered(case: Path, machine: Machine, by: Any, done: Any = None) -> tuple[Diagnosis, str]:
        assert sorted(p.name for p in case.iterdir()) == ["machine.yml", "recordings"]
        return toy_diagnosis("explained"), "audit hook"

    monkeypatch.setattr(demonstrating, "conceal", lambda seed, effect: full(seed, effect, 2))
    monkeypatch.setattr(demonstrating, "write_diagnosis_report", partial(write_diagnosis_report, pictures=False))
    monkeypatch.setattr(demonstrating, "answered", answered)
    monkeypatch.setenv("THERMODRIFT_HOME", str(tmp_path / "home"))
    return in_process(monkeypatch, capsys)


def test_it_says_four_lines(call: Call, tmp_path: Path) -> None:
    done = call("demonstrate", "--seed", FLOOR_SEED)
    assert done.code == 0, done.err
    lines = done.out.splitlines()
    assert [line.split()[0] for line in lines] == ["sealed", "answered", "opened", "page"]
    assert re.search(r"sha256 [0-9a-f]{64} \(simulated recordings, 2 runs\)", lines[0])
    assert lines[2] == "opened     Found: what was concealed is what was named."
    page = tmp_path / "home" / "demonstration" / "report.html"
    assert lines[3] == f"page       {page}" and page.exists()


def test_json_is_one_document(call: Call, tmp_path: Path) -> None:
    done = call("demonstrate", "--seed", FLOOR_SEED, "--out", tmp_path / "out", "--json")
    assert (done.code, done.err) == (0, "")
    answer = json.loads(done.out)
    assert answer["simulated"] and answer["outcome"] == "found" and answer["right"]
    assert answer["concealed"]["effect"] == "floor_sink" and len(answer["sealed"]["digest"]) == 64
    assert set(answer["files"]) == {"report.html", "findings.json", "sealed.json", "opened.json"}


def test_bad_input_is_one_line(call: Call, tmp_path: Path) -> None:
    done = call("demonstrate", "--seed", -3)
    assert (done.code, done.out) == (2, "")
    assert done.err.strip() == "thermodrift: --seed: got '-3', expected a whole number from 0, or \"today\""
    (tmp_path / "file").write_text("")
    done = call("demonstrate", "--seed", 1, "--out", tmp_path / "file")
    assert done.code == 2 and "is a file, expected a folder; give another --out" in done.err


def test_the_seed_is_fixed_unless_today_draws_it() -> None:
    assert seed_of(str(FIXED_SEED)) == FIXED_SEED and seed_of("3") == 3
    assert seed_of("today") == int(date.today().isoformat().replace("-", ""))
