"""A link that the machine file lacks: what it may join, once a pair, and what it writes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from data.errors import InputError
from data.machine import Machine, load_machine
from diagnosis.candidates.library import candidates
from tests.toys.small_machine import machine_with
from twin.compile import compile_network, expanded
from twin.mechanisms.joints import HeatBridge
from twin.schema import TwinPart, twin_part

ENDS = {"body": "first", "other": "third"}


def machine(parameters: dict[str, Any] | None = None, **instance: Any) -> Machine:
    return machine_with(HeatBridge(), parameters, **{"at": ENDS, **instance})


def stated(given: Machine) -> dict[str, Any]:
    assert given.twin is not None
    return given.twin


def test_it_is_proposed_once_for_every_pair_that_nothing_joins() -> None:
    bare = machine()
    bridge = stated(bare)["mechanisms"].pop("tried")
    (only,) = candidates(bare, twin_part(bare), ["heat_bridge"])
    assert (only.name, only.where.name) == ("heat_bridge_first_third", "first")
    assert only.part is not None and only.part.at == ENDS
    for there in ENDS, {"body": "third", "other": "first"}:
        stated(bare)["mechanisms"]["there"] = {**bridge, "at": there}
        assert candidates(bare, twin_part(bare), ["heat_bridge"]) == []
    del stated(bare)["mechanisms"]["there"]
    stated(bare)["exposures"]["first-third"] = "2 W/K"  # air that the machine warms
    assert candidates(bare, twin_part(bare), ["heat_bridge"]) == []


def test_two_heaters_of_a_board_that_its_file_leaves_apart() -> None:
    board = load_machine(Path(__file__).parents[3] / "machines" / "tclab_board.yml")
    linked = twin_part(board)
    apart = linked.model_copy(update={"links": {}})

    def pairs(part: TwinPart, law: str) -> list[Any]:
        every = [c.part.at for c in candidates(board, part, [law]) if c.part and isinstance(c.part.at, dict)]
        return [at for at in every if set(at.values()) == {"heater1", "heater2"}]

    assert pairs(apart, "heat_bridge") == [{"body": "heater1", "other": "heater2"}]
    assert pairs(apart, "radiation") == [{"body": "heater1", "surrounding": "heater2"}]
    assert pairs(linked, "heat_bridge") == pairs(linked, "radiation") == []  # the link's value is the file's to fit


def test_it_becomes_a_link_with_its_value_and_prior() -> None:
    given = {"conductance": {"value": "3 mW/K", "spread": 0.7}}
    part = expanded(twin_part(machine(parameters=given)))
    assert part.links["tried"].between == ("first", "third") and "tried" not in part.mechanisms
    network = compile_network(machine(parameters=given))
    p = network.parameters[network.index("links.tried.conductance")]
    assert (p.value, p.spread, p.low, p.high) == (0.003, 0.7, 0.0, 1e5)


def test_a_link_of_the_same_name() -> None:
    taken = machine()
    stated(taken)["links"]["tried"] = {"between": ["first", "third"], "conductance": "1 W/K"}
    with pytest.raises(InputError, match=r"mechanisms\.tried: a link is called 'tried' already"):
        compile_network(taken)
