"""Displacement of the finite-element plant against bars, beams and a whole machine that warms evenly."""

from __future__ import annotations

import numpy as np
import pytest

from tests.plants.plant_cases import SEED, Array
from thermodrift_exam.plants.elements.elasticity import Elasticity
from thermodrift_exam.plants.elements.geometry import draw_castings
from thermodrift_exam.plants.elements.layout import growths, odd, tool_weights_um_per_K
from thermodrift_exam.plants.elements.mesh import Box, Mesh
from thermodrift_exam.plants.elements.structure import Contact
from thermodrift_exam.plants.structure import FEATURES

LENGTH_M, HIGH_M, WIDE_M = 0.6, 0.1, 0.12
EXPANSION_PER_K = 10.8e-6


def _bar(name: str = "bar", at_m: float = 0.0, cells: int = 6, hollow: str = "block") -> Mesh:
    """Lying along x, its lower face on z = 0."""
    wall_m = 0.02 if hollow == "tube" else 0.0
    size = (LENGTH_M, WIDE_M, HIGH_M)
    volume_m3 = LENGTH_M * WIDE_M * HIGH_M
    return Mesh(Box(name, "cast_iron", 7200.0 * volume_m3, (at_m, 0.0, 0.0), size, (cells, 2, 2), hollow, wall_m))  # type: ignore[arg-type]


def _apart_um(mesh: Mesh, rise_K: Array, one: Array, other: Array) -> Array:
    machine = Elasticity({mesh.box.name: mesh}, [], mesh.box.name)
    weights = machine.weights_um_per_K((mesh.box.name, one), (mesh.box.name, other))
    moved = machine.moved_m(rise_K, mesh.box.name, np.stack([one, other]))
    np.testing.assert_allclose(weights @ rise_K, 1e6 * (moved[0] - moved[1]), rtol=1e-7, atol=1e-3)
    return np.asarray(weights @ rise_K)


def test_a_bar_on_soft_feet_grows_by_expansion_times_length_and_rise() -> None:
    mesh = _bar()
    middle = np.array([WIDE_M / 2, HIGH_M])
    grown = _apart_um(mesh, np.full(mesh.size, 7.0), np.array([LENGTH_M, *middle]), np.array([0.0, *middle]))
    assert grown[0] == pytest.approx(1e6 * EXPANSION_PER_K * LENGTH_M * 7.0, rel=2e-3)


def test_a_free_bar_grows_exactly_and_a_gradient_bends_it_as_a_beam(monkeypatch: pytest.MonkeyPatch) -> None:
    """α L ΔT to 1e-6; and α ΔT L² / 2 h at the end of a bar held at the other (Timoshenko 1925)."""
    monkeypatch.setattr("thermodrift_exam.plants.elements.elasticity.FEET_N_PER_M3", (1e4, 1e4, 1e4))  # all but free
    mesh = _bar()
    near, far = np.array([0.0, WIDE_M / 2, HIGH_M / 2]), np.array([LENGTH_M, WIDE_M / 2, HIGH_M / 2])
    grown = _apart_um(mesh, np.full(mesh.size, 7.0), far, near)
    np.testing.assert_allclose(grown, [1e6 * EXPANSION_PER_K * LENGTH_M * 7.0, 0.0, 0.0], rtol=1e-6, atol=1e-3)

    across_K = 5.0
    rise = across_K * (mesh.points_m[:, 2] / HIGH_M - 0.5)
    axis = np.stack([near, (near + far) / 2, far])
    low, mid, high = Elasticity({"bar": mesh}, [], "bar").moved_m(rise, "bar", axis)[:, 2] * 1e6
    half_m = LENGTH_M / 2
    sagitta_um = 1e6 * EXPANSION_PER_K * across_K * half_m**2 / (2.0 * HIGH_M)  # each half is a bar held at the middle
    assert mid - (low + high) / 2 == pytest.approx(sagitta_um, rel=1e-5)


def test_a_hollow_bar_grows_as_a_full_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("thermodrift_exam.plants.elements.elasticity.FEET_N_PER_M3", (1e4, 1e4, 1e4))
    mesh = _bar(hollow="tube")
    assert mesh.box.fill > 1.5
    grown = _apart_um(mesh, np.full(mesh.size, 3.0), np.array([LENGTH_M, 0.0, 0.0]), np.zeros(3))
    assert grown[0] == pytest.approx(1e6 * EXPANSION_PER_K * LENGTH_M * 3.0, rel=1e-5)


def test_two_bars_tied_end_to_end_grow_together() -> None:
    one, other = _bar("one"), _bar("other", LENGTH_M, cells=5)
    points_m, area_m2 = one.hull([(0, 1)]).gauss()
    tie = Contact("one", "other", points_m, points_m, area_m2, 1.0)
    machine = Elasticity({"one": one, "other": other}, [tie], "one")
    end, start = np.array([2 * LENGTH_M, WIDE_M / 2, HIGH_M]), np.array([0.0, WIDE_M / 2, HIGH_M])
    weights = machine.weights_um_per_K(("other", end), ("one", start))
    warm = np.concatenate([np.full(one.size, 4.0), np.full(other.size, 2.0)])
    assert weights[0] @ warm == pytest.approx(1e6 * EXPANSION_PER_K * LENGTH_M * 6.0, rel=1e-2)


def test_an_evenly_warm_machine_opens_its_gap_and_the_pieces_add_up_to_the_whole() -> None:
    drawn = draw_castings(SEED, True)
    s, weights = drawn.structure, tool_weights_um_per_K(drawn)
    gap_m = drawn.tool_m[2] - drawn.table_m[2]
    even = weights["z"].sum()
    assert even == pytest.approx(-1e6 * EXPANSION_PER_K * gap_m, rel=0.05)  # the spindle is of steel
    pieces = growths(s, weights, frozenset(FEATURES))
    for channel in "xyz":
        np.testing.assert_allclose(
            sum(g.weights_um_per_K for g in pieces if g.channel == channel), weights[channel], atol=1e-12
        )
    (growth,) = (g for g in pieces if g.name == "growth")
    locating_m = s.castings["front"].low_m[2] - s.castings["shaft"].low_m[2]
    ring_m = s.castings["front"].size_m[2]
    low, high = 11.5 * locating_m, 11.5 * (locating_m + ring_m)
    assert low < growth.weights_um_per_K.sum() < high  # it grows from where its front bearings hold it
    (bends,) = (g for g in pieces if g.name == "bending" and g.channel == "z")
    assert bends.weights_um_per_K.sum() == pytest.approx(0.0, abs=1e-9)
    assert bends.lumped_um_per_K < -5.0  # a warm front leans the column back and lifts the tool
    np.testing.assert_allclose(odd(s, "column", bends.weights_um_per_K, 1), bends.weights_um_per_K, atol=1e-12)
