"""Refined twins: chains of cells with webs, which any drawn network can be compiled with."""

from __future__ import annotations

import numpy as np

from diagnosis.fitting.twins import refined
from tests.diagnosis.small_cases import four_bodies
from twin.compile import compile_network
from twin.schema import twin_part


def test_a_web_joins_two_different_cells_of_its_body_and_every_drawn_network_compiles() -> None:
    known = four_bodies()
    part, network = twin_part(known), compile_network(four_bodies())
    webs = 0
    for seed in range(30):
        drawn, cut = refined(part, network, network.values, np.random.default_rng(seed))
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
