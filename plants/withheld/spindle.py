"""The spindle test: its speed, the only cause of its heat, kept back. No twin part: the network is drafted."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from data.batch import Batch
from plants.real import term, windows
from plants.withheld.kept_back import KeptBack, Term


def speed(twin: Mapping[str, Any], batches: list[Batch]) -> list[Term]:
    """Heat by a driver that no channel shows; sensor positions are not documented, so any body is the place."""
    turning = [b.values("spindle_rpm") > 0 for b in batches]
    bodies = batches[0].names("temperature")
    return [
        term(
            "unlisted_speed", None, ("node", bodies[0]), also=[("node", b) for b in bodies[1:]],
            active=windows(batches, turning), words="heat that follows a speed which was not recorded",
        )
    ]  # fmt: skip


CASES = (
    KeptBack(
        "spindle_speed", "spindle_fl", "the spindle's speed kept back", speed,
        channels=("spindle_rpm",), twin=False, kind="unlisted",
    ),
)  # fmt: skip
