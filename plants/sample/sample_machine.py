"""The sample machine: a simulated vertical machining centre as a thermal network of 14 nodes.

The numbers stand in the tables below with their units; typical of the class, none was measured on a machine.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from data.arrays import Array
from plants.sample.thermal_machine import BearingSet, SpeedHeat, ThermalMachine

CAPACITY_J_PER_K: Mapping[str, float] = MappingProxyType({
    "shaft": 6.6e3, "front": 7.7e3, "rear": 4.8e3, "motor": 25e3, "head_front": 55e3, "head_rear": 65e3, "screw": 6.6e3,
    "column_front": 165e3, "column_back": 165e3, "bed": 1100e3, "table": 275e3, "mandrel": 1.6e3, "fixture": 3.6e3,
    "air": 25e3,
})  # fmt: skip
NODES: tuple[str, ...] = tuple(CAPACITY_J_PER_K)
NODE: Mapping[str, int] = MappingProxyType({name: i for i, name in enumerate(NODES)})

LINK_W_PER_K: Mapping[tuple[str, str], float] = MappingProxyType({
    ("shaft", "front"): 14, ("shaft", "rear"): 8, ("shaft", "mandrel"): 9, ("front", "head_front"): 22,
    ("rear", "head_rear"): 18, ("motor", "head_rear"): 8, ("head_front", "head_rear"): 45,
    ("head_front", "column_front"): 14, ("head_rear", "column_front"): 6, ("screw", "head_rear"): 5,
    ("screw", "column_front"): 5, ("column_front", "column_back"): 35, ("column_front", "bed"): 18,
    ("column_back", "bed"): 18, ("bed", "table"): 14, ("table", "fixture"): 2.5,
    # to the enclosure's air
    ("shaft", "air"): 0.8, ("mandrel", "air"): 0.5, ("front", "air"): 1, ("head_front", "air"): 5,
    ("screw", "air"): 1.2, ("column_front", "air"): 6, ("bed", "air"): 6, ("table", "air"): 11, ("fixture", "air"): 0.5,
})  # fmt: skip
ROOM_W_PER_K: Mapping[str, float] = MappingProxyType(
    {"rear": 0.6, "motor": 9, "head_rear": 7, "column_front": 3, "column_back": 13, "bed": 16, "air": 70}
)
FLOOR_W_PER_K: Mapping[str, float] = MappingProxyType({"bed": 10})

ROTATING: tuple[tuple[str, str], ...] = (("shaft", "air"), ("mandrel", "air"))
RATED_RPM = 6000.0

# Preloads and capacities make the load part 10-25 % of the viscous moment, the usual share.
BEARINGS = (BearingSet("front", 3, 77.5, 800.0, 26e3), BearingSet("rear", 2, 70.0, 600.0, 22e3))
HEATS = (
    SpeedHeat("motor", ((40.0, 0.0), (110.0, 1.0), (80.0, 2.0))),
    SpeedHeat("rear", ((70.0, 1.5),)),  # the belt, at the rear housing, where the pulley sits
)
AUXILIARIES_W = 60.0  # into the enclosure's air, always

STEEL_UM_PER_M_K, IRON_UM_PER_M_K = 11.5, 10.8
# (node, length m, steel?); + closes the gap between tool and workpiece. Head and column: mean of their halves.
Z_CHAIN = (
    ("screw", 0.30, True), ("head_front", 0.15, False), ("head_rear", 0.15, False), ("shaft", 0.09, True),
    ("mandrel", 0.20, True), ("fixture", 0.08, True), ("table", 0.28, False),
    ("column_front", -0.625, False), ("column_back", -0.625, False),
)  # fmt: skip
# + moves the spindle away from the column: the head reaches 0.45 m forward, bed and saddle carry the table as far.
Y_CHAIN = (("head_front", 0.225, False), ("head_rear", 0.225, False), ("bed", -0.25, False), ("table", -0.20, False))
# The probe nest sits 0.10 m beside the middle of the table, its scale on the bed.
X_CHAIN = (("table", 0.10, False), ("bed", -0.10, False))
COLUMN_HEIGHT_M, COLUMN_DEPTH_M, HEAD_REACH_M = 1.25, 0.50, 0.45
# The motor is flanged to one side of the head; its heat crosses the head's width through this conductance.
HEAD_SIDE_W_PER_K, HEAD_WIDTH_M = 50.0, 0.30
SPEED_SHIFT_UM = 4.0  # at 6000 rpm, proportional to n²


def network(speed_rpm: float) -> tuple[Array, Array, Array]:
    """Rates of the network at one speed: A (14, 14) in 1/s, and room and floor gains (14,) in 1/s."""
    return machine().rates(speed_rpm)


def heat_W(node_degC: Array, speed_rpm: Array, friction: Array) -> Array:
    """Heat into every node (B, 14), W, from temperatures (B, 14), speed (B,) and the friction factor (B,)."""
    return machine().heat_W(node_degC, speed_rpm, friction)


def simulate(
    speed_rpm: Array,
    room_degC: Array,
    floor_degC: Array,
    start_degC: Array,
    friction: Array,
    step_s: float = 10.0,
    auxiliaries_W: float = AUXILIARIES_W,
) -> Array:
    """Node temperatures (S + 1, B, 14) of B batches at once, as `ThermalMachine.simulate`."""
    return machine(auxiliaries_W).simulate(speed_rpm, room_degC, floor_degC, start_degC, friction, step_s)


def chain_um(
    chain: tuple[tuple[str, float, bool], ...], rise_K: Array, common_um_per_m_K: float | None = None
) -> Array:
    """Sum of ``alpha L theta`` over a chain, µm, from rises (..., 14); one alpha for all if given."""
    total = np.zeros(rise_K.shape[:-1])
    for node, length_m, steel in chain:
        alpha = STEEL_UM_PER_M_K if steel else IRON_UM_PER_M_K
        total += (alpha if common_um_per_m_K is None else common_um_per_m_K) * length_m * rise_K[..., NODE[node]]
    return total


def displacement_um(rise_K: Array, speed_rpm: Array) -> dict[str, Array]:
    """Errors x, y, z in µm, each (...,), from node rises (..., 14) and the speed (...,).

    - column bending ``phi = alpha L (T_front - T_back) / W``: ``Y = -phi L / 2``, ``Z = -phi e``, e the head's reach
    - z = chain + bending + ``4 (n / 6000)²`` (speed shift: no temperature shows it)
    - y = chain + bending
    - x = chain + the head's sideways bow ``alpha dT e² / (2 w)``, where the motor's heat across the head's width w
      makes ``dT = G_motor (T_motor - T_head_rear) / G_side``
    """
    bend_K = rise_K[..., NODE["column_front"]] - rise_K[..., NODE["column_back"]]
    tilt_um_per_m = IRON_UM_PER_M_K * COLUMN_HEIGHT_M * bend_K / COLUMN_DEPTH_M
    motor_K = rise_K[..., NODE["motor"]] - rise_K[..., NODE["head_rear"]]
    side_K = LINK_W_PER_K["motor", "head_rear"] * motor_K / HEAD_SIDE_W_PER_K
    bow_um = IRON_UM_PER_M_K * side_K * HEAD_REACH_M**2 / (2 * HEAD_WIDTH_M)
    return {
        "x": chain_um(X_CHAIN, rise_K) + bow_um,
        "y": chain_um(Y_CHAIN, rise_K) - tilt_um_per_m * COLUMN_HEIGHT_M / 2,
        "z": chain_um(Z_CHAIN, rise_K) - tilt_um_per_m * HEAD_REACH_M + SPEED_SHIFT_UM * (speed_rpm / RATED_RPM) ** 2,
    }


def machine(auxiliaries_W: float = AUXILIARIES_W) -> ThermalMachine:
    """The sample machine as data; its error is linear in the rises, so a unit rise of each node tells all of it."""
    unit = displacement_um(np.eye(len(NODES)), np.zeros(len(NODES)))
    return ThermalMachine(
        capacity_J_per_K=CAPACITY_J_PER_K,
        link_W_per_K=LINK_W_PER_K,
        room_W_per_K=ROOM_W_PER_K,
        floor_W_per_K=FLOOR_W_PER_K,
        bearings=BEARINGS,
        heats=HEATS,
        always_W={"air": auxiliaries_W},
        um_per_K={c: {n: float(v) for n, v in zip(NODES, um, strict=True) if v} for c, um in unit.items()},
        rotating=ROTATING,
        speed_shift_um={"z": SPEED_SHIFT_UM},
        rated_rpm=RATED_RPM,
    )
