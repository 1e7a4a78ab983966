"""Numbers of a suite that only its secret gives."""

from __future__ import annotations

import hashlib
from typing import Literal

Which = Literal["development", "sealed"]


def number(seed: bytes | int, which: str, what: str) -> int:
    """256 bits for one purpose that nobody can tell without the whole seed; development and sealed share none."""
    root = seed if isinstance(seed, bytes) else str(seed).encode()
    told = b"\0".join([b"thermodrift proof", which.encode(), what.encode(), root])
    return int.from_bytes(hashlib.sha256(told).digest(), "big")


def digits(cases: int) -> int:
    """Of the names of so many cases."""
    return max(4, len(str(cases)))
