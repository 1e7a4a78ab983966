"""Laboratory boards: two or three heaters with sinks on a circuit board, sensors, a few watts; temperatures alone.

The machine file names heaters and, on some boards, the board and the sinks. What couples the heaters through the board
and the air is in the file or, as an effect, not.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from data.arrays import Array
from thermodrift_exam.plants.kinds.common import Item, Kind, setting
from thermodrift_exam.plants.kinds.effects.base import Effect
from thermodrift_exam.plants.kinds.effects.exchanges import Bridge, Gate, Radiates, Rises
from thermodrift_exam.plants.kinds.effects.heats import ByDriver, Cabinet, Cross, Plateau, Product, Pump, WrongHeat
from thermodrift_exam.plants.kinds.engine import Cells, Mesh, Solid
from thermodrift_exam.plants.kinds.menus import faults
from thermodrift_exam.plants.kinds.plant import Dice, Drive, Driver, KindPlant, Source, Stated, place_sensors, spread
from thermodrift_exam.plants.kinds.runs import Now, worked
from thermodrift_exam.plants.options import stream


def draw_board(seed: int, effects: frozenset[str] = frozenset()) -> KindPlant:
    dice = Dice(stream(seed, "board"))
    number = dice.whole(2, 3)
    mesh, bodies = _parts(dice, number, "missing_link" in effects)
    row_s = dice.pick((5.0, 10.0))
    own = setting(
        dice, effects, row_s=row_s, hours=(dice.even(0.25, 0.4), dice.even(0.45, 0.7)), solver_s=row_s / 2.0,
        before_h=0.5, before_step_s=5.0, noise_K=dice.span(0.02, 0.15), step_K=dice.pick((0.0, 0.0, 0.03, 0.3)),
        room_degC=(dice.even(18.0, 21.0), dice.even(22.0, 26.0)), day_K=dice.span(0.1, 0.8),
        ripple_K=dice.span(0.02, 0.3), ripple_s=dice.span(300.0, 1500.0), slow_K=0.2, sensor_lag_s=dice.span(2.0, 20.0),
        runs=dice.whole(6, 12),
    )  # fmt: skip
    solid = mesh.solid(dice.even(1.0, 3.0))
    top = dice.pick((1.0, 100.0))
    drivers = {f"heater_{k}": _heater(k, top) for k in range(1, number + 1)}
    sources: dict[str, Source] = {}
    for k in range(1, number + 1):
        sources |= _heated(dice, solid, f"heater_{k}", f"heat{k}", bodies[f"heater{k}"], top)
    always = {f"heater{k}": 1.0 for k in range(1, number + 1)}
    sensors = place_sensors(dice, solid, bodies, always, own, 0.4,
                            {f"heater{k}": bodies[f"heater{k}"][:4] for k in range(1, number + 1)})  # fmt: skip
    return KindPlant(solid, bodies, sources, {}, sensors, drivers, ("room",), own, rated=top)


def _parts(dice: Dice, number: int, uncoupled: bool) -> tuple[Mesh, dict[str, Cells]]:
    """Uncoupled heaters stand on a piece of board each, which the file does not name."""
    mesh = Mesh()
    board = dice.chance(0.6) and not uncoupled
    names = board, board and dice.chance(0.6)  # whether the file names the board, and the sinks
    wide, still, exponent = dice.span(0.03, 0.06), dice.span(5.0, 12.0), dice.even(0.0, 0.05) * dice.chance(0.5)
    for k in range(number if uncoupled else 1):
        length = 0.05 * (1 if uncoupled else number)
        mesh.box(f"board{k}", "board", (length, wide, 0.0016), (round(60 * length), 3, 1), (0.05 * k, 0.0, 0.0))
        mesh.film(f"board{k}", "room", still, ("z-", "z+"), exponent)
    bodies: dict[str, Cells] = {}
    for k in range(1, number + 1):
        at = 0.05 * (k - 0.5)
        mesh.box(f"heater{k}", "copper", (0.012, 0.01, dice.span(0.002, 0.006)), (2, 2, 1), (at, 0.015, 0.0016))
        size = dice.span(0.015, 0.03)
        mesh.box(f"sink{k}", "aluminium", (size, size, dice.span(0.008, 0.02)), (2, 1, 3), (at, 0.012, 0.01), 0.3)
        bolted = dice.span(0.3, 2.0) * (1.0 if names[1] else 4.0)
        mesh.contact(mesh.patch(f"heater{k}", "z+"), mesh.patch(f"sink{k}", "z-"), bolted)
        own = (f"board{k - 1}", 0.3, 0.7) if uncoupled else ("board0", (k - 0.7) / number, (k - 0.3) / number)
        feet = mesh.patch(own[0], "z+", own[1], own[2])
        mesh.contact(mesh.patch(f"heater{k}", "z-"), feet, dice.span(0.02, 0.1) * (1.0 if board else 3.0))
        mesh.film(f"sink{k}", "room", dice.even(2.0, 3.5) * still, (), exponent)
        mesh.film(f"heater{k}", "room", still, ("x-", "x+", "y-", "y+"), exponent)
        if names[1]:
            bodies |= {f"heater{k}": mesh.blocks[f"heater{k}"], f"sink{k}": mesh.blocks[f"sink{k}"]}
        else:
            bodies[f"heater{k}"] = np.r_[mesh.blocks[f"heater{k}"], mesh.blocks[f"sink{k}"]]
    if names[0]:
        return mesh, {**bodies, "board": mesh.blocks["board0"]}
    return mesh, _with_board(mesh, bodies, number)


def _with_board(mesh: Mesh, bodies: dict[str, Cells], number: int) -> dict[str, Cells]:
    """A board that the file does not name belongs to its heaters, each to the nearest."""
    board = np.concatenate([cells for name, cells in mesh.blocks.items() if name.startswith("board")])
    at = np.array([mesh.xyz[c][0] for c in board])
    nearest = np.clip((at / 0.05).astype(int), 0, number - 1) + 1
    return {
        name: np.r_[cells, board[nearest == int(name[-1])]] if name.startswith("heater") else cells
        for name, cells in bodies.items()
    }


def _heater(k: int, top: float) -> Driver:
    """The other heaters begin later, and rest in some runs."""
    protocol = worked(0.15 * top, top, 60.0 + 90.0 * (k - 1), (0.08, 0.2), top / 20.0)

    def draw(rng: np.random.Generator, number: int, end_s: float) -> Any:
        return () if k > 1 and rng.random() < 0.25 else protocol(rng, number + 2 * (k - 1), end_s)

    return Driver("1" if top == 1.0 else "%", 0.0, top, draw)


def _heated(dice: Dice, solid: Solid, driver: str, name: str, cells: Cells, top: float) -> dict[str, Source]:
    watts, bend = dice.span(0.6, 4.0), dice.even(-0.06, 0.02)

    def power_W(drive: Drive) -> Array:
        x = drive[driver] / top
        return watts * x * (1.0 + bend * x)

    stated = Stated("electrical_heat", {"level": driver}, {f"heater{driver[-1]}": 1.0}, {"gain": (watts / top, "W")})
    return {name: Source(spread(solid, cells[:4]), power_W, {name: stated})}


class Sags(Effect):
    """Heaters on one supply: while the others draw, this one heats less, the more so the more they draw."""

    mechanism = "supply_sag"
    words = "a shared supply sags"
    largest = 8.0

    def drawn(self, plant: KindPlant, dice: Dice) -> None:
        k = self.place[-1]
        self.source, others = f"heat{k}", [d for d in plant.drivers if d != f"heater_{k}"]
        self.other, self.top, self.share = dice.pick(others), plant.rated, dice.even(0.08, 0.2)
        self.driver, self.also = self.other, (self.source,)

    def factor(self, source: str, cells_degC: Array, now: Now, size: Array) -> Array | None:
        if source != self.source:
            return None
        x = now.drive[self.other] / self.top
        return 1.0 / (1.0 + size * self.share * x**1.2)

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        lost = size * self.share
        return {"sag": (lost / (1.0 + lost), "1"), "rated": (self.top, "1")}


HEATERS = ("heater*",)
BOARD = Kind(
    draw_board,
    {
        "missing_link": Item(Bridge, ("heater1", "heater2"), {"conductance": (0.002, 0.02)}),
        "supply_sag": Item(Sags, HEATERS),
        "cabinet_heat": Item(Cabinet, ("board", "heater*"), {"watts": (0.05, 0.4)}),
        "hydraulic_unit": Item(Pump, ("board", "heater*"), {"watts": (0.05, 0.4)}),
        "radiation": Item(Radiates, ("heater*", "sink*"), {"to": "room", "area": (0.001, 0.005)}),
        "natural_convection": Item(Rises, ("heater*", "sink*"), {"area": (0.001, 0.004)}),
        "draught": Item(Gate, ("heater1",)),
        "other_heater": Item(
            ByDriver, ("heater1", "board"),
            {"driver": "heater_2", "mechanism": "electrical_heat", "exponent": (1.0, 1.2), "watts": (0.05, 0.4),
             "words": "a heater's leads warm another place"},
        ),
        "wrong_heat": Item(WrongHeat, ("heater2",), {"source": "heat2"}),
        **faults(("heater*",), "heater*", "board", "sink*"),
    },
    {
        "unlisted_warm_level": Item(Product, ("heater1",), {"driver": "heater_1", "watts": (0.05, 0.5)}),
        "unlisted_both": Item(
            Cross, ("heater1", "board"), {"driver": "heater_1", "other": "heater_2", "watts": (0.05, 0.5)}
        ),
        "unlisted_plateau": Item(Plateau, HEATERS),
    },
)  # fmt: skip
