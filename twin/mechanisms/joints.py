"""Mechanisms of joints: changed conductance of a link, and additional heat paths."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from data.arrays import Numeric
from twin.mechanisms.base import Mechanism, PortRole, View, size
from twin.quantity import Spec
from twin.schema import Link, MechanismPart, TwinPart


class JointConductance(Mechanism):
    """A link that conducts `ratio` times its value in the file: always, or while a driver is 1 (clamp closed).

    A power, not a sum, so that no driver value makes a conductance negative; a driver between 0 and 1 lies between.
    """

    key = "joint_conductance"
    of_network = True
    only_driven = True
    summary = "joint that conducts better or worse than assumed"
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

    def factor(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return np.asarray(p["ratio"] ** size(view.driver.get("closed", 1.0)))


class HeatBridge(Mechanism):
    """A link under the mechanism's own name: a bracket, a hose, a circuit board, or air and radiation between two.

    `at`: {body: …, other: …}. Two bodies that face each other exchange about 6 W/m²/K by radiation at room
    temperature, which over tens of kelvins is indistinguishable from conduction.
    """

    key = "heat_bridge"
    of_network = True
    summary = "heat path between two bodies"
    equation = "P = conductance (T_other - T_body)"
    source = "Fourier 1822; Incropera et al. 2007, Fundamentals of Heat and Mass Transfer, sec. 3.1, 1 to 50 W/K"
    signature = "one body follows another that no link of the file joins it with, late and by a share"
    acts_at = ("node",)
    ports = ("body", "other")
    parameters = (Spec("conductance", "W/K", "conductance between the two bodies", 5.0, 1.0, 0.0, 1e5),)
    off: ClassVar[Mapping[str, float]] = {"conductance": 0.0}
    port_roles: ClassVar[Mapping[str, PortRole]] = {"other": "unlinked"}

    def expand(self, name: str, part: MechanismPart, twin: TwinPart) -> TwinPart:
        """Raises ValueError: a link of this name, not two places, unknown parameters; it starts with the key."""
        if name in twin.links:
            raise ValueError(f"mechanisms.{name}: a link is called {name!r} already; rename the mechanism")
        words, given = part.words or self.summary, self.given(name, part)
        link = Link(between=_ends(name, part), conductance=given["conductance"], words=words)
        return twin.model_copy(update={"links": {**twin.links, name: link}})


def _ends(name: str, part: MechanismPart) -> tuple[str, str]:
    at = part.at if isinstance(part.at, Mapping) else {}
    body, other = at.get("body"), at.get("other")
    if set(at) != {"body", "other"} or not isinstance(body, str) or not isinstance(other, str):
        raise ValueError(
            f"mechanisms.{name}.at: expected the two bodies that exchange heat, e.g. at: {{body: bed, other: column}}"
        )
    return body, other
