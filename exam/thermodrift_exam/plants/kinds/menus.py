"""Lists of effects that kinds share: of any recording, of a shop, of a spindle."""

from __future__ import annotations

from thermodrift_exam.plants.kinds.common import Item
from thermodrift_exam.plants.kinds.effects.exchanges import (
    Floor,
    Fluid,
    Gate,
    Radiates,
    Rises,
    Thins,
    Tightens,
    Windy,
    WrongLink,
)
from thermodrift_exam.plants.kinds.effects.faults import Bonded, Drifts, Jumps, Late, Offset, Path, Skewed, Swapped
from thermodrift_exam.plants.kinds.effects.heats import ByDriver, Cabinet, Pump, Sun, Withheld, WrongCapacity, WrongHeat

Places = tuple[str, ...]
BY_SPEED = ("motor_loss", "bearing_viscous", "bearing_load")  # what windage may be taken for


def faults(quick: Places, *bodies: str) -> dict[str, Item]:
    """What every kind may have: sensors, clocks, values of the file; lags show in the `quick` bodies."""
    return {
        "sensor_lag": Item(Late, quick),
        "sensor_drift": Item(Drifts, bodies),
        "sensor_bonding": Item(Bonded, bodies),
        "sensor_offset": Item(Offset, bodies),
        "sensor_swap": Item(Swapped, bodies),
        "time_skew": Item(Skewed, quick),
        "wrong_capacity": Item(WrongCapacity, bodies),
        "wrong_link": Item(WrongLink, bodies),
    }


def shop(heated: Places, sunny: Places, floor: Places, moving: Places, feed: str = "feed") -> dict[str, Item]:
    """Surroundings of a machine in a hall, and friction of what moves."""
    return {
        "cabinet_heat": Item(Cabinet, heated),
        "hydraulic_unit": Item(Pump, heated),
        "sun": Item(Sun, sunny),
        "floor_sink": Item(Floor, floor),
        "draught": Item(Gate, floor),
        "guide_friction": Item(
            ByDriver, moving,
            {"driver": feed, "mechanism": "guide_friction", "exponent": (0.8, 1.1), "stribeck": 0.6,
             "words": "the guides rub"},
        ),
    }  # fmt: skip


def fluid(wet: Places, driver: str = "coolant") -> dict[str, Item]:
    return {"cutting_fluid": Item(Fluid, wet, {"driver": driver})}


def spindle_unit(
    near: Places, turning: Places, windy: Places, shaft: str, source: str = "front_bearings", motor: str = "motor",
    errors: Places = ("z",),
) -> dict[str, Item]:  # fmt: skip
    """Heats, feedback, cooling and shift of a spindle; `near` are the bodies that hold its front bearings."""
    return {
        "belt_loss": Item(
            ByDriver, windy,
            {"driver": "spindle_rpm", "mechanism": "belt_loss", "exponent": (2.0, 2.7), "words": "windage or a belt",
             "same_as": BY_SPEED},
        ),
        "motor_loss": Item(
            Withheld, (motor,), {"source": "motor_loss", "mechanism": "motor_loss", "driver": "spindle_rpm"}
        ),
        "natural_convection": Item(Rises, (motor, *near)),
        "radiation": Item(Radiates, near, {"to": motor}),
        "rotating_convection": Item(Windy, turning),
        "viscosity_feedback": Item(Thins, near, {"source": source, "shaft": shaft}),
        "preload_feedback": Item(Tightens, near, {"source": source, "shaft": shaft}),
        "wrong_heat": Item(WrongHeat, near, {"source": source}),
        "speed_shift": Item(Jumps, errors),
    }  # fmt: skip


def paths(**growths: tuple[str, str]) -> dict[str, Item]:
    """Terms of errors that the file may leave out: key -> growth and the mechanism that it is."""
    return {key: Item(Path, ("*",), {"growth": g, "mechanism": m}) for key, (g, m) in growths.items()}
