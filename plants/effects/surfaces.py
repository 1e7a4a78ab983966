"""Surfaces and air: radiation, convection that is not constant, draught, layers of warm air."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from plants.effects.base import Answer, Effect
from plants.runs import Now
from plants.structure import AIR, Plant

SIGMA_W_PER_M2K4 = 5.670374419e-8
EMISSIVITY = 0.9
ROOM, HALL_TOP, WALLS = "room", "hall_top", "walls"


class Radiation(Effect):
    """A painted face and the hall's walls, to the fourth power, beside all convection."""

    key = "radiation"
    has = frozenset({"walls"})

    def __init__(self, plant: Plant, size: float, rng: np.random.Generator) -> None:
        super().__init__(plant, size, rng)
        self.body = str(rng.choice(["column_back", "bed"]))
        part = plant.part(self.body)
        self.cells, self.area_m2 = part.cells, size * part.surface_m2[:, None]

    def answer(self) -> Answer:
        values = {"area": (float(np.sum(self.area_m2)), "m**2"), "emissivity": (EMISSIVITY, "1")}
        return Answer(self.key, "node", self.body, values, words="radiation to the walls")

    def add_heat_W(self, heat_W: Array, cells_degC: Array, now: Now) -> None:
        wall_K4, own_K4 = (now.wall_degC + 273.15) ** 4, (cells_degC[self.cells] + 273.15) ** 4
        heat_W[self.cells] += EMISSIVITY * SIGMA_W_PER_M2K4 * self.area_m2 * (wall_K4 - own_K4)


class RotatingConvection(Effect):
    """A turning shaft drags air along: Becker (1963), Nu with Re^(2/3), added to the exchange at rest."""

    key = "rotating_convection"
    driver = "spindle_rpm"

    def __init__(self, plant: Plant, size: float, rng: np.random.Generator) -> None:
        super().__init__(plant, size, rng)
        self.cells, self.air = plant.part("shaft").cells, plant.structure.air_cell
        rest = plant.structure.air_W_per_K if self.air is not None else plant.structure.room_W_per_K
        self.rest_W_per_K = rest[self.cells][:, None]
        self.gain = 4.0 * size

    def answer(self) -> Answer:
        values = {"gain": (self.gain, "1"), "rated": (self.plant.rated_rpm, "rpm")}
        where = f"shaft-{AIR if self.air is not None else ROOM}"
        return Answer(self.key, "link", where, values, ("shaft",), "the turning shaft is cooled better")

    def add_heat_W(self, heat_W: Array, cells_degC: Array, now: Now) -> None:
        around = now.room_degC if self.air is None else cells_degC[self.air]
        more = self.gain * (now.speed_rpm / self.plant.rated_rpm) ** (2.0 / 3.0)
        exchanged = self.rest_W_per_K * more * (around - cells_degC[self.cells])
        heat_W[self.cells] += exchanged
        if self.air is not None:
            heat_W[self.air] -= exchanged.sum(axis=0)


class NaturalConvection(Effect):
    """Air that rises along a warm wall: McAdams (1954), laminar or turbulent, beside the constant one."""

    key = "natural_convection"
    height_m = 0.4

    def __init__(self, plant: Plant, size: float, rng: np.random.Generator) -> None:
        super().__init__(plant, size, rng)
        motor = plant.part("motor")
        self.cells, self.area_m2 = motor.cells, 2.0 * size * motor.surface_m2[:, None]  # ribs

    def answer(self) -> Answer:
        values = {"area": (float(np.sum(self.area_m2)), "m**2"), "height": (self.height_m, "m")}
        return Answer(self.key, "node", "motor", values, words="the motor's ribs draw air")

    def add_heat_W(self, heat_W: Array, cells_degC: Array, now: Now) -> None:
        lead_K = now.room_degC - cells_degC[self.cells]
        size_K = np.abs(lead_K)
        coefficient = np.maximum(1.42 * (size_K / self.height_m) ** 0.25, 1.31 * np.cbrt(size_K))
        heat_W[self.cells] += coefficient * self.area_m2 * lead_K


class Draught(Effect):
    """A gate that opens at the same point of every run: colder air at all surfaces in the hall, and more of it."""

    key = "draught"

    def __init__(self, plant: Plant, size: float, rng: np.random.Generator) -> None:
        super().__init__(plant, size, rng)
        self.start_min, self.duration_min = int(rng.integers(60, 210)), int(rng.integers(20, 46))
        self.factor, self.drop_K = 1.0 + 1.0 * size, 6.0 * size
        self.room_W_per_K = plant.structure.room_W_per_K[:, None]

    def answer(self) -> Answer:
        values = {
            "start": (self.start_min / 60.0, "h"), "duration": (self.duration_min, "min"),
            "factor": (self.factor, "1"), "drop": (self.drop_K, "K"),
        }  # fmt: skip
        return Answer(self.key, "node", ROOM, values, (HALL_TOP, f"{AIR}-{ROOM}"), "a gate opens for a while")

    def active(self, now: Now) -> NDArray[np.bool_]:
        since_s = now.time_s - 60.0 * self.start_min
        return np.full(len(now.room_degC), 0 <= since_s < 60.0 * self.duration_min)

    def add_heat_W(self, heat_W: Array, cells_degC: Array, now: Now) -> None:
        if self.active(now).any():
            lead_K = now.room_degC - cells_degC
            heat_W += self.room_W_per_K * (self.factor * (lead_K - self.drop_K) - lead_K)


class Stratification(Effect):
    """The hall's air is warmer higher up: every surface sees the air of its own height."""

    key = "stratification"
    has = frozenset({"layers"})
    sensor_m = 0.8  # height of the room's sensor

    def __init__(self, plant: Plant, size: float, rng: np.random.Generator) -> None:
        super().__init__(plant, size, rng)
        self.gradient_K_per_m = float(rng.uniform(1.5, 2.5)) * size
        above_m = plant.structure.above_floor_m - self.sensor_m
        self.heat_W = (plant.structure.room_W_per_K * self.gradient_K_per_m * above_m)[:, None]

    def answer(self) -> Answer:
        values = {"gradient": (self.gradient_K_per_m, "K/m")}
        return Answer(self.key, "node", HALL_TOP, values, (ROOM,), "the air is warmer higher up")

    def add_heat_W(self, heat_W: Array, cells_degC: Array, now: Now) -> None:
        heat_W += self.heat_W
