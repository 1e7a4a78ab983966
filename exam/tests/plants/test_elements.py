"""The finite-element plant: its matrices, heat balance, order of integration, bodies and pieces."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy import sparse

from tests.plants.plant_cases import SEED, Array
from thermodrift_exam.plants.convergence import slab_error_K
from thermodrift_exam.plants.elements.geometry import draw_castings
from thermodrift_exam.plants.elements.structure import Elements, integrate, total
from thermodrift_exam.plants.structure import AIR, exposures_W_per_K, links_W_per_K


@cache
def machine(seed: int = SEED, finer: int = 1) -> Elements:
    return draw_castings(seed, True, finer).structure


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)])
def test_rows_of_the_losses_are_the_exchange_with_the_room(seed: int) -> None:
    s = machine(seed)
    losses = s.losses()
    np.testing.assert_allclose(losses @ np.ones(s.size), s.room_W_per_K, atol=1e-9)
    assert abs(losses - losses.T).max() < 1e-12
    assert sum(exposures_W_per_K(s)[b, "room"] for b in s.bodies if (b, "room") in exposures_W_per_K(s)) == (
        pytest.approx(s.room_W_per_K.sum())
    )


def test_storage_is_mass_times_specific_heat_and_bodies_share_it_out() -> None:
    s = machine()
    assert s.storage.sum() == pytest.approx(s.capacity_J_per_K.sum())
    bodies = sum(part.capacity_J_per_K for part in s.bodies.values())
    assert bodies == pytest.approx(s.capacity_J_per_K.sum())
    column = s.castings["column"]
    halves = s.bodies["column_front"].capacity_J_per_K + s.bodies["column_back"].capacity_J_per_K
    assert halves == pytest.approx(column.mass_kg * 500.0)
    np.testing.assert_allclose(sum(s.share_of(body) for body in s.bodies), 1.0, atol=1e-12)


def test_a_machine_without_a_room_keeps_every_joule() -> None:
    s = machine()
    closed = sparse.csc_matrix(total([*s.conduction.values(), *s.contacts.values()], s.size))
    solids = [body for body in s.bodies if body != AIR]
    heat = np.zeros((s.size, 1))
    for body in solids:
        s.bodies[body].add(heat[:, 0], 50.0)
    start = np.full((s.size, 1), 20.0)
    course = integrate(s.storage, closed, lambda *_: heat, start, 60.0, 60)
    stored_J = s.capacity_J_per_K @ (course[-1] - start)
    assert np.ptp(course[-1]) > 5.0
    assert float(stored_J[0]) == pytest.approx(50.0 * len(solids) * 3600.0, rel=1e-9)


def test_at_rest_the_room_takes_what_the_motor_gives() -> None:
    s = machine()
    heat = s.room_W_per_K[:, None] * 20.0
    s.bodies["motor"].add(heat[:, 0], 200.0)
    course = integrate(s.storage, s.losses(), lambda *_: heat, np.full((s.size, 1), 20.0), 6000.0, 300)
    lost_W = s.room_W_per_K @ (course[-1] - 20.0)
    assert float(lost_W[0]) == pytest.approx(200.0, rel=1e-9)


def test_the_solver_is_of_second_order_with_explicit_heat_and_damps_what_is_stiff() -> None:
    def heat_W(step: int, stage: int, nodes: Array) -> Array:
        return np.full((1, 1), 40.0) - nodes

    mass, losses = sparse.csc_matrix([[2000.0]]), sparse.csc_matrix([[4.0]])
    exact = 8.0 + 22.0 * np.exp(-1000.0 / 400.0)  # the explicit part adds 1 W/K
    off = []
    for steps in (10, 20, 40):
        off.append(integrate(mass, losses, heat_W, np.full((1, 1), 30.0), 1000.0 / steps, steps)[-1, 0, 0] - exact)
    assert off[0] / off[1] == pytest.approx(4.0, abs=0.6) and off[1] / off[2] == pytest.approx(4.0, abs=0.3)
    stiff = integrate(mass, 1e6 * losses, lambda *_: np.zeros((1, 1)), np.full((1, 1), 30.0), 100.0, 2)
    assert abs(stiff[-1, 0, 0]) < 1e-4


def test_a_cooling_slab_meets_the_series_of_carslaw_and_jaeger_at_second_order() -> None:
    coarse, fine = slab_error_K(6), slab_error_K(12)
    assert fine < 0.005  # of 10 K
    assert np.log2(coarse / fine) == pytest.approx(2.0, abs=0.1)


def test_links_of_halves_are_those_of_a_bar_with_even_heat() -> None:
    """A head of even section: 3 k A / L between its halves' means, what the grid overestimates below 3 %."""
    s = next(machine(seed) for seed in range(8) if "head_rear" in machine(seed).bodies)
    head = s.castings["head"]
    section_m2 = head.size_m[0] * head.size_m[2]
    bar = 3.0 * head.conductivity_W_per_mK * section_m2 / head.size_m[1]
    assert links_W_per_K(s)["head_front", "head_rear"] == pytest.approx(bar, rel=0.03)


def test_pieces_are_integrals_and_not_counts_of_nodes() -> None:
    s, fine = machine(), machine(SEED, 2)
    height_m = s.castings["column"].size_m[2]
    for structure in (s, fine):
        part = structure.part("column", (0.0, 0.3), (0.35, 0.9))
        z_m = structure.above_floor_m[:, None]
        middle_m = structure.castings["column"].low_m[2] + 0.625 * height_m
        assert float(part.mean(z_m)[0]) == pytest.approx(middle_m, rel=1e-9)
    ring = s.part("front", (0.0, 0.35))
    box = s.castings["front"]
    bore_m = box.size_m[0] - 2 * box.wall_m
    outer_m = bore_m + 0.7 * box.wall_m
    volume_m3 = (outer_m**2 - bore_m**2) * box.size_m[2]
    assert ring.capacity_J_per_K == pytest.approx(7850.0 * 460.0 * volume_m3, rel=1e-9)
