"""The laboratory board: its heaters share one supply and one circuit board. Values: the full file, calibrated."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from data.batch import Batch
from plants.real import term, windows
from plants.withheld.kept_back import KeptBack, Term

CALIBRATED: Mapping[str, float] = MappingProxyType({
    "mechanisms.heat2.gain": 0.004823, "mechanisms.sag1.sag": 0.2744, "mechanisms.sag2.sag": 0.4511,
    "links.heater1-heater2.conductance": 0.00543,
})  # fmt: skip


def sag(number: int) -> Callable[[Mapping[str, Any], list[Batch]], list[Term]]:
    """The heat of a heater that falls while the other one is on."""
    other = f"heater{3 - number}"

    def terms(twin: Mapping[str, Any], batches: list[Batch]) -> list[Term]:
        both = [(b.values("heater1") > 0) & (b.values("heater2") > 0) for b in batches]
        return [
            term(
                "supply_sag", "supply_sag", ("node", f"heater{number}"), also=[("node", f"heat{number}")],
                parameters={"sag": (CALIBRATED[f"mechanisms.sag{number}.sag"], "1"), "rated": (100.0, "1")},
                neighbours=[other], active=windows(batches, both), driver=other,
                words=f"heater {number} warms less while the other one is on",
            )
        ]  # fmt: skip

    return terms


def both_sags(twin: Mapping[str, Any], batches: list[Batch]) -> list[Term]:
    return [*sag(1)(twin, batches), *sag(2)(twin, batches)]


def bridge(twin: Mapping[str, Any], batches: list[Batch]) -> list[Term]:
    """Heat from one heater to the other through the board."""
    value = CALIBRATED["links.heater1-heater2.conductance"]
    return [
        term(
            "heat_bridge", "heat_bridge", ("node", "heater1"),
            also=[("node", "heater2"), ("link", "heater1-heater2")],
            parameters={"conductance": (value, "W/K")}, words="the board conducts from heater to heater",
        )
    ]  # fmt: skip


def second_heater(twin: Mapping[str, Any], batches: list[Batch]) -> list[Term]:
    """The heat of heater 2."""
    on = [b.values("heater2") > 0 for b in batches]
    return [
        term(
            "electrical_heat", "electrical_heat", ("node", "heater2"), neighbours=["heater1"],
            parameters={"gain": (CALIBRATED["mechanisms.heat2.gain"], "W")}, active=windows(batches, on),
            driver="heater2", words="heater 2 warms its place",
        )
    ]  # fmt: skip


CASES = (
    KeptBack("board_sag1", "tclab_board", "supply sag of heater 1 kept back", sag(1), without=("mechanisms.sag1",)),
    KeptBack("board_sag2", "tclab_board", "supply sag of heater 2 kept back", sag(2), without=("mechanisms.sag2",)),
    KeptBack(
        "board_both_sags", "tclab_board", "supply sag of both heaters kept back", both_sags,
        without=("mechanisms.sag1", "mechanisms.sag2"), kind="two",
    ),
    KeptBack(
        "board_bridge", "tclab_board", "heat bridge between the heaters kept back", bridge,
        without=("links.heater1-heater2",),
    ),
    KeptBack(
        "board_heater2", "tclab_board", "heat of the second heater kept back", second_heater,
        without=("mechanisms.heat2", "mechanisms.sag2"),
    ),
)  # fmt: skip
