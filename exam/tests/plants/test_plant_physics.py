"""Numerics of the development plants: steps, energy, geometry, displacement, runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse

from tests.plants.plant_cases import NONE, SEED, Array, plant
from thermodrift_exam.plants.drawing import draw_plant
from thermodrift_exam.plants.effects import EFFECTS
from thermodrift_exam.plants.options import Options, stream
from thermodrift_exam.plants.runs import Block, held, plan_runs
from thermodrift_exam.plants.simulation import simulated
from thermodrift_exam.plants.structure import FEATURES, exposures_W_per_K, links_W_per_K
from thermodrift_exam.plants.volumes.layout import bending
from thermodrift_exam.plants.volumes.structure import Plate, Volumes, even, integrate


@pytest.mark.parametrize(
    "key",
    [
        pytest.param(None, marks=pytest.mark.slow),
        "preload_feedback",
        pytest.param("draught", marks=pytest.mark.slow),
        pytest.param("rotating_convection", marks=pytest.mark.slow),
        "natural_convection",
    ],
)
def test_half_the_step_changes_no_cell_by_a_hundredth_of_a_kelvin(key: str | None) -> None:
    kinds = [EFFECTS[key]] if key else []
    p = plant()
    effects = [kind(p, 1.0, stream(SEED, "effect")) for kind in kinds]
    runs = plan_runs(SEED, Options(batches=3, hours=4.0), p.rated_rpm)
    coarse, fine = (simulated(p, runs, effects, step_s) for step_s in (15.0, 7.5))
    assert np.ptp(coarse.cells_degC) > 20.0
    assert np.abs(coarse.cells_degC - fine.cells_degC[::2]).max() < 0.01


def test_the_solver_is_of_second_order_and_meets_the_exact_solution() -> None:
    def heat_W(step: int, stage: int, cells: Array) -> Array:
        return np.full((1, 1), 40.0) - cells

    capacity, losses = np.array([2000.0]), sparse.csc_matrix([[4.0]])  # 500 s
    ends = []
    for step_s in (100.0, 50.0):
        n = round(1000.0 / step_s)
        ends.append(integrate(capacity, losses, heat_W, np.full((1, 1), 30.0), step_s, n)[-1, 0, 0])
    exact = 8.0 + 22.0 * np.exp(-1000.0 / 400.0)  # the explicit part adds 1 W/K
    assert abs(ends[1] - exact) < 0.02
    assert (ends[0] - exact) / (ends[1] - exact) == pytest.approx(4.0, abs=0.8)


def test_a_closed_plant_keeps_every_joule_of_its_sources() -> None:
    p = plant(SEED, "motor_loss")
    closed = replace(p, structure=replace(p.structure, room_W_per_K=np.zeros(p.structure.size)))
    runs = plan_runs(SEED, Options(batches=3, hours=2.0, friction_scatter=0.2), p.rated_rpm)
    course = simulated(closed, runs, [], 15.0)
    stored_J = np.einsum("mnb,n->mb", course.cells_degC - course.cells_degC[0], p.structure.capacity_J_per_K)
    friction = np.array([r.friction for r in runs])
    x = course.speed_rpm[:-1] / p.rated_rpm
    front, load, rear, rear_load, (idle, linear, quadratic) = (
        p.sources[n].watts for n in ("front_bearings", "front_preload", "rear_bearings", "rear_preload", "motor_loss")
    )
    watts = friction * ((front[0] + rear[0]) * x ** (5 / 3) + (load[0] + rear_load[0]) * x)
    watts += np.where(x > 0, idle + linear * x + quadratic * x**2, 0.0)
    given_J = 15.0 * watts.sum(axis=0)
    assert given_J.max() > 1e5
    np.testing.assert_allclose(stored_J[-1], given_J, rtol=1e-9, atol=1e-3)


def test_what_the_plant_loses_is_its_exchange_with_the_room() -> None:
    p = plant()
    s = p.structure
    losses = s.losses()
    np.testing.assert_allclose(np.asarray(losses.sum(axis=1)).ravel(), s.room_W_per_K, atol=1e-9)
    assert abs(losses - losses.T).max() == 0
    at_20 = losses @ np.full(s.size, 20.0) - s.room_W_per_K * 20.0
    np.testing.assert_allclose(at_20, 0.0, atol=1e-7)


@pytest.mark.parametrize("seed", range(3))
def test_machines_differ_and_are_resolved_finely(seed: int) -> None:
    p = plant(seed)
    s = p.structure
    assert 8 <= len(s.castings) + (s.air_cell is not None) <= 14
    assert 100 <= s.size <= 300
    covered = np.concatenate([part.cells for part in s.bodies.values()])
    assert sorted(covered) == list(range(s.size))
    assert 7 <= len(p.sensors) <= 12
    for sensor in p.sensors:
        assert sensor.cell in s.bodies[sensor.body].cells
        assert sensor.cell not in s.joined() or len(s.bodies[sensor.body].cells) <= 5
        assert 30 <= sensor.lag_s <= 60
    for source in p.sources.values():
        assert source.share.sum() == pytest.approx(1.0)


def test_no_two_seeds_give_the_same_machine() -> None:
    assert len({plant(seed).structure.capacity_J_per_K.sum() for seed in range(20)}) == 20


def test_uniform_warming_grows_by_expansion_times_length_and_does_not_bend() -> None:
    p = plant(SEED, "growth", "bending", "mandrel")
    s = p.structure
    one_K = np.ones(s.size)
    by_name = {(g.name, g.channel): g for g in p.growths}
    shaft = s.castings["shaft"]
    assert by_name["growth", "z"].weights_um_per_K @ one_K == pytest.approx(11.5 * 0.3 * shaft.depth_m)
    assert by_name["mandrel", "z"].weights_um_per_K @ one_K == pytest.approx(11.5 * s.castings["mandrel"].depth_m)
    for channel in ("y", "z"):
        assert by_name["bending", channel].weights_um_per_K @ one_K == pytest.approx(0.0, abs=1e-9)


def test_a_column_bends_as_the_beam_with_that_gradient() -> None:
    """κ = α dθ/dx: tip deflection κ H²/2, angle κ H."""
    s = plant().structure
    column = s.castings["column"]
    rise = np.zeros(s.size)
    rise[s.cells["column"]] = 2.0 * (column.along_m[0] - column.depth_m / 2)  # 2 K/m, the front warmer
    curvature_per_m = 10.8 * 2.0
    deflection_um = bending(s, "y", 1.0, None).weights_um_per_K @ rise
    angle_um = bending(s, "z", 1.0, 0.5).weights_um_per_K @ rise
    assert deflection_um == pytest.approx(-curvature_per_m * column.height_m**2 / 2, rel=1e-6)
    assert angle_um == pytest.approx(-curvature_per_m * column.height_m * 0.5, rel=1e-6)


def test_lumped_links_of_a_bar_in_two_pieces_are_those_of_the_textbook() -> None:
    """Two halves of a rod with even heat in one and out of the other: 3 k A / L between their means."""
    rod = Plate("rod", "steel", 7850.0 * 1.0 * 0.01, 1.0, 0.1, 0.1, (400, 1), 0.0)
    one, other, conductance = rod.conduction()
    none, capacity = np.zeros(400), rod.capacity_J_per_K
    bodies = {"left": even(np.arange(200), capacity, none), "right": even(np.arange(200, 400), capacity, none)}
    s = Volumes(
        castings={"rod": rod}, cells={"rod": np.arange(400)}, bodies=bodies, capacity_J_per_K=capacity,
        above_floor_m=none, room_W_per_K=none, surface_m2=none, expansion_um_per_mK=none,
        one=one, other=other, between_W_per_K=conductance, surfaces=0 * conductance,
    )  # fmt: skip
    assert links_W_per_K(s)["left", "right"] == pytest.approx(3.0 * 48.0 * 0.01 / 1.0, rel=1e-3)


def test_lumped_exposures_add_up_to_the_plants_own() -> None:
    s = plant().structure
    total = sum(g for (_, around), g in exposures_W_per_K(s).items() if around == "room")
    assert total == pytest.approx(s.room_W_per_K.sum())


def test_every_feature_can_be_had_and_left_out() -> None:
    assert draw_plant(SEED, frozenset(FEATURES), NONE).features == set(FEATURES)
    assert draw_plant(SEED, NONE, frozenset(FEATURES)).features == set()


def test_seasons_protocols_and_starts_off_equilibrium_vary() -> None:
    p = plant()
    runs = plan_runs(SEED, Options(), p.rated_rpm)
    room = [float(r.room_degC(np.zeros(1))[0]) for r in runs]
    assert min(room) < 15 and max(room) > 25
    assert len({r.batch_id for r in runs}) == 12
    assert [r.start for r in runs] == sorted(r.start for r in runs)
    time_s = np.arange(0.0, 6 * 3600.0, 300.0)
    assert any(not held(r.speed, time_s).any() for r in runs), "one stands still"
    assert any(held(r.speed, time_s)[-1] == 0 < held(r.speed, time_s).max() for r in runs), "one cools down"
    course = simulated(p, runs[:4], [], 15.0)
    start = course.cells_degC[np.argmin(np.abs(course.time_s))]
    assert np.ptp(start, axis=0).min() > 0.2


def test_drivers_change_on_rows_of_the_recording() -> None:
    for run in plan_runs(SEED, Options(), 8000.0):
        for block in (*run.speed, *run.feed, *run.coolant):
            assert block.from_s % 300.0 == 0


def test_a_driver_is_held_from_its_block_on() -> None:
    blocks = (Block(60.0, 5.0), Block(180.0, 0.0))
    assert held(blocks, np.array([0.0, 60.0, 179.0, 180.0])).tolist() == [0.0, 5.0, 5.0, 0.0]
