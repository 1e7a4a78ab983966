"""What a lumped network gets wrong by itself: sensors off their body's mean, and late ones. Every fit has this slack.

A sensor in a casting stands in a gradient that a lump does not have; without slack the difference passes for physics.
"""

from __future__ import annotations

from collections.abc import Sequence

from twin.diagnosis.proposals.candidate import Candidate

LOOSE = ("sensor_place", "sensor_lag", "time_skew")
PLACE = 0.1  # sd of the share of a neighbour's lead that a sensor sees
LAG_S, LAG = 240.0, 1.5  # sd of a lag where the file states none; of the logarithm of one that it holds fixed
SKEW = 0.1  # of the rows' step: a row is the mean about its time, which blurs a corner to both sides


def slack(proposed: Sequence[Candidate], step_s: float) -> dict[str, float]:
    """By name of a candidate the prior sd of its amplitude, for those that every fit has; rows are `step_s` apart."""
    out = {}
    for c in proposed:
        if c.mechanism == "sensor_place":
            out[c.name] = PLACE
        elif c.mechanism == "time_skew":
            out[c.name] = SKEW * step_s
        elif c.mechanism == "sensor_lag":
            out[c.name] = LAG_S
        elif c.mechanism == "wrong_parameter" and c.change is not None and c.change.parameter.name.endswith(".lag"):
            out[c.name] = LAG
    return out


def no_news(proposed: Sequence[Candidate]) -> set[str]:
    """Those that any size is a lumped network's own fault of: never reported as found."""
    return {c.name for c in proposed if c.mechanism == "sensor_place"}
