"""Random numbers by name: each part of a case has a stream of its own, so that one does not move another."""

from __future__ import annotations

from zlib import crc32

import numpy as np


def stream(seed: int, name: str) -> np.random.Generator:
    """The generator of a part ("geometry", "runs", …) of the case of a seed."""
    return np.random.default_rng([seed, crc32(name.encode())])
