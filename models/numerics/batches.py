"""Helpers for families that run along a batch: padding to a rectangle, bridged holes, time steps, caching."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace
from threading import RLock
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array, Mask, Numeric
from data.batch import Batch
from data.checks import why_missing
from data.errors import InputError
from features.design import Design
from features.rises import hold_last


def padded(design: Design, values: Array) -> Array:
    """Rows (n, …) laid out per batch, (K, longest, …), zeros behind a batch's end."""
    at_batch, at_row = _places(design)
    lengths = np.diff(design.offsets)
    out = np.zeros((design.n_batches, int(lengths.max(initial=0)), *values.shape[1:]))
    out[at_batch, at_row] = values
    return out


def unpadded(design: Design, values: Array) -> Array:
    """The inverse of `padded`: (K, longest, …) back to rows (n, …)."""
    at_batch, at_row = _places(design)
    return values[at_batch, at_row]


def only(design: Design, batches: Sequence[int]) -> Design:
    """Some batches of a design, in the order given."""
    rows = np.concatenate([np.empty(0, np.int64), *(np.arange(*design.offsets[k : k + 2]) for k in batches)])
    offsets = np.concatenate([[0], np.cumsum(np.diff(design.offsets)[list(batches)])]).astype(np.int64)
    return replace(design, batch_ids=tuple(design.batch_ids[k] for k in batches), x=design.x[rows],
                   y_um=design.y_um[rows], time_s=design.time_s[rows], offsets=offsets,
                   drivers=design.drivers[rows] if design.driver_names else design.drivers,
                   batches=tuple(design.batches[k] for k in batches) if design.batches else (), _columns=None,
                   _parent=None)  # fmt: skip


def by_batch(design: Design, columns: Array, wanted: Sequence[Sequence[int]]) -> list[list[Array]]:
    """Columns (n, F) of all rows cut to the batches that each of them is wanted for."""
    return [[columns[design.rows(k), f] for k in batches] for f, batches in enumerate(wanted)]


def bridged(design: Design, values: Array) -> Array:
    """Values (n, p) with holes held batch by batch; NaN where a batch has none at all."""
    if np.isfinite(values).all():
        return values
    out = values.copy()
    for k in range(design.n_batches):
        for j in range(values.shape[1]):
            out[design.rows(k), j] = hold_last(values[design.rows(k), j])
    return out


def steps_s(design: Design) -> Array:
    """Sampling step of every batch, s, (K,); NaN for a batch of one row."""
    out = np.full(design.n_batches, np.nan)
    for k in range(design.n_batches):
        time_s = design.time_s[design.rows(k)]
        if len(time_s) > 1:
            out[k] = (time_s[-1] - time_s[0]) / (len(time_s) - 1)
    return out


def fold_masks(key: str, design: Design, folds: Sequence[Sequence[int]], count: Numeric, need: int) -> Mask:
    """Training sets as masks (F, K) over the batches with rows; `count` (K,) of usable rows.

    Raises:
        InputError: fewer than `need` rows in a fold.
    """
    masks = np.zeros((len(folds), design.n_batches), bool)
    for f, fold in enumerate(folds):
        masks[f, list(fold)] = True
        if (got := int(count[masks[f]].sum())) < need:
            raise too_few_rows(key, design, fold, got, need)
    return np.asarray(masks & (count > 0))


def too_few_rows(key: str, design: Design, train: Sequence[int], got: int, need: int) -> InputError:
    """The error of a training set with too few usable rows."""
    names = [design.batch_ids[k] for k in train]
    shown = ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
    why = why_missing(design.batches[train[0]], design.target) if names and design.batches else ""
    return InputError(
        f"family {key}: got {got} usable rows of {design.target or 'the target'} in {shown or 'no batch'}{why}, "
        f"need at least {need}; give more batches, drop inputs that are missing, or overrule a check in the machine "
        "file"
    )


def _places(design: Design) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    return design.group, np.arange(len(design.group)) - design.offsets[design.group]


T = TypeVar("T")


class Recent(Generic[T]):
    """Cache of the last `most` results, by key and identity of the batches."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._held: list[tuple[Hashable, tuple[Batch, ...], T]] = []
        self._lock = RLock()

    def of(self, key: Hashable, batches: tuple[Batch, ...], make: Callable[[], T]) -> T:
        """The cached result, else that of `make`."""
        with self._lock:
            for i, (k, held, thing) in enumerate(self._held):
                if k == key and len(held) == len(batches) and all(a is b for a, b in zip(held, batches, strict=True)):
                    self._held.append(self._held.pop(i))
                    return thing
            made = make()
            self._held = [*self._held, (key, batches, made)][-self._most :]
            return made
