"""Parts that several kinds share: settings, drivers, heats of bearings, motors, axes; the interface of a kind."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from thermodrift_exam.plants.kinds.effects.base import Effect
from thermodrift_exam.plants.kinds.engine import Cells, Solid
from thermodrift_exam.plants.kinds.plant import Dice, Drive, Driver, KindPlant, Setting, Source, Stated, spread
from thermodrift_exam.plants.kinds.runs import strokes, worked


@dataclass(frozen=True)
class Item:
    """An effect on a kind's list: its class, the places that it may be at (* for any ending), and options."""

    make: type[Effect]
    places: tuple[str, ...]
    options: Mapping[str, Any] = field(default_factory=dict)


Menu = Mapping[str, Item]


@dataclass(frozen=True)
class Kind:
    """A kind of plant: how one is drawn from a seed, fit for some effects, and the effects that it may have."""

    draw: Callable[[int, frozenset[str]], KindPlant]
    listed: Menu
    unlisted: Menu


def setting(dice: Dice, effects: frozenset[str], **own: Any) -> Setting:
    """Default settings of recordings in shops; a kind overrides its own.

    A file that states lags or offsets of its sensors lacks neither: a case of such a fault has another file.
    """
    row_s = own.pop("row_s", None) or dice.pick((60.0, 120.0, 180.0, 300.0))
    hours = own.pop("hours", None) or ((1.0, 3.5) if row_s < 100 else (2.5, 8.0))
    usual: dict[str, Any] = {
        "runs": dice.whole(6, 13), "hours": hours, "row_s": row_s, "solver_s": row_s / np.ceil(row_s / 30.0),
        "before_h": dice.even(5.0, 10.0), "before_step_s": 60.0,
        "noise_K": dice.span(0.02, 0.1), "step_K": dice.pick((0.0, 0.01, 0.1, 0.1)),
        "noise_um": dice.span(0.2, 1.5), "step_um": dice.pick((0.0, 0.1, 0.1, 1.0)),
        "room_degC": (dice.even(12.0, 19.0), dice.even(22.0, 30.0)), "day_K": dice.span(0.3, 3.0),
        "ripple_K": dice.span(0.05, 0.6), "ripple_s": dice.span(700.0, 5000.0), "slow_K": dice.even(0.3, 3.0),
        "file_error": dice.even(0.1, 0.4), "mass_error": dice.even(0.05, 0.2), "sensor_lag_s": dice.span(10.0, 60.0),
        "states_offsets": dice.chance(0.5) and "sensor_offset" not in effects,
        "states_lags": dice.chance(0.5) and "sensor_lag" not in effects, "scatter": dice.pick((0.0, 0.0, 0.02)),
    }  # fmt: skip
    out = Setting(**{**usual, **own})
    return out if out.states_lags else replace(out, sensor_lag_s=min(out.sensor_lag_s, 0.1 * row_s))


def spindle(dice: Dice, rated_rpm: float, history: bool = True) -> Driver:
    draw = worked(0.1 * rated_rpm, rated_rpm, 300.0, (0.05, 0.14), 50.0)
    return Driver("rpm", 0.0, rated_rpm, draw, 1.0, history)


def axis_feed(dice: Dice, top_mm_per_min: float, signed: bool = False) -> Driver:
    def feed(rng: np.random.Generator) -> float:
        value = float(np.round(rng.uniform(0.25, 1.0) * top_mm_per_min, -2))
        return value * (1.0 if not signed or rng.random() < 0.5 else -1.0)

    draw = strokes(feed, (600.0, 4000.0), 0.25)
    return Driver("mm/min", -top_mm_per_min if signed else 0.0, top_mm_per_min, draw, 1.0)


RPM_NMM_W = 1.047e-4  # W of 1 N mm at 1 rpm
VISCOSITY_MM2_PER_S = 22.0
STATIC_N, LOAD_FACTOR, LOAD_EXPONENT = 26000.0, 0.001, 0.33


def bearings(
    dice: Dice, solid: Solid, name: str, rated_rpm: float, watts: tuple[float, float], shaft: tuple[str, Cells],
    housing: tuple[str, Cells], diameter_mm: float,
) -> dict[str, Source]:  # fmt: skip
    """A set of bearings: P = W (n / rated)^p with p of 1.35 to 1.7, parted between shaft and housing.

    The file states it as Palmgren (1959) does, a viscous and a load part that add up to the same at the rated speed
    and half of it.
    """
    at_rated, exponent, inner = dice.span(*watts), dice.even(1.35, 1.7), dice.even(0.35, 0.6)

    def power_W(drive: Drive) -> Any:
        return at_rated * (np.abs(drive["spindle_rpm"]) / rated_rpm) ** exponent

    half = 0.5**exponent
    viscous = (half - 0.5) / (0.5 ** (5.0 / 3.0) - 0.5)
    share = inner * spread(solid, shaft[1]) + (1.0 - inner) * spread(solid, housing[1])
    count, per_Nmm = 2.0, 2.0 * RPM_NMM_W * rated_rpm
    unit_Nmm = 1e-7 * (VISCOSITY_MM2_PER_S * rated_rpm) ** (2.0 / 3.0) * diameter_mm**3
    moment_Nmm = max(1.0 - viscous, 0.02) * at_rated / per_Nmm
    preload_N = (moment_Nmm * STATIC_N**LOAD_EXPONENT / (LOAD_FACTOR * diameter_mm)) ** (1.0 / (1.0 + LOAD_EXPONENT))
    into = {shaft[0]: inner, housing[0]: 1.0 - inner}
    fixed: dict[str, str | float] = {"count": count, "mean_diameter": f"{diameter_mm:.0f} mm"}
    stated = {
        f"{name}_viscous": Stated(
            "bearing_viscous", "spindle_rpm", into,
            {"lubrication": (viscous * at_rated / (per_Nmm * unit_Nmm), "")},
            {**fixed, "viscosity": f"{VISCOSITY_MM2_PER_S:g} mm**2/s"},
        ),
        f"{name}_load": Stated(
            "bearing_load", "spindle_rpm", into, {"preload": (preload_N, "N")},
            {**fixed, "static_capacity": f"{STATIC_N:g} N"},
        ),
    }  # fmt: skip
    return {name: Source(share, power_W, stated)}


def motor(
    dice: Dice, solid: Solid, name: str, body: tuple[str, Cells], rated: float, watts: tuple[float, float],
    driver: str = "spindle_rpm",
) -> dict[str, Source]:  # fmt: skip
    """Losses of a motor: something as soon as it turns, the rest by a power of the speed."""
    at_rated, idle, exponent = dice.span(*watts), dice.even(0.1, 0.35), dice.even(1.15, 1.85)

    def power_W(drive: Drive) -> Any:
        x = np.abs(drive[driver]) / rated
        return at_rated * (idle * (x > 0) + (1.0 - idle) * x**exponent)

    square = (1.0 - idle) * (exponent - 1.0)
    stated = Stated(
        "motor_loss", driver, {body[0]: 1.0},
        {"idle": (idle * at_rated, "W"), "linear": ((1.0 - idle - square) * at_rated, "W"),
         "quadratic": (square * at_rated, "W")},
        {"rated": f"{rated:g} rpm"},
    )  # fmt: skip
    return {name: Source(spread(solid, body[1]), power_W, {name: stated})}


def feed_loss(
    dice: Dice, solid: Solid, name: str, body: tuple[str, Cells], top: float, watts: tuple[float, float],
    driver: str = "feed",
) -> dict[str, Source]:  # fmt: skip
    """A nut's or a guide's friction, nearly proportional to the feed."""
    at_top, exponent, lead_mm = dice.span(*watts), dice.even(0.85, 1.05), 10.0

    def power_W(drive: Drive) -> Any:
        return at_top * (np.abs(drive[driver]) / top) ** exponent

    moment_Nm = at_top * 60.0 * lead_mm / (2.0 * np.pi * top)
    stated = Stated("nut_friction", driver, {body[0]: 1.0}, {"moment": (moment_Nm, "N*m")}, {"lead": f"{lead_mm:g} mm"})
    return {name: Source(spread(solid, body[1]), power_W, {name: stated})}
