"""The smallest machine that a mechanism can work in, made from what the mechanism itself declares."""

from __future__ import annotations

from typing import Any

from data.machine import Machine
from twin.compile import compile_network
from twin.mechanisms.base import Mechanism
from twin.network import Network
from twin.schema import TwinPart, twin_part

BODIES = ("first", "second", "third")
WARMTH = {"law": "motor_loss", "into": "first", "drivers": "motor_rpm"}


def machine_with(mechanism: Mechanism, parameters: dict[str, Any] | None = None, **instance: Any) -> Machine:
    """Bodies for every port, a channel for every driver, and something to act on; `instance` overrules its keys."""
    drivers = {f"{role}_driver": unit for role, unit in mechanism.drivers.items()}
    channels: dict[str, Any] = {n: {"role": "driver", "unit": u} for n, u in drivers.items()}
    channels |= {b: {"role": "temperature", "unit": "degC", "resolution": 0.1} for b in BODIES}
    channels |= {
        "motor_rpm": {"role": "driver", "unit": "rpm"},
        "room": {"role": "ambient", "unit": "degC", "resolution": 0.1},
        "z": {"role": "error", "unit": "um", "resolution": 1.0},
    }
    part: dict[str, Any] = {
        "surroundings": {"room": {"channel": "room"}},
        "bodies": {b: {"capacity": "5 kJ/K", "material": "steel"} for b in BODIES},
        "links": {"first-second": "10 W/K", "second-third": "6 W/K"},
        "exposures": {"third-room": "8 W/K"},
        "mechanisms": {"warmth": WARMTH, "tried": _instance(mechanism, parameters)},
        "sensors": {b: {"at": b} for b in BODIES},
        "errors": {"z": {"chain": [{"body": "first", "length": "0.2 m"}], "uniform_length": "0.2 m"}},
    }
    part["mechanisms"]["tried"] |= instance
    return Machine(machine="small", channels=channels, twin=part)


def _instance(mechanism: Mechanism, parameters: dict[str, Any] | None) -> dict[str, Any]:
    """The mechanism as a machine file writes it, every parameter free under its usual prior."""
    targets = {
        "link": "first-second", "exposure": "third-room", "heat": "warmth", "surrounding": "room",
        "sensor": list(BODIES[: mechanism.together]) if mechanism.together > 1 else "first", "error": "z",
    }  # fmt: skip
    out: dict[str, Any] = {"law": mechanism.key, "parameters": parameters or usual(mechanism)}
    on = next((targets[t] for t in mechanism.acts_at if t in targets), None)
    if on and "heat_W" not in mechanism.effects():
        out["acts_on"] = on
    if {"heat_W", "start_K"} & set(mechanism.effects()):
        out["into"] = "first"
    if mechanism.ports:
        seen = BODIES[1:] if "reading" in mechanism.effects() else BODIES
        out["at"] = dict(zip(mechanism.ports, seen, strict=False))
    if mechanism.drivers:
        out["drivers"] = {role: f"{role}_driver" for role in mechanism.drivers}
    return out


def usual(mechanism: Mechanism) -> dict[str, Any]:
    """Every parameter at its usual value and prior, with units."""
    out = {}
    for s in mechanism.parameters:
        unit_of_spread = {"degC": "K"}.get(s.unit, s.unit) if s.scale == "linear" else "1"
        out[s.name] = {"value": f"{s.value} {s.unit}", "spread": f"{s.spread} {unit_of_spread}"}
    return out


def network_with(mechanism: Mechanism, parameters: dict[str, Any] | None = None, **instance: Any) -> Network:
    return compile_network(machine_with(mechanism, parameters, **instance))


def part_with(mechanism: Mechanism, parameters: dict[str, Any] | None = None, **instance: Any) -> TwinPart:
    return twin_part(machine_with(mechanism, parameters, **instance))
