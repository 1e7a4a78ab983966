"""Plant A: a machine of finite elements and what every node's rise does to its tool."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from twin.plants.casting import Array
from twin.plants.elements.elasticity import Elasticity
from twin.plants.elements.geometry import Drawn, draw_castings
from twin.plants.elements.growth import growths
from twin.plants.machine import Layout


@lru_cache(maxsize=4)  # the same machine is asked for with and without an effect
def draw_layout(seed: int, features: frozenset[str], spread: float = 1.0, finer: int = 1) -> Layout:
    """The castings of a seed, cut into hexahedra, with or without a test mandrel; `finer` times along each axis."""
    drawn = draw_castings(seed, "mandrel" in features, finer, spread)
    return Layout(drawn.structure, growths(drawn.structure, tool_weights_um_per_K(drawn), features))


def tool_weights_um_per_K(drawn: Drawn) -> dict[str, Array]:
    """Channel -> error of a kelvin at each node, (N,): x sideways, y away from the column, z + closes the gap."""
    s = drawn.structure
    machine = Elasticity(s.meshes, drawn.contacts, "bed")
    end = "mandrel" if "mandrel" in s.castings else "shaft"
    away = machine.weights_um_per_K((end, drawn.tool_m), ("table", drawn.table_m))
    signed = away * np.array([1.0, 1.0, -1.0])[:, None]
    return dict(zip("xyz", np.pad(signed, ((0, 0), (0, s.size - signed.shape[1]))), strict=True))
