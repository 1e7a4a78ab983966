"""Plant D: what is withheld from a machine file is gone from it, can be proposed, and has the size that is claimed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from data.batch import Batch
from data.errors import InputError
from data.machine import Machine, parse_machine
from data.recording import read_batches
from diagnosis.candidates.library import candidates
from tests.real.recorded import DATA
from thermodrift_exam.plants.real import recorded
from thermodrift_exam.plants.withheld import BOARD, CASES, CELL, build, cases
from thermodrift_exam.proof.scoring.answer_key import AnswerKey
from thermodrift_exam.proof.spec import KINDS
from twin.calibration import CalibrationOptions, calibrate
from twin.compile import compile_network
from twin.schema import twin_part

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="no ../shared/data")
LISTED = [n for n, c in CASES.items() if c.kind != "unlisted"]


def machine_text(machine: Machine) -> str:
    return str(yaml.safe_dump(machine.model_dump(mode="json", exclude_defaults=True), sort_keys=False))


def test_there_are_cases_of_all_four_machines_and_none_without_recordings(tmp_path: Path) -> None:
    assert set(cases(DATA)) == set(CASES) and len(CASES) >= 10
    assert {c.machine for c in CASES.values()} == {"lathe_gv1203", "spindle_fl", "tclab_board", "cell_30q"}
    assert cases(tmp_path) == []


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow if n == "lathe_nut" else []) for n in LISTED])
def test_what_is_kept_back_can_be_proposed_for_the_file_that_lacks_it(name: str) -> None:
    case = build(name, DATA, 1)
    compile_network(case.machine)
    offered = {(c.mechanism, c.where.kind, c.where.name) for c in candidates(case.machine, twin_part(case.machine))}
    for term in case.answer["terms"]:
        places = [term["where"], *term["also"]]
        assert any((term["mechanism"], p["kind"], p["name"]) in offered for p in places), term["where"]
        assert set(term["neighbours"]) <= set(case.machine.twin["bodies"])


@pytest.mark.parametrize("name", ["lathe_nut", "board_sag1", "cell_lost_voltage", "spindle_speed"])
def test_the_case_reads_back_from_its_files_as_it_was(name: str, tmp_path: Path) -> None:
    case = build(name, DATA, 2)
    machine = parse_machine(machine_text(case.machine), "test")
    assert machine == case.machine
    texts = case.recordings()
    assert len(texts) == len(case.batches) and all(t.startswith("# real recording\n") for t in texts.values())
    for batch in case.batches[:2]:
        path = tmp_path / f"{batch.batch_id}.csv"
        path.write_text(texts[path.name])
        (back,) = read_batches(path, machine)
        assert back.batch_id == batch.batch_id and back.start == batch.start
        assert list(back.channels) == list(batch.channels)
        for channel in batch.channels:
            assert back.values(channel) == pytest.approx(batch.values(channel), rel=1e-8, nan_ok=True), channel


@pytest.mark.parametrize("name", [n for n, c in CASES.items() if c.channels])
def test_a_hidden_input_is_nowhere_in_what_is_seen(name: str) -> None:
    case = build(name, DATA, 3)
    for channel in CASES[name].channels:
        drivers = [m.get("drivers") for m in (case.machine.twin or {}).get("mechanisms", {}).values()]
        assert channel not in case.machine.channels and channel not in str(drivers)
        assert not any(channel in b.table.columns or channel in b.channels for b in case.batches)
    if case.machine.twin is not None:
        compile_network(case.machine)


def test_the_seed_picks_runs_and_hours_and_the_same_seed_the_same_ones() -> None:
    one, again, other = (build("lathe_belt", DATA, seed) for seed in (4, 4, 5))
    assert [b.batch_id for b in one.batches] == [b.batch_id for b in again.batches]
    assert [b.batch_id for b in one.batches] != [b.batch_id for b in other.batches]
    assert len(one.batches) == 8 and all(6 <= b.start.hour < 12 for b in one.batches if b.start is not None)


def test_answers_are_plain_finite_data_and_windows_lie_in_the_runs() -> None:
    for name in CASES:
        case = build(name, DATA, 6)
        json.dumps(case.answer, allow_nan=False)
        key = AnswerKey.from_json(case.answer)
        assert not key.simulated and key.kind in KINDS and key.plant == "withheld"
        assert len(key.terms) == (2 if key.kind == "two" else 1)
        ends = {b.batch_id: b.time_s[-1] for b in case.batches}
        for term in case.answer["terms"]:
            assert term["active"] == "always" or all(0 <= s < e <= ends[b] for b, s, e in term["active"])


def test_the_sag_acts_where_both_heaters_are_on() -> None:
    case = build("board_sag1", DATA, 1)
    own = [w for w in case.answer["terms"][0]["active"] if w[0] == case.batches[0].batch_id]
    batch: Batch = case.batches[0]
    inside = np.zeros(batch.n_rows, bool)
    for _, start_s, end_s in own:
        inside |= (batch.time_s >= start_s) & (batch.time_s < end_s)
    on = (batch.values("heater1") > 0) & (batch.values("heater2") > 0)
    assert on.any() and np.array_equal(inside[:-1], on[:-1])


@pytest.mark.parametrize(("machine", "claimed"), [("tclab_board", BOARD), ("cell_30q", CELL)])
def test_the_claimed_sizes_are_those_that_the_full_file_calibrates(machine: str, claimed: dict[str, float]) -> None:
    full, batches = recorded(machine, DATA, 1)
    network = calibrate(full, batches, CalibrationOptions(every_s=10.0)).network
    fitted = {p.name: v for p, v in zip(network.parameters, network.values, strict=True)}
    for path, value in claimed.items():
        name = path if path in fitted else f"{path}.conductance"
        assert fitted.get(name, fitted.get(path)) == pytest.approx(value, rel=0.02, abs=0.05), path


def test_an_unknown_case_is_told_with_the_closest() -> None:
    with pytest.raises(InputError, match=r"withheld: unknown case 'lathe_nuts'; did you mean 'lathe_nut'\?"):
        build("lathe_nuts", DATA, 1)
