"""A demonstration: sealed before it is answered, answered without the answer, opened and judged in plain words."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from data.errors import InputError, WorkError
from data.machine import Machine, load_machine
from reports.diagnosis.page import diagnosis_page, write_diagnosis_report
from tests.proof.toy_answers import FLOOR, SUN, answer
from tests.toys.diagnosis import SAMPLE, toy_diagnosis
from thermodrift_exam.plants import concealed
from thermodrift_exam.proof import demonstrating
from thermodrift_exam.proof.demonstrating import EXAMINEE, Demonstration, answered, demonstrate, judged
from thermodrift_exam.proof.sealing.folder import folder_digest
from thermodrift_exam.proof.sealing.plain import from_plain, plain_text
from thermodrift_exam.proof.sealing.running import Examinee

HERE = str(Path(__file__).parent)


def by(name: str, module: str = "toy_answers") -> Examinee:
    return replace(EXAMINEE, diagnose=f"{module}:{name}", import_from=(HERE,))


@pytest.fixture(autouse=True)
def two_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two recordings are enough for toys, and no pictures."""
    full = concealed.conceal
    monkeypatch.setattr(demonstrating, "conceal", lambda seed, effect: full(seed, effect, 2))
    monkeypatch.setattr(demonstrating, "write_diagnosis_report", partial(write_diagnosis_report, pictures=False))


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Machine]:
    folder = tmp_path_factory.mktemp("case")
    return folder, load_machine(concealed.write_case(concealed.conceal(1, "floor_sink", 2), folder))


@pytest.mark.slow
def test_it_is_sealed_answered_opened_and_written(tmp_path: Path) -> None:
    lines: list[str] = []
    steps: list[tuple[str, int, int]] = []
    sealed_first: list[bool] = []
    out = tmp_path / "out"

    def done(step: str, n: int, of: int) -> None:
        steps.append((step, n, of))
        sealed_first.append((out / "sealed.json").exists() and not (out / "opened.json").exists())

    d = demonstrate(7, out, lines.append, done, "floor_sink", by("floor"))
    assert d.judgement.outcome == "found" and d.judgement.right and d.judgement.finding is not None
    assert steps == [("refit", 3, 9)] and sealed_first == [True]
    assert [line.split()[0] for line in lines] == ["sealed", "answered", "opened"]
    assert d.seal.digest in lines[0] and "floor_sink at bed, 97 %" in lines[1] and lines[2].split()[1] == "Found:"
    sealed, opened = (json.loads((out / n).read_text(encoding="utf-8")) for n in ("sealed.json", "opened.json"))
    assert "floor" not in json.dumps(sealed)
    plain = json.dumps(opened["answer"], sort_keys=True, separators=(",", ":"), ensure_ascii=False).encode()
    assert hashlib.sha256(bytes.fromhex(opened["salt"]) + plain).hexdigest() == sealed["digest"] == d.seal.digest
    assert folder_digest(out / "case") == sealed["case"]
    page = (out / "report.html").read_text(encoding="utf-8")
    panel = page[page.index('<div class="unsealed right"') : page.index("<header")]
    said = " ".join(re.sub(r"<[^>]+>", " ", panel).split())
    assert "SIMULATED" in said and "The foundation exchanges heat with the bed" in said and d.seal.digest in said
    assert "Heat to the floor at bed conductance 22 W/K (90 %: 18 to 27)" in said
    assert "probability 97 %, extremely likely" in said and "6.0 → " in said and "noise 0.80 µm" in said
    assert page.index("unsealed right") < page.index("<header") and "machine.yml" not in page
    again = demonstrate(7, out, effect="floor_sink", by=by("silent"))  # replaces, with another salt
    assert again.judgement.outcome == "missed" and again.seal.digest != d.seal.digest
    assert "Not found: something was concealed, and no effect was named." in (out / "report.html").read_text("utf-8")


def test_a_confined_process_answers(case: tuple[Path, Machine]) -> None:
    """What such a process cannot read: test_isolation."""
    steps: list[tuple[str, int, int]] = []
    diagnosis, isolation = answered(*case, by("floor"), lambda *at: steps.append(at))
    assert "audit hook" in isolation and steps == [("refit", 3, 9)]
    assert diagnosis.findings.findings == (FLOOR,) and list(diagnosis.tables["rms"]["after"]) == [1.0, 1.0]


def test_a_diagnosis_that_fails_leaves_the_seal_closed(tmp_path: Path) -> None:
    with pytest.raises(WorkError, match="demonstration: the diagnosis failed: ValueError: no fit stays finite"):
        demonstrate(7, tmp_path / "out", effect="floor_sink", by=by("broken", "toy_examinee"))
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["case", "sealed.json"]


def test_a_folder_of_something_else_stays(tmp_path: Path) -> None:
    (tmp_path / "findings.json").write_text("mine", encoding="utf-8")
    with pytest.raises(InputError, match=r"findings\.json exists; give another --out"):
        demonstrate(7, tmp_path, by=by("floor"))
    assert [p.name for p in tmp_path.iterdir()] == ["findings.json"]
    other = tmp_path / "other"
    (other / "case").mkdir(parents=True)
    with pytest.raises(InputError, match="case: is there, and is no demonstration's; give another --out"):
        demonstrate(7, other, by=by("floor"))


@pytest.mark.parametrize(
    ("effect", "found", "outcome"),
    [
        ("floor_sink", [FLOOR], "found"),
        ("floor_sink", [FLOOR, SUN], "found_and_more"),
        ("floor_sink", [SUN], "wrong"),
        ("floor_sink", [], "missed"),
        ("sun", [SUN], "other_place"),
        ("nothing", [], "nothing_right"),
        ("nothing", [SUN], "false_alarm"),
        ("sensor_swap", [FLOOR], "wrong"),
    ],
)
def test_it_is_judged_by_mechanism_and_place(
    effect: str, found: list, outcome: str, case: tuple[Path, Machine]
) -> None:  # type: ignore[type-arg]
    truth = concealed.conceal(1, effect, 1).answer
    d = answer(case[1], [], found)
    got = judged(d, truth, case[1])
    assert got.outcome == outcome and got.right == (outcome in ("found", "nothing_right"))
    if outcome == "found_and_more":
        assert [x.mechanism for x in got.false] == ["sun"]


def test_what_ties_with_the_truth_is_not_settled(case: tuple[Path, Machine]) -> None:
    other = SUN.model_copy(update={"alternatives": toy_alternatives(), "probability": 0.5})
    d = answer(case[1], [], [other])
    d = type(d)(**{**d.__dict__, "findings": d.findings.model_copy(update={"verdict": "undecidable"})})
    assert judged(d, concealed.conceal(1, "floor_sink", 1).answer, case[1]).outcome == "in_set"


def toy_alternatives() -> tuple[object, ...]:
    from diagnosis.findings.schema import Alternative

    return (Alternative(mechanism="floor_sink", where=FLOOR.where, probability=0.4),)


@pytest.mark.parametrize("verdict", ["consistent", "explained", "unlisted", "undecidable"])
def test_a_diagnosis_comes_back_from_plain_data_as_it_was(verdict: str) -> None:
    d = toy_diagnosis(verdict)
    back = from_plain(plain_text(d), load_machine(SAMPLE))
    assert back.findings == d.findings and back.part_before == d.part_before and back.part_after == d.part_after
    for name, table in d.tables.items():
        assert back.tables[name].equals(table.reset_index(drop=True)), name
    one, two = diagnosis_page(d, False), diagnosis_page(back, False)
    assert one.sections == two.sections and one.top == two.top
    with pytest.raises(InputError, match="answer: is no diagnosis"):
        from_plain("{}", d.machine)


@pytest.mark.slow
def test_a_real_diagnosis_finds_the_foundation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    d: Demonstration = demonstrate(20261125, tmp_path / "out", effect="floor_sink")
    assert d.judgement.outcome == "found" and (tmp_path / "out" / "report.html").exists()
    rms = d.diagnosis.findings.fit.left_out_rms
    after, before, noise = (values["z_um"] for values in (rms.after, rms.before, rms.noise_floor))
    assert after is not None and before is not None and noise is not None and after < min(before, noise)
