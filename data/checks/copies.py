"""Check for recordings that share rows: one that ends earlier or goes on longer than its copy; ingest stores both."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from data.batch import Batch, Finding
from data.checks.base import Check, span_text
from data.lakefile import MEASURED
from data.machine import Machine

_ROWS = 16  # rows that are compared as one; noise does not repeat over so many
_CHANGES = 8  # of them that differ from the row before: an idle machine may well rest at the same values twice
_MULTIPLIER = np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio, odd (Knuth, 1973, multiplicative hashing)


class Copied(Check):
    """Stretches of equal measured values in two batches, which a left-out batch has then been trained on.

    Batches are compared by hashes of `_ROWS` consecutive rows in all measured channels that every batch has. The
    earlier batch in the given order counts as the original. Rows are compared as they are on the grid: a copy that was
    cut, rounded or exported at another rate so that its rows on the grid are others is not found.
    """

    key = "copied"
    summary = "rows with the same measured values as in another batch"

    def across(self, batches: Sequence[Batch], machine: Machine) -> dict[int, list[Finding]]:
        shared = sorted(set.intersection(*map(_measured, batches))) if batches else []
        hashes = [_hashes(b, shared) for b in batches] if shared else []
        rows = [np.flatnonzero(h) for h in hashes]
        every = np.concatenate([h[r] for h, r in zip(hashes, rows, strict=True)]) if rows else np.empty(0, np.uint64)
        batch_of = np.repeat(np.arange(len(rows)), [len(r) for r in rows])
        _, first, group = np.unique(every, return_index=True, return_inverse=True)
        origin = batch_of[first][group]
        found = {}
        for k in np.unique(batch_of[origin != batch_of]).tolist():
            mine = batch_of == k
            copied = rows[k][origin[mine] != k]
            other = batches[Counter(origin[mine][origin[mine] != k].tolist()).most_common(1)[0][0]]
            n = len(np.unique(copied[:, None] + np.arange(_ROWS)))
            batch, last = batches[k], int(copied[-1]) + _ROWS - 1
            shorter = min(batch, other, key=lambda b: b.n_rows)
            message = (
                f"{n} of {batch.n_rows} rows, {span_text(batch, int(copied[0]), last)}, have the same measured values "
                f"as batch {other.batch_id}: a copy, or a longer export of the same run; withdraw the shorter one "
                f"(`thermodrift lake withdraw {batch.machine} {shorter.batch_id} --reason TEXT`)"
            )
            found[k] = [self.in_rows(batch, None, int(copied[0]), last, message, masks=False)]
        return found


def _measured(batch: Batch) -> set[str]:
    """Measured channels with a value."""
    return {n for n in batch.names(*MEASURED) if n in batch.table and np.isfinite(batch.values(n)).any()}


def _hashes(batch: Batch, names: Sequence[str]) -> NDArray[np.uint64]:
    """For each row the hash of it and the following `_ROWS` - 1 ones, shape (n - _ROWS + 1,); 0 where few change."""
    if batch.n_rows < _ROWS:
        return np.zeros(0, np.uint64)
    row = np.zeros(batch.n_rows, np.uint64)
    for name in names:
        values = batch.values(name)
        bits = np.where(np.isnan(values), np.nan, values + 0.0).view(np.uint64)  # one NaN, and no -0.0
        row = (row ^ bits ^ (bits >> np.uint64(32))) * _MULTIPLIER
    out = np.zeros(batch.n_rows - _ROWS + 1, np.uint64)
    for k in range(_ROWS):
        out = (out ^ row[k : k + len(out)]) * _MULTIPLIER
    changes = np.concatenate([[0], np.cumsum(row[1:] != row[:-1])])
    return np.where(changes[_ROWS - 1 :] - changes[: len(out)] >= _CHANGES, out, np.uint64(0))
