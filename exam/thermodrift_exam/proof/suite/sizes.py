"""Sizes of effects: log-uniform around the detection limit, from below to ten times."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from types import MappingProxyType
from typing import Any

import numpy as np
import yaml

from thermodrift_exam.proof.spec import Kind

SHARE: Mapping[Kind, tuple[float, float]] = MappingProxyType({
    "decoy": (0.3, 10.0), "one": (0.3, 10.0), "two": (1.0, 10.0), "three": (1.0, 10.0), "confounded": (1.0, 10.0),
    "unlisted": (0.3, 10.0), "invisible": (0.05, 0.3),
})  # fmt: skip
"""From and to, in units of the size at the detection limit."""
ALL_OR_NOTHING = ("sensor_swap",)
MOST = 10.0
"""Upper limits; larger effects do not occur in machines."""
BOUNDS: Mapping[str, float] = MappingProxyType(
    {
        "time_skew": 1.8,  # a clock's error stays within what is simulated
        "preload_feedback": 4.0,  # beyond it a bearing diverges thermally
        "wrong_parameter": 3.0,  # a joint that is off by a factor of 64
    }
)


@cache
def table() -> Mapping[str, Any]:
    """The content of `limits.yml`: how it was measured, and by plant and effect the size at the detection limit."""
    text = files("thermodrift_exam.proof.suite").joinpath("limits.yml").read_text(encoding="utf-8")
    return MappingProxyType(yaml.safe_load(text))


def limit(effect: str, plant: str) -> float:
    """The size at which an effect is at the detection limit on a kind of plant."""
    return float(table()["limits"][plant][effect])


def most(effect: str) -> float:
    """The largest size of an effect."""
    return BOUNDS.get(effect, MOST)


def size(effect: str, plant: str, kind: Kind, rng: np.random.Generator) -> float:
    """A size for a case of this kind; uniform up to the largest one where ten times the limit exceeds it."""
    low, high = (share * limit(effect, plant) for share in SHARE[kind])
    high = min(high, most(effect))
    drawn = np.exp(rng.uniform(np.log(min(low, high / 3.0)), np.log(high)))
    return 1.0 if effect in ALL_OR_NOTHING else float(f"{drawn:.4g}")
