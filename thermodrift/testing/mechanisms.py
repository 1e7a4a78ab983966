"""The contract of a mechanism: texts, units, signs, derivatives, and how it runs in a small machine."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, get_args

import numpy as np
import pint

from data.machine import Machine
from thermodrift.testing.contract import Suite, expect, expect_close
from thermodrift.testing.points import DRIVER, TIME_S, Case, Point, U, units_of
from thermodrift.testing.small_machine import BODIES, machine_with, network_with
from twin.compile import compile_network
from twin.mechanisms.base import EQUIPMENT, Mechanism, PortRole
from twin.network import Network
from twin.quantity import Parameter, convert, parameter, same_dimension
from twin.simulation import Simulation, simulate
from twin.simulation.inputs import Inputs

UNITS = {"heat_W": "W", "factor": "", "displacement": "um", "reading": "K", "surrounding_K": "K", "start_K": "K"}
NOTHING = {"heat_W": 0.0, "factor": 1.0, "displacement": 0.0, "surrounding_K": 0.0, "start_K": 0.0}
TARGETS = {
    "heat_W": {"node"}, "factor": {"link", "exposure", "heat"}, "displacement": {"error"},
    "reading": {"sensor", "error"}, "surrounding_K": {"surrounding"}, "start_K": {"start"},
}  # fmt: skip
N_INTERVALS, STEP_S = 120, 60.0


@dataclass(frozen=True)
class MechanismCase:
    """A mechanism with what a suite needs to know of it."""

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
        return machine_with(self.m, {s.name: f"{float(values[s.name])} {s.unit}" for s in self.m.parameters})

    def named(self, **values: float) -> dict[str, str]:
        return {name: f"{value} {self.m.spec(name).unit}" for name, value in values.items()}


SUITE: Suite[MechanismCase] = Suite()


@SUITE.check("machine files, findings and the generated reference show these")
def says_what_it_is(c: MechanismCase) -> None:
    m = c.m
    expect(m.__doc__, "a docstring", m.__doc__)
    for name, low, high in (("summary", 8, 70), ("equation", 3, 130), ("source", 20, 140), ("signature", 20, 140)):
        text = getattr(m, name)
        expect(low <= len(text) <= high, f"a {name} of {low} to {high} characters", f"{len(text)}: {text!r}")
    expect("=" in m.equation, "an equation", m.equation)
    expect(m.acts_at and m.effects(), "a target and an effect", (m.acts_at, m.effects()))
    expect(type(m).__name__.lower() == m.key.replace("_", ""), f"a class named as the key {m.key}", type(m).__name__)


@SUITE.check("a diagnosis places it where it says that it acts")
def acts_where_it_says(c: MechanismCase) -> None:
    for effect in c.laws:
        expect(TARGETS[effect] & set(c.m.acts_at), f"acts_at one of {TARGETS[effect]} for {effect}", c.m.acts_at)


@SUITE.check("a machine file need not state values, and a fit starts there, inside the bounds")
def parameters_have_unit_meaning_value_and_prior(c: MechanismCase) -> None:
    m = c.m
    names = len(set(units_of(m)))
    expect(names == len(m.parameters) + len(m.drivers), "another name for each driver and parameter", units_of(m))
    for s in m.parameters:
        same_dimension(s.unit, s.unit)  # raises for a unit that is none
        expect(len(s.words) >= 5, f"a meaning of {s.name}", s.words)
        expect(s.value is not None and s.spread is not None and s.spread > 0, f"a value and prior of {s.name}", s)
        expect(math.isfinite(s.low) and math.isfinite(s.high) and s.low < s.high, f"finite bounds of {s.name}", s)
        assert s.value is not None
        expect(s.low <= s.value <= s.high, f"the usual {s.name} within {s.low} to {s.high}", s.value)
        expect(s.scale == "linear" or (s.low >= 0 and s.value > 0), f"a positive {s.name} on scale {s.scale}", s)
        expect(s.scale != "logit" or s.high <= 1, f"a share of at most 1 for {s.name}", s.high)
        expect(math.isfinite(parameter("p", s, None).to_x(s.value)), f"a finite start of {s.name} on its scale", s)
    for unit in m.drivers.values():
        same_dimension(unit, unit)


def _agrees(c: MechanismCase, units: dict[str, str], effect: str) -> bool:
    """Whether the law on bare numbers is the case's equation with these units."""
    formula = c.case.more.get(effect, c.case.formula)
    assert formula is not None
    unit = c.case.unit if effect == "displacement" else UNITS[effect]
    try:
        with np.errstate(all="ignore"):
            wanted = U.Quantity(formula(c.point.quantities(units))).to(unit).magnitude
    except (pint.PintError, ValueError):  # another dimension
        return False
    got = c.point.effect(effect) + (273.15 if effect == "reading" else 0.0)
    return bool(np.allclose(got, wanted, rtol=1e-9, atol=1e-9 if effect == "reading" else 0.0))


@SUITE.check("a Spec in W/K with a law in W/m²K is wrong by a factor that no fit shows")
def units_agree_with_the_equation(c: MechanismCase) -> None:
    units = units_of(c.m)
    for effect in c.laws if c.case.formula else ():
        expect(_agrees(c, units, effect), f"{effect} equal to the equation with units {units}", "another value")


@SUITE.check("an equation that hides a unit lets a wrong Spec pass")
def equation_finds_every_wrong_unit(c: MechanismCase) -> None:
    units = units_of(c.m)
    for name, unit in units.items() if c.case.formula and c.laws else ():
        for wrong in _wrong_units(unit):
            found = [not _agrees(c, {**units, name: wrong}, effect) for effect in c.laws]
            expect(any(found), f"the equation to differ with {name} in {wrong} instead of {unit}", "the same value")


def _wrong_units(unit: str) -> Iterator[str]:
    """Of another size, and of another dimension."""
    yield {"degC": "K", "1": "percent"}.get(unit, f"1000 * {unit}")
    yield {"degC": "m"}.get(unit, f"{unit} * m")


@SUITE.check("a stopped spindle must not heat")
def without_its_driver_it_does_nothing(c: MechanismCase) -> None:
    for effect in {"heat_W", "factor"} & set(c.laws) if c.m.drivers and not c.case.undriven else ():
        got = c.point.at_rest().effect(effect)
        expect((got == NOTHING[effect]).all(), f"{effect} {NOTHING[effect]} with every driver at 0", got[0])


@SUITE.check("heat flows from warm to cold: an exchange of another sign makes energy")
def exchange_turns_with_the_temperature_difference(c: MechanismCase) -> None:
    m = c.m
    if m.takes_from is None:
        needed = set(m.ports) - m.optional_ports
        expect("heat_W" not in m.effects() or len(needed) < 2, "takes_from: the port that the heat leaves", needed)
        return
    hot, cold = np.full(TIME_S.shape, 41.0), np.full(TIME_S.shape, 17.0)
    gives = m.takes_from
    (takes,) = set(m.ports) - {gives}
    warm = c.point.seeing(degC={takes: cold, gives: hot}).effect("heat_W")
    expect((warm > 0).all(), f"heat above 0 while {gives} is warmer than {takes}", warm.min())
    turned = c.point.seeing(degC={takes: hot, gives: cold}).effect("heat_W")
    expect_close(turned, -warm, "the opposite heat at exchanged temperatures", rtol=1e-6)
    expect((c.point.seeing(degC={takes: hot, gives: hot}).effect("heat_W") == 0.0).all(), "0 W at equal ones", "heat")


@SUITE.check("energy is neither made nor lost between two places")
def watts_leave_one_place_for_another_or_are_new(c: MechanismCase) -> None:
    network = network_with(c.m)
    for heat in network.heats:
        if heat.law.name == "tried":
            total, wanted = heat.direction(network.values[None]).sum(), 0.0 if c.m.takes_from else 1.0
            expect(abs(total - wanted) <= 1e-15, f"shares of the heat that sum to {wanted:g}", total)


@SUITE.check("a fit walks through the whole prior; one NaN or negative conductance ends it")
def finite_and_of_its_sign_over_the_whole_prior(c: MechanismCase) -> None:
    rng = np.random.default_rng(0)
    for _ in range(50 if c.laws else 0):
        values = {s.name: _draw(parameter("p", s, None), float(s.spread or 0.0), rng) for s in c.m.parameters}
        drawn = c.point.at(**values)
        for effect in c.laws:
            got = drawn.effect(effect)
            expect(np.isfinite(got).all(), f"a finite {effect}", f"{got} at {values}")
            signed = effect == "factor" or (effect == "heat_W" and not c.case.either_way and c.m.takes_from is None)
            expect(not signed or (got >= 0).all(), f"{effect} of at least 0", f"{got.min()} at {values}")


def _draw(p: Parameter, spread: float, rng: np.random.Generator) -> float:
    value = p.from_x(p.to_x(p.value) + spread * rng.standard_normal())
    return float(np.clip(value, p.low, p.high))


@SUITE.check("a calibration follows the derivative by complex steps: `abs`, `max` or a comparison of complex breaks it")
def derivatives_are_those_of_differences(c: MechanismCase) -> None:
    for effect, (name, moved) in itertools.product(c.laws, _movable(c.point).items()):
        if name in c.case.stepped:
            continue
        exact = np.imag(moved(1e-30j).effect(effect)) / 1e-30
        size = float(c.point.values[name]) if name in c.point.values else 10.0
        step = 1e-5 * max(1e-3, abs(size))
        about = (moved(step).effect(effect) - moved(-step).effect(effect)) / (2 * step)
        scale = max(np.abs(about).max(), 1e-6 * np.abs(c.point.effect(effect)).max() / step * 1e-5)
        atol, rtol = 1e-5 * scale + 1e-30, 1e-6
        what = f"d {effect} / d {name} by the complex step and by differences"
        expect_close(exact, about, what, atol=atol, rtol=rtol)


def _movable(point: Point) -> dict[str, Callable[[complex], Point]]:
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


@SUITE.check("a simulation evaluates many parameter sets at once, as the first axis")
def parameter_sets_broadcast_against_time(c: MechanismCase) -> None:
    factors = np.array([1.0, 0.9, 0.8])[:, None]
    for effect in c.laws:
        together = c.point.at(**{n: v * factors for n, v in c.point.values.items()}).effect(effect)
        apart = [c.point.at(**{n: v * f for n, v in c.point.values.items()}).effect(effect) for f in factors[:, 0]]
        got = np.broadcast_to(together, (3, len(TIME_S)))
        expect_close(got, np.array(apart), f"{effect} of three parameter sets together and apart", rtol=1e-12)


@SUITE.check("a machine file that names it and nothing else must work, every parameter under its prior")
def compiles_into_a_machine_file_with_its_priors(c: MechanismCase) -> None:
    if c.structural:
        return
    network = network_with(c.m)
    expect(_at_work(network), "a place in the network", "none")
    for s in c.m.parameters:
        p = network.parameters[network.index(f"mechanisms.tried.{s.name}")]
        got, wanted = (p.value, p.spread, p.free, p.unit), (s.value, s.spread, True, s.unit)
        expect(got == wanted, f"{s.name} with value, spread, free and unit {wanted}", got)


def _at_work(network: Network) -> bool:
    """Whether the law called "tried" has a place in the network."""
    used = [*network.factors, *(law for law, _ in network.starts)]
    used += [law for h in network.heats for law in (h.law, *h.factors)]
    for group in (network.surroundings, network.readings, network.errors):
        used += [law for g in group for law in g.effects]
    used += [law for e in network.errors for law in e.readings]
    return any(law.name == "tried" for law in used)


@SUITE.check("a machine file may leave the driver out; the law must say what then holds")
def optional_drivers_may_be_left_out(c: MechanismCase) -> None:
    m, optional = c.m, c.m.optional_drivers
    expect(optional <= set(m.drivers) and m.any_unit <= set(m.drivers), f"names of {set(m.drivers)}", optional)
    if optional and not c.structural:
        rest = {role: f"{role}_driver" for role in m.drivers if role not in optional}
        expect(_at_work(network_with(m, drivers=rest)), f"a place in the network without {set(optional)}", "none")
        held = {role: np.full(TIME_S.shape, 0.0 if c.case.undriven else 1.0) for role in optional}
        for effect in m.effects():
            driven = c.point.seeing(driver={**c.point.view.driver, **held}).effect(effect)
            bare = c.point.seeing(driver={r: c.point.view.driver[r] for r in rest}).effect(effect)
            expect_close(bare, driven, f"{effect} without {set(optional)} as with it held at its neutral value")


@SUITE.check("what is written into the twin part is what the parameters say")
def structural_values_arrive_with_their_units(c: MechanismCase) -> None:
    if not c.structural:
        return
    m = c.m
    before, after = compile_network(c.without), network_with(m)
    expect("tried" not in [law.law.name for law in after.heats], "nothing left of the instance", "a law")
    known = {p.name for p in before.parameters}
    new = [(p.value, p.unit) for p in after.parameters if p.name not in known]
    for s in m.parameters:
        there = (same_dimension(u, s.unit) and value == convert(f"{s.value} {s.unit}", u) for value, u in new)
        expect(any(there), f"{s.value} {s.unit} of {s.name} among the new parameters", new)
    usual = network_with(m, {s.name: {"free": False, "value": f"{s.value} {s.unit}"} for s in m.parameters})
    expect_close(network_with(m, {}).values, usual.values, "the usual values where none is given", rtol=1e-6)


# ----- what a diagnosis needs


def _does_nothing(point: Point) -> bool:
    for effect in point.mechanism.effects():
        nothing = point.seen if effect == "reading" else NOTHING[effect]
        if not np.allclose(point.effect(effect), nothing, rtol=1e-12, atol=0.0):
            return False
    return True


@SUITE.check("a diagnosis sets these parameters to these values")
def what_it_names_is_a_parameter_within_its_bounds(c: MechanismCase) -> None:
    m, off = c.m, c.m.off or {}
    names = {s.name for s in m.parameters}
    expect({*off, *m.shape, *m.ghost, *m.of_port} <= names, f"names of {names}", {*off, *m.shape, *m.ghost, *m.of_port})
    expect(not set(off) & {*m.shape, *m.ghost}, "no parameter in `off` and in `shape` or `ghost`", off)
    points = [{name: value} for name, values in m.scan.items() for value in values]
    expect(len({tuple(p.items()) for p in points}) == len(points), "each point of `scan` once", m.scan)
    for name, value in [*off.items(), *m.ghost.items()]:
        expect(m.spec(name).low <= value <= m.spec(name).high, f"{name} within its bounds", value)
    for name, value in (pair for point in [*points, *m.scan_points] for pair in point.items()):
        within = m.spec(name).low <= value <= m.spec(name).high and value != m.spec(name).value
        expect(within, f"a value of {name} within its bounds and not the usual one in `scan`", value)


@SUITE.check("candidates are placed by ports and weighed by equipment")
def ports_and_equipment_are_known(c: MechanismCase) -> None:
    m = c.m
    expect(not m.needs or m.needs in EQUIPMENT, f"`needs` of {sorted(EQUIPMENT)}", m.needs)
    expect(m.optional_ports <= set(m.ports), f"optional_ports of {m.ports}", m.optional_ports)
    expect({port for port, _ in m.of_port.values()} <= m.optional_ports, "of_port of optional ports", m.of_port)
    expect(m.fault == ("sensor" in m.acts_at), "`fault` where it acts at a sensor, and only there", m.fault)
    expect(set(m.ports) <= set(m.port_roles), f"a role of each port {m.ports}", m.port_roles)
    expect(set(m.port_roles.values()) <= set(get_args(PortRole)), f"roles of {get_args(PortRole)}", m.port_roles)
    expect("itself" not in m.port_roles.values() or "node" in m.acts_at, "`itself` at a node only", m.acts_at)
    expect("outlet" not in m.port_roles.values() or m.acts_at == ("heat",), "`outlet` at a heat only", m.acts_at)
    if m.port_roles:
        others = iter(BODIES[1:])
        known = {"itself": "first", "surrounding": "room"}
        at = {port: known[role] if role in known else next(others) for port, role in m.port_roles.items()}
        network = network_with(m, at=at)
        more = len(network.parameters) > len(compile_network(c.without).parameters)
        expect(_at_work(network) or more, f"a place in the network at {at}", "none")


@SUITE.check("a diagnosis compares with and without it")
def switched_off_it_does_nothing(c: MechanismCase) -> None:
    m = c.m
    if m.off is None or c.structural:
        return
    expect(_does_nothing(c.off), f"no effect at {dict(m.off)}", "one")
    expect(not _does_nothing(c.point), "an effect at the usual values", "none")
    for name in m.off:
        alone = c.off.at(**{name: c.point.values[name]})
        expect(not _does_nothing(alone), f"an effect with {name} alone switched on, or no {name} in `off`", "none")


@SUITE.check("screening takes the derivative at `off`; without one the candidate is never seen")
def switched_off_every_amplitude_has_a_slope(c: MechanismCase) -> None:
    for name in (c.m.off or {}) if c.laws else ():
        slopes = [np.imag(c.off.at(**{name: c.off.values[name] + 1e-30j}).effect(e)) / 1e-30 for e in c.laws]
        expect(all(np.isfinite(s).all() for s in slopes), f"a finite slope by {name} at `off`", slopes)
        seen = c.m.proposable == any(s.any() for s in slopes) or c.case.undriven
        expect(seen, f"a slope by {name} at `off` of a proposable mechanism, and none of another", slopes)


@SUITE.check("`shape` costs a search; a parameter that only rescales is an amplitude")
def shape_changes_more_than_the_size(c: MechanismCase) -> None:
    if c.structural:
        return
    rising = np.linspace(0.4, 1.0, len(TIME_S))
    point = c.point.seeing(driver={role: d * rising for role, d in c.point.view.driver.items()})
    for name in c.m.shape:
        other = point.at(**{name: 0.75 * point.values[name] + 0.01})
        changed = any(not np.allclose(_form(c, point, e), _form(c, other, e), rtol=1e-6, atol=1e-6) for e in c.laws)
        expect(changed, f"another form over time with another {name}", "the same form")


def _form(c: MechanismCase, point: Point, effect: str) -> Any:
    """What an effect adds over time, in units of its own root mean square."""
    added = point.effect(effect) - c.off.effect(effect)
    return added / np.sqrt(np.mean(added**2))


@SUITE.check("a candidate that changes the network while it is off makes every comparison wrong")
def structural_one_switched_off_leaves_the_network_as_it_was(c: MechanismCase) -> None:
    m = c.m
    if not c.structural or m.off is None:
        return
    before, after = compile_network(c.without), network_with(m, c.named(**m.off))
    n = before.n_cells
    if "conductance" in m.off:
        G, known = after.conductance_W_per_K(after.values)[:n, :n], before.conductance_W_per_K(before.values)
        expect_close(G, known, "conductances as without it")
    for one, other in zip(before.errors, after.errors, strict=True):
        expect_close(other.matrix(after.values)[:n], one.matrix(before.values), "error chains as without it")
        expect((other.matrix(after.values)[n:] == 0).all(), "no part of new bodies in an error", "one")


@SUITE.check("screening adds the body as a ghost: it must be as late and hardly load its neighbours")
def ghost_hardly_loads_its_neighbours(c: MechanismCase) -> None:
    m = c.m
    if not c.structural or not m.ghost:
        return
    before, usual, ghost = compile_network(c.without), network_with(m), network_with(m, c.named(**m.ghost))
    n = before.n_cells
    G = ghost.conductance_W_per_K(ghost.values)[:n, :n]
    expect_close(G, before.conductance_W_per_K(before.values), "conductances as without it", rtol=1e-3, atol=1e-12)
    rates = [w.conductance_W_per_K(w.values)[n, n] / w.capacity_J_per_K(w.values)[n] for w in (ghost, usual)]
    expect_close(rates[0], rates[1], "the time constant of the ghost and of the usual values", rtol=1e-6)


# ----- in a simulation


def _inputs(network: Network, machine: Machine) -> Inputs:
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


def _simulated(machine: Machine) -> Simulation:
    network = compile_network(machine)
    return simulate(network, network.values, _inputs(network, machine), keep_cells=True)


@SUITE.check("an effect that nothing recorded shows cannot be diagnosed")
def runs_and_changes_what_is_seen(c: MechanismCase) -> None:
    out, bare = _simulated(c.machine), _simulated(c.without)
    finite = np.isfinite(out.readings).all() and np.isfinite(out.errors).all()
    expect(finite, "finite readings and errors", "NaN or infinity")
    moved_K, moved_um = np.abs(out.readings - bare.readings).max(), np.abs(out.errors - bare.errors).max()
    if "error" in c.m.acts_at and "reading" not in c.m.effects():
        expect(moved_um > 0.05, "an error that moves by more than 0.05 µm", f"{moved_um:.3g} µm")
        expect(moved_K < 1e-9 or c.structural, "temperatures as without it", f"{moved_K:.3g} K")
    else:
        expect(moved_K > 0.005, "a reading that moves by more than 0.005 K", f"{moved_K:.3g} K")


@SUITE.check("energy that appears from nowhere fits any recording")
def a_closed_network_keeps_its_energy(c: MechanismCase) -> None:
    machine = (c.without if c.case.open else c.machine).model_copy(deep=True)
    assert machine.twin is not None
    for exposure in machine.twin["exposures"]:
        machine.twin["exposures"][exposure] = "1e-9 W/K"
    out = _simulated(machine)
    network = out.network
    assert out.cells_degC is not None
    stored_J = ((out.cells_degC - out.cells_degC[:, :, :1]) * network.capacity_J_per_K(network.values)).sum(axis=-1)
    exchanged = "tried" if c.m.takes_from else ""
    supplied_J: Any = sum(J for name, J in out.heat_J.items() if name != exchanged)
    # heat that follows a temperature is stated as if it were linear within an interval
    rtol = 1e-3 if c.m.ports and not exchanged else 1e-9
    expect_close(stored_J, supplied_J + 0.0 * stored_J, "stored and supplied energy in J", rtol=rtol, atol=0.05)


@SUITE.check("a calibration simulates many parameter sets at once")
def parameter_sets_together_are_those_apart(c: MechanismCase) -> None:
    network = compile_network(c.machine)
    inputs = _inputs(network, c.machine)
    sets = network.values * np.array([[1.0], [0.97], [0.9]])
    together = simulate(network, sets, inputs)
    for p, values in enumerate(sets):
        alone = simulate(network, values, inputs)
        expect_close(together.readings[p], alone.readings[0], "readings in K", atol=2e-3, rtol=1e-6)
        expect_close(together.errors[p], alone.errors[0], "errors in µm", atol=2e-2, rtol=1e-6)


@SUITE.check("the derivative of a linear law is the law itself, without complex numbers")
def a_linear_reading_is_linear(c: MechanismCase) -> None:
    m = c.m
    if not m.linear_reading:
        return
    rng = np.random.default_rng(0)
    seen, d_seen = rng.normal(20, 5, (2, 3, 40))
    ports, d_ports = ({role: rng.normal(20, 5, (3, 40)) for role in m.ports} for _ in range(2))
    p = {s.name: np.full((1, 1), s.value + 0.5 * (s.value == 0)) for s in m.parameters if s.value is not None}
    time_s = np.cumsum(np.full((3, 40), 10.0), axis=1) - 10.0
    for step_s in (10.0, np.nan):
        view = replace(c.point.view, time_s=time_s, step_s=step_s, driver={})

        def shown(seen: Any, ports: Any, view: Any = view) -> Any:
            return m.reading(seen, replace(view, degC=ports, rise_K=ports), p)

        moved = {r: t + 1e-30j * d_ports[r] for r, t in ports.items()}
        ahead = shown(seen + 1e-30j * d_seen, moved).imag / 1e-30
        nothing = shown(np.zeros((3, 40)), dict.fromkeys(ports, np.zeros((3, 40))))
        expect_close(shown(d_seen, d_ports) - nothing, ahead, "the law less its constant", rtol=1e-12, atol=1e-12)
