"""The region a model was trained in, and how far outside it a prediction is made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from data.batch import Batch
from features.rises import feature, feature_unit

Array = NDArray[np.float64]
Watched = Mapping[str, Array]  # quantity -> (n,) of one batch

SLACK = 0.05  # widths beyond the trained range that still count as inside
PATTERN = "pattern of the points"
_LEAST_WIDTH = {"K": 5.0, "degC": 5.0, "K/h": 10.0, "rpm": 1000.0, "mm/min": 1000.0}  # a narrow range is not a wall
_LEAST_WIDTH_OF_PATTERN_K = 2.0  # sensors scatter about their common course by so much in any machine


@dataclass(frozen=True)
class Region:
    """Where the training batches were.

    `ranges`: least and greatest value of every input (K), start temperature of its channel (`name@start`, degC) and
    driver (its unit). `directions` (p, p): the principal directions of the temperature inputs about `centre` (p,),
    with the least and greatest score `low`, `high` (p,) in K: they know how the points stand to each other, so a
    sensor that was moved or replaced is far outside though every single value was seen before.
    """

    ranges: Mapping[str, tuple[float, float]]
    units: Mapping[str, str]
    points: tuple[str, ...]
    centre: Array
    directions: Array
    low: Array
    high: Array

    @classmethod
    def of(cls, batches: Sequence[Batch], inputs: Sequence[str]) -> Self:
        """The region of whole batches."""
        units = {name: feature_unit(b, name) for b in batches for name in _names(b, inputs)}
        return cls.of_values([watched(b, inputs) for b in batches], inputs, units)

    @classmethod
    def of_values(cls, values: Sequence[Watched], inputs: Sequence[str], units: Mapping[str, str]) -> Self:
        """The same from each batch's quantities, see `watched`."""
        ranges = {}
        for name in dict.fromkeys(name for v in values for name in v):
            series = np.concatenate([v[name] for v in values if name in v])
            if np.isfinite(series).any():
                ranges[name] = (float(np.nanmin(series)), float(np.nanmax(series)))
        points = tuple(i for i in inputs if units.get(i) == "K" and i in ranges)
        rows = np.concatenate([np.column_stack([v[i] for i in points]) for v in values]) if points else np.empty((0, 0))
        rows = rows[np.isfinite(rows).all(axis=1)]
        if len(rows) < 2:
            return cls(ranges, units, (), np.empty(0), np.empty((0, 0)), np.empty(0), np.empty(0))
        centre = rows.mean(axis=0)
        directions = np.linalg.eigh((rows - centre).T @ (rows - centre))[1]
        scores = (rows - centre) @ directions
        return cls(ranges, units, points, centre, directions, scores.min(axis=0), scores.max(axis=0))

    def beyond(self, values: Watched) -> dict[str, Array]:
        """For every quantity of a batch how far each row (n,) is outside, in trained widths (at least 5 K, 1000 rpm
        or 1000 mm/min); 0 inside, 1 as far outside as the region is wide. NaN where the quantity is missing.

        Quantities that the batch lacks (a driver not recorded) are not judged.
        """
        out = {}
        for name, (low, high) in self.ranges.items():
            if name in values:
                width = max(high - low, _LEAST_WIDTH.get(self.units.get(name, ""), 0.0)) or 1.0
                out[name] = _excess(values[name], low, high) / width
        if len(self.points) > 1 and all(i in values for i in self.points):
            scores = (np.column_stack([values[i] for i in self.points]) - self.centre) @ self.directions
            widths = np.maximum(self.high - self.low, _LEAST_WIDTH_OF_PATTERN_K)
            out[PATTERN] = (_excess(scores, self.low, self.high) / widths).max(axis=1)
        return out

    def outside(self, batch: Batch, inputs: Sequence[str]) -> dict[str, NDArray[np.bool_]]:
        """For every watched quantity of the batch the rows (n,) beyond the region by more than 5 % of its width."""
        with np.errstate(invalid="ignore"):
            return {name: far > SLACK for name, far in self.beyond(watched(batch, inputs)).items()}

    def distance(self, values: Watched) -> Array:
        """The farthest of all quantities, (n,), in widths; 0 inside; NaN where none is recorded."""
        every = list(self.beyond(values).values())
        known = np.array([np.isfinite(far) for far in every]).any(axis=0)
        return np.where(known, np.max([np.nan_to_num(far, nan=0.0) for far in every], axis=0), np.nan)

    def as_plain(self) -> dict[str, Any]:
        """Everything as numbers, strings, lists and arrays."""
        ranges = {name: [low, high] for name, (low, high) in self.ranges.items()}
        return {"ranges": ranges, "units": dict(self.units), "points": list(self.points), "centre": self.centre,
                "directions": self.directions, "low": self.low, "high": self.high}  # fmt: skip

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Self:
        """The inverse of `as_plain`."""
        ranges = {name: (float(low), float(high)) for name, (low, high) in plain["ranges"].items()}
        return cls(ranges, plain["units"], tuple(plain["points"]),
                   *(np.asarray(plain[k], float) for k in ("centre", "directions", "low", "high")))  # fmt: skip


def watched(batch: Batch, inputs: Sequence[str]) -> dict[str, Array]:
    """The quantities of a batch that a region knows: inputs, start temperatures of their channels, drivers."""
    return {name: feature(batch, name) for name in _names(batch, inputs) if name.partition("@")[0] in batch.table}


def _names(batch: Batch, inputs: Sequence[str]) -> list[str]:
    channels = [c for c in dict.fromkeys(i.partition("@")[0] for i in inputs) if c in batch.channels]
    starts = [f"{c}@start" for c in channels if batch.channels[c].role in ("temperature", "ambient")]
    return [*(i for i in inputs if i.partition("@")[0] in batch.channels), *starts, *batch.names("driver")]


def _excess(values: Array, low: Array | float, high: Array | float) -> Array:
    return np.maximum(np.maximum(low - values, values - high), 0.0)
