"""Everyday physics of a plant: what it is by hand, that it makes no heat of its own, and the order of the steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.plants.plant_cases import SEED, full_speed, plant
from thermodrift_exam.plants.everyday import (
    EVERYDAY,
    SLICES,
    Films,
    Joints,
    Nut,
    contact_factor,
    everyday,
    radiation_factor,
    rising_factor,
)
from thermodrift_exam.plants.options import Options, stream
from thermodrift_exam.plants.plant import draw
from thermodrift_exam.plants.runs import plan_runs
from thermodrift_exam.plants.simulation import simulated
from thermodrift_exam.plants.volumes.structure import Volumes
from twin.compile import compile_network


def test_air_rises_faster_by_the_root_that_mcadams_gives() -> None:
    """In still air eight times the excess exchanges twice as well where turbulent, 8^(1/4) where laminar."""
    assert rising_factor(np.array([40.0]), 1 / 3, 5.0, 0.0) == pytest.approx(2.0)
    assert rising_factor(np.array([-40.0]), 0.25, 5.0, 0.0) == pytest.approx(8**0.25)
    assert rising_factor(np.array([5.0]), 0.3, 5.0, 1.5) == pytest.approx(1.0)
    assert 0.5 < rising_factor(np.array([0.0]), 0.3, 5.0, 1.5)[0] < 1.0


def test_radiation_is_the_difference_of_fourth_powers() -> None:
    """313.15⁴ - 283.15⁴ = 3.189e9 over 30 K and 4 · 293.15³ = 1.0077e8."""
    assert radiation_factor(np.array([40.0]), np.array([10.0])) == pytest.approx(3.1890e9 / 30 / 1.00771e8, rel=1e-3)
    assert radiation_factor(np.array([20.0]), np.array([20.0])) == pytest.approx(1.0)


def test_a_joint_conducts_with_the_power_of_its_pressure_beside_its_gap() -> None:
    assert contact_factor(np.array([10.0]), 0.4, 0.02) == pytest.approx(0.4 + 0.6 * 1.2**0.95)
    assert contact_factor(np.zeros(1), 0.4, 0.02) == pytest.approx(1.0)
    assert contact_factor(np.array([-1e3]), 0.4, 0.02) > 0.4


@pytest.mark.parametrize("seed", [3, 4])
def test_only_the_nut_makes_heat(seed: int) -> None:
    """Films and joints move it: what leaves the castings inside an enclosure is in its air, and joints add nothing."""
    p = plant(seed, "feed", "motor_loss")
    warm = 20.0 + 15.0 * stream(1, "cells").random((p.structure.size, 1))
    now = full_speed(p)
    heat = np.zeros_like(warm)
    Joints(p, 1.0, stream(seed, "joints")).add_heat_W(heat, warm, now)
    assert np.abs(heat).max() > 0.1
    assert heat.sum() == pytest.approx(0.0, abs=1e-9)
    films = Films(p, 1.0, stream(seed, "films"))
    films.to_room[:] = 0.0
    heat[:] = 0.0
    films.add_heat_W(heat, warm, now)
    assert heat.sum() == pytest.approx(0.0, abs=1e-9)
    assert (np.abs(heat).max() > 0.1) == (p.structure.air_cell is not None)


def test_even_temperature_moves_no_heat() -> None:
    p = plant(SEED, "feed")
    for piece in everyday(p, SEED):
        heat = np.zeros((p.structure.size, 1))
        piece.add_heat_W(heat, np.full(heat.shape, 20.0), full_speed(p))
        assert np.abs(heat).max() < 1e-12, piece.key


def test_the_nut_heats_the_screw_where_the_axis_works() -> None:
    """2π 0.3 N m · 800 per minute = 25 W; the middle of the warm stretch is where the strokes are."""
    p = plant(4, "feed")
    nut = Nut(p, 1.0, stream(4, "nut"))
    nut.moment_Nm = 0.3
    middles = (np.arange(SLICES) + 0.5) / SLICES
    places = []
    for hour in np.linspace(0.0, 24.0 / nut.rounds, 9):
        now = replace(full_speed(p), feed_mm_per_min=np.full(1, 8000.0), clock_h=np.full(1, hour))
        heat = np.zeros((p.structure.size, 1))
        nut.add_heat_W(heat, np.zeros_like(heat), now)
        assert heat.sum() == pytest.approx(2 * np.pi * 0.3 * 800 / 60)
        assert set(np.flatnonzero(heat)) <= set(p.structure.cells["screw"])
        wanted = nut.middle + nut.travel * np.sin(2 * np.pi * nut.rounds * hour / 24)
        places.append(float(middles @ nut.shares(now)[:, 0]))
        assert places[-1] == pytest.approx(wanted, abs=0.03)
    assert np.ptp(places) == pytest.approx(2 * nut.travel, abs=0.06)
    resting = replace(full_speed(p), feed_mm_per_min=np.zeros(1))
    assert nut.power_W(resting) == 0


def test_a_plant_without_screw_or_feed_has_no_nut() -> None:
    for seed in range(8):
        p = plant(seed)
        has = {piece.key for piece in everyday(p, seed)}
        assert ("nut" in has) == ("screw" in p.structure.castings and "feed" in p.features)
        assert {"films", "joints"} <= has <= {kind.key for kind in EVERYDAY}


@pytest.mark.parametrize("seed", [3, pytest.param(4, marks=pytest.mark.slow)])
def test_the_steps_keep_their_second_order(seed: int) -> None:
    """Against a step of 5 s: half the step, a quarter of the error; a sensor could not see it."""
    p = plant(seed, "feed")
    runs = plan_runs(seed, Options(batches=2, hours=2.0), p.rated_rpm)
    pieces = everyday(p, seed)
    steps_s = np.array([60.0, 30.0, 20.0, 10.0])
    exact = simulated(p, runs, pieces, 5.0, before_h=2.0).cells_degC
    off = [simulated(p, runs, pieces, s, before_h=2.0).cells_degC - exact[:: round(s / 5.0)] for s in steps_s]
    rms = [float(np.sqrt(np.mean(d**2))) for d in off]
    assert np.abs(off[2]).max() < 0.02
    assert 1.8 < np.polyfit(np.log(steps_s), np.log(rms), 1)[0] < 2.6


def test_it_is_moderate() -> None:
    """What the films and joints change is a small part of how far a machine warms."""
    p = plant(SEED, "feed")
    runs = plan_runs(SEED, Options(batches=3, hours=4.0), p.rated_rpm)
    plain = simulated(p, runs, [], 30.0).cells_degC
    pieces = [e for e in everyday(p, SEED) if e.key != "nut"]
    changed = simulated(p, runs, pieces, 30.0).cells_degC
    share = np.sqrt(np.mean((changed - plain) ** 2)) / np.sqrt(np.mean((plain - plain[:1]) ** 2))
    assert 0.003 < share < 0.15


def test_a_case_has_it_where_it_is_asked_for_and_the_file_states_the_nut() -> None:
    brief = {"batches": 2, "hours": 1.0, "before_h": 1.0, "solver_s": 50.0, "has": ("feed",), "file_error": 0.0}
    plain, daily = (draw(SEED, "sun", everyday=asked, **brief) for asked in (False, True))
    assert plain.truth == daily.truth, "it is never an answer"
    assert not plain.batches[0].table.equals(daily.batches[0].table)
    assert plain.machine.twin is not None and daily.machine.twin is not None
    assert set(daily.machine.twin["mechanisms"]) - set(plain.machine.twin["mechanisms"]) == {"nut"}
    (moment,) = (piece.moment_Nm for piece in everyday(plant(SEED, "feed"), SEED) if isinstance(piece, Nut))
    nut = daily.machine.twin["mechanisms"]["nut"]
    assert nut["parameters"]["moment"]["value"] == f"{moment:.4g} N*m" and nut["into"] == "screw"
    assert "nut" in [h.law.name for h in compile_network(daily.machine).heats]


def test_a_bearing_tightens_by_its_shafts_lead_and_a_joint_by_its_own_warmth() -> None:
    """Shaft at 40 degC, all else at 30: the front bearing passes G0 (f - 1) 10 K more, f by hand; others nothing."""
    p = plant(SEED, "feed")
    s, joints = p.structure, Joints(p, 1.0, stream(SEED, "joints"))
    assert isinstance(s, Volumes)
    cells = np.full((s.size, 1), 30.0)
    cells[s.cells["shaft"]] = 40.0
    heat = np.zeros_like(cells)
    joints.add_heat_W(heat, cells, full_speed(p))
    casting = {int(c): name for name, own in s.cells.items() for c in own}
    at = [k for k, (i, j) in enumerate(zip(s.one, s.other, strict=True))
          if (casting[int(i)], casting.get(int(j))) == ("shaft", "front")]  # fmt: skip
    order = sorted({(list(s.cells).index(a), list(s.cells).index(b)) for a, b in _touching(s, casting)})
    row = order.index((list(s.cells).index("shaft"), list(s.cells).index("front")))
    gap, per_K = joints.gap[row, 0], joints.per_K[row, 0]
    more = gap + (1 - gap) * (1 + 10 * per_K) ** 0.95 - 1
    assert heat[s.cells["front"]].sum() == pytest.approx(s.between_W_per_K[at].sum() * more * 10.0)
    assert 0.005 <= per_K <= 0.02
    assert np.abs(heat[s.cells["column"]]).max() == 0


def _touching(s: Volumes, casting: dict[int, str]) -> set[tuple[str, str]]:
    pairs = zip(s.one, s.other, s.surfaces, strict=True)
    named = [(casting[int(i)], casting[int(j)]) for i, j, air in pairs if not air]
    return {(a, b) for a, b in named if a != b}
