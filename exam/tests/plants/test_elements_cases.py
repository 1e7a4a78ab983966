"""Cases of the finite-element plant: machines differ, all effects work on it, and the file names their places."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.plants.plant_cases import NONE, SEED
from thermodrift_exam.plants.drawing import PLANTS, draw_plant
from thermodrift_exam.plants.effects import EFFECTS
from thermodrift_exam.plants.effects.heat import Draught
from thermodrift_exam.plants.elements.geometry import draw_castings
from thermodrift_exam.plants.plant import draw, posed
from thermodrift_exam.plants.runs import Now
from thermodrift_exam.plants.structure import FEATURES, Plant

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("seed", range(2))
def test_machines_differ_and_sensors_sit_in_their_bodies(seed: int) -> None:
    p = draw_plant(seed, NONE, NONE, "elements")
    s = p.structure
    assert 600 <= s.size <= 1300
    assert 7 <= len(p.sensors) <= 12
    assert s.capacity_J_per_K.sum() != pytest.approx(
        draw_castings(seed + 1, True).structure.capacity_J_per_K.sum(), rel=1e-3
    )
    for sensor in p.sensors:
        assert sensor.cell in s.bodies[sensor.body].cells
    for source in p.sources.values():
        assert source.share.sum() == pytest.approx(1.0)


@pytest.mark.slow
def test_both_kinds_of_plant_have_the_same_features() -> None:
    for kind in PLANTS:
        p = draw_plant(SEED, frozenset(FEATURES), NONE, kind)
        assert {"bending", "growth", "mandrel"} <= {g.name for g in p.growths}
        p = draw_plant(SEED, NONE, frozenset(FEATURES), kind)
        assert not {"bending", "growth", "mandrel"} & {g.name for g in p.growths}


def _busy(p: Plant) -> Now:
    """One batch at the rated speed with feed and coolant on, in the gate's time, at noon."""
    one = np.ones(1)
    return Now(3.0 * 3600.0, p.rated_rpm * one, 8000.0 * one, one, 22.0 * one, 17.0 * one, 15.0 * one, 12.0 * one)


@pytest.mark.parametrize("key", EFFECTS)
def test_every_effect_works_on_elements_and_its_place_is_in_the_machine_file(key: str) -> None:
    at = posed(SEED, {key: 1.0}, "elements", has=FEATURES, batches=2)
    (effect,), twin = at.effects, at.machine.twin
    assert twin is not None
    answer = effect.answer()
    places = {
        "node": {**twin["bodies"], **twin["surroundings"]}, "link": {**twin["links"], **twin["exposures"]},
        "sensor": twin["sensors"], "error": twin["errors"],
    }  # fmt: skip
    assert answer.name in places[answer.kind]
    nodes_degC, now = np.full((at.plant.structure.size, 1), 35.0), _busy(at.plant)
    nodes_degC[at.plant.part("shaft").cells] = 50.0
    heat = np.zeros_like(nodes_degC)
    if isinstance(effect, Draught):
        now = replace(now, time_s=60.0 * effect.start_min)
    effect.add_heat_W(heat, nodes_degC, now)
    if "power" in answer.parameters and key != "sun":
        scale = {"unlisted_warm_speed": 1.5}.get(key, 1.0)
        assert heat.sum() == pytest.approx(scale * answer.parameters["power"][0])
    rubs = [np.any(effect.friction(name, nodes_degC, now) != 1.0) for name in at.plant.sources]
    faulty = effect.sensed(at.plant.sensors) != at.plant.sensors
    shown = faulty or effect.displaced_um(now.speed_rpm) or effect.ahead_s()
    assert heat.any() or any(rubs) or shown or effect.withholds or effect.misread()


def test_a_case_of_elements_is_drawn_whole_and_an_effect_moves_it() -> None:
    short = {"batches": 2, "hours": 1.0, "before_h": 1.0, "solver_s": 100.0, "noise_um": 0.0, "noise_K": 0.0}
    one, none = (draw(SEED, "cabinet_heat", size, plant="elements", **short) for size in (1.0, 0.0))
    for a, b in zip(one.batches, none.batches, strict=True):
        warmer = a.values("t_column_back") - b.values("t_column_back")
        assert warmer.min() > 0.0 and warmer[-1] - warmer[0] > 0.05
    assert one.machine == none.machine and one.machine.simulated
    assert one.truth["terms"][0]["where"] == {"kind": "node", "name": "column_back"}
