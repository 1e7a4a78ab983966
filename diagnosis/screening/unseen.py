"""Regimes left out of the fit: all batches of a season, or of the highest speed, predicted by the others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from data.batch import Batch
from diagnosis.contracts import Fitted
from diagnosis.policy import POLICY
from diagnosis.screening.screen import alone


def unseen(before: Fitted, after: Fitted) -> dict[str, Mapping[str, float]]:
    """Gains in nats where a whole season, or the fastest runs, were left out; empty where the data allow none."""
    one, other = alone(before, before.memory), alone(after, before.memory)
    out: dict[str, Mapping[str, float]] = {}
    for key, groups in (("seasons_left_out", _seasons(before.batches)), ("regimes_left_out", _fast(before.batches))):
        gains = {
            name: float(other.group_score(at) - one.group_score(at))
            for name, at in groups.items()
            if POLICY.unseen_min_batches <= len(at) <= len(before.batches) - POLICY.unseen_min_batches
        }
        if gains:
            out[key] = gains
    return out


def _seasons(batches: Sequence[Batch]) -> dict[str, list[int]]:
    """Thirds of the batches by the ambient's mean: cold, mild, warm."""
    names = batches[0].names("ambient")
    if not names:
        return {}
    mean = [float(np.nanmean(b.masked(names[0]))) for b in batches]
    order = np.argsort(mean)
    thirds = np.array_split(order, 3)
    return {
        f"{word} ({min(mean[k] for k in at):.0f} to {max(mean[k] for k in at):.0f} degC)": sorted(at.tolist())
        for word, at in zip(("cold", "mild", "warm"), thirds, strict=True)
        if len(at)
    }


def _fast(batches: Sequence[Batch]) -> dict[str, list[int]]:
    """By driver the batches that reach its highest value, if others do not."""
    out = {}
    for name in batches[0].names("driver"):
        top = [float(np.nanmax(b.values(name))) for b in batches]
        highest = max(top)
        if highest > 0 and min(top) < POLICY.unseen_top_share * highest:
            out[f"{name} up to {highest:g}"] = [k for k, v in enumerate(top) if v >= POLICY.unseen_top_share * highest]
    return out
