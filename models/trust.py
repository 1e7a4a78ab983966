"""Region of the training data, and the growth of a model's error with the distance from it on left-out batches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from data.arrays import Array
from data.batch import Batch
from data.errors import InputError
from features.rises import feature, feature_unit
from models import FAMILIES
from models.crossing import Crossing
from models.metrics import residual_std_um

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
    with the least and greatest score `low`, `high` (p,) in K. They capture the pattern of the points: a moved or
    replaced sensor is far outside even if each single value is within its range.
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

        Quantities that the batch lacks (a driver not recorded) are skipped.
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


COLUMNS = ["cell", "protocol", "fold", "batch_id", "distance", "farthest", "S_um"]
EDGES = (0.05, 0.25, 0.5, 1.0, 2.0, np.inf)  # upper ends of the bands, in trained widths
_LEAST_PAIRS = 3  # left-out batches that a band needs to be stated
_FAR = ("leave-season-out", "leave-speed-out")


def error_against_distance(crossing: Crossing, selector: str, family: str, n_tsp: int) -> pd.DataFrame:
    """One row per protocol, fold and left-out batch of a cell, with the columns `COLUMNS`.

    cell: "selector|family|n_tsp"; distance: how far the batch went beyond the region of the fold's training batches,
    in trained widths (`Region.distance`; the 95 % quantile over its rows); farthest: in which quantity; S_um: the
    fold's error there. Folds that cannot be fitted are left out, and models of one batch where a fit is slow.
    """
    rows, cell = [], f"{selector}|{family}|{n_tsp}"
    for protocol, folds in crossing.folds.items():
        if protocol == "train-on-one" and not FAMILIES[family].closed_form:
            continue
        for design, which in crossing.needed(folds, [(selector, n_tsp)]):
            values = [watched(b, design.inputs) for b in crossing.batches]
            units = {name: feature_unit(b, name) for b, v in zip(crossing.batches, values, strict=True) for name in v}
            try:
                fitted = FAMILIES[family]().fit_folds(design, [folds[i].train for i in which])
                predicted = fitted[0].predict_folds(design, fitted, [folds[i].test for i in which])
            except InputError:
                continue
            for i, errors in zip(which, predicted, strict=True):
                region = Region.of_values([values[k] for k in folds[i].train], design.inputs, units)
                for k, error_um in zip(folds[i].test, errors, strict=True):
                    S_um = float(residual_std_um(design.y_um[design.rows(k)] - error_um))
                    distance, farthest = _farthest(region.beyond(values[k]))
                    rows.append((cell, protocol, folds[i].name, design.batch_ids[k], distance, farthest, S_um))
    return pd.DataFrame(rows, columns=COLUMNS)


@dataclass(frozen=True)
class Rise:
    """How many times larger S is in bands of distance than on the same batches predicted by their neighbours.

    inside_um: the median S by leave-batch-out. Per band the upper edge (B,) in widths, the number of predicted batches,
    the median and the 90 % quantile of the factor S / S by leave-batch-out: the same batch near and far, so that
    batches of large errors do not count as distant ones. From seasons and speeds left out, that is from models that
    learned from many batches; bands with fewer than 3 predictions are not among them.
    """

    inside_um: float
    edge: tuple[float, ...]
    count: tuple[int, ...]
    factor: tuple[float, ...]
    high: tuple[float, ...]

    @classmethod
    def of(cls, table: pd.DataFrame) -> Self:
        """From the table of `error_against_distance`."""
        near = table[table["protocol"] == "leave-batch-out"].set_index("batch_id")["S_um"]
        far = table[table["protocol"].isin(_FAR)]
        factor = far["S_um"].to_numpy(float) / far["batch_id"].map(near).to_numpy(float)
        ok = np.isfinite(factor) & np.isfinite(far["distance"].to_numpy(float))
        band = np.searchsorted(EDGES, far["distance"].to_numpy(float), side="left")
        found = []
        for b, edge in enumerate(EDGES):
            own = factor[ok & (band == b)]
            if len(own) >= _LEAST_PAIRS:
                found.append((edge, len(own), float(np.median(own)), float(np.quantile(own, 0.9))))
        inside_um = float(near.median()) if near.notna().any() else float("nan")
        return cls(inside_um, *(list(zip(*found, strict=True)) or [(), (), (), ()]))

    @classmethod
    def of_cell(cls, table: pd.DataFrame, cell: str) -> Self | None:
        """The same of one cell; None where the table knows another or none."""
        own = table[table["cell"] == cell] if len(table) else table
        return cls.of(own) if len(own) else None

    def expected_um(self, distance: Array) -> Array:
        """S (n,) to be expected at a distance: the median by leave-batch-out times the band's factor, at least 1 and
        never falling with the distance. NaN in bands that were not measured."""
        factor = np.full(len(EDGES) + 1, np.nan)
        if self.edge:
            factor[np.searchsorted(EDGES, self.edge)] = np.maximum.accumulate(np.maximum(self.factor, 1.0))
        factor[0] = 1.0
        band = np.searchsorted(EDGES, distance, side="left")
        return np.asarray(self.inside_um * np.where(np.isfinite(distance), factor[band], np.nan))

    def as_plain(self) -> dict[str, Any]:
        """Numbers and lists; the upper edge of the last band is "beyond"."""
        return {"inside_um": self.inside_um, "edge": [e if np.isfinite(e) else "beyond" for e in self.edge],
                "count": list(self.count), "factor": list(self.factor), "high": list(self.high)}  # fmt: skip

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Self:
        """The inverse of `as_plain`."""
        edge = tuple(np.inf if e == "beyond" else float(e) for e in plain["edge"])
        return cls(float(plain["inside_um"]), edge, *(tuple(plain[k]) for k in ("count", "factor", "high")))


def _farthest(beyond: Mapping[str, Array]) -> tuple[float, str]:
    """How far a batch went (95 % quantile over the rows), and in which quantity; ("", 0) inside everywhere."""
    far = {name: float(np.nanquantile(d, 0.95)) for name, d in beyond.items() if np.isfinite(d).any()}
    name = max(far, key=lambda n: far[n], default="")
    return (far[name], name) if name and far[name] > 0 else (0.0, "")
