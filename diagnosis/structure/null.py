"""The null of the whole screen: what the best of all candidates gains where nothing is missing."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from data.arrays import Array
from diagnosis.policy import POLICY
from diagnosis.structure.policy import STRUCTURE, StructurePolicy


@dataclass(frozen=True)
class Null:
    """Largest log evidence (T,), nats, of any candidate in T machines that the covariance has not seen.

    A few machines say little about a quantile of 99 %, so a Gumbel distribution of their mean and spread stands for
    them (Gumbel 1958): largest values of many candidates are distributed so. The spread is that of all but the largest
    machine in twenty, whose share is made up for: one odd machine must not decide.
    """

    gain: Array

    @cached_property
    def _gumbel(self) -> tuple[float, float]:
        """Location and scale."""
        if len(self.gain) < POLICY.null_min_machines:
            return float("inf"), 1.0
        middle, high = np.quantile(self.gain, (0.5, STRUCTURE.null_high_quantile))
        shares = -np.log(-np.log(np.array([0.5, STRUCTURE.null_high_quantile])))
        scale = max(float((high - middle) / (shares[1] - shares[0])), STRUCTURE.null_min_scale_nats)
        return float(middle - scale * shares[0]), scale

    def threshold(self, policy: StructurePolicy = STRUCTURE) -> float:
        """The gain that structure alone exceeds with the probability of a false alarm that the policy allows."""
        location, scale = self._gumbel
        if not np.isfinite(location):
            return float("inf")
        level = location - scale * float(np.log(-np.log1p(-policy.false_alarms)))
        return max(level, policy.null_min_threshold_nats)

    def p_value(self, gain: float) -> float:
        """Probability that structure alone gains as much."""
        location, scale = self._gumbel
        if not np.isfinite(location):
            return 1.0
        return float(-np.expm1(-np.exp(-(gain - location) / scale)))
