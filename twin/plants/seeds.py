"""Random numbers by name: each part of a case has a stream of its own, so that one does not move another."""

from __future__ import annotations

from zlib import crc32

import numpy as np

Range = tuple[float, float]


def stream(seed: int, name: str) -> np.random.Generator:
    """The generator of a part ("geometry", "runs", …) of the case of a seed."""
    return np.random.default_rng([seed, crc32(name.encode())])


def wider(limits: Range, spread: float) -> Range:
    """The range of a positive quantity made `spread` times as wide, by logarithm about its own middle."""
    low, high = limits
    if spread == 1.0:
        return limits
    middle, half = float(np.sqrt(low * high)), float(np.log(high / low)) / 2.0 * spread
    return middle * float(np.exp(-half)), middle * float(np.exp(half))
