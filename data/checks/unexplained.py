"""A batch whose error the temperatures explain far worse than in all the others. Odd, not proven: masks nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data.batch import Batch, Finding
from data.checks.base import THERMAL, Array, Check, in_time
from data.machine import Machine

_BATCHES = 8
_SIGMAS = 6.0
_TIMES = 3.0
_FLOOR_UM = 20.0  # friction that scatters by 15 % moves 80 µm by 12 from batch to batch


class Unexplained(Check):
    """Ridge on the rises of all sound temperatures, each batch predicted by the others. A batch is told when
    its residual exceeds the median over batches by 6 robust sigma, three times the median itself, and 20 µm.
    """

    key = "unexplained"
    words = "the temperatures explain this batch's error far worse than the others'"

    def across(self, batches: Sequence[Batch], machine: Machine) -> dict[int, list[Finding]]:
        if len(batches) < _BATCHES:
            return {}
        names = [n for n in batches[0].names(*THERMAL) if all(_sound(b, n) for b in batches)]
        if len(names) < 2:
            return {}
        x = [np.column_stack([b.masked(n) for n in names]) for b in batches]
        x = [v - v[:3].mean(axis=0) for v in x]
        found: dict[int, list[Finding]] = {}
        for target in in_time(batches[0], "error"):
            sums = _Sums(x, [b.masked(target) if target in b.channels else np.empty(0) for b in batches])
            odd: list[int] = []
            while len(odd) < len(batches) // 4:
                left = sums.left_out(odd)
                worst = int(np.nanargmax(np.where(np.isin(np.arange(len(left)), odd), -1.0, np.nan_to_num(left))))
                # a batch this odd bends the model for the others, so judge it by what they are without it
                left = sums.left_out([*odd, worst])
                usual = np.delete(left, [*odd, worst])
                usual = usual[np.isfinite(usual)]
                if len(usual) < _BATCHES - 1:
                    break
                centre = float(np.median(usual))
                spread = 1.4826 * float(np.median(np.abs(usual - centre)))
                if not left[worst] > max(centre + _SIGMAS * spread, _TIMES * centre, _FLOOR_UM):
                    break
                odd.append(worst)
                words = (
                    f"{target}: a ridge model of the other batches leaves {left[worst]:.0f} µm here and "
                    f"{centre:.0f} µm in the median batch. No sensor explains it; look at the probe and its fixture. "
                    "Not masked: to leave it out of training, overrule with mask: true"
                )
                found.setdefault(worst, []).append(self.finding(target, words, masks=False))
        return found


class _Sums:
    """Cross-products of every batch, so that leaving some out costs one small solve."""

    def __init__(self, x: list[Array], errors: list[Array]) -> None:
        self.rows = []
        for xk, y in zip(x, errors, strict=True):
            ok = np.isfinite(y) & np.isfinite(xk).all(axis=1) if len(y) == len(xk) else np.zeros(len(xk), bool)
            self.rows.append((xk[ok], y[ok] - y[ok][0]) if ok.sum() > 10 else (xk[:0], np.empty(0)))
        scale = np.vstack([a for a, _ in self.rows]).std(axis=0) + 1e-9
        self.rows = [(a / scale, y) for a, y in self.rows]
        self.grams = np.array([a.T @ a for a, _ in self.rows])
        self.cross = np.array([a.T @ y for a, y in self.rows])
        self.counts = np.array([len(y) for _, y in self.rows])

    def left_out(self, never: list[int]) -> Array:
        """Rms residual of every batch predicted by all others but `never`, µm, shape (K,); NaN without values."""
        out = np.full(len(self.rows), np.nan)
        for k, (a, y) in enumerate(self.rows):
            train = np.setdiff1d(np.arange(len(self.rows)), [*never, k])
            if len(y) and len(train):
                ridge = 0.001 * self.counts[train].sum() * np.eye(a.shape[1])
                w = np.linalg.solve(self.grams[train].sum(axis=0) + ridge, self.cross[train].sum(axis=0))
                out[k] = float(np.sqrt(np.mean((y - a @ w) ** 2)))
        return out


def _sound(batch: Batch, name: str) -> bool:
    return name in batch.channels and bool(np.isfinite(batch.masked(name)).mean() > 0.8)
