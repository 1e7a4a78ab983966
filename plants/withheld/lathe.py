"""The lathe: one of its heats or shifts kept back. Values: as the full file states them, which was fitted to its runs.

Feed is 5000 mm/min in nearly all runs, so that laws proportional to it are alike; so are losses of two exponents of
the speed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from data.batch import Batch
from plants.real import Place, linked, term, windows
from plants.withheld.kept_back import KeptBack, Term

BY_FEED = ("nut_friction", "guide_friction", "screw_bearing")
BY_SPEED = ("belt_loss", "motor_loss", "bearing_viscous", "bearing_load")
UNITS = {"moment": "N*m", "power": "W", "shift": "um", "slope": "1/K"}


def one(
    instance: str, kind: str, name: str, amplitude: str, also: tuple[Place, ...] = (), alike: tuple[str, ...] = ()
) -> Callable[[Mapping[str, Any], list[Batch]], list[Term]]:
    """The term of a mechanism of the file; `alike` are laws that these runs cannot tell from its own."""

    def terms(twin: Mapping[str, Any], batches: list[Batch]) -> list[Term]:
        given = twin["mechanisms"][instance]
        told = given["parameters"][amplitude]["value"]
        driver = given.get("drivers")
        moving = [b.values(driver or "spindle_rpm") > 0 for b in batches]
        return [
            term(
                given["law"], given["law"], (kind, name), also=also,
                parameters={amplitude: (float(str(told).split()[0]), UNITS[amplitude])},
                neighbours=linked(twin, name), active=windows(batches, moving), driver=driver,
                same_as=[(law, (kind, name)) for law in alike if law != given["law"]],
                words=f"{instance.replace('_', ' ')} of the lathe",
            )
        ]  # fmt: skip

    return terms


CASES = (
    KeptBack(
        "lathe_nut", "lathe_gv1203", "friction of the nut kept back",
        one("nut", "node", "nut", "moment", alike=BY_FEED), without=("mechanisms.nut",),
        instead={"mechanisms.guide_oil.acts_on": ["programme", "x_drive"]},
    ),
    KeptBack(
        "lathe_x_drive", "lathe_gv1203", "heat of the X drive kept back",
        one("x_drive", "node", "x_drive", "moment", alike=BY_FEED), without=("mechanisms.x_drive",),
        instead={"mechanisms.guide_oil.acts_on": ["programme", "nut"]},
    ),
    KeptBack(
        "lathe_belt", "lathe_gv1203", "losses of the belt kept back",
        one("belt", "node", "motor_cover", "power", alike=BY_SPEED), without=("mechanisms.belt",),
    ),
    KeptBack(
        "lathe_grease", "lathe_gv1203", "grease that thins kept back",
        one("grease", "node", "nose", "slope", (("node", "head"), ("node", "bearings_viscous"))),
        without=("mechanisms.grease",),
    ),
    KeptBack(
        "lathe_z_shift", "lathe_gv1203", "shift of Z by the speed kept back",
        one("z_shift", "error", "disp_z", "shift"), without=("mechanisms.z_shift",),
    ),
)  # fmt: skip
