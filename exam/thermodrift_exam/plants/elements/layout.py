"""Plant A: a machine of finite elements and the influence of every node's rise on its tool."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import numpy as np
from scipy.sparse.linalg import splu

from data.arrays import Array
from thermodrift_exam.plants.elements.elasticity import Elasticity
from thermodrift_exam.plants.elements.geometry import Drawn, draw_castings
from thermodrift_exam.plants.elements.structure import Elements
from thermodrift_exam.plants.structure import Growth, Layout

FRONT, BACK = "column_front", "column_back"


def growths(s: Elements, weights_um_per_K: Mapping[str, Array], features: frozenset[str]) -> tuple[Growth, ...]:
    """All pieces together are the whole displacement, but for what the plant's features leave out.

    The response to a temperature difference between front and back of the column at the same height is its bending.
    "growth" is the shaft along z, "mandrel" the mandrel.
    """
    out: list[Growth] = []
    for channel, whole in weights_um_per_K.items():
        for casting, cells in s.cells.items():
            own = np.zeros(s.size)
            own[cells] = whole[cells]
            if casting == "column" and channel != "x":
                bends = odd(s, "column", own, axis=1)
                out.append(Growth("bending", channel, bends, (FRONT, BACK), _lumped(s, bends)))
                out.append(Growth("column", channel, own - bends))
            elif casting == "head" and channel == "x":
                bow = odd(s, "head", own, axis=0)
                rear = "head_rear" if "head_rear" in s.bodies else "head"
                out.append(Growth("bow", channel, bow, ("motor", rear), _by_the_motor(s, bow, rear)))
                out.append(Growth("head", channel, own - bow))
            else:
                name = "growth" if casting == "shaft" and channel == "z" else casting
                out.append(Growth(name, channel, own))
    chosen = {"bending", "growth", "mandrel"} - features
    return tuple(g for g in out if g.name not in chosen)


def odd(s: Elements, casting: str, weights_um_per_K: Array, axis: int) -> Array:
    """The part of the weights that changes its sign where the casting is mirrored along an axis, (N,)."""
    nodes, first = s.meshes[casting].nodes, s.cells[casting][0]
    metal = nodes >= 0
    here, there = first + nodes[metal], first + np.flip(nodes, axis)[metal]
    out = np.zeros(s.size)
    out[here] = (weights_um_per_K[here] - weights_um_per_K[there]) / 2
    return out


def _lumped(s: Elements, bends_um_per_K: Array) -> float:
    """Response to a uniform gradient through the depth of the column, per kelvin between the means of its halves."""
    mesh = s.meshes["column"]
    gradient = np.zeros(s.size)
    gradient[s.cells["column"]] = mesh.points_m[:, 1]
    return float(bends_um_per_K @ gradient / (s.bodies[FRONT].mean(gradient) - s.bodies[BACK].mean(gradient)))


def _by_the_motor(s: Elements, bow_um_per_K: Array, rear: str) -> float:
    """The sideways bow per kelvin between motor and head in the steady state of the motor's heat alone."""
    heat = np.zeros(s.size)
    s.bodies["motor"].add(heat, 1.0)
    rise = splu(s.losses()).solve(heat)
    return float(bow_um_per_K @ rise / (s.bodies["motor"].mean(rise) - s.bodies[rear].mean(rise)))


@lru_cache(maxsize=4)  # the same machine is drawn with and without an effect
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
