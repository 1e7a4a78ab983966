"""A candidate whose driver counts in its channel's own unit states its effect at the top of the channel's range."""

from __future__ import annotations

from typing import Any

import pytest

from data.machine import Machine
from diagnosis.candidates.library import candidates
from diagnosis.screening.signatures import asleep
from twin.schema import twin_part


def board(range_: list[float] | None) -> Machine:
    level: dict[str, Any] = {"role": "driver", "unit": "%"} | ({"range": range_} if range_ else {})
    return Machine(
        machine="board",
        channels={
            "one": level, "other": level,
            "t": {"role": "temperature", "unit": "degC", "resolution": 0.1},
            "room": {"role": "ambient", "unit": "degC"},
        },
        twin={
            "surroundings": {"room": {"channel": "room"}}, "bodies": {"plate": {"capacity": "3 J/K"}},
            "exposures": {"plate-room": "12 mW/K"}, "sensors": {"t": {"at": "plate"}},
            "mechanisms": {"heat": {"law": "electrical_heat", "drivers": {"level": "one"}, "into": "plate"}},
        },
    )  # fmt: skip


@pytest.mark.parametrize("range_, level", [([0.0, 100.0], 100.0), (None, 1.0)])
def test_a_sag_is_stated_at_the_other_ones_full_level(range_: list[float] | None, level: float) -> None:
    machine = board(range_)
    part = twin_part(machine)
    sags = [c for c in candidates(machine, part, ["supply_sag"]) if c.part and c.part.drivers == {"other": "other"}]
    network = asleep(machine, part, sags).network
    assert network.values[network.index("mechanisms.supply_sag_heat_other.rated")] == level
