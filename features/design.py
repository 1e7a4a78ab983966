"""Batches stacked into arrays: the rows that all selectors, families and folds share, and their per-batch sums."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.batch import Batch
from data.errors import InputError, closest
from data.machine import Machine
from features.rises import feature, feature_unit, zeroed_error_um
from features.start import Start


@dataclass(frozen=True)
class Moments:
    """Per-batch sums over the usable rows, sufficient for a linear family.

    count (K,), sum_x (K, p), sum_y (K,), xx (K, p, p), xy (K, p), yy (K,). Inputs and target are
    first shifted by `shift_x`, `shift_y` (fixed, only for conditioning: results do not depend on it).
    `about_start`: of values relative to the batch's start, for fits without an intercept; the shifts are 0.
    """

    count: Array
    sum_x: Array
    sum_y: Array
    xx: Array
    xy: Array
    yy: Array
    shift_x: Array
    shift_y: float
    about_start: bool = False

    def subset(self, columns: Sequence[int]) -> Moments:
        c = np.asarray(columns, int)
        return Moments(self.count, self.sum_x[:, c], self.sum_y, self.xx[:, c[:, None], c[None, :]],
                       self.xy[:, c], self.yy, self.shift_x[c], self.shift_y, self.about_start)  # fmt: skip


@dataclass(frozen=True)
class Design:
    """Rows of K batches: x (n, p) inputs, y_um (n,) target, time_s (n,), offsets (K+1,).

    Rows of batch k are offsets[k]:offsets[k+1]; they are consecutive on the regular grid and never
    cross a border. y_um is NaN where there is no usable target, x where there is no usable input;
    `usable` marks rows fit for training. Short holes in x are filled by readers and checks.
    `drivers` (n, d) are the first batch's driver channels as recorded (NaN where a batch lacks one), for the
    families that follow the load; empty where the design was made by hand. Units are in the same order as names.
    `batches` and `machine` are what it was built from, for families that need more than rows (the twin).
    `about_start`: x is relative to each batch's start, see `started`.
    """

    inputs: tuple[str, ...]
    target: str
    batch_ids: tuple[str, ...]
    x: Array
    y_um: Array
    time_s: Array
    offsets: NDArray[np.int64]
    step_s: float = 0.0
    _columns: tuple[int, ...] | None = field(default=None, repr=False)
    _parent: Design | None = field(default=None, repr=False)
    drivers: Array = field(default_factory=lambda: np.empty((0, 0)), repr=False)
    driver_names: tuple[str, ...] = ()
    driver_units: tuple[str, ...] = ()
    input_units: tuple[str, ...] = ()
    batches: tuple[Batch, ...] = field(default=(), repr=False)
    machine: Machine | None = field(default=None, repr=False)
    about_start: bool = False

    @classmethod
    def build(
        cls, batches: Sequence[Batch], inputs: Sequence[str], target: str | None, machine: Machine | None = None
    ) -> Design:
        """Stack the named inputs (feature names, see features.rises) and the zeroed target of the batches.

        Raises:
            InputError: an unknown channel or kind of feature, or batches on different time steps.
        """
        steps = sorted((b.step_s, b.batch_id) for b in batches if b.n_rows > 1)
        if steps and steps[-1][0] - steps[0][0] > 1e-6:
            (one, first), (other, second) = steps[0], steps[-1]
            raise InputError(
                f"batches {first} and {second}: time steps of {one:g} s and {other:g} s; expected one step for all, "
                "ingest them with the same step_s"
            )
        sizes = [b.n_rows for b in batches]
        offsets = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        n, p = int(offsets[-1]), len(inputs)
        x = np.empty((n, p))
        y = np.full(n, np.nan)
        time_s = np.empty(n)
        driver_names = batches[0].names("driver") if batches else ()
        drivers = np.full((n, len(driver_names)), np.nan)
        for k, b in enumerate(batches):
            rows = slice(offsets[k], offsets[k + 1])
            time_s[rows] = b.time_s
            for j, name in enumerate(inputs):
                x[rows, j] = feature(b, name)
            for j, name in enumerate(driver_names):
                if name in b.channels:
                    drivers[rows, j] = b.masked(name)
            if target is not None:
                y[rows] = zeroed_error_um(b, target)
        return cls(tuple(inputs), target or "", tuple(b.batch_id for b in batches), x, y, time_s, offsets,
                   steps[0][0] if steps else 0.0, drivers=drivers, driver_names=driver_names,
                   driver_units=tuple(batches[0].channels[d].unit for d in driver_names),
                   input_units=tuple(feature_unit(batches[0], i) for i in inputs) if batches else (),
                   batches=tuple(batches), machine=machine)  # fmt: skip

    @property
    def n_batches(self) -> int:
        return len(self.batch_ids)

    def rows(self, k: int) -> slice:
        """The rows of batch k."""
        return slice(int(self.offsets[k]), int(self.offsets[k + 1]))

    @cached_property
    def group(self) -> NDArray[np.int64]:
        """Batch index of every row, (n,)."""
        return np.repeat(np.arange(self.n_batches), np.diff(self.offsets))

    @cached_property
    def along(self) -> str:
        """The position channel along which the target was measured, "" for none."""
        return self._along(self.target)

    def _along(self, target: str) -> str:
        known = self.batches[0].channels if self.batches else {}
        return known[target].position if target in known else ""

    def since_start(self, values: Array, k: int, target: str) -> Array:
        """A series (n_k,) of batch k less its values at the start, as the error channel `target` is zeroed.

        The start is the first finite value, and along an axis the first sweep (`features.start`).
        """
        known = np.isfinite(values)
        along = self._along(target)
        if not along:
            return values - values[np.argmax(known)] if len(values) else values
        rows = self.rows(k)
        start = Start.of(known, self.time_s[rows], self.position_mm(along)[rows])
        return values if start is None else start.since(values)

    @cached_property
    def _starts(self) -> list[Start | None]:
        """References of each batch's rows; only rows with all inputs can be the start."""
        complete: NDArray[np.bool_] = np.asarray(self._finite.all(axis=1))
        position_mm = self.position_mm(self.along) if self.along else None
        rows = map(self.rows, range(self.n_batches))
        return [Start.of(complete[r], self.time_s[r], None if position_mm is None else position_mm[r]) for r in rows]

    @cached_property
    def started(self) -> Design:
        """The same rows with the inputs relative to each batch's start, for fits whose prediction is 0 there.

        `moments` and `quarters` of it are about 0 instead of about a mean. A batch without a row that has all inputs
        is NaN throughout.
        """
        parent = self._parent
        if self.about_start:
            return self
        if parent is not None and (parent._complete or _same(parent._starts, self._starts)):
            return parent.started.subset(self.inputs)
        x = np.full(self.x.shape, np.nan)
        for k, start in enumerate(self._starts):
            if start is not None:
                x[self.rows(k)] = start.since(self.x[self.rows(k)])
        return replace(self, x=x, about_start=True, _columns=None, _parent=None)

    def position_mm(self, channel: str) -> Array:
        """A position channel of the batches on every row (n,), NaN where nothing was read."""
        known = self.root._positions
        if channel not in known:
            known[channel] = np.concatenate([np.empty(0), *(b.masked(channel) for b in self.batches)])
        return known[channel]

    @cached_property
    def _positions(self) -> dict[str, Array]:
        return {}

    @cached_property
    def usable(self) -> NDArray[np.bool_]:
        """Rows with a finite target and finite inputs, (n,), read-only."""
        if self._parent is not None and self._columns is not None:
            return self._parent._usable_with(self._columns)
        return self._usable_with(range(len(self.inputs)))

    @cached_property
    def _finite(self) -> NDArray[np.bool_]:
        return np.isfinite(self.x)

    @cached_property
    def _complete(self) -> bool:
        """Whether no input is missing in any row: every batch's start is then that of every subset."""
        return bool(self._finite.all())

    @cached_property
    def _holed(self) -> list[bool]:
        """Inputs that are missing in some row with a target: only these make the rows of two subsets differ."""
        missing = np.count_nonzero(~self._finite[np.isfinite(self.y_um)], axis=0)
        return [bool(m) for m in missing]

    @cached_property
    def _masks(self) -> dict[tuple[int, ...], NDArray[np.bool_]]:
        return {}

    def _usable_with(self, columns: Iterable[int]) -> NDArray[np.bool_]:
        key = tuple(sorted({c for c in columns if self._holed[c]}))
        if key not in self._masks:
            mask = np.isfinite(self.y_um) & self._finite[:, list(key)].all(axis=1)
            mask.setflags(write=False)
            self._masks[key] = mask
        return self._masks[key]

    def stacked(self, train: Sequence[int]) -> tuple[Array, Array, NDArray[np.int64]]:
        """x (n, p), y_um (n,) and batch index (n,) of the n usable rows of the given batches."""
        trained = np.zeros(self.n_batches, bool)
        trained[np.asarray(train, int)] = True
        keep = self.usable & trained[self.group]
        return self.x[keep], self.y_um[keep], self.group[keep]

    @cached_property
    def _place(self) -> dict[str, int]:
        return {name: c for c, name in enumerate(self.inputs)}

    def subset(self, inputs: Sequence[str]) -> Design:
        """The same rows with fewer inputs; usable rows are those of the subset.

        Raises:
            InputError: an input that the design does not have.
        """
        unknown = [i for i in inputs if i not in self._place]
        if unknown:
            raise InputError(f"subset of a design: no input {unknown[0]!r}; {closest(unknown[0], self.inputs)}")
        columns = tuple(self._place[i] for i in inputs)
        x = self.x.take(np.array(columns, int), axis=1)
        return Design(tuple(inputs), self.target, self.batch_ids, x, self.y_um, self.time_s, self.offsets,
                      self.step_s, columns, self, self.drivers, self.driver_names, self.driver_units,
                      tuple(self.input_units[c] for c in columns if c < len(self.input_units)),
                      self.batches, self.machine, self.about_start)  # fmt: skip

    @property
    def root(self) -> Design:
        """The design that this one is a subset of, or itself."""
        return self if self._parent is None else self._parent.root

    @cached_property
    def moments(self) -> Moments:
        """Cross-products per batch; a subset takes its parent's where both use the same rows."""
        parent = self._parent
        if parent is not None and self._columns is not None and np.array_equal(parent.usable, self.usable):
            return parent.moments.subset(self._columns)
        return self._sums(self.group[self.usable], self.n_batches)

    @cached_property
    def quarters(self) -> Moments:
        """The same per contiguous quarter of every batch's usable rows: quarter q of batch k at 4 k + q, (4 K, …).

        The blocks of `models.base.inner_groups` for trainings of one or two batches.
        """
        parent = self._parent
        if parent is not None and self._columns is not None and np.array_equal(parent.usable, self.usable):
            return parent.quarters.subset(self._columns)
        batch = self.group[self.usable]
        count = np.bincount(batch, minlength=self.n_batches)
        within = np.arange(len(batch)) - (np.cumsum(count) - count)[batch]
        return self._sums(4 * batch + within * 4 // np.maximum(count, 1)[batch], 4 * self.n_batches)

    def _sums(self, block: NDArray[np.int64], n_blocks: int) -> Moments:
        """Moments per block; `block` numbers the usable rows, rising."""
        ok = self.usable
        usable_x, usable_y = self.x[ok], self.y_um[ok]
        about_mean = len(block) > 0 and not self.about_start
        shift_x = usable_x.mean(axis=0) if about_mean else np.zeros(len(self.inputs))
        shift_y = float(usable_y.mean()) if about_mean else 0.0
        usable_x, usable_y = usable_x - shift_x, usable_y - shift_y
        k, p = n_blocks, len(self.inputs)
        count, sum_x, sum_y = np.zeros(k), np.zeros((k, p)), np.zeros(k)
        xx, xy, yy = np.zeros((k, p, p)), np.zeros((k, p)), np.zeros(k)
        border = np.searchsorted(block, np.arange(k + 1))
        for i in range(k):
            x, y = usable_x[border[i] : border[i + 1]], usable_y[border[i] : border[i + 1]]
            count[i], sum_x[i], sum_y[i] = len(y), x.sum(axis=0), y.sum()
            xx[i], xy[i], yy[i] = x.T @ x, x.T @ y, y @ y
        return Moments(count, sum_x, sum_y, xx, xy, yy, shift_x, shift_y, self.about_start)


def _same(some: Sequence[Start | None], others: Sequence[Start | None]) -> bool:
    """Whether all rows refer to the same rows."""
    return all(
        a is b
        or (a is not None and b is not None
            and all(np.array_equal(getattr(a, n), getattr(b, n)) for n in ("left", "right", "share")))
        for a, b in zip(some, others, strict=True)
    )  # fmt: skip


def even_rows(design: Design, batch: int, most: int) -> NDArray[np.int64]:
    """Indices (≤ most,) of a batch's usable rows, evenly spread where there are more."""
    usable = np.flatnonzero(design.usable[design.rows(batch)]) + design.offsets[batch]
    if len(usable) > most:
        usable = usable[np.round(np.linspace(0, len(usable) - 1, most)).astype(int)]
    return usable.astype(np.int64)


def decimated_rows(design: Design, train: Sequence[int], most: int) -> list[NDArray[np.int64]]:
    """`even_rows` of every training batch, in rising order of the batches."""
    return [even_rows(design, k, most) for k in sorted(train)]
