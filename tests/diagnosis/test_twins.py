"""Refined twins: chains of cells with webs, which any drawn network can be compiled with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from diagnosis.fitting import twins
from diagnosis.fitting.twins import Dice, refined
from tests.diagnosis.small_cases import DRIFT, consistent, four_bodies
from twin.compile import compile_network
from twin.schema import twin_part


def test_a_web_joins_two_different_cells_of_its_body_and_every_drawn_network_compiles() -> None:
    known = four_bodies()
    part, network = twin_part(known), compile_network(four_bodies())
    webs = 0
    for seed in range(30):
        drawn, cut = refined(part, network, network.values, Dice(seed, 0))
        for key, link in drawn.links.items():
            if not key.startswith("web_"):
                continue
            (body, one), (other_body, other) = (place.split("@") for place in link.between)
            cells = int(drawn.bodies[body].cells)  # type: ignore[arg-type]
            assert body == other_body and body in cut
            assert int(float(one) * cells) != int(float(other) * cells)
            webs += 1
        finer = compile_network(known, part=drawn)
        assert finer.n_cells > network.n_cells
    assert webs > 100


def test_machines_that_differ_by_an_effect_are_refined_alike_in_all_else() -> None:
    known = [four_bodies(), four_bodies(mechanisms__drift=DRIFT)]
    networks = [compile_network(m) for m in known]
    (one, cut), (other, other_cut) = (
        refined(twin_part(m), n, n.values, Dice(3, 7)) for m, n in zip(known, networks, strict=True)
    )
    assert cut == other_cut and one.bodies == other.bodies and one.links == other.links
    assert one.sensors == other.sensors and one.errors == other.errors
    assert one.mechanisms == {k: v for k, v in other.mechanisms.items() if k != "drift"}
    next_one, _ = refined(twin_part(known[0]), networks[0], networks[0].values, Dice(3, 8))
    assert next_one.links != one.links and next_one.bodies != one.bodies


def test_a_draw_that_runs_away_is_drawn_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    at = consistent()
    rows = [len(m.row) for m in at.problem.measured]
    sizes = iter([1.0, 1e9, np.nan, 2.0, 3.0])
    monkeypatch.setattr(twins, "_misfit", lambda *_: [np.full((n, 2), size) for size in [next(sizes)] for n in rows])
    z = np.zeros_like(at.z)
    drawn, timing = twins.drawn_misfits(at.machine, at.part, at.batches, at.problem, z, z + 1.0, draws=3, seed=0)
    for own in (*drawn, *timing):
        assert (own == [1.0, 2.0, 3.0]).all()
    assert [own.shape for own in drawn] == [own.shape for own in timing] == [(n, 3) for n in rows]


def test_a_driver_changes_at_most_half_a_row_sooner_or_later_in_each_twin_by_its_own() -> None:
    at = consistent()
    inputs, _ = at.problem.inputs_at([np.zeros(q) for q in at.problem.nuisance_sizes])
    step = replace(inputs, drivers={"rpm": np.array([[0.0, 0.0, 6.0, 6.0]]), "feed": np.full((1, 4), 2.0)})
    drawn = [twins._timed(step, Dice(3, k)).drivers for k in range(200)]
    moved = np.array([d["rpm"][0] for d in drawn])
    assert all((d["feed"] == 2.0).all() for d in drawn)
    assert (moved[:, [0, 3]] == [0.0, 6.0]).all()
    sooner, later = moved[:, 1] / 6.0, 1.0 - moved[:, 2] / 6.0  # in rows
    assert ((sooner == 0.0) | (later == 0.0)).all()
    assert 0.45 < sooner.max() <= 0.5 and 0.45 < later.max() <= 0.5
    assert step.drivers["rpm"].tolist() == [[0.0, 0.0, 6.0, 6.0]]
