"""A stated few rows of every batch, for what needs rows and not only their sums."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from features.design import Design


def even_rows(design: Design, batch: int, most: int) -> NDArray[np.int64]:
    """Numbers of a batch's usable rows: all, or `most` of them evenly spread."""
    usable = np.flatnonzero(design.usable[design.rows(batch)]) + design.offsets[batch]
    if len(usable) > most:
        usable = usable[np.round(np.linspace(0, len(usable) - 1, most)).astype(int)]
    return usable.astype(np.int64)


def decimated_rows(design: Design, train: Sequence[int], most: int) -> list[NDArray[np.int64]]:
    """The same of every training batch, in rising order of the batches."""
    return [even_rows(design, k, most) for k in sorted(train)]
