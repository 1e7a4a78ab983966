"""What every mechanism promises, run over the registry: a new one is tested by a line in `cases` and `signatures`."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pint
import pytest
from cases import CASES, U
from points import TIME_S, Point, units_of
from signatures import SIGNATURES
from small_machine import machine_with, network_with

from twin.compile import compile_network
from twin.mechanisms import MECHANISMS
from twin.mechanisms.base import Mechanism
from twin.network import Network
from twin.quantity import convert, parameter, same_dimension

UNITS = {"heat_W": "W", "factor": "", "displacement": "um", "reading": "K", "surrounding_K": "K", "start_K": "K"}
UNIT_OF = {"charge_strain": "um/m"}  # displacements in another unit than um
NOTHING = {"heat_W": 0.0, "factor": 1.0, "displacement": 0.0, "surrounding_K": 0.0, "start_K": 0.0}
TARGETS = {
    "heat_W": {"node"}, "factor": {"link", "exposure", "heat"}, "displacement": {"error"},
    "reading": {"sensor", "error"}, "surrounding_K": {"surrounding"}, "start_K": {"start"},
}  # fmt: skip
LAWS = [k for k in MECHANISMS if k not in CASES or CASES[k].formula]
STRUCTURAL = [k for k in MECHANISMS if k not in LAWS]
SIGNED_HEAT = {
    "jacket_chiller",
    "coolant_jacket",
    "ohmic_heat",
    "voltage_loss_heat",
    "free_flux",
}  # and exchanges: heat either way
FREE_FORM = {"free_flux", "free_shift"}  # without their driver they go on, by temperature alone
every = pytest.mark.parametrize("key", list(MECHANISMS))
laws = pytest.mark.parametrize("key", LAWS)
structural = pytest.mark.parametrize("key", STRUCTURAL)


def made(key: str) -> Mechanism:
    mechanism: Mechanism = MECHANISMS[key]()
    return mechanism


@every
def test_it_says_what_it_is(key):
    m = made(key)
    assert m.key == key
    assert m.__doc__ and 8 <= len(m.summary) <= 70
    assert "=" in m.equation and len(m.equation) <= 130
    assert 20 <= len(m.source) <= 140
    assert 20 <= len(m.signature) <= 140
    assert m.acts_at and m.effects()
    assert {type(m).__name__.lower()} == {key.replace("_", "")}


def test_no_two_read_alike():
    for said in ("summary", "signature"):
        texts = [getattr(made(key), said) for key in MECHANISMS]
        assert len(set(texts)) == len(texts)


@every
def test_it_acts_where_it_says(key):
    m = made(key)
    for effect in m.effects():
        assert effect == "expand" or TARGETS[effect] & set(m.acts_at), effect
    assert (m.effects() == ("expand",)) == (key in STRUCTURAL)


@every
def test_every_parameter_has_unit_meaning_usual_value_and_prior(key):
    m = made(key)
    assert len(set(units_of(m))) == len(m.parameters) + len(m.drivers), "a driver and a parameter share a name"
    for s in m.parameters:
        assert same_dimension(s.unit, s.unit), s.name
        assert len(s.words) >= 5 and s.value is not None and s.spread is not None and s.spread > 0, s.name
        assert s.low <= s.value <= s.high and s.low < s.high, s.name
        assert math.isfinite(s.low) and math.isfinite(s.high), s.name
        assert s.scale == "linear" or (s.low >= 0 and s.value > 0), s.name
        assert s.scale != "logit" or s.high <= 1, s.name
        assert math.isfinite(parameter("p", s, None).to_x(s.value)), s.name
    for unit in m.drivers.values():
        assert same_dimension(unit, unit)


def agrees(point: Point, units: dict[str, str], effect: str) -> bool:
    """Whether the law on bare numbers is its equation in `cases` with these units."""
    case = CASES[point.mechanism.key]
    formula = case.more.get(effect, case.formula)
    try:
        with np.errstate(all="ignore"):
            expected = (
                U.Quantity(formula(point.quantities(units)))
                .to(UNIT_OF.get(point.mechanism.key, UNITS[effect]))
                .magnitude
            )
    except (pint.PintError, ValueError):  # another dimension
        return False
    got = point.effect(effect) + (273.15 if effect == "reading" else 0.0)
    return bool(np.allclose(got, expected, rtol=1e-9, atol=1e-9 if effect == "reading" else 0.0))


@laws
def test_units_by_a_dimensional_check(key):
    point = Point.of(made(key))
    for effect in point.mechanism.effects():
        assert agrees(point, units_of(point.mechanism), effect), effect


@laws
def test_the_dimensional_check_finds_every_wrong_unit(key):
    point = Point.of(made(key))
    units = units_of(point.mechanism)
    for name, unit in units.items():
        for wrong in wrong_units(unit):
            found = [not agrees(point, {**units, name: wrong}, effect) for effect in point.mechanism.effects()]
            assert any(found), f"{name} in {wrong} instead of {unit} is not noticed"


def wrong_units(unit: str) -> Iterator[str]:
    """Of another size, and of another dimension."""
    yield {"degC": "K", "1": "percent"}.get(unit, f"1000 * {unit}")
    yield {"degC": "m"}.get(unit, f"{unit} * m")


@laws
def test_without_its_driver_it_does_nothing(key):
    m = made(key)
    for effect in {"heat_W", "factor"} & set(m.effects()) if m.drivers and key not in FREE_FORM else ():
        assert (Point.of(m).at_rest().effect(effect) == NOTHING[effect]).all()


@laws
def test_an_exchange_stops_at_equal_temperatures_and_turns_with_their_difference(key):
    m = made(key)
    if m.takes_from is None:
        needed = set(m.ports) - m.optional_ports
        assert "heat_W" not in m.effects() or len(needed) < 2, "an exchange says which port the heat leaves"
        return
    point, hot, cold = Point.of(m), np.full(TIME_S.shape, 41.0), np.full(TIME_S.shape, 17.0)
    gives = m.takes_from
    (takes,) = set(m.ports) - {gives}
    warm = point.seeing(degC={takes: cold, gives: hot}).effect("heat_W")
    assert (warm > 0).all()
    assert point.seeing(degC={takes: hot, gives: cold}).effect("heat_W") == pytest.approx(-warm)
    assert (point.seeing(degC={takes: hot, gives: hot}).effect("heat_W") == 0.0).all()


@every
def test_watts_that_enter_the_network_leave_another_place_or_are_new(key):
    m = made(key)
    for heat in network_with(m).heats:
        if heat.law.name == "tried":
            closed = m.takes_from is not None
            total = heat.direction(network_with(m).values[None]).sum()
            assert total == pytest.approx(0.0 if closed else 1.0, abs=1e-15)


@laws
def test_signs_hold_over_the_whole_prior(key):
    rng, m = np.random.default_rng(0), made(key)
    point = Point.of(m)
    for _ in range(50):
        drawn = point.told(**{s.name: draw(parameter("p", s, None), s.spread, rng) for s in m.parameters})
        for effect in m.effects():
            assert np.isfinite(drawn.effect(effect)).all(), effect
        if "factor" in m.effects():
            assert (drawn.effect("factor") >= 0).all()
        if "heat_W" in m.effects() and key not in SIGNED_HEAT and m.takes_from is None:
            assert (drawn.effect("heat_W") >= 0).all()


def draw(p, spread: float, rng: np.random.Generator) -> float:
    value = p.from_x(p.to_x(p.value) + spread * rng.standard_normal())
    return float(np.clip(value, p.low, p.high))


@laws
def test_derivatives_by_complex_step_are_those_of_differences(key):
    point = Point.of(made(key))
    for effect, (name, moved) in itertools.product(point.mechanism.effects(), movable(point).items()):
        if key == "sensor_quantised" and name in ("seen", "step"):
            continue  # by design those of its mean, see test_sensors
        exact = np.imag(moved(1e-30j).effect(effect)) / 1e-30
        step = 1e-5 * max(1e-3, abs(size(point, name)))
        about = (moved(step).effect(effect) - moved(-step).effect(effect)) / (2 * step)
        scale = max(np.abs(about).max(), 1e-6 * np.abs(point.effect(effect)).max() / step * 1e-5)
        assert exact == pytest.approx(about, abs=1e-5 * scale + 1e-30), f"{effect} by {name}"


def movable(point: Point) -> dict[str, Callable[[complex], Point]]:
    """By name: the same point with a parameter, a port's temperature or rise, or what a sensor sees moved by a step."""
    out = {n: lambda h, n=n: point.told(**{n: point.values[n] + h}) for n in point.values}
    for kind, port in itertools.product(("degC", "rise_K"), point.mechanism.ports):
        old = getattr(point.view, kind)
        out[f"{kind} {port}"] = lambda h, k=kind, o=old, p=port: point.seeing(**{k: {**o, p: o[p] + h}})
    return out | {"seen": lambda h: replace(point, seen=point.seen + h)}


def size(point: Point, name: str) -> float:
    return float(point.values[name]) if name in point.values else 10.0


@laws
def test_parameter_sets_broadcast_against_time(key):
    point = Point.of(made(key))
    factors = np.array([1.0, 0.9, 0.8])[:, None]
    for effect in point.mechanism.effects():
        together = point.told(**{n: v * factors for n, v in point.values.items()}).effect(effect)
        apart = [point.told(**{n: v * f for n, v in point.values.items()}).effect(effect) for f in factors[:, 0]]
        assert np.broadcast_to(together, (3, len(TIME_S))) == pytest.approx(np.array(apart), rel=1e-12, abs=1e-300)


@laws
def test_it_compiles_into_a_machine_file_with_its_priors(key):
    m = made(key)
    network = network_with(m)
    assert at_work(network), "compiled, but at work nowhere"
    for s in m.parameters:
        p = network.parameters[network.index(f"mechanisms.tried.{s.name}")]
        assert (p.value, p.spread, p.free, p.unit) == (s.value, s.spread, True, s.unit)


def at_work(network: Network) -> bool:
    """Whether the law called "tried" has a place in the network."""
    used = [*network.factors, *(law for law, _ in network.starts)]
    used += [law for h in network.heats for law in (h.law, *h.factors)]
    used += [
        law for group in (network.surroundings, network.readings, network.errors) for g in group for law in g.effects
    ]
    used += [law for e in network.errors for law in e.readings]
    return any(law.name == "tried" for law in used)


@laws
def test_drivers_that_may_be_left_out(key):
    m = made(key)
    optional = m.optional_drivers
    assert optional <= set(m.drivers)
    if optional:
        rest = {role: f"{role}_driver" for role in m.drivers if role not in optional}
        assert at_work(network_with(m, drivers=rest))
        counts_as = 0.0 if key in FREE_FORM else 1.0
        point, held = Point.of(m), {role: np.full(TIME_S.shape, counts_as) for role in optional}
        for effect in m.effects():
            driven = point.seeing(driver={**point.view.driver, **held}).effect(effect)
            assert (point.seeing(driver={r: point.view.driver[r] for r in rest}).effect(effect) == driven).all()


@structural
def test_a_structural_one_is_written_out_with_its_values_and_units(key):
    m, bare = made(key), machine_with(made(key))
    bare.twin["mechanisms"].pop("tried")
    before, after = compile_network(bare), network_with(m)
    assert "tried" not in [law.law.name for law in after.heats]
    known = {p.name for p in before.parameters}
    new = [(p.value, p.unit) for p in after.parameters if p.name not in known]
    for s in m.parameters:
        assert any(
            same_dimension(unit, s.unit) and value == convert(f"{s.value} {s.unit}", unit) for value, unit in new
        )
    usual = network_with(m, {s.name: {"free": False, "value": f"{s.value} {s.unit}"} for s in m.parameters})
    assert network_with(m, {}).values == pytest.approx(usual.values)


@every
def test_it_shows_as_its_signature_says(key):
    SIGNATURES[key](made(key))


def test_the_tables_name_what_is_registered_and_nothing_else():
    assert set(CASES) == set(SIGNATURES) == set(MECHANISMS)
