"""Left-out errors of all channels as one number, in units of the noise."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np


def error_level(rms: Mapping[str, float | None], noise: Mapping[str, float | None]) -> float | None:
    """Root of the mean over channels of (left-out rms / noise)²; None where no channel has both."""
    ratios = [
        value / floor
        for key, value in rms.items()
        if value is not None and (floor := noise.get(key)) is not None and floor > 0
    ]
    return float(np.sqrt(np.mean(np.square(ratios)))) if ratios else None


def closed(before: float | None, after: float | None, true: float | None) -> float | None:
    """Share of the way from the baseline to the true model; at most 1, None where the true model is no better."""
    if before is None or after is None or true is None or before <= true:
        return None
    return min(1.0, 1.0 - (after - true) / (before - true))
