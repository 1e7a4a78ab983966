"""Cases of the development plants: the machine file that leaves an effect out, the answer key, files on disk."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from data.errors import InputError
from data.machine import load_machine
from data.recording import read_batches, recording_files
from tests.plants.plant_cases import NONE, SEED, brief, full_speed
from thermodrift_exam.plants.drawing import draw_plant
from thermodrift_exam.plants.effects import EFFECTS
from thermodrift_exam.plants.options import Options
from thermodrift_exam.plants.plant import draw, write_case
from thermodrift_exam.plants.runs import plan_runs
from thermodrift_exam.plants.simulation import power_W
from twin.compile import compile_network
from twin.mechanisms import MECHANISMS
from twin.mechanisms.base import View
from twin.quantity import values_of
from twin.simulation import simulate
from twin.simulation.inputs import inputs_of, parameters_of


def test_the_same_seed_gives_the_same_case_and_another_another() -> None:
    a, b, c = (draw(seed, "sun", batches=2, hours=2.0) for seed in (5, 5, 6))
    assert a.machine == b.machine and a.truth == b.truth
    for one, other in zip(a.batches, b.batches, strict=True):
        assert one.table.equals(other.table) and one.batch_id == other.batch_id
    assert a.machine.twin != c.machine.twin


@pytest.mark.parametrize("key", EFFECTS)
def test_at_size_0_the_recordings_are_those_of_a_machine_without_it(key: str) -> None:
    kind = EFFECTS[key]
    has = tuple(sorted(kind.has - {kind.withholds}))
    lacks = (kind.withholds,) if kind.withholds else ()
    none, plain = brief(key, 0.0, has), brief(None, 1.0, has, lacks)
    assert none.truth["effect"] is None and none.truth["terms"] == []
    assert none.machine == plain.machine
    for one, other in zip(none.batches, plain.batches, strict=True):
        assert one.table.equals(other.table)


@pytest.mark.parametrize("key", EFFECTS)
def test_the_machine_file_says_nothing_of_the_effect(key: str) -> None:
    """A withheld one is missing in the file alone; every other one leaves the file as it was."""
    kind = EFFECTS[key]
    has = tuple(sorted(kind.has))
    case, plain = brief(key, 1.0, has), brief(None, 1.0, has)
    assert case.truth["effect"] == key
    assert key not in json.dumps(case.machine.model_dump(mode="json")) or key in ("wrong_parameter",)
    if kind.withholds is None and key != "wrong_parameter":
        assert case.machine == plain.machine
    else:
        assert case.machine != plain.machine
        for one, other in zip(case.batches, plain.batches, strict=True):
            assert one.table.equals(other.table)
    mechanism = case.truth["mechanism"]
    assert mechanism is None or mechanism in MECHANISMS or mechanism == "wrong_parameter"


@pytest.mark.parametrize("key", EFFECTS)
def test_the_answer_names_a_place_of_the_machine_file(key: str) -> None:
    case = brief(key, 1.0, tuple(sorted(EFFECTS[key].has)))
    assert case.machine.twin is not None
    twin_part, where = case.machine.twin, case.truth["where"]
    places = {
        "node": {**twin_part["bodies"], **twin_part["surroundings"]},
        "link": {**twin_part["links"], **twin_part["exposures"]},
        "sensor": twin_part["sensors"],
        "error": twin_part["errors"],
    }
    assert where["name"] in places[where["kind"]]
    if where["kind"] in ("node", "link") and where["name"] not in twin_part["surroundings"]:
        assert case.truth["neighbours"]
        assert set(case.truth["neighbours"]) <= set(twin_part["bodies"])
    assert json.loads(json.dumps(case.truth)) == case.truth


def test_two_effects_are_both_in_the_key() -> None:
    case = draw(SEED, "sun+speed_shift", batches=2, hours=1.0)
    assert [t["mechanism"] for t in case.truth["terms"]] == ["sun", "speed_shift"]


@pytest.mark.parametrize("seed", range(6))
def test_the_machine_file_compiles_and_its_twin_is_in_the_right_ballpark(seed: int) -> None:
    """Values off by 30 % and one lump a body: temperatures are told better than by holding the first reading."""
    case = draw(seed, None, batches=4, solver_s=50.0)
    network = compile_network(case.machine)
    shown = simulate(network, values_of(network.parameters), inputs_of(network, case.batches, 1))
    measured = np.stack([[b.values(r.channel) for r in network.readings] for b in case.batches])
    told = np.moveaxis(shown.readings[0], -1, 1)
    rms = np.sqrt(np.mean((told - measured) ** 2, axis=(0, 2)))
    held_rms = np.sqrt(np.mean((measured - measured[..., :1]) ** 2, axis=(0, 2)))
    assert np.median(rms / held_rms) < 0.8
    assert rms.max() < 12.0
    assert len(network.free) > 40


def test_without_errors_of_the_engineer_the_file_states_the_plants_own_watts_and_masses() -> None:
    case = draw(SEED, None, batches=1, hours=1.0, file_error=0.0, mass_error=0.0)
    p = draw_plant(SEED, NONE, NONE)
    network = compile_network(case.machine)
    capacity = {b: sum(network.capacities[c](network.values) for c in cells) for b, cells in network.bodies.items()}
    for body, part in p.structure.bodies.items():
        assert capacity[body] == pytest.approx(part.capacity_J_per_K, rel=1e-3)
    full = full_speed(p)
    told = {h.law.name: _heat_W(network, h, p.rated_rpm) for h in network.heats}
    for name, source in p.sources.items():
        assert told[name] == pytest.approx(float(power_W(source, full, p.rated_rpm, np.ones(1))[0]), rel=2e-3)


def _heat_W(network: Any, heat: Any, rpm: float) -> float:
    view = View(driver={role: np.full(1, rpm) for role in heat.law.drivers})
    return float(np.ravel(heat.law.mechanism.heat_W(view, parameters_of(heat.law, network.values[None], 1)))[0])


def test_a_case_on_disk_reads_back_and_the_key_lies_outside(tmp_path: Path) -> None:
    case = draw(SEED, "cabinet_heat", batches=2, hours=1.0, missing=0.1, has=("feed", "coolant"))
    lost = {b.batch_id: b.table.isna().to_numpy() for b in case.batches}
    machine, recordings, key = write_case(case, tmp_path / "case")
    assert load_machine(machine) == case.machine
    files, others = recording_files(recordings, case.machine)
    assert others == [] and len(files) == 2
    for file, batch in zip(files, case.batches, strict=True):
        assert "simulated" in file.read_text(encoding="utf-8").splitlines()[0]
        (back,) = read_batches(file, load_machine(machine))
        assert back.batch_id == batch.batch_id and back.start == batch.start
        kept = ~lost[batch.batch_id]  # the reader closes short gaps
        assert not kept.all()
        np.testing.assert_allclose(
            back.table[list(batch.table)].to_numpy()[kept], batch.table.to_numpy()[kept], atol=1e-9
        )
    assert json.loads(key.read_text(encoding="utf-8"))["where"] == {"kind": "node", "name": "column_back"}
    assert not list((tmp_path / "case").rglob("truth*"))
    everything = "".join(f.read_text(encoding="utf-8") for f in (tmp_path / "case").rglob("*") if f.is_file())
    assert "cabinet" not in everything
    with pytest.raises(InputError, match=r"the key's folder .* lies in"):
        write_case(case, tmp_path / "case", tmp_path / "case" / "key")


def test_everything_is_called_simulated() -> None:
    case = brief(None, 1.0)
    assert case.machine.simulated and case.truth["simulated"]
    assert all(b.simulated for b in case.batches)


def test_options_shape_the_recordings() -> None:
    case = draw(SEED, None, batches=2, hours=2.0, step_s=60.0, quantisation_K=0.5, missing=0.2, friction_scatter=0.3)
    batch = case.batches[0]
    room = case.tables[batch.batch_id]["room"].to_numpy()
    assert batch.step_s == 60.0 and batch.n_rows == 121
    assert 0.1 < np.isnan(room).mean() < 0.3
    assert np.nanmax(np.abs(room * 2 - np.rint(room * 2))) < 1e-9
    assert not np.isnan(batch.values("spindle_rpm")).any()
    runs = plan_runs(SEED, Options(batches=12, hours=2.0, step_s=60.0, friction_scatter=0.3), 8000.0)
    assert np.ptp([r.friction for r in runs]) > 0.2


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"effect": "flor_sink"}, "unknown effect 'flor_sink': did you mean 'floor_sink'"),
        ({"noise_k": 0.1}, "unknown option 'noise_k'; did you mean 'noise_K'"),
        ({"has": ("fead",)}, "unknown feature 'fead'; did you mean 'feed'"),
        ({"size": -1.0}, "size: got -1.0, expected 0 or more"),
        ({"batches": 0}, "batches: got 0, expected 1 to 60"),
        ({"solver_s": 7.0}, "solver_s: got 7.0, expected a divisor of 900 s and of step_s"),
    ],
)
def test_bad_arguments_are_told_in_one_line(given: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError) as error:
        draw(SEED, **given)
    assert words in str(error.value)
    assert "\n" not in str(error.value)
