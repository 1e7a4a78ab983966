"""Where a run starts from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from twin.mechanisms.base import Array, Mechanism, View
from twin.quantity import Spec


class InitialState(Mechanism):
    """A body that is warmer or colder at the first sample than the first readings say."""

    key = "initial_state"
    words = "start away from equilibrium"
    equation = "T(0) = first reading + excess"
    source = "Carslaw and Jaeger (1959), Conduction of Heat in Solids: an initial state as a sum of decaying modes"
    signature = "drift before any load that decays with the slow time constants and does not depend on the speed"
    acts_at = ("start",)
    parameters = (
        Spec(
            "excess", "K", "temperature at the start above what the first readings say", 0.0, 2.0, -50.0, 50.0, "linear"
        ),
    )
    off: ClassVar[Mapping[str, float]] = {"excess": 0.0}

    def start_K(self, view: View, p: Mapping[str, Array]) -> Array:
        return np.asarray(p["excess"])
