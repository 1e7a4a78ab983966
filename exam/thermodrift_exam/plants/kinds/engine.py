"""A small thermal engine: boxes and rings cut into cells, contacts, films to air, and an L-stable Rosenbrock method.

The kinds draw every property of a solid; this module solves the conduction problem. Temperatures are (N cells, C
columns): all runs of a case, in all its variants, are integrated together.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType

import numpy as np

from data.arrays import Array, Index
from thermodrift_exam.plants.structure import Material

MATERIALS: Mapping[str, Material] = MappingProxyType({  # kg/m³, J/kg/K, W/m/K, µm/m/K
    "steel": Material(7850.0, 465.0, 45.0, 11.7),
    "cast_iron": Material(7200.0, 510.0, 47.0, 10.6),
    "aluminium": Material(2700.0, 890.0, 170.0, 23.2),
    "polymer_concrete": Material(2350.0, 880.0, 2.2, 14.0),
    "copper": Material(8900.0, 386.0, 385.0, 16.9),
    "laminations": Material(7500.0, 470.0, 22.0, 12.0),
    "board": Material(1900.0, 1100.0, 25.0, 15.0),
    "wound": Material(2500.0, 1000.0, 1.2, 18.0),
})  # fmt: skip
FACES = ("x-", "x+", "y-", "y+", "z-", "z+")
Cells = Index


@dataclass(frozen=True)
class Patch:
    """Outer cells of a block on one face, and the area that each has there, m²."""

    cells: Cells
    area_m2: Array

    def __add__(self, other: Patch) -> Patch:
        return Patch(np.r_[self.cells, other.cells], np.r_[self.area_m2, other.area_m2])


@dataclass(frozen=True)
class Solid:
    """A finished mesh of N cells: C dT/dt = -L T + sum of films G (T_air - T) + heat.

    `laplacian_W_per_K` (N, N) is symmetric with rows that add up to 0. `film_W_per_K` (N,) by air; a film's coefficient
    grows with its temperature difference to the power `exponent` (N,), 0 where it is constant.
    """

    capacity_J_per_K: Array
    laplacian_W_per_K: Array
    film_W_per_K: Mapping[str, Array]
    exponent: Array
    expansion_um_per_mK: Array
    xyz_m: Array
    blocks: Mapping[str, Cells]
    faces: Mapping[tuple[str, str], Patch]
    moving_K: float = 3.0

    @property
    def size(self) -> int:
        return len(self.capacity_J_per_K)

    @cached_property
    def _growing(self) -> Mapping[str, tuple[Cells, Array, Array]]:
        """By air: cells whose film grows with the difference, its conductance and half of its exponent."""
        of = {air: np.flatnonzero((g > 0) & (self.exponent > 0)) for air, g in self.film_W_per_K.items()}
        return {a: (c, self.film_W_per_K[a][c, None], self.exponent[c, None] / 2.0) for a, c in of.items()}

    def film_heat_W(self, cells_degC: Array, air_degC: Mapping[str, Array]) -> Array:
        """Heat of the films beyond ``-G T``: the term of the air, and the growth of the coefficient; (N, C).

        h = h0 [(dT² + m²) / (6² + m²)]^(p / 2): the coefficient that is stated holds 6 K above the air; m is what the
        hall's own draughts do at no difference.
        """
        out = np.zeros_like(cells_degC)
        still = self.moving_K**2
        for air, (cells, conductance, half) in self._growing.items():
            out += np.multiply.outer(self.film_W_per_K[air], air_degC[air])
            if len(cells):
                lead_K = air_degC[air] - cells_degC[cells]
                growth = np.expm1(half * np.log((lead_K * lead_K + still) / (36.0 + still)))
                out[cells] += conductance * growth * lead_K
        return out


@dataclass
class Mesh:
    """Collects blocks, contacts and films; `solid` finishes it."""

    capacity: list[float] = field(default_factory=list)
    expansion: list[float] = field(default_factory=list)
    exponent: list[float] = field(default_factory=list)
    xyz: list[Sequence[float]] = field(default_factory=list)
    pairs: list[tuple[int, int, float]] = field(default_factory=list)
    films: dict[str, list[tuple[Cells, Array]]] = field(default_factory=dict)
    blocks: dict[str, Cells] = field(default_factory=dict)
    faces: dict[tuple[str, str], Patch] = field(default_factory=dict)

    def lump(self, name: str, capacity_J_per_K: float, at_m: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        """One cell: stirred air, a tank, a winding."""
        self.blocks[name] = np.array([len(self.capacity)])
        self._cell(capacity_J_per_K, MATERIALS["steel"], at_m)

    def box(
        self, name: str, material: str, size_m: Sequence[float], cells: Sequence[int],
        corner_m: Sequence[float] = (0.0, 0.0, 0.0), filled: float = 1.0,
    ) -> None:  # fmt: skip
        """A bar (n, 1, 1), a plate (n, m, 1) or a box; `filled` is the share that is solid in a ribbed casting."""
        of, shape = MATERIALS[material], tuple(cells)
        step = np.asarray(size_m, float) / np.asarray(shape)
        first = len(self.capacity)
        number = first + np.arange(int(np.prod(shape))).reshape(shape)
        volume = float(np.prod(step)) * filled
        for ijk in np.ndindex(shape):
            middle = np.asarray(corner_m, float) + (np.asarray(ijk) + 0.5) * step
            self._cell(volume * of.density_kg_per_m3 * of.specific_heat_J_per_kgK, of, middle.tolist())
        for axis in range(3):
            across = float(np.prod(step)) / step[axis]
            near, far = (np.take(number, r, axis).ravel() for r in (range(shape[axis] - 1), range(1, shape[axis])))
            each = of.conductivity_W_per_mK * filled * across / step[axis]
            self.pairs += [(int(i), int(j), each) for i, j in zip(near, far, strict=True)]
            for face, at in ((FACES[2 * axis], 0), (FACES[2 * axis + 1], shape[axis] - 1)):
                cells_there = np.take(number, at, axis).ravel()
                self.faces[name, face] = Patch(cells_there, np.full(len(cells_there), across))
        self.blocks[name] = number.ravel()

    def ring(
        self, name: str, material: str, inner_m: float, outer_m: float, length_m: float, cells: tuple[int, int],
        start_m: Sequence[float] = (0.0, 0.0, 0.0), filled: float = 1.0, along_W_per_mK: float | None = None,
    ) -> None:  # fmt: skip
        """A shaft, sleeve or disc about the x axis, `cells` along it and outwards; `inner_m` may be 0.

        `along_W_per_mK`: another conductivity along the axis (wound or laminated).
        """
        of, (n, m) = MATERIALS[material], cells
        edges = np.linspace(inner_m, outer_m, m + 1)
        middle, step = np.sqrt((edges[1:] ** 2 + edges[:-1] ** 2) / 2.0), length_m / n
        section = np.pi * (edges[1:] ** 2 - edges[:-1] ** 2)
        number = len(self.capacity) + np.arange(n * m).reshape(n, m)
        x, y, z = start_m
        for i, j in np.ndindex(n, m):
            heat = filled * section[j] * step * of.density_kg_per_m3 * of.specific_heat_J_per_kgK
            self._cell(float(heat), of, (x + (i + 0.5) * step, y + float(middle[j]), z))
        along = along_W_per_mK or of.conductivity_W_per_mK
        for j in range(m):
            each = float(along * filled * section[j] / step)
            self.pairs += [(int(number[i, j]), int(number[i + 1, j]), each) for i in range(n - 1)]
        for j in range(m - 1):
            each = float(2 * np.pi * of.conductivity_W_per_mK * filled * step / np.log(middle[j + 1] / middle[j]))
            self.pairs += [(int(number[i, j]), int(number[i, j + 1]), each) for i in range(n)]
        self.faces |= {
            (name, "x-"): Patch(number[0], section), (name, "x+"): Patch(number[-1], section),
            (name, "in"): Patch(number[:, 0], np.full(n, 2 * np.pi * inner_m * step)),
            (name, "out"): Patch(number[:, -1], np.full(n, 2 * np.pi * outer_m * step)),
        }  # fmt: skip
        self.blocks[name] = number.ravel()

    def patch(self, block: str, face: str, low: float = 0.0, high: float = 1.0, along: int = 0) -> Patch:
        """The part of a face whose cells lie between two shares of the block's length along an axis."""
        whole = self.faces[block, face]
        at = np.array([self.xyz[c][along] for c in whole.cells])
        every = np.array([self.xyz[c][along] for c in self.blocks[block]])
        share = (at - every.min()) / max(float(np.ptp(every)), 1e-12)
        inside = (share >= low - 1e-9) & (share <= high + 1e-9)
        if not inside.any():
            inside = np.abs(share - (low + high) / 2) <= np.abs(share - (low + high) / 2).min() + 1e-9
        return Patch(whole.cells[inside], whole.area_m2[inside])

    def contact(self, one: Patch | str, other: Patch | str, conductance_W_per_K: float) -> None:
        """Joins two patches, or whole blocks: every cell of the larger one with the nearest of the other."""
        a, b = sorted((self._patch(one), self._patch(other)), key=lambda p: -len(p.cells))
        there = np.array([self.xyz[c] for c in b.cells])
        share = a.area_m2 / a.area_m2.sum()
        for cell, part in zip(a.cells, share, strict=True):
            nearest = int(b.cells[np.argmin(((there - np.array(self.xyz[cell])) ** 2).sum(axis=1))])
            self.pairs.append((int(cell), nearest, float(conductance_W_per_K * part)))

    def film(
        self, block: str, air: str, coefficient_W_per_m2K: float, faces: Sequence[str] = (), exponent: float = 0.0
    ) -> None:
        """Convection of a block's faces (default: all) to an air that the plant does not change."""
        chosen = faces or [face for name, face in self.faces if name == block]
        for face in chosen:
            patch = self.faces[block, face]
            self.films.setdefault(air, []).append((patch.cells, coefficient_W_per_m2K * patch.area_m2))
        for cell in self.blocks[block]:
            self.exponent[cell] = exponent

    def solid(self, moving_K: float = 3.0) -> Solid:
        n = len(self.capacity)
        laplacian = np.zeros((n, n))
        for i, j, joint in self.pairs:
            laplacian[[i, j, i, j], [i, j, j, i]] += joint * np.array([1.0, 1.0, -1.0, -1.0])
        films = {air: np.zeros(n) for air in self.films}
        for air, parts in self.films.items():
            for cells, conductance in parts:
                np.add.at(films[air], cells, conductance)
        return Solid(
            np.array(self.capacity), laplacian, films, np.array(self.exponent), np.array(self.expansion),
            np.array(self.xyz), dict(self.blocks), dict(self.faces), moving_K,
        )  # fmt: skip

    def _patch(self, given: Patch | str) -> Patch:
        if isinstance(given, Patch):
            return given
        cells = self.blocks[given]
        return Patch(cells, np.ones(len(cells)))

    def _cell(self, capacity_J_per_K: float, material: Material, at_m: Sequence[float]) -> None:
        self.capacity.append(capacity_J_per_K)
        self.expansion.append(material.expansion_um_per_mK)
        self.exponent.append(0.0)
        self.xyz.append(tuple(at_m))


GAMMA = 1.0 - 1.0 / np.sqrt(2.0)  # L-stable
HeatOf = Callable[[int, int, Array], Array]  # step, stage (0 its start, 1 its end), cells (N, C) -> W (N, C)
SlownessOf = Callable[[Array], Array | None]  # cells (N, C) -> capacities as multiples of the solid's (N, C)


def _as_they_are(cells_degC: Array) -> None:
    return None


def integrate(
    solid: Solid, heat_W: HeatOf, start_degC: Array, step_s: float, steps: int, watch: Array,
    slowness: SlownessOf = _as_they_are,
) -> tuple[Array, Array]:  # fmt: skip
    """``C dT/dt = -L T - G T + heat`` from `start_degC` (N, C) by the method ROS2 of Verwer et al. (1999).

    ROS2 is of second order whatever matrix stands in it, so that it takes the linear network's and the rest of the heat
    may depend on temperature. Returns what `watch` (O, N) sees, (steps + 1, O, C), and the last temperatures (N, C).
    """
    leaving = solid.laplacian_W_per_K + np.diag(sum(solid.film_W_per_K.values(), np.zeros(solid.size)))
    per_J = 1.0 / solid.capacity_J_per_K[:, None]
    a = -leaving * per_J
    solve = np.linalg.inv(np.eye(solid.size) - GAMMA * step_s * a)

    def rate(step: int, stage: int, cells_degC: Array) -> Array:
        out = a @ cells_degC + per_J * heat_W(step, stage, cells_degC)
        slower = slowness(cells_degC)
        return out if slower is None else out / slower

    now = start_degC.copy()
    seen = np.empty((steps + 1, len(watch), start_degC.shape[1]))
    seen[0] = watch @ now
    for k in range(steps):
        one = solve @ rate(k, 0, now)
        two = solve @ (rate(k, 1, now + step_s * one) - 2.0 * one)
        now = now + step_s * (1.5 * one + 0.5 * two)
        seen[k + 1] = watch @ now
    return seen, now
