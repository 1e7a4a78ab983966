"""Regression trees as plain arrays, evaluated together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from features.design import Design, decimated_rows
from models.numerics.batches import too_few_rows
from models.program import Builder

_FEWEST = 4
_VALUES_AT_ONCE = 2_000_000  # tree × row places walked together


@dataclass(frozen=True)
class Trees:
    """T binary trees, their nodes one after the other: node i goes left if x[feature] ≤ threshold, else right.

    feature, left, right (N,): whole numbers, children counted over all nodes; a leaf is its own child on both sides.
    threshold, value (N,); roots (T,).
    """

    roots: NDArray[np.int64]
    feature: NDArray[np.int64]
    threshold: Array
    left: NDArray[np.int64]
    right: NDArray[np.int64]
    value: Array

    @classmethod
    def joined(cls, parts: Sequence[tuple[Any, Any, Any, Any, Any]]) -> Self:
        """From (feature, threshold, left, right, value) of each tree, children counted within it, −1 or 0 for leaves.

        A node is a leaf where left equals right, as it does in scikit-learn's trees.
        """
        sizes = np.array([len(part[0]) for part in parts])
        roots = np.cumsum(sizes) - sizes
        feature, threshold, left, right, value = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        leaf, own, first = left == right, np.arange(len(left)), np.repeat(roots, sizes)
        return cls(
            roots.astype(np.int64),
            np.where(leaf, 0, feature).astype(np.int64),
            np.where(leaf, 0.0, threshold),
            np.where(leaf, own, left + first).astype(np.int64),
            np.where(leaf, own, right + first).astype(np.int64),
            value.astype(float),
        )

    def values(self, x: Array) -> Array:
        """Each tree's value (T, n) at rows x (n, p); undefined for NaN rows."""
        out = np.empty((len(self.roots), len(x)))
        step = max(1, _VALUES_AT_ONCE // max(1, len(self.roots)))
        for start in range(0, len(x), step):
            some = x[start : start + step]
            row = np.arange(len(some))
            node = np.tile(self.roots[:, None], (1, len(some)))
            while True:
                goes_left = some[row, self.feature[node]] <= self.threshold[node]
                child = np.where(goes_left, self.left[node], self.right[node])
                if np.array_equal(child, node):
                    break
                node = child
            out[:, start : start + step] = self.value[node]
        return out

    def operation(self, b: Builder, x: int, weight: float, single: bool) -> int:
        """Weighted sum of the trees at x; with `single` inputs are rounded to single precision first."""
        plain = {name: values for name, values in self.as_plain().items() if name != "value"}
        return b.add("trees", [x], 1, **plain, value=weight * self.value, single=float(single))

    def as_plain(self) -> dict[str, Any]:
        """The arrays by name."""
        return dict(vars(self))

    @classmethod
    def from_plain(cls, plain: dict[str, Any]) -> Self:
        """The inverse of `as_plain`; other entries are left alone."""
        whole = {k: np.atleast_1d(plain[k]).astype(np.int64) for k in ("roots", "feature", "left", "right")}
        threshold, value = (np.atleast_1d(np.asarray(plain[k], float)) for k in ("threshold", "value"))
        return cls(**whole, threshold=threshold, value=value)


def training_rows(key: str, design: Design, train: Sequence[int], most: int, together: int = 0) -> NDArray[np.int64]:
    """Usable rows of the batches `train`, evenly at most so many of each (more where few batches give `together`).

    Raises:
        InputError: fewer than 4 usable rows.
    """
    each = max(most, together // max(1, len(train)))
    out = np.concatenate([np.empty(0, np.int64), *decimated_rows(design, train, each)])
    if len(out) < _FEWEST:
        raise too_few_rows(key, design, train, len(out), _FEWEST)
    return out
