"""How large a machine is beside a machine tool: usual heats and conductances are of tonnes, a board has grams."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from twin.diagnosis.rounds.fitted import Fitted
from twin.quantity import Spec, same_dimension

TYPICAL_W_PER_K = 20.0  # a link or an exposure of a machine tool's body
SAME = 10.0  # within this factor it is one: priors are wider
GROW = ("W", "W/K", "m**2")  # units of what goes with the size


def size_of(fitted: Fitted) -> float:
    """Geometric mean of the fitted conductances over a machine tool's; 1 where that is within a factor of `SAME`."""
    network = fitted.problem.network
    conductances = np.array([float(e.conductance(fitted.values)) for e in network.edges])
    known = conductances[conductances > 0]
    if not len(known):
        return 1.0
    ratio = float(np.exp(np.mean(np.log(known)))) / TYPICAL_W_PER_K
    return 1.0 if 1.0 / SAME < ratio < SAME else ratio


def at_size(spec: Spec, size: float) -> Spec:
    """The Spec with the usual value of a machine of that size."""
    if size == 1.0 or spec.scale != "log" or not spec.value or not any(same_dimension(spec.unit, u) for u in GROW):
        return spec
    return replace(spec, value=float(np.clip(spec.value * size, spec.low, spec.high)))
