"""Links, exposures and conduction inside bodies as edges between cells."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from data.errors import closest
from twin.compiling.parameters import AREA, COEFFICIENT, CONDUCTANCE, LENGTH
from twin.compiling.scope import Scope
from twin.network import Edge
from twin.quantity import Monomial, Value

Array = NDArray[np.float64]


def inside(scope: Scope, name: str) -> list[Edge]:
    """Conduction between neighbouring cells of a bar or a plate."""
    nx, ny = scope.cells.shape[name]
    if nx * ny == 1:
        return []
    along, across = scope.table.inside(name, scope.part.bodies[name])
    number = scope.cells.of[name].reshape(nx, ny)
    edges = []
    for a, b, g in (
        (number[:-1], number[1:], along.times(nx / ny)),
        (number[:, :-1], number[:, 1:], across.times(ny / nx)),
    ):
        edges += [
            Edge(name, _from_to(scope, i, j), g) for i, j in zip(a.ravel().tolist(), b.ravel().tolist(), strict=True)
        ]
    return edges


def _from_to(scope: Scope, i: int, j: int) -> Array:
    d = np.zeros(len(scope.cells))
    d[i], d[j] = 1.0, -1.0
    return d


def link(scope: Scope, name: str) -> list[Edge]:
    link, key = scope.part.links[name], f"links.{name}"
    ends = [scope.cells.weights(p, f"{key}.between") for p in link.between]
    if np.array_equal(ends[0], ends[1]):
        raise ValueError(f"{key}.between: both ends are {link.between[0]!r}; link two different places")
    given = {k for k in ("conductance", "coefficient", "length") if getattr(link, k) is not None}
    if given == {"conductance"}:
        g = scope.table.one(f"{key}.conductance", CONDUCTANCE, link.conductance)
    elif given == {"coefficient"}:
        g = _joint(scope, key, link.area, link.coefficient)
    elif given == {"length"}:
        k = scope.table.material(link.material, "conductivity", f"{key}.material")
        area = scope.table.add(f"{key}.area", AREA, link.area)
        g = Monomial(1.0, ((k, 1.0), (area, 1.0), (scope.table.add(f"{key}.length", LENGTH, link.length), -1.0)))
    else:
        raise ValueError(f"{key}: give one of conductance, area with coefficient, or length with area and material")
    return [Edge(name, ends[0] - ends[1], g)]


def _joint(scope: Scope, key: str, area: Value | None, coefficient: Value | None) -> Monomial:
    return scope.table.product((f"{key}.area", AREA, area, 1.0), (f"{key}.coefficient", COEFFICIENT, coefficient, 1.0))


def exposure(scope: Scope, name: str) -> list[Edge]:
    given, key = scope.part.exposures[name], f"exposures.{name}"
    if given.conductance is not None:
        g = scope.table.one(f"{key}.conductance", CONDUCTANCE, given.conductance)
    else:
        g = _joint(scope, key, given.area, given.coefficient)
    body = scope.cells.body_of(given.of, f"{key}.of")
    if "@" in given.of:
        places, g = [scope.cells.weights(given.of, f"{key}.of")], g
    else:
        places = [np.eye(len(scope.cells))[i] for i in scope.cells.of[body]]
        g = g.times(1.0 / len(places))
    if given.to in scope.surroundings:
        return [Edge(name, w, g, surrounding=scope.surroundings[given.to]) for w in places]
    if given.to not in scope.part.bodies:
        raise ValueError(
            f"{key}.to: no surrounding {given.to!r}; {closest(given.to, [*scope.surroundings, *scope.part.bodies])}"
        )
    other = scope.cells.weights(given.to, f"{key}.to")
    return [Edge(name, w - other, g) for w in places]
