"""The draw of a kind: a solid with named bodies, heats, error terms, sensors, drivers, and a setting.

Also the lumped values that a drawing of the plant would give: links, exposures and gains of its bodies.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np

from data.arrays import Array
from thermodrift_exam.plants.kinds.engine import Cells, Mesh, Solid
from thermodrift_exam.plants.runs import Block
from thermodrift_exam.plants.structure import Sensor

Drive = Mapping[str, Array]  # drivers by channel, any one shape
PowerOf = Callable[[Drive], Array]


class Dice:
    """Draws of one random stream."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def span(self, low: float, high: float) -> float:
        """A positive number, even in its logarithm."""
        return float(np.exp(self.rng.uniform(np.log(low), np.log(high))))

    def even(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def whole(self, low: int, high: int) -> int:
        """Both ends included."""
        return int(self.rng.integers(low, high + 1))

    def chance(self, share: float) -> bool:
        return bool(self.rng.random() < share)

    def pick(self, of: Sequence[Any]) -> Any:
        return of[int(self.rng.integers(len(of)))]

    def sign(self) -> float:
        return 1.0 if self.rng.random() < 0.5 else -1.0


@dataclass(frozen=True)
class Stated:
    """A heat as the machine file states it: `free` values are guessed, `fixed` ones and `signed` ones are as given.

    `signed` values have the prior's sd with them. `into` maps bodies to shares; the last one has the rest.
    """

    law: str
    drivers: Mapping[str, str] | str
    into: Mapping[str, float]
    free: Mapping[str, tuple[float, str]] = field(default_factory=dict)
    fixed: Mapping[str, str | float] = field(default_factory=dict)
    signed: Mapping[str, tuple[float, str, float]] = field(default_factory=dict)
    at: Mapping[str, str] | None = None


@dataclass(frozen=True)
class Source:
    """Heat by the drivers alone; `share` (N,) adds up to 1. `stated` is empty for what no file states."""

    share: Array
    power_W: PowerOf
    stated: Mapping[str, Stated] = field(default_factory=dict)


@dataclass(frozen=True)
class Growth:
    """One piece of an error: `weights_um_per_K` (N,) · rise. `tilt` names the warm and the cold body of a bending."""

    channel: str
    weights_um_per_K: Array
    tilt: tuple[str, str] | None = None
    lumped_um_per_K: float = 0.0


@dataclass(frozen=True)
class Driver:
    """A driver channel. `draw` gives a run's blocks from the generator, the run's number and its length in s."""

    unit: str
    low: float
    high: float
    draw: Callable[[np.random.Generator, int, float], tuple[Block, ...]]
    resolution: float | None = None
    history: bool = False  # whether a shift before the run may have used it


@dataclass(frozen=True)
class Setting:
    """Recording of a case and accuracy of its machine file; K, s, h, µm.

    `noise_K` and `step_K` (0: unrounded) are of temperatures, `noise_um` and `step_um` of errors. `file_error` is the
    sd of the logarithm of what the file's values are off by. Lags and offsets that the file does not state are small.
    """

    runs: int
    hours: tuple[float, float]
    row_s: float
    solver_s: float
    before_h: float
    before_step_s: float
    noise_K: float
    step_K: float
    noise_um: float
    step_um: float
    room_degC: tuple[float, float]
    day_K: float
    ripple_K: float
    ripple_s: float
    slow_K: float
    file_error: float
    mass_error: float
    sensor_lag_s: float
    states_offsets: bool
    states_lags: bool
    scatter: float  # of the heats from run to run

    @property
    def offset_K(self) -> float:
        """Largest offset of a sound sensor."""
        return 0.15 if self.states_offsets else 0.03


@dataclass(frozen=True)
class KindPlant:
    """A plant of a kind. `bodies` are cells by name, every cell in one; `airs` are surroundings and their channels."""

    solid: Solid
    bodies: Mapping[str, Cells]
    sources: Mapping[str, Source]
    growths: Mapping[str, Growth]
    sensors: tuple[Sensor, ...]
    drivers: Mapping[str, Driver]
    airs: tuple[str, ...]
    setting: Setting
    materials: Mapping[str, str] = field(default_factory=dict)
    error_unit: str = "um"
    errors: tuple[str, ...] = ()
    rated: float = 1.0  # speed at which heats are stated

    def share(self, body: str, cells: Cells | None = None) -> Array:
        """A heat spread over cells, by default of the whole body, in proportion to their capacities, (N,)."""
        chosen = self.bodies[body] if cells is None else cells
        return spread(self.solid, chosen)

    def mean(self, body: str) -> Array:
        """Weights (N,) that give a body's mean temperature."""
        return self.share(body)

    def touching(self) -> set[frozenset[str]]:
        return {frozenset(pair) for pair in links_W_per_K(self)}


def spread(solid: Solid, cells: Cells) -> Array:
    out = np.zeros(solid.size)
    out[cells] = solid.capacity_J_per_K[cells] / solid.capacity_J_per_K[cells].sum()
    return out


def cut(mesh: Mesh, block: str, axis: int, names: Sequence[str]) -> dict[str, Cells]:
    """A block in as many pieces as it has names, along an axis."""
    cells = mesh.blocks[block]
    at = np.array([mesh.xyz[c][axis] for c in cells])
    layers, layer = np.unique(np.round(at, 9), return_inverse=True)
    piece = np.minimum(layer * len(names) // len(layers), len(names) - 1)
    return {name: cells[piece == k] for k, name in enumerate(names) if np.any(piece == k)}


def expanding(solid: Solid, parts: Sequence[tuple[Cells, float]]) -> Array:
    """Weights (N,) of the path through these cells with signed lengths in m: expansion · length · mean rise."""
    out = np.zeros(solid.size)
    for cells, length_m in parts:
        out += spread(solid, cells) * length_m * float(solid.expansion_um_per_mK[cells].mean())
    return out


def bending(solid: Solid, hot: Cells, cold: Cells, um_per_K: float) -> Array:
    return um_per_K * (spread(solid, hot) - spread(solid, cold))


def place_sensors(
    dice: Dice, solid: Solid, bodies: Mapping[str, Cells], chance: Mapping[str, float], setting: Setting,
    usual: float = 0.85, on: Mapping[str, Cells] | None = None,
) -> tuple[Sensor, ...]:  # fmt: skip
    """One at a random cell of most bodies, two in some; `chance` overrules the usual one by body, `on` its cells.

    Of two cells the engineer takes the one nearer to the body's middle.
    """
    out = []
    chosen = {body: dice.chance(chance.get(body, usual)) for body in bodies}
    for body, whole in bodies.items():
        cells = (on or {}).get(body, whole)
        sensed, twice = chosen[body] or sum(chosen.values()) < 2, dice.chance(0.15) and len(cells) > 4
        order, middle = dice.rng.permutation(cells), solid.xyz_m[cells].mean(axis=0)
        pairs = [sorted(order[2 * k : 2 * k + 2], key=lambda c: off_m(solid, c, middle)) for k in range(1 + twice)]
        for k, (cell, *_) in enumerate(pairs if sensed else ()):
            name = f"t_{body}" if k == 0 else f"t_{body}_{k + 1}"
            lag_s, offset_K = setting.sensor_lag_s * dice.span(0.6, 1.6), dice.even(-1, 1) * setting.offset_K
            out.append(Sensor(name, body, int(cell), lag_s, offset_K))
    return tuple(out)


def off_m(solid: Solid, cell: int, middle_m: Array) -> float:
    return float(np.linalg.norm(solid.xyz_m[cell] - middle_m))


def links_W_per_K(plant: KindPlant) -> dict[tuple[str, str], float]:
    """Between every two bodies that touch: one over the difference of the means that 1 W through both makes."""
    s = plant.solid
    out = {}
    for (a, one), (b, other) in combinations(plant.bodies.items(), 2):
        if not np.any(s.laplacian_W_per_K[np.ix_(one, other)]):
            continue
        cells = np.r_[one, other]
        within = s.laplacian_W_per_K[np.ix_(cells, cells)].copy()
        np.fill_diagonal(within, 0.0)
        np.fill_diagonal(within, -within.sum(axis=1))
        through = (spread(s, one) - spread(s, other))[cells]
        rise = np.linalg.lstsq(within, through, rcond=1e-12)[0]
        out[a, b] = float(1.0 / (through @ rise))
    return out


def exposures_W_per_K(plant: KindPlant) -> dict[tuple[str, str], float]:
    """(body, air) -> conductance of all its films at the difference where their coefficients are stated."""
    films = plant.solid.film_W_per_K
    every = {(b, air): float(films[air][cells].sum()) for b, cells in plant.bodies.items() for air in films}
    return {where: g for where, g in every.items() if g > 0}


def gains_um_per_K(plant: KindPlant, growth: Growth) -> dict[str, float]:
    """Contribution of the mean rise of each body to an error, µm/K."""
    sums = {body: float(growth.weights_um_per_K[cells].sum()) for body, cells in plant.bodies.items()}
    return {body: total for body, total in sums.items() if abs(total) > 0.02}
