"""A batch whose error the temperatures explain far worse than in all the others. Odd, not proven: masks nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data.batch import Batch, Finding
from data.checks.base import THERMAL, Array, Check
from data.machine import Machine

_BATCHES = 8
_SIGMAS = 6.0
_TIMES = 3.0
_FLOOR_UM = 10.0


class Unexplained(Check):
    """Ridge on the rises of all sound temperatures, each batch predicted by the others. A batch is told when
    its residual exceeds the median over batches by 6 robust sigma, three times the median itself, and 10 µm.
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
        for target in batches[0].names("error"):
            left = self._left_out(x, [b.masked(target) if target in b.channels else np.empty(0) for b in batches])
            known = left[np.isfinite(left)]
            if len(known) < _BATCHES:
                continue
            centre = float(np.median(known))
            limit = max(
                centre + _SIGMAS * 1.4826 * float(np.median(np.abs(known - centre))), _TIMES * centre, _FLOOR_UM
            )
            for k in np.flatnonzero(np.nan_to_num(left) > limit):
                words = (
                    f"{target}: a ridge model of the other batches leaves {left[k]:.0f} µm here and {centre:.0f} µm in "
                    "the median batch. No sensor explains it; look at the probe and its fixture. Not masked: to "
                    "leave it out of training, overrule with mask: true"
                )
                found.setdefault(int(k), []).append(self.finding(target, words, masks=False))
        return found

    def _left_out(self, x: list[Array], errors: list[Array]) -> Array:
        """Root mean square residual of every batch predicted by the others, µm; NaN without values."""
        rows = []
        for xk, y in zip(x, errors, strict=True):
            ok = np.isfinite(y) & np.isfinite(xk).all(axis=1) if len(y) == len(xk) else np.zeros(len(xk), bool)
            rows.append((xk[ok], y[ok] - y[ok][0]) if ok.sum() > 10 else (xk[:0], np.empty(0)))
        scale = np.vstack([r[0] for r in rows]).std(axis=0) + 1e-9
        grams = [(a / scale).T @ (a / scale) for a, _ in rows]
        cross = [(a / scale).T @ y for a, y in rows]
        total, moment = np.sum(grams, axis=0), np.sum(cross, axis=0)
        count = sum(len(y) for _, y in rows)
        out = np.full(len(rows), np.nan)
        for k, (a, y) in enumerate(rows):
            if len(y):
                ridge = 0.001 * (count - len(y)) * np.eye(len(scale))
                w = np.linalg.solve(total - grams[k] + ridge, moment - cross[k])
                out[k] = float(np.sqrt(np.mean((y - (a / scale) @ w) ** 2)))
        return out


def _sound(batch: Batch, name: str) -> bool:
    return name in batch.channels and bool(np.isfinite(batch.masked(name)).mean() > 0.8)
