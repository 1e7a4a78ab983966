"""Displacement: what the rises of the nodes add to an error channel, in pieces that a machine file would name."""

from __future__ import annotations

from dataclasses import dataclass, replace

from twin.plants.casting import Array


@dataclass(frozen=True)
class Growth:
    """One piece of an error channel, linear in the rises: error_um = amount · weights · rise.

    `weights_um_per_K` (N,). `tilt` names the warm and the cold body of a bending and is None for an expanding path;
    `lumped_um_per_K` is what a tilt gives per kelvin between these two bodies.
    """

    name: str
    channel: str
    weights_um_per_K: Array
    tilt: tuple[str, str] | None = None
    lumped_um_per_K: float = 0.0
    amount: float = 1.0

    def scaled(self, amount: float) -> Growth:
        return replace(self, amount=amount)
