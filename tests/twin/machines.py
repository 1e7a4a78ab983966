"""Small machine files for tests: two bodies in a room, and a way to change them."""

from __future__ import annotations

from typing import Any

import yaml

from data.machine import Machine, parse_machine

TWO_BODIES: dict[str, Any] = {
    "machine": "two_bodies",
    "simulated": True,
    "recording": {"step_s": 60},
    "channels": {
        "t_shaft": {"role": "temperature", "unit": "degC", "resolution": 0.1},
        "t_head": {"role": "temperature", "unit": "degC", "resolution": 0.1},
        "room": {"role": "ambient", "unit": "degC", "resolution": 0.1},
        "rpm": {"role": "driver", "unit": "rpm"},
        "z": {"role": "error", "unit": "um", "resolution": 1},
    },
    "twin": {
        "surroundings": {"room": {"channel": "room"}},
        "bodies": {
            "shaft": {"capacity": {"value": "5 kJ/K", "spread": 0.3}, "material": "steel"},
            "head": {"capacity": {"value": "40 kJ/K", "spread": 0.3}, "material": "cast_iron"},
        },
        "links": {"shaft-head": {"value": "12 W/K", "spread": 0.5}},
        "exposures": {"shaft-room": "1 W/K", "head-room": {"value": "8 W/K", "spread": 0.5}},
        "mechanisms": {
            "belt": {"law": "belt_loss", "drivers": "rpm", "into": "shaft",
                     "parameters": {"power": {"value": "120 W", "spread": 0.4}}},
        },
        "sensors": {"t_shaft": {"at": "shaft"}, "t_head": {"at": "head"}},
        "errors": {
            "z": {"chain": [{"body": "shaft", "length": "0.4 m"}, {"body": "head", "length": "0.4 m", "sign": -1}]},
        },
    },
}  # fmt: skip


def machine(raw: dict[str, Any] | None = None, **changes: Any) -> Machine:
    """A machine from a mapping, with dotted keys of its twin part set (or, with None, removed)."""
    import copy

    raw = copy.deepcopy(TWO_BODIES if raw is None else raw)
    for dotted, value in changes.items():
        at, *keys = [raw["twin"], *dotted.split("__")]
        for key in keys[:-1]:
            at = at.setdefault(key, {})
        if value is None:
            del at[keys[-1]]
        else:
            at[keys[-1]] = value
    return parse_machine(yaml.safe_dump(raw, sort_keys=False), "two_bodies.yml")
