"""Heat paths that the machine file lacks: floor, walls, air that moves, fluids, bridges, joints; and feedback."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase
from typing import Any, TypeVar

import numpy as np

from data.arrays import Array, Mask
from data.errors import InputError
from thermodrift_exam.plants.kinds.effects.base import Effect
from thermodrift_exam.plants.kinds.engine import Cells
from thermodrift_exam.plants.kinds.plant import Dice, KindPlant, links_W_per_K
from thermodrift_exam.plants.kinds.runs import Now

T = TypeVar("T")


def largest(plant: KindPlant, cells: Cells, W_per_K: float) -> float:
    """The size at which an exchange of so much at size 1, spread over these cells, empties them in a step."""
    return float(plant.solid.capacity_J_per_K[cells].sum() / plant.setting.before_step_s / W_per_K)


class _Surface(Effect):
    """A part of a body's cells, each with its share of a conductance."""

    def drawn(self, plant: KindPlant, dice: Dice, **options: Any) -> None:
        cells = plant.bodies[self.place]
        kept = np.sort(dice.rng.permutation(cells)[: max(1, int(len(cells) * dice.even(0.5, 1.0)))])
        self.cells, self.part = kept, plant.share(self.place, kept)[kept][:, None]
        self.mean = plant.mean(self.place)
        self.more(plant, dice, **options)

    def more(self, plant: KindPlant, dice: Dice) -> None:
        """Draws its own attributes."""

    def limit(self, W_per_K: float) -> None:
        """No larger a size than the solver's longest step allows an exchange that it does not know beforehand."""
        self.largest = largest(self.plant, self.cells, W_per_K)


class Floor(_Surface):
    """To ground that lies between a yearly mean and this day's mean air; better where the foot is warmer than it."""

    mechanism = "floor_sink"
    words = "heat to the floor"

    def more(self, plant: KindPlant, dice: Dice, conductance: tuple[float, float] = (8.0, 40.0)) -> None:
        self.conductance, self.rests_K = dice.span(*conductance), dice.even(8.0, 25.0)
        self.limit(1.3 * self.conductance)

    def heat_W(self, out: Array, cells_degC: Array, now: Now, size: Array) -> None:
        lead_K = now.ground_degC - cells_degC[self.cells]
        out[self.cells] += size * self.conductance * self.part * lead_K * (1.0 - 0.15 * np.tanh(lead_K / self.rests_K))

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        return {"conductance": (size * self.conductance, "W/K"), "temperature": (14.0, "degC"), "follow": (0.4, "1")}


class Radiates(_Surface):
    """To an air that is recorded of its own (walls), or between two bodies, to the fourth power."""

    mechanism = "radiation"
    words = "radiation"

    def more(self, plant: KindPlant, dice: Dice, to: str = "room", area: tuple[float, float] = (0.4, 2.0)) -> None:
        self.to, self.area, self.emissivity = to, dice.span(*area), dice.even(0.6, 0.95)
        self.limit(8.0 * self.area)
        self.other_share = plant.share(to)[:, None] if to in plant.bodies else None
        self.also = (to, f"{self.place}-{to}") if to in plant.bodies else (f"{self.place}-{to}",)
        if to == plant.airs[0]:
            self.same_as = (("natural_convection", "node", self.place),)

    def heat_W(self, out: Array, cells_degC: Array, now: Now, size: Array) -> None:
        share = self.other_share
        there = now.air_degC[self.to] if share is None else (share.T @ cells_degC)[0]
        own_K, far_K = (cells_degC[self.cells] + 273.15) / 100.0, (there + 273.15) / 100.0
        flow = size * self.emissivity * 5.670 * self.area * self.part * (far_K**4 - own_K**4)
        out[self.cells] += flow
        if share is not None:
            out -= share * flow.sum(axis=0)

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        return {"area": (size * self.area, "m**2"), "emissivity": (self.emissivity, "1")}


class Rises(_Surface):
    """Air that rises along a warm face: with a power of the difference other than that of textbooks."""

    mechanism = "natural_convection"
    words = "natural convection"

    def more(self, plant: KindPlant, dice: Dice, area: tuple[float, float] = (0.3, 1.5), air: str = "room") -> None:
        self.air, self.area, self.exponent = air, dice.span(*area), dice.even(0.22, 0.38)
        self.also, self.same_as = (f"{self.place}-{air}",), (("radiation", "node", self.place),)
        self.limit(8.0 * self.area)

    def heat_W(self, out: Array, cells_degC: Array, now: Now, size: Array) -> None:
        lead_K = now.air_degC[self.air] - cells_degC[self.cells]
        coefficient = 1.7 * (np.abs(lead_K) + 1e-9) ** self.exponent
        out[self.cells] += size * self.area * self.part * coefficient * lead_K

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        return {"area": (size * self.area, "m**2")}


class Windy(_Surface):
    """A turning part that air cools better: linear at first, then saturating."""

    mechanism = "rotating_convection"
    kind = "link"
    words = "the turning part is cooled better"

    def more(self, plant: KindPlant, dice: Dice, driver: str = "spindle_rpm", air: str = "room") -> None:
        self.driver, self.air = driver, air
        films = plant.solid.film_W_per_K[air][self.cells]
        self.rest_W_per_K = films[:, None] if films.sum() > 0 else 2.0 * self.part
        self.gain, self.bend, self.top = dice.span(1.5, 6.0), dice.even(0.2, 1.5), plant.rated
        self.limit(self.gain * float(self.rest_W_per_K.sum()))
        self.largest = min(self.largest, 25.0 / self.gain)
        self.also, self.place = (self.place,), f"{self.place}-{air}"

    def heat_W(self, out: Array, cells_degC: Array, now: Now, size: Array) -> None:
        x = np.abs(now.drive[str(self.driver)]) / self.top
        more = size * self.gain * x * (1.0 + self.bend) / (1.0 + self.bend * x)
        out[self.cells] += self.rest_W_per_K * more * (now.air_degC[self.air] - cells_degC[self.cells])

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        return {"gain": (size * self.gain, "1"), "rated": (self.top, "rpm")}


class Gate(Effect):
    """A gate that opens at the same time of every run: colder air at all faces, with the time constant of a hall."""

    mechanism = "draught"
    words = "a gate opens for a while"
    largest = 5.0

    def drawn(self, plant: KindPlant, dice: Dice, air: str = "room") -> None:
        longest_s = 3600.0 * plant.setting.hours[0]
        self.from_s, self.for_s = dice.even(0.15, 0.55) * longest_s, dice.even(0.08, 0.3) * longest_s
        self.film, self.air = plant.solid.film_W_per_K[air][:, None], air
        self.stronger, self.drop_K, self.edge_s = dice.even(0.3, 1.0), dice.even(3.0, 8.0), dice.span(60.0, 300.0)
        self.place, self.also = air, tuple(f"{b}-{air}" for b, c in plant.bodies.items() if self.film[c].sum() > 0)

    def active(self, now: Now) -> Mask:
        return np.full(len(now.ground_degC), 0 <= now.time_s - self.from_s < self.for_s)

    def heat_W(self, out: Array, cells_degC: Array, now: Now, size: Array) -> None:
        edges_s = self.from_s, self.from_s + self.for_s
        begun, done = (np.clip((now.time_s - t) / self.edge_s, 0.0, 40.0) for t in edges_s)
        opened = np.exp(-done) - np.exp(-begun)
        if opened > 1e-4:
            lead_K = now.air_degC[self.air] - cells_degC
            beyond = (1.0 + opened * size * self.stronger) * (lead_K - opened * size * self.drop_K) - lead_K
            out += self.film * beyond

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        return {
            "start": (self.from_s / 3600.0, "h"), "duration": (self.for_s / 60.0, "min"),
            "factor": (1.0 + size * self.stronger, "1"), "drop": (size * self.drop_K, "K"),
        }  # fmt: skip


class Fluid(_Surface):
    """Coolant over a body while its pump runs; its tank follows the air, and warms with the pump's own hours."""

    mechanism = "cutting_fluid"
    words = "coolant over a body"

    def more(
        self, plant: KindPlant, dice: Dice, driver: str = "coolant", conductance: tuple[float, float] = (20.0, 120.0)
    ) -> None:
        self.driver, self.conductance = driver, dice.span(*conductance)
        self.above_K, self.warms_K_per_h = dice.even(-4.0, 4.0), dice.even(0.0, 0.8)
        self.limit(self.conductance)

    def heat_W(self, out: Array, cells_degC: Array, now: Now, size: Array) -> None:
        air = next(iter(now.air_degC.values()))
        tank = air + self.above_K + self.warms_K_per_h * max(now.time_s, 0.0) / 3600.0
        flow = now.drive[str(self.driver)] ** 0.8
        out[self.cells] += size * self.conductance * self.part * flow * (tank - cells_degC[self.cells])

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        return {"conductance": (size * self.conductance, "W/K")}


class Chiller(_Surface):
    """A jacket whose chiller is set some kelvins off the room and cools in proportion until it is at its limit."""

    mechanism = "jacket_chiller"
    words = "a chiller that follows the room"

    def more(self, plant: KindPlant, dice: Dice, conductance: tuple[float, float] = (20.0, 120.0)) -> None:
        self.conductance, self.off_K, self.band_K = dice.span(*conductance), dice.even(-1.0, 5.0), dice.even(1.0, 4.0)
        self.colder_K = dice.even(3.0, 8.0)
        self.limit(self.conductance * (1.0 + self.colder_K / self.band_K))

    def heat_W(self, out: Array, cells_degC: Array, now: Now, size: Array) -> None:
        set_degC = next(iter(now.air_degC.values())) + self.off_K
        opened = np.clip((self.mean @ cells_degC - set_degC) / self.band_K, 0.0, 1.0)
        lead_K = set_degC - self.colder_K - cells_degC[self.cells]
        out[self.cells] += size * self.conductance * self.part * opened * lead_K

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        return {"conductance": (size * self.conductance, "W/K")}


class Bridge(Effect):
    """A path between two bodies that the file leaves uncoupled: a bracket, a hose, a cable, the air between."""

    mechanism = "heat_bridge"
    words = "a heat path between two bodies"

    def drawn(self, plant: KindPlant, dice: Dice, to: str = "", conductance: tuple[float, float] = (1.0, 8.0)) -> None:
        pairs = _far_apart(plant, self.place)
        other = to if to in pairs else dice.pick(_some(pairs, self.key, f"{self.place} touches all others"))
        self.conductance = dice.span(*conductance)
        self.one, self.other = plant.mean(self.place), plant.mean(other)
        self.also = (other, {"kind": "link", "name": f"{self.place}-{other}"})
        self.largest = min(largest(plant, plant.bodies[b], 1.5 * self.conductance) for b in (self.place, other))

    def heat_W(self, out: Array, cells_degC: Array, now: Now, size: Array) -> None:
        lead_K = self.other @ cells_degC - self.one @ cells_degC
        watts = size * self.conductance * lead_K * (1.0 + 0.004 * np.abs(lead_K))
        out += np.multiply.outer(self.one - self.other, watts)

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        return {"conductance": (size * self.conductance, "W/K")}


def _some(found: Sequence[T], key: str, lacks: str) -> Sequence[T]:
    if not found:
        raise InputError(f"kind case: effect {key}: {lacks} in this plant; choose another seed or leave it out")
    return found


def _far_apart(plant: KindPlant, body: str) -> list[str]:
    """Bodies that neither touch it nor share a neighbour with it; of all others where there is none, the untouched."""
    near: dict[str, set[str]] = {b: set() for b in plant.bodies}
    for a, b in links_W_per_K(plant):
        near[a].add(b)
        near[b].add(a)
    others = [b for b in plant.bodies if b != body and b not in near[body]]
    return [b for b in others if not near[b] & near[body]] or others


class Clamped(Effect):
    """A joint that conducts better while its clamp is closed."""

    mechanism = "joint_conductance"
    kind = "link"
    words = "a clamp that closes a joint"

    def drawn(self, plant: KindPlant, dice: Dice, to: str = "", driver: str = "") -> None:
        joints = links_W_per_K(plant)
        own = [p for p in joints if self.place in p and fnmatchcase(p[p[0] == self.place], to)]
        pair = dice.pick(_some(own, self.key, f"{self.place} touches nothing"))
        self.driver, self.open_W_per_K = driver, joints[pair]
        self.one, self.other = plant.mean(pair[0]), plant.mean(pair[1])
        self.largest = min(20.0, *(largest(plant, plant.bodies[b], self.open_W_per_K) for b in pair))
        self.place, self.also = f"{pair[0]}-{pair[1]}", pair

    def heat_W(self, out: Array, cells_degC: Array, now: Now, size: Array) -> None:
        lead_K = self.other @ cells_degC - self.one @ cells_degC
        out += np.multiply.outer(self.one - self.other, size * self.open_W_per_K * now.drive[str(self.driver)] * lead_K)

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        return {"ratio": (1.0 + size, "1")}


class WrongLink(Clamped):
    """No physics is missing; one joint conducts far better than the file states."""

    mechanism = "wrong_parameter"
    words = "a joint is stated wrong"

    def heat_W(self, out: Array, cells_degC: Array, now: Now, size: Array) -> None:
        lead_K = self.other @ cells_degC - self.one @ cells_degC
        out += np.multiply.outer(self.one - self.other, size * self.open_W_per_K * lead_K)

    def drawn(self, plant: KindPlant, dice: Dice, to: str = "*", driver: str = "") -> None:
        super().drawn(plant, dice, to)
        self.driver = None
        self.least = min(float(np.expm1(3.9 * plant.setting.file_error)), self.largest)

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        return {"factor": (1.0 + size, "1")}


class _Friction(Effect):
    """Feedback of temperatures on a heat of the file."""

    driver = "spindle_rpm"

    def drawn(self, plant: KindPlant, dice: Dice, source: str = "", shaft: str = "", housing: str = "") -> None:
        self.source, housing = source, housing or self.place
        self.shaft, self.housing = plant.mean(shaft), plant.mean(housing)
        self.also = (*(b for b in (shaft, housing) if b != self.place), *plant.sources[source].stated)
        self.more(dice)

    def more(self, dice: Dice) -> None:
        """Draws its own attributes."""


class Thins(_Friction):
    """Grease that thins: friction falls as one over a line in the temperature."""

    mechanism = "viscosity_feedback"
    words = "the grease thins as it warms"

    def more(self, dice: Dice) -> None:
        self.per_K, self.at_degC = dice.span(0.012, 0.03), dice.even(25.0, 40.0)

    def factor(self, source: str, cells_degC: Array, now: Now, size: Array) -> Array | None:
        if source != self.source:
            return None
        over_K = 0.5 * (self.shaft + self.housing) @ cells_degC - self.at_degC
        return 1.0 / np.maximum(1.0 + size * self.per_K * over_K, 0.15)

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        return {"slope": (1.5 * size * self.per_K, "1/K"), "reference": (self.at_degC, "degC")}


class Tightens(_Friction):
    """A shaft warmer than its housing tightens the bearing, up to where the housing gives way."""

    mechanism = "preload_feedback"
    words = "the bearing tightens"
    largest = 30.0

    def more(self, dice: Dice) -> None:
        self.per_K, self.gives_K = dice.span(0.02, 0.08), dice.even(8.0, 25.0)

    def factor(self, source: str, cells_degC: Array, now: Now, size: Array) -> Array | None:
        if source != self.source:
            return None
        lead_K = (self.shaft - self.housing) @ cells_degC
        return np.clip(1.0 + size * self.per_K * lead_K / (1.0 + np.abs(lead_K) / self.gives_K), 0.1, 6.0)

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        return {"kappa": (size * self.per_K, "1/K")}
