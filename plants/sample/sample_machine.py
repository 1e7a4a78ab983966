"""The sample machine: a simulated vertical machining centre as a thermal network of 14 nodes.

Its numbers are in ``machines/sample_vmc.yml``, typical of the class; none was measured on a machine. Laws and
numerics are this package's own: it shares no code with the twin that is calibrated on its recordings.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from data.arrays import Array
from data.machine import load_machine
from plants.sample.thermal_machine import BearingSet, SpeedHeat, ThermalMachine

FILE = Path(__file__).parents[2] / "machines" / "sample_vmc.yml"
_TWIN: Mapping[str, Any] = load_machine(FILE).twin or {}
_MECHANISMS: Mapping[str, Any] = _TWIN["mechanisms"]


def _number(given: Any, unit: str) -> float:
    """The number of "14 W/K", of {value: 14 W/K, …} or of a bare number, which has the unit "1".

    Raises:
        ValueError: the file has another unit.
    """
    number, _, own = str(given["value"] if isinstance(given, Mapping) else given).partition(" ")
    if (own or "1") != unit:
        raise ValueError(f"{FILE}: got {given!r}, expected a number in {unit}")
    return float(number)


def _parameter(mechanism: str, name: str, unit: str) -> float:
    return _number(_MECHANISMS[mechanism]["parameters"][name], unit)


def _conductances_W_per_K(group: str, to: str = "") -> dict[tuple[str, str], float]:
    """By both ends; of exposures those `to` one surrounding."""
    ends = {key: (key.split("-")[0], key.split("-")[1]) for key in _TWIN[group]}
    return {e: _number(_TWIN[group][key], "W/K") for key, e in ends.items() if to in ("", e[1])}


def _chain(axis: str) -> tuple[tuple[str, float, bool], ...]:
    steel = {name for name, body in _TWIN["bodies"].items() if body.get("material") == "steel"}
    links = _TWIN["errors"][axis]["chain"]
    return tuple((k["body"], k.get("sign", 1) * _number(k["length"], "m"), k["body"] in steel) for k in links)


def _bearings(end: str) -> BearingSet:
    preload = f"{end}_preload"
    count, diameter_mm = int(_parameter(preload, "count", "1")), _parameter(preload, "mean_diameter", "mm")
    return BearingSet(
        end, count, diameter_mm, _parameter(preload, "preload", "N"), _parameter(preload, "static_capacity", "N")
    )


CAPACITY_J_PER_K: Mapping[str, float] = MappingProxyType(
    {name: 1e3 * _number(body["capacity"], "kJ/K") for name, body in _TWIN["bodies"].items()}
)
NODES: tuple[str, ...] = tuple(CAPACITY_J_PER_K)
NODE: Mapping[str, int] = MappingProxyType({name: i for i, name in enumerate(NODES)})
LINK_W_PER_K: Mapping[tuple[str, str], float] = MappingProxyType(
    _conductances_W_per_K("links") | _conductances_W_per_K("exposures", "air")
)
ROOM_W_PER_K: Mapping[str, float] = MappingProxyType(
    {body: g for (body, _), g in _conductances_W_per_K("exposures", "room").items()}
)
FLOOR_W_PER_K: Mapping[str, float] = MappingProxyType(
    {body: g for (body, _), g in _conductances_W_per_K("exposures", "floor").items()}
)
ROTATING = tuple((key.split("-")[0], key.split("-")[1]) for key in _MECHANISMS["spinning"]["acts_on"])

# Preloads and capacities make the load part 10-25 % of the viscous moment, the usual share.
BEARINGS = (_bearings("front"), _bearings("rear"))
_MOTOR_W = [_parameter("motor_loss", name, "W") for name in ("idle", "linear", "quadratic")]
HEATS = (
    SpeedHeat("motor", tuple(zip(_MOTOR_W, (0.0, 1.0, 2.0), strict=True))),
    SpeedHeat("rear", ((_parameter("belt", "power", "W"), 1.5),)),  # at the rear housing, where the pulley sits
)
AUXILIARIES_W = _parameter("auxiliaries", "heat", "W")  # into the enclosure's air, always

# (node, length m, steel?); + closes the gap between tool and workpiece. Head and column: mean of their halves.
Z_CHAIN = _chain("z")
# + moves the spindle away from the column: the head reaches 0.45 m forward, bed and saddle carry the table as far.
Y_CHAIN = _chain("y")
# The probe nest sits 0.10 m from the middle of the table, its scale on the bed.
X_CHAIN = _chain("x")
_BENDING: Mapping[str, Any] = _TWIN["errors"]["z"]["tilts"][0]
COLUMN_HEIGHT_M, COLUMN_DEPTH_M, HEAD_REACH_M = (_number(_BENDING[k], "m") for k in ("height", "depth", "lever"))
SPEED_SHIFT_UM = _parameter("speed_shift", "shift", "um")  # at 6000 rpm, proportional to n²

# Not in the file: the twin has expansions and rated speed in its mechanisms, and lumps the head's bow into
# one rounded gain. The motor is flanged to one side of the head; its heat crosses the head's width.
STEEL_UM_PER_M_K, IRON_UM_PER_M_K = 11.5, 10.8
RATED_RPM = 6000.0
HEAD_SIDE_W_PER_K, HEAD_WIDTH_M = 50.0, 0.30


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
    """The sample machine as data; its error is linear in the rises, so that unit rises of the nodes determine it."""
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
