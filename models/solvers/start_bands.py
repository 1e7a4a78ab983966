"""Bands of start temperature: training batches of each sub-model, and weights of the sub-models for a batch."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data.arrays import Array
from features.design import Design
from models.protocols import start_ambient_degC

_NEAREST_K = 0.5  # bands whose mean start temperatures are closer than this are one


def start_temperatures_degC(design: Design) -> Array:
    """Ambient at the start of every batch (K,); NaN where it is not known, as in a design made by hand."""
    if not design.batches:
        return np.full(design.n_batches, np.nan)
    return np.array([start_ambient_degC(batch) for batch in design.batches])


def bands_of(
    start_degC: Array, train: Sequence[int], bands: int | Sequence[float], least_batches: int
) -> list[tuple[int, ...]]:
    """The training batches in bands from cold to warm, by number of bands (equally many batches) or edges in °C.

    Bands of too few batches join their colder or warmer neighbour, whichever is smaller. One band where a start
    temperature is not known.
    """
    batches = np.array(sorted(train, key=lambda k: start_degC[k]), int)
    own = start_degC[batches]
    if not np.isfinite(own).all():
        return [tuple(sorted(train))]
    if isinstance(bands, int):
        n = max(1, min(bands, len(batches) // least_batches))
        parts = [part.tolist() for part in np.array_split(batches, n)]
    else:
        place = np.searchsorted(np.sort(bands), own, side="right")
        parts = [batches[place == p].tolist() for p in np.unique(place)]
    while len(parts) > 1:
        mean = np.array([start_degC[part].mean() for part in parts])
        size = [len(part) for part in parts]
        close = np.flatnonzero(np.diff(mean) < _NEAREST_K)
        if len(close):
            first = int(close[0])
        elif min(size) < least_batches:
            small = int(np.argmin(size))
            warmer = small == 0 or (small < len(parts) - 1 and size[small + 1] < size[small - 1])
            first = small if warmer else small - 1
        else:
            break
        parts[first : first + 2] = [parts[first] + parts[first + 1]]
    return [tuple(sorted(part)) for part in parts]


def band_weights(start_degC: float, band_degC: Array, band_batches: Sequence[int]) -> Array:
    """Weights (B,) of bands at rising temperatures (B,): linear between neighbours, outside the nearest alone.

    A batch whose start temperature is not known gets them by their numbers of training batches.
    """
    if not np.isfinite(start_degC) or len(band_batches) == 1:
        return np.asarray(np.array(band_batches) / np.sum(band_batches), float)
    return np.array([np.interp(start_degC, band_degC, own) for own in np.eye(len(band_degC))])
