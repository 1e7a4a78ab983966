"""Cells and small packs: wound cores, cans, tabs, a holder; driven by a current, positive while it charges.

Temperatures, and on some rigs the hoop strain of the first can.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from data.arrays import Array
from thermodrift_exam.plants.kinds.common import Item, Kind, setting
from thermodrift_exam.plants.kinds.effects.base import Effect, Seen
from thermodrift_exam.plants.kinds.effects.exchanges import Bridge, Gate, Radiates, Rises
from thermodrift_exam.plants.kinds.effects.faults import Reverses
from thermodrift_exam.plants.kinds.effects.heats import ByDriver, Cabinet, Cross, Plateau, Product, Pump, WrongHeat
from thermodrift_exam.plants.kinds.engine import Cells, Mesh, Solid
from thermodrift_exam.plants.kinds.menus import faults
from thermodrift_exam.plants.kinds.plant import (
    Dice,
    Drive,
    Driver,
    Growth,
    KindPlant,
    Source,
    Stated,
    expanding,
    place_sensors,
    spread,
)
from thermodrift_exam.plants.kinds.runs import Now, switch, worked
from thermodrift_exam.plants.options import stream
from thermodrift_exam.plants.runs import Block


def draw_battery(seed: int, effects: frozenset[str] = frozenset()) -> KindPlant:
    dice = Dice(stream(seed, "battery"))
    number = dice.whole(2, 3) if "heat_bridge" in effects else dice.whole(1, 3)
    mesh, bodies = _parts(dice, number, "heat_bridge" in effects)
    row_s = dice.pick((5.0, 10.0, 20.0))
    own = setting(
        dice, effects, row_s=row_s, hours=(dice.even(0.4, 0.7), dice.even(0.8, 1.3)), solver_s=5.0, before_h=0.6,
        before_step_s=10.0, noise_K=dice.span(0.01, 0.1), step_K=dice.pick((0.0, 0.01, 0.1)),
        room_degC=(dice.even(10.0, 20.0), dice.even(22.0, 32.0)), day_K=dice.span(0.05, 0.5),
        ripple_K=dice.span(0.02, 0.4), ripple_s=dice.span(200.0, 1200.0), slow_K=0.2, sensor_lag_s=dice.span(2.0, 15.0),
        noise_um=dice.span(0.3, 3.0), step_um=dice.pick((0.0, 0.1, 1.0)), runs=dice.whole(6, 12),
    )  # fmt: skip
    solid = mesh.solid(dice.even(1.0, 3.0))
    top_A = dice.span(4.0, 20.0)
    drivers = {"current": _current(top_A), "fan": switch((300.0, 1200.0), 0.3)}
    sure = {n: 0.1 for n in bodies if n.startswith("core")} | {n: 0.95 for n in bodies if n.startswith("can")}
    sensors = place_sensors(dice, solid, bodies, sure, own)
    thick = dice.chance(0.5) or bool(effects & {"charge_strain", "unlisted_reversal"})
    growths = {
        f"{part}@strain": Growth("strain", expanding(solid, [(bodies[f"{part}1"], dice.span(*part_of))]))
        for part, part_of in (("core", (0.2, 0.7)), ("can", (0.1, 0.5)))
        if thick
    }
    return KindPlant(
        solid, bodies, _sources(dice, solid, bodies, number, top_A), growths, sensors, drivers, ("room",), own,
        errors=("strain",) if thick else (), rated=top_A, error_unit="um/m",
    )  # fmt: skip


def _parts(dice: Dice, number: int, uncoupled: bool) -> tuple[Mesh, dict[str, Cells]]:
    """Cells with a tab each, in a holder that joins them or, uncoupled, in a clamp of their own."""
    mesh = Mesh()
    outer, high = dice.span(0.009, 0.024), dice.span(0.06, 0.12)
    share, film = dice.span(6.0, 25.0), dice.even(0.0, 0.08) * dice.chance(0.5)
    for k in range(1, number + 1):
        at = (0.0, 2.6 * outer * k, 0.0)
        mesh.ring(f"core{k}", "wound", 0.15 * outer, outer - 0.0005, high, (4, 3), at, 1.0, dice.span(15.0, 30.0))
        mesh.ring(f"can{k}", dice.pick(("steel", "aluminium")), outer - 0.0005, outer, high, (4, 1), at)
        mesh.box(f"tab{k}", "copper", (0.02, 0.012, dice.span(0.0015, 0.004)), (3, 1, 1), (high, at[1], 0.0))
        mesh.contact(mesh.patch(f"core{k}", "out"), mesh.patch(f"can{k}", "in"), dice.span(0.8, 6.0))
        mesh.contact(mesh.patch(f"tab{k}", "x-"), mesh.patch(f"core{k}", "x+"), dice.span(0.03, 0.3))
        mesh.film(f"can{k}", "room", share, ("out",), film)
        mesh.film(f"tab{k}", "room", share, (), film)
    for k in range(1, number + 1 if uncoupled else 2):
        name = f"holder{k}" if uncoupled else "holder"
        wide = 2.6 * outer * (1 if uncoupled else number)
        mesh.box(name, "wound", (0.04, wide, 0.012), (2, 3, 1), (0.3 * high, 2.6 * outer * k, 0.0))
        mesh.film(name, "room", 0.7 * share, (), film)
        for j in (k,) if uncoupled else range(1, number + 1):
            low, top = (0.0, 1.0) if uncoupled else ((j - 1) / number, j / number)
            under = mesh.patch(name, "z+", low, top, 1)
            mesh.contact(under, mesh.patch(f"can{j}", "out", 0.2, 0.8), dice.span(0.05, 0.5))
    return mesh, dict(mesh.blocks)


def _current(top_A: float) -> Driver:
    """Discharge by one of the protocols, in some runs in turns with charge."""
    drawn = worked(0.2 * top_A, top_A, 120.0, (0.06, 0.16), 0.1)

    def draw(rng: np.random.Generator, number: int, end_s: float) -> tuple[Block, ...]:
        blocks, turns = drawn(rng, number, end_s), rng.random() < 0.5
        return tuple(Block(b.from_s, -b.value if not turns or k % 2 == 0 else b.value) for k, b in enumerate(blocks))

    return Driver("A", -top_A, top_A, draw)


def _sources(dice: Dice, solid: Solid, bodies: Mapping[str, Cells], number: int, top_A: float) -> dict[str, Source]:
    """Loss by the square of the current, with a small linear term; cells in series, each with its resistance."""
    out: dict[str, Source] = {}
    common = dice.span(0.8, 6.0)
    for k in range(1, number + 1):
        watts, linear = common * dice.span(0.85, 1.2), dice.even(0.0, 0.12)

        def power_W(drive: Drive, watts: float = watts, linear: float = linear) -> Array:
            x = np.abs(drive["current"]) / top_A
            return watts * (linear * x + (1.0 - linear) * x * x)

        core = f"core{k}"
        stated = Stated(
            "ohmic_heat", "current", {core: 1.0}, {"resistance": (watts / top_A**2, "ohm")}, at={"body": core}
        )
        out[f"cell{k}"] = Source(spread(solid, bodies[core]), power_W, {f"cell{k}": stated})
    return out


class Swells(Effect):
    """Electrodes that swell with the charge that is in them."""

    mechanism = "charge_strain"
    kind = "error"
    driver = "current"
    words = "the cell swells with its charge"

    def drawn(self, plant: KindPlant, dice: Dice) -> None:
        self.um, self.wave = dice.span(20.0, 150.0), dice.even(0.1, 0.35)
        self.full_As = 0.6 * 3600.0 * plant.rated * plant.setting.hours[1]

    def displaced(self, seen: Seen, size: float) -> Mapping[str, Array]:
        charge = np.cumsum(seen.drive["current"], axis=0) * (seen.time_s[1] - seen.time_s[0]) / self.full_As
        return {self.place: size * self.um * (charge + self.wave * np.sin(2 * np.pi * charge) / np.pi)}


class Sluggish(Effect):
    """A cold cell resists more: its heat grows below a temperature, up to a limit."""

    mechanism = None
    driver = "current"
    largest = 20.0

    def drawn(self, plant: KindPlant, dice: Dice) -> None:
        self.source, self.mean = f"cell{self.place[-1]}", plant.mean(self.place)
        self.per_K, self.at_degC = dice.span(0.01, 0.03), dice.even(18.0, 26.0)
        self.words, self.form = f"the heat of {self.place} falls as it warms", ()

    def factor(self, source: str, cells_degC: Array, now: Now, size: Array) -> Array | None:
        if source != self.source:
            return None
        colder = np.tanh((self.at_degC - self.mean @ cells_degC) / 10.0)
        return np.maximum(1.0 + size * self.per_K * 10.0 * colder, 0.2)


WATTS = (0.1, 0.8)
BATTERY = Kind(
    draw_battery,
    {
        "cabinet_heat": Item(Cabinet, ("holder*", "tab1"), {"watts": WATTS}),
        "hydraulic_unit": Item(Pump, ("holder*", "can1"), {"watts": WATTS}),
        "tab_heat": Item(
            ByDriver, ("tab*",),
            {"driver": "current", "mechanism": "ohmic_heat", "exponent": (1.9, 2.2), "watts": WATTS,
             "words": "current warms a tab"},
        ),
        "fan_motor": Item(Cabinet, ("holder*", "can*"), {"watts": WATTS, "running": "fan"}),
        "radiation": Item(Radiates, ("can*", "tab*"), {"to": "room", "area": (0.002, 0.01)}),
        "natural_convection": Item(Rises, ("can*",), {"area": (0.002, 0.01)}),
        "draught": Item(Gate, ("can1",)),
        "heat_bridge": Item(Bridge, ("can1", "can2"), {"conductance": (0.02, 0.2)}),
        "charge_strain": Item(Swells, ("strain",)),
        "wrong_heat": Item(WrongHeat, ("core1",), {"source": "cell1"}),
        **faults(("can*", "tab*"), "can*", "tab*", "holder*"),
    },
    {
        "unlisted_warm_current": Item(
            Product, ("can1", "holder*"), {"driver": "current", "watts": WATTS, "signed": True}
        ),
        "unlisted_fan_current": Item(
            Cross, ("holder*", "tab1"), {"driver": "current", "other": "fan", "watts": WATTS, "exponent": (1.8, 2.2)}
        ),
        "unlisted_plateau": Item(Plateau, ("core1", "can1")),
        "unlisted_cold_cell": Item(Sluggish, ("core*",)),
        "unlisted_reversal": Item(Reverses, ("strain",), {"driver": "current", "um": (2.0, 12.0)}),
    },
)  # fmt: skip
