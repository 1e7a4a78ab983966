"""Where the bodies of a network stand in a picture: strong links short, no crossings, always the same.

Distances follow the resistance between bodies (Klein and Randić 1993), flattened by stress majorisation (Gansner, Koren
and North 2004); then every body takes a place on a brick pattern and a search without chance removes crossings.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array

Ints = NDArray[np.int64]

_CROSSING, _HIDDEN, _STEEP = 6.0, 14.0, 1.0  # what a crossing, a body on a foreign link, a steep link cost, in pitches
_SWEEPS, _TURNS, _TRIES = 40, 12, 20
_NEAR_IN = 0.62  # a link must pass a foreign body at this distance, in pitches of height
_SMALL = 1e-9


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
        heavy: what weighs how much: the picture is turned so that the heavy stands low.
    """
    n = len(bodies)
    if n == 0:
        return {}
    number = {b: i for i, b in enumerate(bodies)}
    apart = {(number[a], number[b]): float(g) for (a, b), g in links.items() if a != b}
    xy = np.array(_placed(n, tuple(apart.items()), pitch))
    weighs = np.array([(heavy or {}).get(b, 0.0) for b in bodies])
    if weighs @ (xy[:, 1] - xy[:, 1].mean()) > 0:
        xy = xy * [1.0, -1.0]
    xy = xy - xy.min(axis=0)
    return {b: (float(xy[i, 0]), float(xy[i, 1])) for b, i in number.items()}


@lru_cache(maxsize=16)
def _placed(
    n: int, links: tuple[tuple[tuple[int, int], float], ...], pitch: tuple[float, float]
) -> tuple[tuple[float, ...], ...]:
    """The cheapest places found, kept: pictures of one network at several moments share them."""
    ends = np.array([pair for pair, _ in links], dtype=np.int64).reshape(-1, 2)
    strength = np.array([g for _, g in links], dtype=float)
    flat = flattened(resistance_distance(n, ends, strength))
    slots = _slots(n, pitch)
    weight = _weights(strength)
    best, least = np.zeros(n, np.int64), math.inf
    for turned in _turns(flat):
        at, cost = _search(_assigned(turned, slots), slots, ends, weight, pitch)
        if cost < least - _SMALL:
            best, least = at, cost
    return tuple(tuple(map(float, p)) for p in slots[best])


def resistance_distance(n: int, ends: Ints, conductance: Array) -> Array:
    """Root of the effective resistance (n, n) between all bodies, K/W to ½; parts without a link are far apart.

    Args:
        ends: numbers (m, 2) of the two bodies of every link.
        conductance: of every link (m,), W/K.
    """
    laplacian = np.zeros((n, n))
    # links span decades: their logarithm keeps a weak one from throwing its body out of the picture
    g = 1.0 + np.log1p(np.maximum(conductance, 0.0))
    for (i, j), w in zip(ends, g, strict=True):
        laplacian[i, i] += w
        laplacian[j, j] += w
        laplacian[i, j] -= w
        laplacian[j, i] -= w
    weak = 0.02 * (g.min() if len(g) else 1.0)
    laplacian += weak * (np.eye(n) - 1.0 / n)
    inverse = np.linalg.pinv(laplacian)
    own = np.diag(inverse)
    return np.asarray(np.sqrt(np.maximum(own[:, None] + own[None, :] - 2 * inverse, 0.0)))


def flattened(distance: Array, steps: int = 200) -> Array:
    """Positions (n, 2) whose distances are near `distance` (n, n): majorised stress with weights 1/d², mean zero."""
    n = len(distance)
    if n < 3:
        return np.column_stack([np.arange(n) - (n - 1) / 2.0, np.zeros(n)])
    mean = distance**2 - (distance**2).mean(axis=0)
    _, vector = np.linalg.eigh(-0.5 * (mean - mean.mean(axis=1, keepdims=True)))
    xy = vector[:, [-1, -2]]
    xy = xy * np.sign(xy[np.abs(xy).argmax(axis=0), [0, 1]])  # an eigenvector's sign is chance
    xy = xy / xy.std(axis=0) * distance.mean()
    away = distance + np.eye(n)
    weight = away**-2 * (1 - np.eye(n))
    inverse = np.linalg.pinv(np.diag(weight.sum(axis=1)) - weight)
    for _ in range(steps):
        apart = np.linalg.norm(xy[:, None] - xy[None], axis=-1) + np.eye(n)
        pull = -weight * distance / np.maximum(apart, _SMALL)
        np.fill_diagonal(pull, 0.0)
        np.fill_diagonal(pull, -pull.sum(axis=1))
        xy = inverse @ (pull @ xy)
    return np.asarray(xy - xy.mean(axis=0))


def _slots(n: int, pitch: tuple[float, float]) -> Array:
    """Places (s, 2) in rows of which every other is shifted by half a place; a fifth more than bodies."""
    columns = max(2, round(math.sqrt(1.05 * n * 1.25))) if n > 2 else n
    rows = max(1, math.ceil(1.15 * n / columns))
    at = [(c + 0.5 * (r % 2), -r) for r in range(rows) for c in range(columns)]
    return np.array(at, dtype=float) * pitch


def _turns(flat: Array) -> list[Array]:
    """The flat positions turned by every part of half a turn; a mirrored picture costs the same."""
    out = []
    turns = max(2, round(_TURNS * min(1.0, 14 / len(flat)) ** 2))  # many bodies cost much: fewer beginnings
    for k in range(turns):
        c, s = math.cos(k * math.pi / turns), math.sin(k * math.pi / turns)
        out.append(flat @ np.array([[c, -s], [s, c]]))
    return out


def _assigned(flat: Array, slots: Array) -> Ints:
    """Each body's slot, all together as near as can be."""
    from scipy.optimize import linear_sum_assignment

    size = np.maximum(np.ptp(flat, axis=0), _SMALL)
    low, high = slots.min(axis=0), slots.max(axis=0)
    spread = low + (flat - flat.min(axis=0)) / size * (high - low)
    _, at = linear_sum_assignment(((spread[:, None] - slots[None]) ** 2).sum(axis=-1))
    return np.asarray(at, dtype=np.int64)


def _weights(strength: Array) -> Array:
    g = np.log1p(np.maximum(strength, 0.0))
    return np.asarray(0.4 + g / max(float(g.max(initial=0.0)), _SMALL))


def _search(at: Ints, slots: Array, ends: Ints, weight: Array, pitch: tuple[float, float]) -> tuple[Ints, float]:
    """Move each body in turn to the slot (or swap) that costs least, until nothing improves."""
    cost = float(_cost(slots[at][None], ends, weight, pitch)[0])
    for _ in range(_SWEEPS):
        before = cost
        for i in range(len(at)):
            near = _near(i, at, slots, ends)
            tries = np.repeat(at[None], len(near), axis=0)
            for k, s in enumerate(near):
                tries[k, at == s] = at[i]
                tries[k, i] = s
            costs = _cost(slots[tries], ends, weight, pitch)
            k = int(np.argmin(costs))
            if costs[k] < cost - 1e-6:
                at, cost = tries[k], float(costs[k])
        if cost > before - 1e-6:
            break
    return at, cost


def _near(i: int, at: Ints, slots: Array, ends: Ints) -> Ints:
    """The slots worth a try for body i: all of a small picture, else those nearest to what it is linked with."""
    if len(slots) <= _TRIES:
        return np.arange(len(slots))
    linked = np.concatenate([ends[ends[:, 0] == i, 1], ends[ends[:, 1] == i, 0]])
    middle = slots[at[linked if len(linked) else [i]]].mean(axis=0)
    return np.argsort(np.linalg.norm(slots - middle, axis=1), kind="stable")[:_TRIES]


def _cost(xy: Array, ends: Ints, weight: Array, pitch: tuple[float, float]) -> Array:
    """Of layouts (K, n, 2): weighted lengths, crossings, links over foreign bodies, steep links; shape (K,)."""
    xy = xy / np.asarray(pitch)
    a, b = xy[:, ends[:, 0]], xy[:, ends[:, 1]]
    along = b - a
    length = np.linalg.norm(along, axis=-1)
    out = (weight * length**2).sum(axis=-1) + 0.02 * ((xy - xy.mean(axis=1, keepdims=True)) ** 2).sum(axis=(1, 2))
    out = out + _STEEP * (np.abs(along[..., 0]) < 0.25).sum(axis=-1)
    out = out + _HIDDEN * _hidden(xy, a, along, length, ends) + _CROSSING * crossings(a, b, ends)
    return np.asarray(out)


def _hidden(xy: Array, a: Array, along: Array, length: Array, ends: Ints) -> Array:
    """How many bodies stand on a link of others, (K,)."""
    to = xy[:, None] - a[:, :, None]  # (K, m, n, 2)
    share = (to * along[:, :, None]).sum(axis=-1) / np.maximum(length, _SMALL)[..., None] ** 2
    off = np.linalg.norm(to - np.clip(share, 0, 1)[..., None] * along[:, :, None], axis=-1)
    own = (np.arange(xy.shape[1]) == ends[:, :1]) | (np.arange(xy.shape[1]) == ends[:, 1:])
    return np.asarray(((off < _NEAR_IN) & ~own).sum(axis=(1, 2)))


def crossings(a: Array, b: Array, ends: Ints) -> Array:
    """How many pairs of links without a common body cross, (K,)."""
    i, j = np.triu_indices(len(ends), 1)
    apart = ~(ends[i][:, :, None] == ends[j][:, None, :]).any(axis=(1, 2))
    i, j = i[apart], j[apart]

    def side(p: Array, q: Array, r: Array) -> Array:
        d, e = q - p, r - p
        return np.asarray(d[..., 0] * e[..., 1] - d[..., 1] * e[..., 0])

    cross = (side(a[:, i], b[:, i], a[:, j]) * side(a[:, i], b[:, i], b[:, j]) < -_SMALL) & (
        side(a[:, j], b[:, j], a[:, i]) * side(a[:, j], b[:, j], b[:, i]) < -_SMALL
    )
    return np.asarray(cross.sum(axis=-1))
