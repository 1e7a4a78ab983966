"""Which candidates a machine has: places, drivers, ports and names; a new mechanism needs no other file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import yaml

from data.arrays import Numeric
from data.machine import Machine, load_machine, parse_machine
from data.registry import Registry
from diagnosis.candidates.alternatives import alternatives, coarse_candidates
from diagnosis.candidates.library import candidates, linked
from diagnosis.contracts import Candidate, pieces_of
from diagnosis.search.search import search
from tests.diagnosis.small_cases import equipped, fitted, four_bodies, runs, two_bodies
from twin.compile import compile_network
from twin.mechanisms import MECHANISMS
from twin.mechanisms.base import Mechanism, View
from twin.quantity import Spec
from twin.schema import TwinPart, twin_part

SAMPLE = load_machine(Path(__file__).parents[2] / "machines" / "sample_vmc.yml")
BODIES = ("spindle", "head", "column", "bed")


def of(machine: Machine, *keys: str) -> list[Candidate]:
    return candidates(machine, twin_part(machine), keys or MECHANISMS)


def names(machine: Machine, *keys: str) -> set[str]:
    return {c.name for c in of(machine, *keys)}


def test_heat_goes_into_every_body_that_has_not_got_it() -> None:
    assert names(four_bodies(), "cabinet_heat") == {f"cabinet_heat_{b}" for b in BODIES}
    # The file's own friction warms spindle and head, its guides the column.
    assert names(four_bodies(), "bearing_viscous") == {"bearing_viscous_column_rpm", "bearing_viscous_bed_rpm"}
    assert "guide_friction_column_feed" not in names(four_bodies(), "guide_friction")
    (found, *begun) = (c for c in of(four_bodies(), "floor_sink") if c.where.name == "bed")
    assert {c.variant_of for c in begun} == {found.name}  # at other temperatures
    assert found.part is not None and found.part.at == {"body": "bed", "room": "room"}
    assert found.where.kind == "node" and not found.fault


def test_pieces_that_a_finer_network_invents_are_no_places() -> None:
    now = fitted(four_bodies(), runs(four_bodies(), count=4))
    before = {c.name for c in candidates(now.machine, now.part)}
    for c in coarse_candidates(now, np.array([1.0, 100.0, 1.0, 1.0])):
        part = c.applied(now.part)
        after = candidates(now.machine, part)
        pieces = pieces_of(part)
        for other in after:
            ports = other.part.at if other.part is not None and isinstance(other.part.at, dict) else {}
            assert other.where.name not in pieces and not pieces.keys() & set(ports.values()), other.name
        assert all(linked(part, b) == linked(now.part, b) for b in BODIES) or not pieces
        new = {o.name for o in after} - before
        assert not any(o.startswith(("heat_bridge", "cabinet_heat")) for o in new), new


def test_the_same_law_by_another_driver_is_news() -> None:
    given = equipped()
    second = given.model_copy(update={"channels": {**given.channels, "turret": given.channels["rpm"]}})
    assert {"bearing_viscous_head_turret", "bearing_viscous_spindle_turret"} <= names(second, "bearing_viscous")
    assert "bearing_viscous_head_rpm" not in names(second, "bearing_viscous")


def test_drivers_fit_by_unit() -> None:
    given = equipped()
    assert [c.part.drivers for c in of(given, "belt_loss") if c.part] == [{"speed": "rpm"}] * 4
    assert names(two_bodies(), "guide_friction") == set()  # nothing there moves an axis
    assert names(given, "cutting_heat") == {f"cutting_heat_{b}_power" for b in BODIES}
    by = {c.name: c.part.drivers for c in of(given, "voltage_loss_heat") if c.part}
    assert by["voltage_loss_heat_bed_current_voltage"] == {"current": "current", "voltage": "voltage"}


def test_an_optional_driver_is_left_out_or_named() -> None:
    assert {"cabinet_heat_bed", "cabinet_heat_bed_coolant"} <= names(equipped(), "cabinet_heat")
    joints = names(equipped(), "joint_conductance")  # without a driver it would only be another value
    assert joints == {f"joint_conductance_{a}_{b}_coolant" for a, b in pairwise(BODIES)}


def test_ports_look_where_their_roles_say() -> None:
    given = equipped()
    part = twin_part(given)
    assert linked(part, "head") == ["spindle", "column"]
    bending = [c.part.at for c in of(given, "column_bending") if c.part]
    assert bending == [{"hot": a, "cold": b} for a, b in (("column", "bed"), ("head", "column"), ("spindle", "head"))]
    places = {(c.where.name, c.part.at["towards"]) for c in of(given, "sensor_place") if c.part}  # type: ignore[index]
    assert places == {("t_spindle", "head"), ("t_head", "spindle"), ("t_head", "column"), ("t_bed", "column")}
    preload = {tuple(c.part.at.values()) for c in of(given, "preload_feedback") if c.part}  # type: ignore[union-attr]
    assert preload == {("spindle", "head"), ("head", "spindle")}  # the outlets of the heat that it multiplies
    for c in of(given, "preload_feedback"):
        assert c.part is not None and c.part.acts_on == "load"


def test_what_multiplies_heat_goes_with_its_own_laws() -> None:
    assert names(equipped(), "viscosity_feedback") == {f"viscosity_feedback_friction_{b}" for b in ("spindle", "head")}
    multiplied = {c.part.acts_on for c in of(equipped(), "supply_sag") if c.part}
    assert multiplied == {"friction", "load", "guides"}


def test_what_a_sensor_states_is_fitted_and_not_proposed() -> None:
    given = four_bodies(sensors__t_bed__offset="0.1 K")
    assert names(given, "sensor_lag") == {"sensor_lag_t_spindle", "sensor_lag_t_bed"}
    assert names(given, "sensor_bonding") == {"sensor_bonding_t_spindle_room", "sensor_bonding_t_bed_room"}
    assert names(given, "sensor_offset") == {"sensor_offset_t_spindle", "sensor_offset_t_head"}


@pytest.mark.parametrize(
    ("law", "gone"),
    [
        ({"law": "speed_shift", "acts_on": "z", "drivers": "rpm"}, "speed_shift_z_rpm"),
        ({"law": "radiation", "at": {"body": "bed", "surrounding": "room"}, "into": "bed"}, "radiation_bed_room"),
        ({"law": "stratification", "acts_on": "room"}, "stratification_room"),
        (
            {"law": "viscosity_feedback", "at": {"oil": "head"}, "acts_on": "friction"},
            "viscosity_feedback_friction_head",
        ),
        ({"law": "sensor_drift", "acts_on": ["t_bed", "t_head"]}, "sensor_drift_t_head"),
        ({"law": "rotating_convection", "acts_on": "bed-room", "drivers": "rpm"}, "rotating_convection_bed_room_rpm"),
    ],
)
def test_what_the_file_has_already_is_not_proposed(law: dict[str, Any], gone: str) -> None:
    key = law["law"]
    before, after = names(four_bodies(), key), names(four_bodies(mechanisms__own=law), key)
    assert gone in before and gone not in after
    assert after < before and len(before - after) <= 2


def test_swaps_come_in_pairs() -> None:
    swaps = of(four_bodies(), "sensor_swap")
    assert [c.name for c in swaps] == [
        "sensor_swap_t_head_t_bed", "sensor_swap_t_spindle_t_bed", "sensor_swap_t_spindle_t_head",
    ]  # fmt: skip
    assert all(c.part is not None and isinstance(c.part.acts_on, tuple) and len(c.part.acts_on) == 2 for c in swaps)
    assert all(c.fault for c in swaps)


def test_what_goes_to_an_error_fits_its_unit() -> None:
    given = four_bodies()
    assert {"spindle_growth_z_head", "column_bending_z_head_column", "speed_shift_z_rpm"} <= names(given)
    angle = given.channels["z"].model_copy(update={"unit": "urad"})
    turned = given.model_copy(update={"channels": {**given.channels, "z": angle}})
    of_errors = {c.mechanism for c in of(turned) if c.where.kind == "error"}
    assert of_errors == {"time_skew"}  # a clock may be wrong in any unit; um and um/K are none of an angle's


def test_the_order_of_the_file_does_not_matter() -> None:
    given = equipped()
    part = twin_part(given)
    turned = part.model_copy(
        update={g: dict(reversed(getattr(part, g).items())) for g in ("bodies", "links", "sensors", "mechanisms")}
    )
    both = [{c.name for c in candidates(given, p)} for p in (part, turned)]
    signed = ("column_bending", "sensor_swap", "heat_bridge")  # of two places the first is the file's first
    one, other = ({n for n in every if not n.startswith(signed)} for every in both)
    assert one == other and len(both[0]) == len(both[1])
    listed = [c.name for c in candidates(given, part)]
    assert listed == sorted(listed)


@pytest.mark.parametrize("machine", [two_bodies(), equipped(), SAMPLE], ids=["two", "four", "sample"])
def test_names_are_unique_and_keys_of_a_machine_file(machine: Machine) -> None:
    every = of(machine)
    part = twin_part(machine)
    more = alternatives(compile_network(machine))
    assert len({c.name for c in [*every, *more]}) == len(every) + len(more)
    assert len({c.label for c in [*every, *more]}) == len(every) + len(more)
    stated = {c.name: c.part.model_dump(exclude_none=True) for c in every if c.part}
    assert list(TwinPart.model_validate({**(machine.twin or {}), "mechanisms": stated}).mechanisms) == list(stated)
    assert yaml.safe_load(yaml.safe_dump(dict.fromkeys(stated))) == dict.fromkeys(stated)
    assert not {c.name for c in every} & set(part.mechanisms)


def test_places_inside_bodies_make_keys_too() -> None:
    plate = {"capacity": "40 kJ/K", "shape": "plate", "cells": [3, 2], "length": "1 m", "width": "0.5 m",
             "thickness": "0.1 m", "material": "cast_iron"}  # fmt: skip
    given = two_bodies(
        bodies__head=plate, links={"joint": {"between": ["shaft", "head@0.2,0.5"], "conductance": "12 W/K"}},
        exposures={"shaft-room": "1 W/K", "head@0.2,0.5-room": "8 W/K"},
    )  # fmt: skip
    every = of(given)
    assert any("joint" in c.name for c in every)
    for c in every:
        assert c.name.isidentifier(), c.name
    assert "joint" in {c.where.name for c in of(given, "rotating_convection")}


def sampled() -> Iterator[Any]:
    """Of every mechanism three places of the sample machine, with what drives it."""
    channels = {"coolant": "1", "feed": "mm/min", "power": "W", "current": "A", "voltage": "V", "travel": "mm"}
    raw = SAMPLE.model_dump()
    for name, unit in channels.items():
        role = "position" if unit == "mm" else "driver"
        raw["channels"][name] = {"role": role, "unit": unit}
    machine = parse_machine(yaml.safe_dump(raw), "sample_vmc.yml")
    every = of(machine)
    for key in MECHANISMS:
        own = [c for c in every if c.mechanism == key]
        if own:
            yield pytest.param(machine, own[:: max(1, len(own) // 2)], id=key)


@pytest.mark.parametrize(("machine", "own"), list(sampled()))
def test_every_candidate_compiles_by_itself(machine: Machine, own: list[Candidate]) -> None:
    part = twin_part(machine)
    before = compile_network(machine)
    for c in own:
        after = compile_network(machine, part=c.applied(part))
        assert len(after.parameters) > len(before.parameters) or c.amplitudes == {}, c.name
        with pytest.raises(ValueError, match=f"mechanisms.{c.name}: is there already"):
            c.applied(c.applied(part))


def test_only_these_have_no_place_there() -> None:
    """Its sensors state lag, bonding and offset; its errors are no strains."""
    tried = {str(p.id) for p in sampled()}
    stated = {"sensor_lag", "sensor_bonding", "sensor_offset", "charge_strain"}
    assert set(MECHANISMS) - tried - {k for k in MECHANISMS if not MECHANISMS[k].proposable} == stated


class Pump(Mechanism):
    """A mechanism that nobody has heard of."""

    key = "morning_pump"
    summary = "pump that runs while the oil is cold"
    equation = "P = heat until duration"
    source = "none"
    signature = "heat at the start of every run"
    acts_at = ("node",)
    parameters = (Spec("heat", "W", "heat of the pump", 50.0, 0.6, 0.0, 5000.0),)
    off: ClassVar[Mapping[str, float]] = {"heat": 0.0}

    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return np.asarray(p["heat"] * np.where(view.time_s < 5400.0, 1.0, 0.0))


@pytest.fixture
def registry(monkeypatch: pytest.MonkeyPatch) -> Registry:
    """The registry, as it was afterwards."""
    monkeypatch.setattr(MECHANISMS, "_members", dict(MECHANISMS._members))
    return MECHANISMS


def test_a_mechanism_added_at_run_time_is_proposed_and_found(registry: Registry) -> None:
    known = two_bodies()
    assert names(known, *registry) == names(known)
    registry.add("morning_pump", f"{Pump.__module__}:Pump")
    assert names(known, "morning_pump") == {"morning_pump_shaft", "morning_pump_head"}
    hidden = {"own": {"law": "morning_pump", "into": "head", "parameters": {"heat": "120 W"}}}
    done = search(fitted(known, runs(known, hidden)))
    (found,) = done.accepted
    assert found.best is not None and found.best.candidate.name == "morning_pump_head"
    values = dict(zip((p.name for p in done.final.problem.network.parameters), done.final.values, strict=True))
    assert values["mechanisms.morning_pump_head.heat"] == pytest.approx(120.0, rel=0.05)
