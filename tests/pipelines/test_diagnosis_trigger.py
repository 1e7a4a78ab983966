"""After a training whose twin predicts new batches worse than it did comes a diagnosis, and after no other."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from data.errors import WorkError
from data.ingest import ingest
from data.lake import Lake
from data.machine import load_machine
from models.protocols import PromotionRule
from models.selection.crossing import Plan
from models.selection.result import GridResult
from pipelines.caller import DirectCaller
from pipelines.jobs import diagnosing, training
from pipelines.jobs.diagnosing import diagnose_if_grown, greatest_growth, growth
from pipelines.jobs.request import TrainRequest
from pipelines.settings import DiagnoseRule, Settings
from tests.toys.diagnoser import Toy, write_machine, write_recordings
from tests.toys.tracked import log_training
from tests.toys.training import toy_batches, toy_result

RULE = PromotionRule()


def trained(machine: str, **S_um: Sequence[float]) -> GridResult:
    """A training of as many batches as there are left-out S of each family."""
    n = len(next(iter(S_um.values())))
    return toy_result(toy_batches(machine, n), {f"none|{family}|0": s for family, s in S_um.items()})


@pytest.fixture
def home(store: Any, store_home: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("THERMODRIFT_HOME", str(store_home))
    return store_home


def test_growth_is_that_of_the_new_batches() -> None:
    got = growth(trained("m", twin=[1.0, 1.2, 0.8]), trained("m", twin=[1.0, 1.2, 0.8, 1.9, 2.1]), "twin", RULE)
    assert got is not None and (got.before_um, got.after_um, got.n_new) == (1.0, pytest.approx(2.0), 2)
    assert got.share == pytest.approx(1.0)
    assert got.summary == "z: left-out S of the family twin is 2.00 µm on 2 new batches, was 1.00 µm (+100 %)"


def test_without_new_batches_all_of_them_count() -> None:
    got = growth(trained("m", twin=[1.0, 3.0]), trained("m", twin=[2.0, 4.0]), "twin", RULE)
    assert got is not None and (got.before_um, got.after_um, got.n_new) == (2.0, 3.0, 0)
    assert got.summary.endswith("is 3.00 µm on the same batches, was 2.00 µm (+50 %)")


def test_a_family_that_was_not_trained_before_has_not_grown() -> None:
    assert growth(trained("m", zero=[1.0, 3.0]), trained("m", twin=[2.0, 4.0]), "twin", RULE) is None
    nan = float("nan")
    assert growth(trained("m", twin=[nan, nan]), trained("m", twin=[2.0, 4.0]), "twin", RULE) is None


def test_each_family_of_the_twin_counts_for_itself_and_no_other(home: Path, store: Settings) -> None:
    """What is learned from the residual hides what the physics lacks."""
    log_training(trained("grown-families", twin=[1.0, 1.0], twin_residual=[0.5, 0.5], zero=[1.0, 1.0]), store)
    now = trained("grown-families", twin=[1.0, 1.0, 1.6], twin_residual=[0.5, 0.5, 0.5], zero=[1.0, 1.0, 9.0])
    ids = {"z": log_training(now, store)}  # tracked already, and not what it is compared with
    got = greatest_growth({"z": now}, store, ids)
    assert got is not None and (got.family, got.share) == ("twin", pytest.approx(0.6))


def test_the_first_training_has_nothing_to_grow_from(home: Path, store: Settings) -> None:
    now = trained("grown-first", twin=[5.0, 9.0])
    assert greatest_growth({"z": now}, store, {"z": log_training(now, store)}) is None


@pytest.fixture
def grown(home: Path, store: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A machine whose twin's error on a new batch has grown by 40 %; its lake holds three recordings."""
    monkeypatch.setattr("reports.diagnosis.page.write_diagnosis_report", lambda path, d, **_: None)
    name = f"grown-{zlib.crc32(str(tmp_path).encode()):x}"
    file = write_machine(tmp_path / "m.yml", name)
    ingest([write_recordings(tmp_path / "in")], load_machine(file), Lake(home / "lake"))
    log_training(trained(name, twin=[1.0, 1.0]), store)
    now = trained(name, twin=[1.0, 1.0, 1.4])
    ids = {"z": log_training(now, store)}

    def run(limit: float | None, toy: Toy) -> Any:
        settings = replace(store, diagnose=DiagnoseRule(when_error_grows_by=limit))
        said: list[str] = []
        monkeypatch.setattr(diagnosing, "library_diagnosis", lambda: toy)
        return (*diagnose_if_grown(file, {"z": now}, ids, settings, said.append), said)

    return run


def test_it_is_diagnosed_where_the_error_has_grown_by_more_than_the_rule_says(grown: Any, home: Path) -> None:
    toy = Toy()
    outcome, words, said = grown(0.25, toy)
    assert toy.calls[0]["batches"] == ["b0", "b1", "b2"]
    assert outcome.out.parent == home / "diagnoses" and (outcome.out / "machine.yml").exists()
    why = "z: left-out S of the family twin is 1.40 µm on 1 new batch, was 1.00 µm (+40 %)"
    assert said[0] == f"diagnose: {why}"
    assert words == f"{why}; diagnosed: explained (floor_sink at bed), {outcome.out}"


@pytest.mark.parametrize("limit", [0.5, None])
def test_it_is_left_alone_below_that_or_where_the_rule_is_off(grown: Any, limit: float | None) -> None:
    toy = Toy()
    assert grown(limit, toy) == (None, "", [])
    assert toy.calls == []


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (WorkError("no fit stays finite"), "not diagnosed: no fit stays finite"),
        (ZeroDivisionError("by zero"), "not diagnosed: ZeroDivisionError: by zero"),
    ],
    ids=["work", "fault"],
)
def test_a_diagnosis_that_fails_takes_nothing_from_the_training(grown: Any, error: Exception, words: str) -> None:
    def fails(d: Any) -> Any:
        raise error

    outcome, told, _ = grown(0.25, Toy(change=fails))
    assert (outcome, told) == (None, words)


def test_training_ends_with_it(home: Path, store: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Any] = []

    def asked(machine_file: Path, now: Any, *, ids: Any, settings: Settings, say: Any) -> Any:
        given.append((machine_file.stem, {t: r.target for t, r in now.items()}, ids))
        return None, "not diagnosed: this is a test"

    monkeypatch.setattr(diagnosing, "diagnose_if_grown", asked)
    plan = Plan(("none",), ("zero",), ("leave-batch-out",))
    recordings = (write_recordings(tmp_path / "in"),)
    for name, twin in (("ends-twin", True), ("ends-bare", False)):
        file = write_machine(tmp_path / f"{name}.yml", name, twin)
        request = TrainRequest(file, recordings, ("z",), plan, tmp_path / "r.md", promote=False)
        outcome = training.train(request, store, DirectCaller())
        assert outcome.diagnosis_summary == ("not diagnosed: this is a test" if twin else "")
        assert ("diagnose" in outcome.seconds) is twin
        if twin:
            assert given == [("ends-twin", {"z": "z"}, outcome.training_ids)]
    assert len(given) == 1
