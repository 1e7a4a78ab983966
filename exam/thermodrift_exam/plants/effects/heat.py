"""Effects on the heat balance: floor, cabinet, guides, sun, bearings, surfaces, air; three unlisted ones."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from thermodrift_exam.plants.effects.base import Answer, Effect
from thermodrift_exam.plants.runs import Now
from thermodrift_exam.plants.structure import AIR, Part, Plant, Source


class FloorSink(Effect):
    """The bed's foot exchanges with the ground: G (T_ground - T), the ground half a season behind."""

    key = "floor_sink"

    def drawn(self, plant: Plant, size: float, rng: np.random.Generator) -> None:
        self.feet = plant.structure.part("bed", height=(0.0, 0.3))
        self.conductance_W_per_K = float(rng.uniform(18.0, 32.0)) * size

    def answer(self) -> Answer:
        values = {"conductance": (self.conductance_W_per_K, "W/K"), "temperature": (18.0, "degC"), "follow": (0.5, "1")}
        return Answer(self.key, "node", "bed", values, words="the bed loses heat to the floor")

    def add_heat_W(self, heat_W: Array, cells_degC: Array, now: Now) -> None:
        each = self.conductance_W_per_K * self.feet.weights[:, None]
        heat_W[self.feet.cells] += each * (now.ground_degC - cells_degC[self.feet.cells])


class _Steady(Effect):
    """Watts into the cells of one body, by the drivers."""

    body: str
    watts: float

    def drawn(self, plant: Plant, size: float, rng: np.random.Generator) -> None:
        self.at = self._part(plant)
        self.power_W = self.watts * float(rng.uniform(0.8, 1.25)) * size

    def _part(self, plant: Plant) -> Part:
        return plant.part(self.body)

    def share(self, cells_degC: Array, now: Now) -> Array:
        """Of the full power, (B,)."""
        raise NotImplementedError

    def add_heat_W(self, heat_W: Array, cells_degC: Array, now: Now) -> None:
        self.at.add(heat_W, self.power_W * self.share(cells_degC, now))


class CabinetHeat(_Steady):
    """A cabinet at the upper back of the column that is always on."""

    key = "cabinet_heat"
    body, watts = "column_back", 80.0

    def _part(self, plant: Plant) -> Part:
        return plant.structure.part("column", (0.0, 0.3), (0.35, 0.9))

    def answer(self) -> Answer:
        return Answer(
            "cabinet_heat", "node", self.body, {"heat": (self.power_W, "W")}, words="a cabinet warms the back"
        )

    def share(self, cells_degC: Array, now: Now) -> Array:
        return np.ones(cells_degC.shape[1])


class PumpHeat(CabinetHeat):
    """The coolant pump behind the column: heat while it runs."""

    key = "pump_heat"
    has = frozenset({"coolant"})
    driver = "coolant"
    watts = 120.0

    def share(self, cells_degC: Array, now: Now) -> Array:
        return now.coolant


class GuideFriction(_Steady):
    """Coulomb friction under the table, μ F v."""

    key = "guide_friction"
    has = frozenset({"feed"})
    driver = "feed"
    body, watts = "table", 160.0  # at FAST_MM_PER_MIN
    FAST_MM_PER_MIN, LOAD_N = 8000.0, 5000.0

    def answer(self) -> Answer:
        friction = self.power_W / (self.LOAD_N * self.FAST_MM_PER_MIN / 60e3)
        values = {"friction": (friction, "1"), "load": (self.LOAD_N, "N")}
        return Answer(self.key, "node", "table", values, words="the guides rub under the table")

    def share(self, cells_degC: Array, now: Now) -> Array:
        return np.abs(now.feed_mm_per_min) / self.FAST_MM_PER_MIN


class Sun(_Steady):
    """The sun on the column's back between two hours of the day: half a sine of a clear day."""

    key = "sun"
    body, watts = "column_back", 140.0

    def drawn(self, plant: Plant, size: float, rng: np.random.Generator) -> None:
        super().drawn(plant, size, rng)
        self.rise_h, self.set_h = float(rng.uniform(8.0, 10.0)), float(rng.uniform(14.0, 17.0))

    def answer(self) -> Answer:
        values = {"power": (self.power_W, "W"), "rise": (self.rise_h, "h"), "set": (self.set_h, "h")}
        return Answer(self.key, "node", self.body, values, words="the sun on the column's back")

    def share(self, cells_degC: Array, now: Now) -> Array:
        up = (now.clock_h - self.rise_h) / (self.set_h - self.rise_h)
        return np.where((up > 0) & (up < 1), np.sin(np.pi * up), 0.0)


class UnlistedWarmSpeed(_Steady):
    """Unlisted: heat into the rear of the head by speed times the head's excess over 20 degC."""

    key = "unlisted_warm_speed"
    driver = "spindle_rpm"
    watts = 50.0  # at the rated speed and 10 K above 20 degC

    def _part(self, plant: Plant) -> Part:
        self.body = plant.body_like("head_rear", "head")
        return plant.part(self.body)

    def answer(self) -> Answer:
        values = {"power": (self.power_W, "W")}
        form = ("product", "spindle_rpm")
        return Answer(None, "node", self.body, values, words="power (n / rated) (T - 20 degC) / 10 K", form=form)

    def share(self, cells_degC: Array, now: Now) -> Array:
        return now.speed_rpm / self.plant.rated_rpm * (self.at.mean(cells_degC) - 20.0) / 10.0


class UnlistedCoolantSpeed(PumpHeat):
    """Unlisted: heat into the back of the column while coolant flows, by the speed squared."""

    key = "unlisted_coolant_speed"
    watts = 180.0

    def answer(self) -> Answer:
        values, form = {"power": (self.power_W, "W")}, ("square_cross", "spindle_rpm", "coolant")
        return Answer(None, "node", self.body, values, words="power coolant (n / rated)^2", form=form)

    def active(self, now: Now) -> NDArray[np.bool_]:
        return (now.coolant != 0) & (now.speed_rpm != 0)

    def share(self, cells_degC: Array, now: Now) -> Array:
        return now.coolant * (now.speed_rpm / self.plant.rated_rpm) ** 2


class UnlistedFeedSpeed(_Steady):
    """Unlisted: heat into the bed while the table moves under a turning spindle, by feed times speed."""

    key = "unlisted_feed_speed"
    has = frozenset({"feed"})
    driver = "feed"
    body, watts = "bed", 400.0  # at `FAST_MM_PER_MIN` and the rated speed
    FAST_MM_PER_MIN = 8000.0

    def answer(self) -> Answer:
        values = {"power": (self.power_W, "W")}
        form = ("cross", "spindle_rpm", "feed")
        return Answer(None, "node", self.body, values, words="power (feed / 8000 mm/min) (n / rated)", form=form)

    def active(self, now: Now) -> NDArray[np.bool_]:
        return (now.feed_mm_per_min != 0) & (now.speed_rpm != 0)

    def share(self, cells_degC: Array, now: Now) -> Array:
        return np.abs(now.feed_mm_per_min) / self.FAST_MM_PER_MIN * now.speed_rpm / self.plant.rated_rpm


REFERENCE_DEGC = 40.0
PALMGREN_Y = 0.33


class _FrontBearings(Effect):
    driver = "spindle_rpm"
    source: str

    def _temperatures(self, cells_degC: Array) -> tuple[Array, Array]:
        """Inner and outer ring, degC, each (B,)."""
        at: Source = self.plant.sources[self.source]
        assert at.shaft is not None and at.housing is not None, "a bearing has both"
        return at.shaft.mean(cells_degC), at.housing.mean(cells_degC)


class ViscosityFeedback(_FrontBearings):
    """Oil that thins by the exponential law of Reynolds (1886); Palmgren's moment goes with viscosity^(2/3)."""

    key = "viscosity_feedback"
    source = "front_bearings"

    def answer(self) -> Answer:
        slope = {"slope": (0.035 * self.size, "1/K")}
        return Answer(self.key, "node", "front", slope, ("shaft", self.source), "the front bearings' grease thins")

    def friction(self, source: str, cells_degC: Array, now: Now) -> Array | float:
        if source != self.source:
            return 1.0
        shaft, ring = self._temperatures(cells_degC)
        thinner = np.exp(-0.035 * self.size * ((shaft + ring) / 2 - REFERENCE_DEGC))
        return np.asarray(thinner ** (2.0 / 3.0))


class PreloadFeedback(_FrontBearings):
    """A shaft that is warmer than its housing tightens the bearing (Stein and Tu 1994): moment with F^(1 + y)."""

    key = "preload_feedback"
    source = "front_preload"

    def answer(self) -> Answer:
        kappa = {"kappa": (0.08 * self.size, "1/K")}
        return Answer(self.key, "node", "front", kappa, ("shaft", self.source), "the front bearings tighten")

    def friction(self, source: str, cells_degC: Array, now: Now) -> Array | float:
        if source != self.source:
            return 1.0
        shaft, ring = self._temperatures(cells_degC)
        force = np.clip(1.0 + 0.08 * self.size * (shaft - ring), 0.0, None)
        return np.asarray(force ** (1.0 + PALMGREN_Y))


SIGMA_W_PER_M2K4 = 5.670374419e-8
EMISSIVITY = 0.9
ROOM, HALL_TOP, WALLS = "room", "hall_top", "walls"


class Radiation(Effect):
    """A painted face and the hall's walls, to the fourth power, in addition to all convection."""

    key = "radiation"
    has = frozenset({"walls"})

    def drawn(self, plant: Plant, size: float, rng: np.random.Generator) -> None:
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

    def drawn(self, plant: Plant, size: float, rng: np.random.Generator) -> None:
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
    """Air that rises along a warm wall: McAdams (1954), laminar or turbulent, in addition to the constant one."""

    key = "natural_convection"
    height_m = 0.4

    def drawn(self, plant: Plant, size: float, rng: np.random.Generator) -> None:
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

    def drawn(self, plant: Plant, size: float, rng: np.random.Generator) -> None:
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

    def drawn(self, plant: Plant, size: float, rng: np.random.Generator) -> None:
        self.gradient_K_per_m = float(rng.uniform(1.5, 2.5)) * size
        above_m = plant.structure.above_floor_m - self.sensor_m
        self.heat_W = (plant.structure.room_W_per_K * self.gradient_K_per_m * above_m)[:, None]

    def answer(self) -> Answer:
        values = {"gradient": (self.gradient_K_per_m, "K/m")}
        return Answer(self.key, "node", HALL_TOP, values, (ROOM,), "the air is warmer higher up")

    def add_heat_W(self, heat_W: Array, cells_degC: Array, now: Now) -> None:
        heat_W += self.heat_W
