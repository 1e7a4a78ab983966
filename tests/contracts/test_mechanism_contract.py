"""Texts, units, signs and derivatives of every registered mechanism, and how it runs in a small machine.

`tests/twin/mechanisms/cases.py` has the equation of each once more, with units.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, get_args

import numpy as np
import pint
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from data.machine import Machine
from tests.toys.points import DRIVER, TIME_S, Case, Point, U, units_of
from tests.toys.small_machine import BODIES, machine_with, network_with
from tests.twin.mechanisms.cases import CASES
from twin.compile import compile_network
from twin.mechanisms import MECHANISMS
from twin.mechanisms.base import EQUIPMENT, Mechanism, PortRole
from twin.network import Network
from twin.quantity import convert, parameter, same_dimension
from twin.simulation import Simulation, simulate
from twin.simulation.inputs import Inputs

UNITS = {"heat_W": "W", "factor": "", "displacement": "um", "reading": "K", "surrounding_K": "K", "start_K": "K"}
NOTHING = {"heat_W": 0.0, "factor": 1.0, "displacement": 0.0, "surrounding_K": 0.0, "start_K": 0.0}
TARGETS = {
    "heat_W": {"node"}, "factor": {"link", "exposure", "heat"}, "displacement": {"error"},
    "reading": {"sensor", "error"}, "surrounding_K": {"surrounding"}, "start_K": {"start"},
}  # fmt: skip
TEXTS = {"summary": (8, 70), "equation": (3, 130), "source": (20, 140), "signature": (20, 140)}  # characters
N_INTERVALS, STEP_S = 120, 60.0


@dataclass(frozen=True)
class Given:
    """A mechanism with what must be known of it."""

    m: Mechanism
    case: Case

    @property
    def structural(self) -> bool:
        return self.m.effects() == ("expand",)

    @property
    def laws(self) -> tuple[str, ...]:
        """The effects that are functions; none of a structural mechanism."""
        return () if self.structural else self.m.effects()

    @cached_property
    def point(self) -> Point:
        return Point.of(self.m, self.case)

    @property
    def off(self) -> Point:
        """The point with the mechanism switched off."""
        return self.point.at(**(self.m.off or {}))

    @cached_property
    def without(self) -> Machine:
        """The small machine without the mechanism."""
        bare = machine_with(self.m)
        assert bare.twin is not None
        bare.twin["mechanisms"].pop("tried")
        return bare

    @cached_property
    def machine(self) -> Machine:
        """The small machine with it, parameters next to the usual ones, so that none is 0."""
        values: Mapping[str, Any] = {s.name: s.value for s in self.m.parameters}
        values = values if self.structural else self.point.values
        return machine_with(self.m, self.named({s.name: float(values[s.name]) for s in self.m.parameters}))

    def named(self, values: Mapping[str, float]) -> dict[str, str]:
        return {name: f"{value} {self.m.spec(name).unit}" for name, value in values.items()}


@pytest.fixture(scope="module", params=MECHANISMS, name="c")
def given(request: pytest.FixtureRequest) -> Given:
    return Given(MECHANISMS[request.param](), CASES[request.param])


def test_texts_have_the_length_that_pages_take(c: Given) -> None:
    assert all(low <= len(getattr(c.m, name)) <= high for name, (low, high) in TEXTS.items())
    assert "=" in c.m.equation and type(c.m).__name__.lower() == c.m.key.replace("_", "")


def test_it_acts_where_it_says(c: Given) -> None:
    assert c.m.acts_at and c.m.effects()
    assert all(TARGETS[effect] & set(c.m.acts_at) for effect in c.laws)


def test_parameters_have_unit_meaning_value_and_prior(c: Given) -> None:
    m = c.m
    assert len(units_of(m)) == len(m.parameters) + len(m.drivers)  # no name twice
    for unit in units_of(m).values():
        same_dimension(unit, unit)  # raises for a unit that is none
    for s in m.parameters:
        assert len(s.words) >= 5 and s.value is not None and s.spread is not None and s.spread > 0
        assert math.isfinite(s.low) and math.isfinite(s.high) and s.low < s.high and s.low <= s.value <= s.high
        assert s.scale == "linear" or (s.low >= 0 and s.value > 0)
        assert s.scale != "logit" or s.high <= 1
        assert math.isfinite(parameter("p", s, None).to_x(s.value))


def agrees(c: Given, units: dict[str, str], effect: str) -> bool:
    """Whether the law on bare numbers is the case's equation with these units."""
    formula = c.case.more.get(effect, c.case.formula)
    assert formula is not None
    try:
        with np.errstate(all="ignore"):
            wanted = U.Quantity(formula(c.point.quantities(units)))
            wanted = wanted.to(c.case.unit if effect == "displacement" else UNITS[effect]).magnitude
    except (pint.PintError, ValueError):  # another dimension
        return False
    got = c.point.effect(effect) + (273.15 if effect == "reading" else 0.0)
    return bool(np.allclose(got, wanted, rtol=1e-9, atol=1e-9 if effect == "reading" else 0.0))


def test_units_agree_with_the_equation(c: Given) -> None:
    """A Spec in W/K with a law in W/m²K is wrong by a factor that no fit shows."""
    for effect in c.laws if c.case.formula else ():
        assert agrees(c, units_of(c.m), effect)


def test_the_equation_finds_every_wrong_unit(c: Given) -> None:
    """Of another size and of another dimension: an equation that hides a unit lets a wrong Spec pass."""
    units = units_of(c.m)
    for name, unit in units.items() if c.case.formula and c.laws else ():
        size = {"degC": "K", "1": "percent"}.get(unit, f"1000 * {unit}")
        for wrong in (size, "m" if unit == "degC" else f"{unit} * m"):
            assert not all(agrees(c, {**units, name: wrong}, effect) for effect in c.laws), (name, wrong)


def test_without_its_driver_it_does_nothing(c: Given) -> None:
    for effect in {"heat_W", "factor"} & set(c.laws) if c.m.drivers and not c.case.undriven else ():
        assert (c.point.at_rest().effect(effect) == NOTHING[effect]).all()


def test_an_exchange_turns_with_the_temperature_difference(c: Given) -> None:
    """One of another sign makes energy."""
    gives = c.m.takes_from
    if gives is None:
        assert "heat_W" not in c.m.effects() or len(set(c.m.ports) - c.m.optional_ports) < 2
        return
    hot, cold = np.full(TIME_S.shape, 41.0), np.full(TIME_S.shape, 17.0)
    (takes,) = set(c.m.ports) - {gives}
    warm, turned, equal = (
        c.point.seeing(degC={takes: one, gives: other}).effect("heat_W")
        for one, other in ((cold, hot), (hot, cold), (hot, hot))
    )
    assert (warm > 0).all() and (equal == 0.0).all()
    assert_allclose(turned, -warm, rtol=1e-6)


def test_watts_leave_one_place_for_another_or_are_new(c: Given) -> None:
    network = network_with(c.m)
    for heat in (h for h in network.heats if h.law.name == "tried"):
        total = heat.direction(network.values[None]).sum()
        assert abs(total - (0.0 if c.m.takes_from else 1.0)) <= 1e-15


def test_it_is_finite_and_of_its_sign_over_the_whole_prior(c: Given) -> None:
    """A fit walks through the whole prior; one NaN or negative conductance ends it."""
    rng = np.random.default_rng(0)
    for _ in range(50 if c.laws else 0):
        values = {}
        for s in c.m.parameters:
            p = parameter("p", s, None)
            drawn = p.from_x(p.to_x(p.value) + float(s.spread or 0.0) * rng.standard_normal())
            values[s.name] = float(np.clip(drawn, p.low, p.high))
        for effect in c.laws:
            got = c.point.at(**values).effect(effect)
            signed = effect == "factor" or (effect == "heat_W" and not c.case.either_way and c.m.takes_from is None)
            assert np.isfinite(got).all() and (not signed or (got >= 0).all()), (effect, values)


def test_derivatives_by_complex_steps_are_those_of_differences(c: Given) -> None:
    """A calibration follows them: `abs`, `max` or a comparison of complex numbers breaks them."""
    for effect, (name, moved) in itertools.product(c.laws, movable(c.point).items()):
        if name in c.case.stepped:
            continue
        exact = np.imag(moved(1e-30j).effect(effect)) / 1e-30
        size = float(c.point.values[name]) if name in c.point.values else 10.0
        step = 1e-5 * max(1e-3, abs(size))
        about = (moved(step).effect(effect) - moved(-step).effect(effect)) / (2 * step)
        scale = max(np.abs(about).max(), 1e-6 * np.abs(c.point.effect(effect)).max() / step * 1e-5)
        assert_allclose(exact, about, rtol=1e-6, atol=1e-5 * scale + 1e-30, err_msg=f"d {effect} / d {name}")


def movable(point: Point) -> dict[str, Callable[[complex], Point]]:
    """By name: the same point with a parameter, a port's temperature or rise, or what a sensor sees moved by a step."""

    def parameter_moved(name: str, h: complex) -> Point:
        return point.at(**{name: point.values[name] + h})

    def port_moved(kind: str, port: str, h: complex) -> Point:
        old = getattr(point.view, kind)
        return point.seeing(**{kind: {**old, port: old[port] + h}})

    out: dict[str, Callable[[complex], Point]] = {n: partial(parameter_moved, n) for n in point.values}
    for kind, port in itertools.product(("degC", "rise_K"), point.mechanism.ports):
        out[f"{kind} {port}"] = partial(port_moved, kind, port)
    return out | {"seen": lambda h: replace(point, seen=point.seen + h)}


def test_parameter_sets_broadcast_against_time(c: Given) -> None:
    factors = np.array([1.0, 0.9, 0.8])[:, None]
    for effect in c.laws:
        together = c.point.at(**{n: v * factors for n, v in c.point.values.items()}).effect(effect)
        apart = [c.point.at(**{n: v * f for n, v in c.point.values.items()}).effect(effect) for f in factors[:, 0]]
        assert_allclose(np.broadcast_to(together, (3, len(TIME_S))), np.array(apart), rtol=1e-12)


def at_work(network: Network) -> bool:
    """Whether the law called "tried" has a place in the network."""
    used = [*network.factors, *(law for law, _ in network.starts)]
    used += [law for h in network.heats for law in (h.law, *h.factors)]
    for group in (network.surroundings, network.readings, network.errors):
        used += [law for g in group for law in g.effects]
    used += [law for e in network.errors for law in e.readings]
    return any(law.name == "tried" for law in used)


def test_it_compiles_in_a_machine_file_with_its_priors(c: Given) -> None:
    if not c.structural:
        network = network_with(c.m)
        assert at_work(network)
        for s in c.m.parameters:
            p = network.parameters[network.index(f"mechanisms.tried.{s.name}")]
            assert (p.value, p.spread, p.free, p.unit) == (s.value, s.spread, True, s.unit)


def test_optional_drivers_may_be_left_out(c: Given) -> None:
    m, optional = c.m, c.m.optional_drivers
    assert optional <= set(m.drivers) and m.any_unit <= set(m.drivers)
    if optional and not c.structural:
        rest = {role: f"{role}_driver" for role in m.drivers if role not in optional}
        assert at_work(network_with(m, drivers=rest))
        held = {role: np.full(TIME_S.shape, 0.0 if c.case.undriven else 1.0) for role in optional}
        for effect in m.effects():
            driven = c.point.seeing(driver={**c.point.view.driver, **held}).effect(effect)
            bare = c.point.seeing(driver={r: c.point.view.driver[r] for r in rest}).effect(effect)
            assert_array_equal(bare, driven)


def test_structural_values_arrive_with_their_units(c: Given) -> None:
    if c.structural:
        before, after = compile_network(c.without), network_with(c.m)
        known = {p.name for p in before.parameters}
        new = [(p.value, p.unit) for p in after.parameters if p.name not in known]
        for s in c.m.parameters:
            assert any(same_dimension(u, s.unit) and v == convert(f"{s.value} {s.unit}", u) for v, u in new), s.name
        held = {s.name: {"free": False, "value": f"{s.value} {s.unit}"} for s in c.m.parameters}
        assert "tried" not in [law.law.name for law in after.heats]
        assert_allclose(network_with(c.m, {}).values, network_with(c.m, held).values, rtol=1e-6)


# What a diagnosis needs


def does_nothing(point: Point) -> bool:
    return all(
        np.allclose(point.effect(e), point.seen if e == "reading" else NOTHING[e], rtol=1e-12, atol=0.0)
        for e in point.mechanism.effects()
    )


def test_what_a_diagnosis_sets_is_a_parameter_within_its_bounds(c: Given) -> None:
    m, off = c.m, c.m.off or {}
    assert {*off, *m.shape, *m.null_values, *m.of_port} <= {s.name for s in m.parameters}
    assert not set(off) & {*m.shape, *m.null_values}
    scanned = [(name, value) for name, values in m.scan.items() for value in values]
    assert len(set(scanned)) == len(scanned)
    scanned += [pair for point in m.scan_points for pair in point.items()]
    for name, value in (*off.items(), *m.null_values.items(), *scanned):
        assert m.spec(name).low <= value <= m.spec(name).high, (name, value)
    assert all(value != m.spec(name).value for name, value in scanned)


def test_ports_and_equipment_are_known(c: Given) -> None:
    m, roles = c.m, set(c.m.port_roles.values())
    assert not m.needs or m.needs in EQUIPMENT
    assert {port for port, _ in m.of_port.values()} <= m.optional_ports <= set(m.ports) <= set(m.port_roles)
    assert roles <= set(get_args(PortRole)) and m.fault == ("sensor" in m.acts_at)
    assert "itself" not in roles or "node" in m.acts_at
    assert "outlet" not in roles or m.acts_at == ("heat",)
    if m.port_roles:
        others, known = iter(BODIES[1:]), {"itself": "first", "surrounding": "room"}
        at = {port: known[role] if role in known else next(others) for port, role in m.port_roles.items()}
        network = network_with(m, at=at)
        assert at_work(network) or len(network.parameters) > len(compile_network(c.without).parameters)


def test_switched_off_it_does_nothing(c: Given) -> None:
    if c.m.off is not None and not c.structural:
        assert does_nothing(c.off) and not does_nothing(c.point)
        for name in c.m.off:  # each is needed
            assert not does_nothing(c.off.at(**{name: c.point.values[name]})), name


def test_switched_off_every_amplitude_has_a_slope(c: Given) -> None:
    """Screening takes the derivative at `off`; without one the candidate is never seen."""
    for name in (c.m.off or {}) if c.laws else ():
        slopes = [np.imag(c.off.at(**{name: c.off.values[name] + 1e-30j}).effect(e)) / 1e-30 for e in c.laws]
        assert all(np.isfinite(s).all() for s in slopes), name
        assert c.m.proposable == any(s.any() for s in slopes) or c.case.undriven, name


def test_shape_changes_more_than_the_size(c: Given) -> None:
    """`shape` costs a search; a parameter that only rescales is an amplitude."""
    rising = np.linspace(0.4, 1.0, len(TIME_S))
    for name in c.m.shape if c.laws else ():
        point = c.point.seeing(driver={role: d * rising for role, d in c.point.view.driver.items()})
        other = point.at(**{name: 0.75 * point.values[name] + 0.01})
        assert not all(np.allclose(form(c, point, e), form(c, other, e), rtol=1e-6, atol=1e-6) for e in c.laws), name


def form(c: Given, point: Point, effect: str) -> Any:
    """What an effect adds over time, in units of its own root mean square."""
    added = point.effect(effect) - c.off.effect(effect)
    return added / np.sqrt(np.mean(added**2))


def test_a_structural_one_switched_off_leaves_the_network_as_it_was(c: Given) -> None:
    if c.structural and c.m.off is not None:
        before, after = compile_network(c.without), network_with(c.m, c.named(c.m.off))
        n = before.n_cells
        if "conductance" in c.m.off:
            G = after.conductance_W_per_K(after.values)[:n, :n]
            assert_array_equal(G, before.conductance_W_per_K(before.values))
        for one, other in zip(before.errors, after.errors, strict=True):
            assert_array_equal(other.matrix(after.values)[:n], one.matrix(before.values))
            assert (other.matrix(after.values)[n:] == 0).all()


def test_at_null_values_it_hardly_loads_its_neighbours_and_is_as_late(c: Given) -> None:
    if c.structural and c.m.null_values:
        before, usual = compile_network(c.without), network_with(c.m)
        null = network_with(c.m, c.named(c.m.null_values))
        n = before.n_cells
        G = null.conductance_W_per_K(null.values)[:n, :n]
        assert_allclose(G, before.conductance_W_per_K(before.values), rtol=1e-3, atol=1e-12)
        late, wanted = (w.conductance_W_per_K(w.values)[n, n] / w.capacity_J_per_K(w.values)[n] for w in (null, usual))
        assert late == pytest.approx(wanted, rel=1e-6)


# In a simulation


def inputs_of(network: Network, machine: Machine) -> Inputs:
    """Two batches: drivers half of the time on, a room that warms by a kelvin, bodies that start a little apart."""
    time_s = np.tile(STEP_S * np.arange(N_INTERVALS + 1), (2, 1))
    on = np.where(np.arange(N_INTERVALS) < N_INTERVALS // 2, 1.0, 0.0) * np.array([[1.0], [0.5]])
    return Inputs(
        batch_ids=("a", "b"),
        time_s=time_s,
        n_intervals=np.full(2, N_INTERVALS),
        drivers={n: on * DRIVER[machine.channels[n].unit] for n in network.drivers},
        recorded={"room": 20.0 + time_s / time_s.max() + np.array([[0.0], [5.0]])},
        clock_h=np.array([8.0, 11.0]),
        first={b: np.array([20.0, 25.0]) + k for k, b in enumerate((*BODIES, "room"))},
    )


def simulated(machine: Machine) -> Simulation:
    network = compile_network(machine)
    return simulate(network, network.values, inputs_of(network, machine), keep_cells=True)


def test_it_runs_and_changes_what_is_seen(c: Given) -> None:
    out, bare = simulated(c.machine), simulated(c.without)
    assert np.isfinite(out.readings).all() and np.isfinite(out.errors).all()
    moved_K, moved_um = np.abs(out.readings - bare.readings).max(), np.abs(out.errors - bare.errors).max()
    if "error" in c.m.acts_at and "reading" not in c.m.effects():
        assert moved_um > 0.05 and (moved_K < 1e-9 or c.structural)
    else:
        assert moved_K > 0.005


def test_a_closed_network_keeps_its_energy(c: Given) -> None:
    machine = (c.without if c.case.open else c.machine).model_copy(deep=True)
    assert machine.twin is not None
    machine.twin["exposures"] = dict.fromkeys(machine.twin["exposures"], "1e-9 W/K")
    out = simulated(machine)
    assert out.cells_degC is not None
    capacity = out.network.capacity_J_per_K(out.network.values)
    stored_J = ((out.cells_degC - out.cells_degC[:, :, :1]) * capacity).sum(axis=-1)
    exchanged = "tried" if c.m.takes_from else ""
    supplied_J: Any = sum(J for name, J in out.heat_J.items() if name != exchanged)
    # heat that follows a temperature is stated as if it were linear within an interval
    rtol = 1e-3 if c.m.ports and not exchanged else 1e-9
    assert_allclose(stored_J, supplied_J + 0.0 * stored_J, rtol=rtol, atol=0.05)


def test_parameter_sets_simulated_together_are_those_apart(c: Given) -> None:
    network = compile_network(c.machine)
    inputs = inputs_of(network, c.machine)
    sets = network.values * np.array([[1.0], [0.97], [0.9]])
    together = simulate(network, sets, inputs)
    for p, values in enumerate(sets):
        alone = simulate(network, values, inputs)
        assert_allclose(together.readings[p], alone.readings[0], atol=2e-3, rtol=1e-6)
        assert_allclose(together.errors[p], alone.errors[0], atol=2e-2, rtol=1e-6)


def test_a_linear_reading_is_linear(c: Given) -> None:
    """Its derivative is then taken as the law itself, without complex numbers."""
    m, rng = c.m, np.random.default_rng(0)
    if not m.linear_reading:
        return
    seen, d_seen = rng.normal(20, 5, (2, 3, 40))
    ports, d_ports = ({role: rng.normal(20, 5, (3, 40)) for role in m.ports} for _ in range(2))
    p = {s.name: np.full((1, 1), s.value + 0.5 * (s.value == 0)) for s in m.parameters if s.value is not None}
    time_s = np.tile(10.0 * np.arange(40), (3, 1))
    for step_s in (10.0, np.nan):

        def shown(seen: Any, ports: Any, step_s: float = step_s) -> Any:
            view = replace(c.point.view, time_s=time_s, step_s=step_s, driver={}, degC=ports, rise_K=ports)
            return m.reading(seen, view, p)

        moved = {r: t + 1e-30j * d_ports[r] for r, t in ports.items()}
        ahead = shown(seen + 1e-30j * d_seen, moved).imag / 1e-30
        nothing = shown(np.zeros((3, 40)), dict.fromkeys(ports, np.zeros((3, 40))))
        assert_allclose(shown(d_seen, d_ports) - nothing, ahead, rtol=1e-12, atol=1e-12)
