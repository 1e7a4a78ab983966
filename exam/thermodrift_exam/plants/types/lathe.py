"""The sample lathe: a simulated slant-bed lathe whose spindle and feed axes warm each other's errors.

Built after the coupled-lathe study's description (travels of 180 mm in X and 520 mm in Z, semi-closed loops, so that a
screw that grows moves its axis). Values are typical of the class; none was measured on a machine.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from data.arrays import Array
from plants.sample.sample_machine import IRON_UM_PER_M_K, STEEL_UM_PER_M_K
from plants.sample.thermal_machine import BearingSet, SpeedHeat, ThermalMachine


@dataclass(frozen=True)
class FeedAxis:
    """One axis: its travel, where the screw is held, and the bodies that its drive heats.

    The screw's three thirds of the travel, `thirds`, begin at the fixed end.
    """

    travel_mm: tuple[float, float]
    fixed_end_mm: float
    thirds: tuple[str, str, str]
    nut: str
    bearing: str
    motor: str
    carriage: str

    def elongation_um(self, rise_K: Mapping[str, Array], position_mm: Array) -> Array:
        """Growth ``alpha ∫ theta dP`` of the screw from its fixed end to the nut, µm; rises and positions alike."""
        third_mm = (self.travel_mm[1] - self.travel_mm[0]) / 3
        away_mm = position_mm - self.fixed_end_mm
        total = np.zeros_like(away_mm)
        for k, body in enumerate(self.thirds):
            total += rise_K[body] * np.clip(away_mm - k * third_mm, 0.0, third_mm)
        return np.asarray(STEEL_UM_PER_M_K * 1e-3 * total)


AXES: Mapping[str, FeedAxis] = MappingProxyType({
    "x": FeedAxis((0.0, 180.0), 0.0, ("x_screw_1", "x_screw_2", "x_screw_3"), "x_nut", "x_bearing", "x_motor",
                  "cross_slide"),
    "z": FeedAxis((-500.0, 20.0), -500.0, ("z_screw_1", "z_screw_2", "z_screw_3"), "z_nut", "z_bearing", "z_motor",
                  "saddle"),
})  # fmt: skip

# Heat of a drive: P = 2 pi N M / 60 with M rising by the feed; nut, screw and thrust bearing take 1/2 of it each.
LEAD_MM, RATED_FEED_MM_PER_MIN = 10.0, 1500.0
TORQUE_NM = (0.25, 0.20)  # at standstill, and what the rated feed adds
MOTOR_W = (15.0, 35.0)  # holding, and what the rated feed adds
GUIDE_W = 15.0  # of the carriage at the rated feed

LATHE = ThermalMachine(
    capacity_J_per_K={
        "shaft": 11e3, "spindle_front": 10e3, "spindle_rear": 7e3, "headstock": 110e3, "spindle_motor": 30e3,
        "bed_left": 420e3, "bed_right": 380e3, "saddle": 85e3, "cross_slide": 45e3, "turret": 60e3, "enclosure": 25e3,
        "x_screw_1": 0.5e3, "x_screw_2": 0.5e3, "x_screw_3": 0.5e3, "x_nut": 1.4e3, "x_bearing": 2.5e3, "x_motor": 7e3,
        "z_screw_1": 1.5e3, "z_screw_2": 1.5e3, "z_screw_3": 1.5e3, "z_nut": 2.6e3, "z_bearing": 4.0e3, "z_motor": 9e3,
    },
    link_W_per_K={
        ("shaft", "spindle_front"): 15, ("shaft", "spindle_rear"): 9, ("spindle_front", "headstock"): 20,
        ("spindle_rear", "headstock"): 16, ("spindle_motor", "headstock"): 4, ("headstock", "bed_left"): 22,
        ("bed_left", "bed_right"): 28, ("saddle", "bed_left"): 4, ("saddle", "bed_right"): 4,
        ("cross_slide", "saddle"): 8, ("turret", "cross_slide"): 12,
        ("x_screw_1", "x_bearing"): 0.6, ("x_screw_1", "x_screw_2"): 0.4, ("x_screw_2", "x_screw_3"): 0.4,
        ("x_nut", "x_screw_1"): 0.4, ("x_nut", "x_screw_2"): 0.5, ("x_nut", "x_screw_3"): 0.4,
        ("x_nut", "cross_slide"): 1.2, ("x_bearing", "saddle"): 1.6, ("x_motor", "x_bearing"): 0.8,
        ("z_screw_1", "z_bearing"): 0.7, ("z_screw_1", "z_screw_2"): 0.3, ("z_screw_2", "z_screw_3"): 0.3,
        ("z_nut", "z_screw_1"): 0.4, ("z_nut", "z_screw_2"): 0.5, ("z_nut", "z_screw_3"): 0.4,
        ("z_nut", "saddle"): 1.6, ("z_bearing", "bed_right"): 2.4, ("z_motor", "z_bearing"): 0.8,
        # to the air of the enclosure
        ("shaft", "enclosure"): 0.8, ("spindle_front", "enclosure"): 1.2, ("headstock", "enclosure"): 6,
        ("bed_left", "enclosure"): 7, ("bed_right", "enclosure"): 6, ("saddle", "enclosure"): 3,
        ("cross_slide", "enclosure"): 3, ("turret", "enclosure"): 4, ("x_nut", "enclosure"): 0.2,
        ("x_screw_1", "enclosure"): 0.15, ("x_screw_2", "enclosure"): 0.15, ("x_screw_3", "enclosure"): 0.15,
        ("z_nut", "enclosure"): 0.3, ("z_screw_1", "enclosure"): 0.35, ("z_screw_2", "enclosure"): 0.35,
        ("z_screw_3", "enclosure"): 0.35,
    },
    room_W_per_K={"spindle_motor": 6, "headstock": 4, "bed_left": 10, "bed_right": 9, "enclosure": 60,
                  "x_motor": 1.5, "z_motor": 1.8, "z_bearing": 0.8},
    floor_W_per_K={"bed_left": 6, "bed_right": 6},
    bearings=(BearingSet("spindle_front", 2, 105.0, 900.0, 45e3), BearingSet("spindle_rear", 2, 95.0, 700.0, 38e3)),
    heats=(
        SpeedHeat("spindle_motor", ((40.0, 0.0), (50.0, 1.0), (30.0, 2.0))), SpeedHeat("spindle_rear", ((20.0, 1.5),)),
    ),
    always_W={"enclosure": 50.0},
    # X: the headstock rises and the slanted slide turns that into X. Z: spindle and bed grow towards the tool.
    um_per_K={
        "x_spindle": {"headstock": 0.09 * IRON_UM_PER_M_K, "spindle_front": 0.05 * IRON_UM_PER_M_K,
                      "turret": -0.03 * IRON_UM_PER_M_K},
        "z_spindle": {"shaft": 0.26 * STEEL_UM_PER_M_K, "headstock": 0.10 * IRON_UM_PER_M_K,
                      "bed_left": 0.20 * IRON_UM_PER_M_K, "turret": -0.06 * IRON_UM_PER_M_K},
    },
    rotating=(("shaft", "enclosure"),),
    rated_rpm=2000.0,
)  # fmt: skip
SLOW_BODIES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"bed": ("bed_left", "bed_right"), "column": ("headstock",), "table": ("saddle", "cross_slide", "turret")}
)


@dataclass(frozen=True)
class Drive:
    """How an axis is driven in one run: friction against the catalogue's, and the shares of the screw's thirds in the
    heat of the nut's rubbing, which follow where the axis cycles."""

    friction: float = 1.0
    shares: tuple[float, float, float] = (0.3, 0.4, 0.3)


def feed_heat_W(machine: ThermalMachine, feed_mm_per_min: Array, drives: Mapping[str, Sequence[Drive]]) -> Array:
    """Heat of the axes' drives into every body (S, B, N), W, at feeds (S, B); `drives`: axis -> one a run."""
    x = feed_mm_per_min / RATED_FEED_MM_PER_MIN
    catalogue_W = 2 * np.pi * feed_mm_per_min / LEAD_MM / 60.0 * (TORQUE_NM[0] + TORQUE_NM[1] * x)
    heat = np.zeros((*feed_mm_per_min.shape, len(machine.bodies)))
    for name, axis in AXES.items():
        rubbed_W = catalogue_W * np.array([d.friction for d in drives[name]])
        heat[..., machine.place[axis.nut]] += rubbed_W / 2
        heat[..., machine.place[axis.bearing]] += rubbed_W / 2
        for k, body in enumerate(axis.thirds):
            heat[..., machine.place[body]] += rubbed_W / 2 * np.array([d.shares[k] for d in drives[name]])
        heat[..., machine.place[axis.motor]] += np.where(x > 0, MOTOR_W[0] + MOTOR_W[1] * x, 0.0)
        heat[..., machine.place[axis.carriage]] += GUIDE_W * x
    return heat
