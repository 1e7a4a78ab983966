"""How a model's error rises with the distance from where it was trained, measured on batches that it never saw."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from data.errors import InputError
from features.rises import feature_unit
from models import FAMILIES
from models.crossing import Crossing
from models.metrics import residual_std_um
from models.region import Region, watched

Array = NDArray[np.float64]
COLUMNS = ["cell", "protocol", "fold", "batch_id", "distance", "farthest", "S_um"]
EDGES = (0.05, 0.25, 0.5, 1.0, 2.0, np.inf)  # upper ends of the bands, in trained widths
_LEAST_PAIRS = 3  # left-out batches that a band needs before it says anything
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

    inside_um: the median S by leave-batch-out. Per band the upper edge (B,) in widths, the number of predicted
    batches, the median and the 90 % quantile of the factor S / S by leave-batch-out: the same batch near and far, so
    batches of large errors do not pass for distant ones. From seasons and speeds left out, that is from models that
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
        told = np.full(len(EDGES) + 1, np.nan)
        if self.edge:
            told[np.searchsorted(EDGES, self.edge)] = np.maximum.accumulate(np.maximum(self.factor, 1.0))
        told[0] = 1.0
        band = np.searchsorted(EDGES, distance, side="left")
        return np.asarray(self.inside_um * np.where(np.isfinite(distance), told[band], np.nan))

    def as_plain(self) -> dict[str, Any]:
        """Numbers and lists; the last band has no upper edge and says "beyond"."""
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
