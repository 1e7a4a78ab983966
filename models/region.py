"""The region a model was trained in: a prediction outside it is an extrapolation and says so."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from data.batch import Batch
from features.rises import feature

Region = dict[str, tuple[float, float]]


def region_of(batches: Sequence[Batch], inputs: Sequence[str]) -> Region:
    """Least and greatest value seen of every input (K), start temperature of its channel (`name@start`, degC) and
    driver (its unit) over the training batches."""
    series: dict[str, list[NDArray[np.float64]]] = {}
    for b in batches:
        for name in _watched(b, inputs):
            series.setdefault(name, []).append(feature(b, name))
    region = {}
    for name, parts in series.items():
        values = np.concatenate(parts)
        if np.isfinite(values).any():
            region[name] = (float(np.nanmin(values)), float(np.nanmax(values)))
    return region


def outside(batch: Batch, region: Mapping[str, Sequence[float]], inputs: Sequence[str]) -> dict[str, NDArray[np.bool_]]:
    """For every watched quantity of the batch: rows (n,) beyond the trained range by more than 5 % of its width.

    Quantities that the batch lacks (a driver not recorded) are not judged.
    """
    out = {}
    for name in _watched(batch, inputs):
        if name not in region:
            continue
        low, high = region[name]
        slack = 0.05 * (high - low)
        values = feature(batch, name)
        with np.errstate(invalid="ignore"):
            out[name] = (values < low - slack) | (values > high + slack)
    return out


def _watched(batch: Batch, inputs: Sequence[str]) -> list[str]:
    channels = dict.fromkeys(i.partition("@")[0] for i in inputs)
    starts = [f"{c}@start" for c in channels if batch.channels[c].role in ("temperature", "ambient")]
    return [*inputs, *starts, *batch.names("driver")]
