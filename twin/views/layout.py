"""Where the bodies of a network are in a picture: strong links short, few crossings, always the same.

Distances are the shortest ways along the links (Kamada and Kawai 1989, Information Processing Letters 31, 7). The flat
picture is turned step by step, and every body takes the nearest place on a brick pattern; the turn with the shortest
links and the fewest crossings stays.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import networkx as nx
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from data.arrays import Array

CROSSING, HIDDEN = 6.0, 40.0  # what a crossing and a body on a foreign link cost, in squared pitches
HIDDEN_WITHIN = 0.45  # pitches between a link and the middle of a body that it hides
TURNS = 72
APART = 1.3  # of the longest way: bodies without a way between them
SMALL = 1e-9


def places(
    bodies: Sequence[str],
    links: Mapping[tuple[str, str], float],
    heavy: Mapping[str, float] | None = None,
    pitch: tuple[float, float] = (2.6, 1.7),
) -> dict[str, tuple[float, float]]:
    """Centres of the bodies, in the unit of `pitch` (width and height of a place), y upwards, starting at (0, 0).

    Args:
        bodies: their names, in the order of the file.
        links: conductance between two bodies, W/K.
        heavy: what weighs how much: the picture is turned so that the heavy is low.
    """
    if not bodies:
        return {}
    ends = np.array(sorted((bodies.index(a), bodies.index(b)) for a, b in links if a != b), int).reshape(-1, 2)
    slots, flat = _slots(len(bodies)), _flat(bodies, links)
    angles = 2.0 * np.pi * np.arange(TURNS) / TURNS
    turns = [flat @ np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) for a in angles]
    xy = min((slots[_assigned(turned, slots)] for turned in turns), key=lambda xy: _cost(xy, ends)) * pitch
    weighs = np.array([(heavy or {}).get(b, 0.0) for b in bodies])
    if weighs @ (xy[:, 1] - xy[:, 1].mean()) > 0:
        xy = xy * [1.0, -1.0]
    xy = xy - xy.min(axis=0)
    return {b: (float(x), float(y)) for b, (x, y) in zip(bodies, xy, strict=True)}


def _flat(bodies: Sequence[str], links: Mapping[tuple[str, str], float]) -> Array:
    """Positions (n, 2) whose distances are near the ways along the links."""
    graph = nx.Graph()
    graph.add_nodes_from(bodies)
    for (a, b), g in sorted(links.items()):
        if a != b:  # conductances span decades
            graph.add_edge(a, b, way=1.0 / (1.0 + math.log1p(max(g, 0.0))))
    ways = dict(nx.all_pairs_dijkstra_path_length(graph, weight="way"))
    longest = max(way for own in ways.values() for way in own.values()) or 1.0
    at = nx.kamada_kawai_layout(graph, dist={a: {b: ways[a].get(b, APART * longest) for b in bodies} for a in bodies})
    return np.array([at[b] for b in bodies])


def _slots(n: int) -> Array:
    """Places (s, 2) in rows of which every other is shifted by half a place; a fifth more than bodies."""
    columns = max(2, round(math.sqrt(1.05 * n * 1.25))) if n > 2 else n
    rows = max(1, math.ceil(1.15 * n / columns))
    return np.array([(c + 0.5 * (r % 2), -r) for r in range(rows) for c in range(columns)], float)


def _assigned(flat: Array, slots: Array) -> NDArray[np.intp]:
    """Each body's slot, all together as near as can be."""
    size = np.maximum(np.ptp(flat, axis=0), SMALL)
    spread = slots.min(axis=0) + (flat - flat.min(axis=0)) / size * np.ptp(slots, axis=0)
    return linear_sum_assignment(((spread[:, None] - slots[None]) ** 2).sum(axis=-1))[1]


def _cost(xy: Array, ends: NDArray[np.int64]) -> float:
    """Squared lengths of the links, crossings, and bodies on foreign links."""
    a, along = xy[ends[:, 0]], xy[ends[:, 1]] - xy[ends[:, 0]]
    squared = (along**2).sum(axis=1)
    to = xy[None] - a[:, None]
    share = np.clip((to * along[:, None]).sum(axis=-1) / np.maximum(squared, SMALL)[:, None], 0.0, 1.0)
    foreign = (np.arange(len(xy)) != ends[:, :1]) & (np.arange(len(xy)) != ends[:, 1:])
    hidden = (np.linalg.norm(to - share[..., None] * along[:, None], axis=-1) < HIDDEN_WITHIN) & foreign
    return float(squared.sum() + HIDDEN * hidden.sum() + CROSSING * crossings(xy, ends))


def crossings(xy: Array, ends: NDArray[np.int64]) -> int:
    """Number of crossing pairs of links without a common body; xy (n, 2) of the bodies, `ends` (links, 2)."""
    i, j = np.triu_indices(len(ends), 1)
    separate = ~(ends[i][:, :, None] == ends[j][:, None, :]).any(axis=(1, 2))
    one, other = xy[ends[i[separate]]], xy[ends[j[separate]]]  # (pairs, 2 ends, 2)

    def sides(line: Array, points: Array) -> Array:
        """On which side of a line both points are, as a product: below 0 if on different ones."""
        d, e = line[:, 1] - line[:, 0], points - line[:, :1]
        turn = d[:, None, 0] * e[..., 1] - d[:, None, 1] * e[..., 0]
        return np.asarray(turn[:, 0] * turn[:, 1])

    return int(((sides(one, other) < -SMALL) & (sides(other, one) < -SMALL)).sum())
