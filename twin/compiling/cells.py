"""Discretisation of bodies into cells, and places as weights over all cells."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.errors import closest
from data.machine import Machine
from twin.compiling.parameters import AREA, COEFFICIENT, CONDUCTANCE, LENGTH, ParameterTable
from twin.network import Edge, Law
from twin.quantity import Monomial, Value, convert
from twin.schema import Body, TwinPart


class Cells:
    """The cells of all bodies in the file's order: names, which belong to a body, and what a place means.

    A place is a body, meaning all of it evenly, or a point "column@0.8" (0 to 1 along a bar) or "table@0.3,0.7" (of a
    plate), interpolated between the nearest cell centres so that refining a body moves nothing by a jump.
    """

    def __init__(self, bodies: Mapping[str, Body]) -> None:
        self.shape: dict[str, tuple[int, int]] = {}
        self.of: dict[str, NDArray[np.int64]] = {}
        names: list[str] = []
        for name, body in bodies.items():
            nx, ny = grid(name, body)
            self.shape[name] = (nx, ny)
            self.of[name] = np.arange(len(names), len(names) + nx * ny)
            names += [name] if nx * ny == 1 else [f"{name}[{i}]" for i in range(nx * ny)]
        self.names = tuple(names)

    def __len__(self) -> int:
        return len(self.names)

    def body_of(self, place: str, key: str) -> str:
        """The body that a place lies in.

        Raises:
            ValueError: no such body, with the closest.
        """
        body = place.partition("@")[0]
        if body not in self.of:
            raise ValueError(f"{key}: no body {body!r}; {closest(body, self.of)}")
        return body

    def weights(self, place: str, key: str) -> Array:
        """Weights (N,) over all cells, sum 1.

        Raises:
            ValueError: no such body, or a position outside 0..1 or of the wrong number of coordinates.
        """
        body, _, position = place.partition("@")
        self.body_of(place, key)
        nx, ny = self.shape[body]
        out = np.zeros(len(self))
        if not position:
            out[self.of[body]] = 1.0 / (nx * ny)
            return out
        try:
            at = [float(p) for p in position.split(",")]
        except ValueError:
            at = [-1.0]
        if len(at) > 2 or any(not 0 <= a <= 1 for a in at):
            raise ValueError(f"{key}: got {place!r}, expected a position from 0 to 1 after @, e.g. {body}@0.5")
        if ny > 1 and len(at) == 1:
            raise ValueError(f"{key}: got {place!r}, but {body} is a plate; give two positions, e.g. {body}@0.5,0.5")
        out[self.of[body]] = np.outer(_between(at[0], nx), _between(at[1] if len(at) > 1 else 0.5, ny)).ravel()
        return out


def grid(name: str, body: Body) -> tuple[int, int]:
    """Cells along the first and the second side.

    Raises:
        ValueError: several cells in a lump, or two counts for a bar.
    """
    if isinstance(body.cells, int):
        nx, ny = body.cells, 1
    else:
        nx, ny = body.cells
    if nx < 1 or ny < 1:
        raise ValueError(f"bodies.{name}.cells: got {list(body.cells)!r}, expected counts of 1 or more")  # type: ignore[arg-type]
    if body.shape == "lump" and nx * ny > 1:
        raise ValueError(f"bodies.{name}.cells: got {nx * ny} for a lump; set shape: bar or plate, or cells: 1")
    if body.shape == "bar" and ny > 1:
        raise ValueError(f"bodies.{name}.cells: got [{nx}, {ny}] for a bar; give one number, or set shape: plate")
    return nx, ny


def _between(at: float, n: int) -> Array:
    """Linear weights (n,) of a position 0..1 between the cell centres (i + ½)/n."""
    where = np.clip(at * n - 0.5, 0, n - 1)
    low = min(int(where), max(n - 2, 0))
    out = np.zeros(n)
    out[low] = 1.0 - (where - low)
    if n > 1:
        out[low + 1] = where - low
    return out


@dataclass
class Scope:
    """Filled while one network is compiled."""

    machine: Machine
    part: TwinPart
    table: ParameterTable
    cells: Cells
    drivers: set[str] = field(default_factory=set)  # channels that some law needs
    laws: dict[str, Law] = field(default_factory=dict)

    @classmethod
    def of(cls, machine: Machine, part: TwinPart) -> Scope:
        return cls(machine, part, ParameterTable(part), Cells(part.bodies))

    @property
    def surroundings(self) -> dict[str, int]:
        """Numbers of the surroundings by name."""
        return {name: k for k, name in enumerate(self.part.surroundings)}


def number(key: str, given: str | float, unit: str) -> float:
    try:
        value = convert(given, unit)
    except ValueError as error:
        raise ValueError(f"{key}: {error}") from None
    if value < 0:
        raise ValueError(f"{key}: got {given!r}, expected 0 {unit} or more")
    return value


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
        unit = np.eye(len(scope.cells))
        edges += [Edge(name, unit[i] - unit[j], g) for i, j in zip(a.ravel(), b.ravel(), strict=True)]
    return edges


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
    factors = ("area", AREA, area), ("coefficient", COEFFICIENT, coefficient)
    return Monomial(1.0, tuple((scope.table.add(f"{key}.{name}", spec, given), 1.0) for name, spec, given in factors))


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
