"""Pieces of bodies that a finer network has beside the machine file's own: no places where physics is named."""

from __future__ import annotations

from twin.schema import TwinPart

NEAR, FAR = "_near", "_far"  # how they are called


def pieces_of(part: TwinPart) -> dict[str, str]:
    """The bodies that are pieces of others around or far from a sensor, as a finer network states them."""
    out = {}
    for name in part.bodies:
        for end in (NEAR, FAR):
            if name.endswith(end):
                ends = next((link.between for link in part.links.values() if link.between[0] == name), None)
                if ends is not None:
                    out[name] = ends[1]
    return out
