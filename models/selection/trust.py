"""What is known of a run before its error: its distance from the training data, and how far like models disagree."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from data.arrays import Array
from data.batch import Batch, Channel
from features.rises import feature, feature_unit
from models.metrics import residual_std_um, row_quantiles
from models.program import Builder, Program
from models.selection.crossing import Crossing
from models.selection.judging import left_out_by_fold

Watched = Mapping[str, Array]  # quantity -> (n,) of one batch

SLACK = 0.05  # widths beyond the trained range that still count as inside
PATTERN = "pattern of the points"
LEAST_WIDTH = {"K": 5.0, "degC": 5.0, "K/h": 10.0, "rpm": 1000.0, "mm/min": 1000.0}  # a narrow range is not a wall
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
        for name, low, high, width in zip(self.ranges, *self.widths(), strict=True):
            if name in values:
                out[name] = _excess(values[name], low, high) / width
        if len(self.points) > 1 and all(i in values for i in self.points):
            scores = (np.column_stack([values[i] for i in self.points]) - self.centre) @ self.directions
            widths = np.maximum(self.high - self.low, _LEAST_WIDTH_OF_PATTERN_K)
            out[PATTERN] = (_excess(scores, self.low, self.high) / widths).max(axis=1)
        return out

    def outside(self, batch: Batch, inputs: Sequence[str]) -> dict[str, NDArray[np.bool_]]:
        """For every watched quantity of the batch the rows (n,) beyond the region by more than 5 % of its width, and of
        an input those without a value."""
        far_of = self.beyond(watched(batch, inputs)).items()
        return {name: (far > SLACK) | ((name in inputs) & np.isnan(far)) for name, far in far_of}

    def distance(self, values: Watched) -> Array:
        """The farthest of all quantities, (n,), in widths; 0 inside; NaN where none is recorded."""
        every = list(self.beyond(values).values())
        known = np.array([np.isfinite(far) for far in every]).any(axis=0)
        return np.where(known, np.max([np.nan_to_num(far, nan=0.0) for far in every], axis=0), np.nan)

    def program(self, channels: Mapping[str, Channel], step_s: float) -> Program:
        """The watched quantities (q,) row by row, in the order of `ranges`, see `row`."""
        b = Builder(channels, step_s)
        return b.program([b.features(list(self.ranges), required=False)], zero_start=False)

    def widths(self) -> tuple[Array, Array, Array]:
        """Least and greatest value and width (q,) of every watched quantity."""
        low, high = (np.array([ends[side] for ends in self.ranges.values()]) for side in (0, 1))
        least = np.array([LEAST_WIDTH.get(self.units.get(n, ""), 0.0) for n in self.ranges])
        width = np.maximum(high - low, least)
        return low, high, np.where(width == 0.0, 1.0, width)

    def pattern(self) -> dict[str, Any]:
        """The pattern of the points: places among the watched quantities, none for fewer than two points."""
        names = list(self.ranges)
        points = [names.index(n) for n in self.points] if len(self.points) > 1 else []
        spread = np.maximum(self.high - self.low, _LEAST_WIDTH_OF_PATTERN_K)
        return {"points": points, "centre": self.centre, "directions": self.directions, "least": self.low,
                "most": self.high, "spread": spread}  # fmt: skip

    def row(self) -> Callable[[Array], tuple[float, str]]:
        """`far(values (q,)) -> (distance, quantity)`: `beyond` and the farthest of one row, in the order of `ranges`.

        Missing quantities are skipped; 0 and no quantity where none is outside.
        """
        names = list(self.ranges)
        low, high, width = self.widths()
        pattern = self.pattern()
        points, widths = pattern["points"], pattern["spread"]

        def far(values: Array) -> tuple[float, str]:
            beyond = np.nan_to_num(_excess(values, low, high) / width, nan=0.0)
            at = int(np.argmax(beyond)) if len(beyond) else -1
            most, name = (float(beyond[at]), names[at]) if at >= 0 else (0.0, "")
            if points:
                scores = (values[points] - self.centre) @ self.directions
                pattern = float(np.nan_to_num(_excess(scores, self.low, self.high) / widths, nan=0.0).max())
                most, name = (pattern, PATTERN) if pattern > most else (most, name)
            return (most, name) if most > 0 else (0.0, "")

        return far

    def excess(self, name: str, values: Watched) -> str:
        """How a quantity of a batch leaves the region, as "room 31 degC, trained 18 to 27"."""
        if name == PATTERN:
            return f"{PATTERN} unlike the training"
        low, high = self.ranges[name]
        known = values[name][np.isfinite(values[name])]
        value = known[np.argmax(_excess(known, low, high))]
        unit = self.units.get(name, "")
        return f"{quantity_label(name, unit)} {value:.3g} {unit}, trained {low:.3g} to {high:.3g}"

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


def quantity_label(name: str, unit: str = "") -> str:
    """A watched quantity as text: "room at start", and in K "front rise"."""
    channel, _, kind = name.partition("@")
    rise = " rise" if not kind and unit == "K" else ""
    return f"{channel}{rise}{' at ' if kind == 'start' else ' ' if kind else ''}{kind}"


def worth(distance: Array | float, tested: float) -> Array:
    """Share (n,) of a correction that applies at a distance (n,) outside the region, in widths: 1 as far as runs were
    left out (`RunBound.tested`), from there on less with the distance."""
    return np.asarray(1.0 / (1.0 + np.maximum(distance - np.fmax(tested, SLACK), 0.0)))


def watched(batch: Batch, inputs: Sequence[str]) -> dict[str, Array]:
    """The quantities (n,) of a batch that a region knows, by name: inputs, start temperatures of their channels,
    drivers."""
    return {name: feature(batch, name) for name in _watched_names(batch, inputs)}


def _watched_names(batch: Batch, inputs: Sequence[str]) -> list[str]:
    return [name for name in _names(batch, inputs) if name.partition("@")[0] in batch.table]


def _names(batch: Batch, inputs: Sequence[str]) -> list[str]:
    channels = [c for c in dict.fromkeys(i.partition("@")[0] for i in inputs) if c in batch.channels]
    starts = [f"{c}@start" for c in channels if batch.channels[c].role in ("temperature", "ambient")]
    return [*(i for i in inputs if i.partition("@")[0] in batch.channels), *starts, *batch.names("driver")]


def _excess(values: Array, low: Array | float, high: Array | float) -> Array:
    return np.maximum(np.maximum(low - values, values - high), 0.0)


COLUMNS = ["cell", "protocol", "fold", "batch_id", "start", "distance", "farthest", "predicted_rms_um",
           "disagreement_um", "S_um"]  # fmt: skip


class LeftOut(NamedTuple):
    """`runs`: a row per protocol, fold and left-out batch with the columns `COLUMNS`. `curves`: protocol, fold,
    batch_id, time_s, along an axis position_mm, recorded_um and predicted_um."""

    runs: pd.DataFrame
    curves: pd.DataFrame


def left_out_runs(
    crossing: Crossing,
    cell: tuple[str, str, int],
    predictions: Mapping[str, NDArray[Any]],
    peers: pd.DataFrame | None = None,
) -> LeftOut:
    """Every left-out batch of a cell (selector, family, n_tsp) with what was known of it before its error.

    cell: "selector|family|n_tsp"; start: of the batch (NaT where unknown); distance: how far it went beyond the region
    of the fold's training batches, in trained widths (`Region.distance`; the 95 % quantile over its rows); farthest:
    in which quantity; predicted_rms_um: of the prediction; disagreement_um: see `disagreement_um`, NaN without
    peers; S_um: the fold's error.

    Args:
        predictions: of the crossing, see `FamilyResult.predictions`; protocols without the cell's are left out.
        peers: see `GridResult.stack`; those of the cell's own family are not used.
    """
    selector, family, n_tsp = cell
    label = f"{selector}|{family}|{n_tsp}"
    own = () if peers is None else peers.itertuples()
    others = [f"{p.selector}|{p.family}|{p.n_tsp}" for p in own if p.family != family]
    runs, curves = [], []
    known = cache(lambda k, name: feature(crossing.batches[k], name))  # sets of inputs have most quantities in common
    for protocol in [p for p in crossing.folds if f"{p}|{label}" in predictions]:
        folds = crossing.folds[protocol]
        given = [predictions[name] for c in (label, *others) if (name := f"{protocol}|{c}") in predictions]
        by_fold = left_out_by_fold(crossing.design, folds, np.column_stack(given).astype(float))
        for design, which in crossing.needed(folds, [(selector, n_tsp)]):
            values = [
                {name: known(k, name) for name in _watched_names(b, design.inputs)}
                for k, b in enumerate(crossing.batches)
            ]
            units = {name: feature_unit(b, name) for b, v in zip(crossing.batches, values, strict=True) for name in v}
            for i in which:
                region = Region.of_values([values[k] for k in folds[i].train], design.inputs, units)
                for k, (recorded_um, every_um) in by_fold[i].items():
                    batch, own_um = crossing.batches[k], every_um[:, 0]
                    apart_um = disagreement_um(own_um, list(every_um[:, 1:].T))
                    S_um = float(residual_std_um(recorded_um - own_um))
                    runs.append((label, protocol, folds[i].name, batch.batch_id, batch.start,
                                 *farthest(region.beyond(values[k])), _rms(own_um), apart_um, S_um))  # fmt: skip
                    at = {"position_mm": design.position_mm(design.along)[design.rows(k)]} if design.along else {}
                    curves.append(pd.DataFrame({
                        "protocol": protocol, "fold": folds[i].name, "batch_id": batch.batch_id,
                        "time_s": batch.time_s, **at, "recorded_um": recorded_um, "predicted_um": own_um,
                    }))  # fmt: skip
    table = pd.DataFrame(runs, columns=COLUMNS).astype({"start": "datetime64[ns]"})
    return LeftOut(table, pd.concat(curves, ignore_index=True) if curves else pd.DataFrame())


def disagreement_um(predicted_um: Array, peers_um: Sequence[Array]) -> float:
    """Root mean square difference (µm) of a prediction (n,) and a peer's, the median over peers; NaN without any."""
    return float(np.median([_rms(p - predicted_um) for p in peers_um])) if peers_um else float("nan")


def _rms(values_um: Array) -> float:
    known = values_um[np.isfinite(values_um)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")


def farthest(beyond: Mapping[str, Array]) -> tuple[float, str]:
    """Distance of a batch in widths (95 % quantile over the rows), and in which quantity; (0, "") inside everywhere.

    `beyond` has the distance (n,) of every row by quantity.
    """
    if not beyond:
        return 0.0, ""
    far = np.nan_to_num(row_quantiles(np.stack(list(beyond.values())), 0.95), nan=0.0)
    first = int(np.argmax(far))
    return (float(far[first]), list(beyond)[first]) if far[first] > 0 else (0.0, "")
