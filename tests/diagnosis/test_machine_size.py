"""What is usual of a mechanism goes with the machine's size; a structural one is fitted from what the screen saw."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from diagnosis.candidates.library import candidates
from diagnosis.candidates.priors import at_size, free_values, size_of
from diagnosis.contracts import Scored
from diagnosis.fitting.carried import carried_start
from diagnosis.fitting.fit import Fitted
from diagnosis.policy import POLICY
from tests.diagnosis.small_cases import FLOOR, cold_floor, four_bodies
from twin.calibration.fit_problem import x_of
from twin.compile import compile_network
from twin.mechanisms import MECHANISMS
from twin.quantity import Value, convert
from twin.schema import MechanismPart, twin_part

SMALL = {"bodies", "links", "exposures"}


def of_grams() -> Any:
    """The four bodies as a thing of a thousandth."""
    given = four_bodies()
    twin = dict(given.twin or {})
    for group in SMALL:
        twin[group] = {k: _smaller(v) for k, v in twin[group].items()}
    return given.model_copy(update={"twin": twin})


def _smaller(given: Any) -> Any:
    if isinstance(given, dict):
        return {k: _smaller(v) if k in ("value", "capacity") else v for k, v in given.items()}
    number, unit = str(given).split()
    return f"{float(number) / 1e3:g} {unit}"


def at_rest(machine: Any) -> Fitted:
    """As much of a fit as a size needs."""
    network = compile_network(machine)
    given = {"problem": SimpleNamespace(network=network), "values": network.values}
    return cast(Fitted, SimpleNamespace(**given, machine=machine, part=twin_part(machine)))


def bridge(conductance_W_per_K: float) -> Scored:
    found = candidates(four_bodies(), twin_part(four_bodies()), ["heat_bridge"])[0]
    return Scored(found, 5.0, 0.5, {"conductance": conductance_W_per_K}, 1e-4, 0)


def test_a_machine_tool_is_of_the_usual_size_and_grams_are_not() -> None:
    assert size_of(cold_floor()) == size_of(at_rest(four_bodies())) == 1.0
    small = size_of(at_rest(of_grams()))
    assert 1e-4 < small < 1e-3
    links_W_per_K = (15e-3 * 15e-3 * 20e-3 * 1e-3 * 4e-3 * 10e-3) ** (1 / 6)
    assert small == pytest.approx(links_W_per_K / POLICY.typical_conductance_W_per_K)


def test_watts_conductances_and_surfaces_go_with_it_and_nothing_else() -> None:
    spec = MECHANISMS["heat_bridge"].spec("conductance")
    assert at_size(spec, 1.0) is spec
    assert at_size(spec, 1e-3).value == pytest.approx(5e-3)
    assert at_size(MECHANISMS["radiation"].spec("area"), 1e-3).value == pytest.approx(1e-3)
    for key, name in (("supply_sag", "sag"), ("joint_conductance", "ratio"), ("sensor_drift", "rate")):
        assert at_size(MECHANISMS[key].spec(name), 1e-3) is MECHANISMS[key].spec(name)


def test_a_structural_one_begins_at_what_the_screen_saw_about_the_usual_value() -> None:
    values = free_values(bridge(2.8), cold_floor())
    own = values["conductance"]
    assert own.value is not None and own.prior is not None
    assert (convert(own.value, "W/K"), convert(own.prior, "W/K")) == (2.8, 5.0)
    floor = Value(value="3 W/K", prior="10 W/K", spread=1.5)
    part = cold_floor().part
    given = MechanismPart.model_validate({**FLOOR, "parameters": {"conductance": floor}})
    more = part.model_copy(update={"mechanisms": {**part.mechanisms, "floor": given}})
    problem, z, _ = carried_start(cold_floor(), more)
    name = "exposures.head-floor.conductance"
    assert problem.values_at(x_of(problem.unknowns, z))[problem.network.index(name)] == pytest.approx(3.0)
    (u,) = [u for u in problem.unknowns if u.name == name]
    assert u.value(u.prior) == pytest.approx(10.0)
