"""What every mechanism tells a diagnosis, run over the registry: what switches it off, its form, where ports look."""

from __future__ import annotations

from typing import Any, get_args

import numpy as np
import pytest
from points import TIME_S, Point
from small_machine import machine_with, network_with
from test_mechanisms import FREE_FORM, NOTHING, at_work, every, laws, made, structural

from twin.compile import compile_network
from twin.mechanisms import MECHANISMS
from twin.mechanisms.base import EQUIPMENT, Mechanism, PortRole

NEVER_OFF = {"enclosure_air", "voltage_loss_heat", "sensor_swap", "sensor_stuck"}


def switched_off(m: Mechanism) -> Point:
    return Point.of(m).told(**(m.off or {}))


def does_nothing(point: Point) -> bool:
    for effect in point.mechanism.effects():
        nothing = point.seen if effect == "reading" else NOTHING[effect]
        if point.effect(effect) != pytest.approx(nothing, rel=1e-12, abs=0.0):
            return False
    return True


@every
def test_what_is_named_is_a_parameter_within_its_bounds(key: str) -> None:
    m = made(key)
    off = m.off or {}
    assert {*off, *m.shape, *m.ghost} <= {s.name for s in m.parameters}
    assert not set(off) & set(m.shape) and not set(off) & set(m.ghost)
    for name, value in [*off.items(), *m.ghost.items()]:
        assert m.spec(name).low <= value <= m.spec(name).high, name


@every
def test_what_it_needs_and_where_it_is_looked_for_is_known(key: str) -> None:
    m = made(key)
    assert not m.needs or m.needs in EQUIPMENT
    assert m.optional_ports <= set(m.ports) and {port for port, _ in m.of_port.values()} <= m.optional_ports
    points = [{name: value} for name, values in m.scan.items() for value in values]
    for point in [*points, *m.scan_points]:
        for name, value in point.items():
            assert m.spec(name).low <= value <= m.spec(name).high and value != m.spec(name).value, (name, value)
    assert len({tuple(p.items()) for p in points}) == len(points)
    assert set(m.of_port) <= {s.name for s in m.parameters}


def test_only_these_cannot_be_switched_off() -> None:
    assert {key for key in MECHANISMS if made(key).off is None} == NEVER_OFF


@laws
def test_switched_off_it_does_nothing(key: str) -> None:
    m = made(key)
    if m.off is not None:
        assert does_nothing(switched_off(m)) and not does_nothing(Point.of(m))


@laws
def test_everything_that_switches_it_off_is_needed_for_that(key: str) -> None:
    m = made(key)
    for name in m.off or {}:
        assert not does_nothing(switched_off(m).told(**{name: Point.of(m).values[name]})), name


@laws
def test_switched_off_every_amplitude_still_has_a_slope(key: str) -> None:
    m = made(key)
    off = switched_off(m)
    for name in m.off or {}:
        slopes = [np.imag(off.told(**{name: off.values[name] + 1e-30j}).effect(e)) / 1e-30 for e in m.effects()]
        assert all(np.isfinite(s).all() for s in slopes), name
        assert m.proposable == any(s.any() for s in slopes) or key in FREE_FORM, name


@laws
def test_shape_changes_more_than_the_size(key: str) -> None:
    m = made(key)
    point = Point.of(m)
    rising = np.linspace(0.4, 1.0, len(TIME_S))
    point = point.seeing(driver={role: d * rising for role, d in point.view.driver.items()})
    for name in m.shape:
        other = point.told(**{name: 0.75 * point.values[name] + 0.01})
        assert any(form(point, e) != pytest.approx(form(other, e), abs=1e-6) for e in m.effects()), name


def form(point: Point, effect: str) -> Any:
    """What an effect adds over time, in units of its own root mean square."""
    added = point.effect(effect) - switched_off(point.mechanism).effect(effect)
    return added / np.sqrt(np.mean(added**2))


@structural
def test_a_structural_one_switched_off_leaves_the_network_as_it_was(key: str) -> None:
    m, bare = made(key), machine_with(made(key))
    if m.off is None:
        return
    bare.twin["mechanisms"].pop("tried")
    before = compile_network(bare)
    after = network_with(m, {name: f"{v} {m.spec(name).unit}" for name, v in m.off.items()})
    n = before.n_cells
    if "conductance" in m.off:
        assert (after.conductance_W_per_K(after.values)[:n, :n] == before.conductance_W_per_K(before.values)).all()
    for one, other in zip(before.errors, after.errors, strict=True):
        assert (other.matrix(after.values)[:n] == one.matrix(before.values)).all()
        assert (other.matrix(after.values)[n:] == 0).all()


@structural
def test_a_ghost_hardly_loads_its_neighbours_and_is_as_late(key: str) -> None:
    m, bare = made(key), machine_with(made(key))
    if not m.ghost:
        return
    bare.twin["mechanisms"].pop("tried")
    before, usual = compile_network(bare), network_with(m)
    ghost = network_with(m, {name: f"{v} {m.spec(name).unit}" for name, v in m.ghost.items()})
    n = before.n_cells
    G, known = ghost.conductance_W_per_K(ghost.values), before.conductance_W_per_K(before.values)
    assert G[:n, :n] == pytest.approx(known, rel=1e-3)
    rate, usual_rate = (w.conductance_W_per_K(w.values)[n, n] / w.capacity_J_per_K(w.values)[n] for w in (ghost, usual))
    assert rate == pytest.approx(usual_rate)


@every
def test_a_fault_is_of_a_sensor(key: str) -> None:
    m = made(key)
    assert m.fault == ("sensor" in m.acts_at)


@every
def test_every_port_has_a_role_that_compiles(key: str) -> None:
    m = made(key)
    assert set(m.ports) <= set(m.port_roles) and set(m.port_roles.values()) <= set(get_args(PortRole))
    assert "itself" not in m.port_roles.values() or "node" in m.acts_at
    assert "outlet" not in m.port_roles.values() or m.acts_at == ("heat",)
    if m.port_roles:
        others = iter(("second", "third"))
        known = {"itself": "first", "surrounding": "room"}
        at = {port: known[role] if role in known else next(others) for port, role in m.port_roles.items()}
        network = network_with(m, at=at)
        assert at_work(network) or len(network.parameters) > len(compile_network(_without(m)).parameters)


def _without(m: Mechanism) -> Any:
    bare = machine_with(m)
    bare.twin["mechanisms"].pop("tried")
    return bare


def test_usual_roles_need_not_be_stated() -> None:
    class Drip(Mechanism):
        acts_at = ("node",)
        ports = ("body", "supply", "lid")
        port_roles = {"lid": "neighbour"}  # noqa: RUF012

    assert Drip.port_roles == {"body": "itself", "supply": "surrounding", "lid": "neighbour"}
