"""Refined twins: what the lumped network says in total stays, and only what it does not say is drawn."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from data.arrays import Array
from data.errors import WorkError
from diagnosis.structure import refined as module
from diagnosis.structure.policy import STRUCTURE
from diagnosis.structure.refined import STYLES, Cut, Style, misfits, refined
from diagnosis.structure.rows import Rows
from tests.diagnosis.small_cases import driven, four_bodies
from twin.calibration.problem import CalibrationProblem
from twin.compile import compile_network
from twin.network import Network, Outlet

MORE: dict[str, Any] = {  # a law that multiplies heat, a body that a law brings, heat by temperature, a start, a bar
    "mechanisms__grease": {"law": "viscosity_feedback", "at": {"oil": "head"}, "acts_on": "friction"},
    "mechanisms__bar": {"law": "mandrel_fixture", "at": {"seat": "spindle"}, "acts_on": "z"},
    "mechanisms__walls": {"law": "radiation", "at": {"body": "bed", "surrounding": "room"}, "into": "bed"},
    "mechanisms__rest": {"law": "initial_state", "into": "bed", "parameters": {"excess": "2 K"}},
    "bodies__column": {"capacity": "60 kJ/K", "shape": "bar", "cells": 3, "conductance": "30 W/K",
                       "material": "cast_iron"},
}  # fmt: skip
STIFF, SOFT = (1e-4, 1e-4), (5.0, 5.0)
STYLE_NAMES: tuple[Style, ...] = ("chain", "web")


def lumped() -> Network:
    return compile_network(four_bodies(**MORE))


def cut(style: Style, seed: int = 0, biot: tuple[float, float] = (0.1, 1.0)) -> tuple[Network, Network, Cut]:
    network = lumped()
    finer, how = refined(network, network.values, style, biot, np.random.default_rng(seed))
    return network, finer, how


def by_cell(how: Cut, weights: Array) -> Array:
    """Weights (..., M) of pieces added up by the cells (..., N) that they belong to."""
    out = np.zeros((*weights.shape[:-1], len(how.pieces)))
    for piece, k in enumerate(how.parent):
        out[..., k] += weights[..., piece]
    return out


both_styles = pytest.mark.parametrize("style", STYLE_NAMES)


@both_styles
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_capacities_joints_films_and_shares_add_up_to_the_lumps(style: Style, seed: int) -> None:
    network, finer, how = cut(style, seed)
    values = network.values
    np.testing.assert_allclose(by_cell(how, finer.capacity_J_per_K(values)), network.capacity_J_per_K(values))
    # what joins pieces of one body cancels when they are added up: the rest are the lump's links and films
    whole = by_cell(how, by_cell(how, finer.conductance_W_per_K(values)).T)
    np.testing.assert_allclose(whole, network.conductance_W_per_K(values), atol=1e-9)
    films = by_cell(how, finer.surrounding_W_per_K(values))
    np.testing.assert_allclose(films, network.surrounding_W_per_K(values), atol=1e-12)
    for before, after in zip(network.heats, finer.heats, strict=True):
        np.testing.assert_allclose(by_cell(how, after.direction(values)), before.direction(values), atol=1e-12)
    for before_, after_ in zip(network.errors, finer.errors, strict=True):
        np.testing.assert_allclose(by_cell(how, after_.matrix(values)), before_.matrix(values), atol=1e-12)
    for sensor, finer_sensor in zip(network.readings, finer.readings, strict=True):
        np.testing.assert_allclose(by_cell(how, finer_sensor.cells), sensor.cells)
    for (_, before_at), (_, after_at) in zip(network.starts, finer.starts, strict=True):
        np.testing.assert_array_equal(after_at, before_at[how.parent])  # every piece starts as its body does
    ports = [p for h in finer.heats for law in (h.law, *h.factors) for p in law.ports.values() if p.cells is not None]
    assert ports and all(p.cells is not None and p.cells.sum() == pytest.approx(1.0) for p in ports)


@both_styles
def test_every_lump_that_exchanges_heat_is_cut_and_a_bar_stays(style: Style) -> None:
    network, finer, how = cut(style)
    low, high = STRUCTURE.refined_cells
    for name, cells in network.bodies.items():
        count = len(finer.bodies[name])
        assert count == 3 if name == "column" else low <= count <= high, name
        assert set(how.parent[finer.bodies[name]]) == set(cells.tolist())
    assert finer.parameters is network.parameters
    assert sorted(np.concatenate(list(finer.bodies.values()))) == list(range(finer.n_cells))
    joints = {e.name: np.count_nonzero(e.direction) for e in finer.edges if e.surrounding is None}
    assert joints["spindle-head"] == 2  # a link touches one piece of either body, a film all of its own
    film = [e for e in finer.edges if e.name == "bed-room"]
    assert len(film) == len(finer.bodies["bed"]) and all(np.count_nonzero(e.direction) == 1 for e in film)
    assert all(np.count_nonzero(r.cells) == 1 for r in finer.readings if r.channel != "t_column")


@both_styles
def test_all_pieces_of_a_body_hang_together(style: Style) -> None:
    for cells in range(2, 8):
        pairs = STYLES[style](cells, np.random.default_rng(cells))
        joined = np.eye(cells)
        for a, b in pairs:
            assert 0 <= a < b < cells
            joined[a, b] = joined[b, a] = 1.0
        assert (np.linalg.matrix_power(joined, cells) > 0).all()


def problem() -> tuple[CalibrationProblem, list[Array]]:
    known = four_bodies()
    batches = driven(known, 2, hours=4.0)
    for b in batches:
        for name in ("t_spindle", "t_head", "t_bed"):
            b.table[name] = b.table["room"]
    posed = CalibrationProblem.of(compile_network(known), batches)
    return posed, [np.zeros(q) for q in posed.nuisance_sizes]


def drawn(style: Style = "chain", biot: tuple[float, float] = SOFT, machines: int = 3, seed: int = 0) -> Array:
    posed, nuisance = problem()
    return misfits(posed, posed.network.values, nuisance, style, biot, machines, seed)


def rms(draws: Array) -> float:
    return float(np.sqrt(np.mean(draws**2)))


@both_styles
def test_a_block_that_conducts_well_inside_shows_what_the_lump_shows(style: Style) -> None:
    """With a Biot number near 0 the pieces have one temperature, wherever heat enters and sensors stand."""
    assert rms(drawn(style, STIFF)) < 0.02 < 1.0 < rms(drawn(style, SOFT))  # of the noise
    middle = [rms(drawn(style, (b, b))) for b in (0.01, 0.1, 1.0)]
    assert middle == sorted(middle)


def test_a_seed_draws_the_same_machines_and_styles_differ() -> None:
    one = drawn(machines=3, seed=4)
    np.testing.assert_array_equal(one, drawn(machines=3, seed=4))
    np.testing.assert_array_equal(one[:, :2], drawn(machines=2, seed=4))  # how many there are changes none of them
    alike = [abs(np.corrcoef(a, b)[0, 1]) for a in one.T for b in one.T if a is not b]
    assert min(alike) < 0.9
    assert not np.allclose(one, drawn(machines=3, seed=5))
    assert not np.allclose(one, drawn("web", machines=3, seed=4))


def test_rows_are_those_of_the_problem_and_a_machine_that_fails_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    posed, _ = problem()
    every = drawn(machines=3)
    assert every.shape == (Rows.of(posed).n, 3)
    real, calls = module._shown, []

    def failing(network: Network, *given: Any) -> Array:
        calls.append(network)
        if len(calls) == 3:  # the lump comes first
            raise WorkError("stiff beyond the step control")
        return real(network, *given)

    monkeypatch.setattr(module, "_shown", failing)
    np.testing.assert_array_equal(drawn(machines=3), every[:, [0, 2]])
    monkeypatch.setattr(module, "_shown", lambda network, *given: real(network, *given) + np.nan)
    assert drawn(machines=3).shape == (Rows.of(posed).n, 0)


def test_heat_taken_from_a_body_is_taken_from_its_pieces() -> None:
    network = lumped()
    heat = network.heats[0]
    cells = np.eye(network.n_cells)
    how = Cut.drawn(network, np.random.default_rng(0))
    into, out = int(network.bodies["head"][0]), int(network.bodies["bed"][0])
    taking = module.replace(heat, outlets=(Outlet(cells[into]),), taken=cells[out])
    finer = module._on_pieces(module.replace(network, heats=(taking,)), how, [])
    direction = finer.heats[0].direction(network.values)
    assert direction.sum() == pytest.approx(0.0)
    assert (np.flatnonzero(direction < 0) == finer.bodies["bed"]).all()
    assert (np.flatnonzero(direction > 0) == finer.bodies["head"]).all()
