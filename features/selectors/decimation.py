"""A stated few rows of every batch, for selectors that need rows and not only their sums."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from features.design import Design


def decimated_rows(design: Design, train: Sequence[int], most: int) -> list[NDArray[np.int64]]:
    """Usable rows of every training batch, in rising order of the batches: all, or `most` of them evenly spread."""
    out = []
    for k in sorted(train):
        usable = np.flatnonzero(design.usable[design.rows(k)]) + design.offsets[k]
        if len(usable) > most:
            usable = usable[np.round(np.linspace(0, len(usable) - 1, most)).astype(int)]
        out.append(usable.astype(np.int64))
    return out
