"""Joints: what bolting, clamping or a rail does to a link."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from twin.mechanisms.base import Array, Mechanism, View
from twin.quantity import Spec


class JointConductance(Mechanism):
    """A link that conducts `ratio` times what its file says: always, or while a driver (clamp closed, 1) says so.

    A power, not a sum, so that no driver value makes a conductance negative; a driver between 0 and 1 lies between.
    """

    key = "joint_conductance"
    of_network = True
    only_driven = True
    words = "joint that conducts better or worse than assumed"
    equation = "G = G0 ratio^closed; closed is 1 where no driver is named"
    source = (
        "Cooper, Mikic and Yovanovich 1969, Int. J. Heat Mass Transfer 12, 279; 500 to 1e4 W/m2K bolted, lower on rails"
    )
    signature = "step in the temperature gradient across a joint"
    acts_at = ("link",)
    drivers: ClassVar[Mapping[str, str]] = {"closed": "1"}
    optional_drivers: ClassVar[frozenset[str]] = frozenset({"closed"})
    parameters = (Spec("ratio", "1", "conductance of the joint over the one assumed", 1.0, 0.7, 0.01, 100.0),)
    off: ClassVar[Mapping[str, float]] = {"ratio": 1.0}

    def factor(self, view: View, p: Mapping[str, Array]) -> Array:
        return np.asarray(p["ratio"] ** view.driver.get("closed", 1.0))
