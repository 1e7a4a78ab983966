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
from diagnosis.candidates.alternatives import alternatives
from diagnosis.candidates.library import HINTS, candidates, equipment_named, linked, log_prior_odds
from diagnosis.contracts import Candidate, Where
from diagnosis.fitting.signatures import differences, with_disabled
from diagnosis.policy import POLICY
from diagnosis.screening.screen import proposed
from diagnosis.search.search import search
from tests.diagnosis.small_cases import equipped, fitted, four_bodies, runs, two_bodies
from twin.compile import compile_network
from twin.mechanisms import MECHANISMS
from twin.mechanisms.base import EQUIPMENT, Mechanism, View
from twin.quantity import Spec, convert
from twin.schema import TwinPart, twin_part

MACHINES = Path(__file__).parents[2] / "machines"
SAMPLE = load_machine(MACHINES / "sample_vmc.yml")
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
    assert {c.part.acts_on for c in of(given, "preload_feedback") if c.part} == {"load", "friction"}


def test_optional_ports_are_named_one_at_a_time_or_not_at_all() -> None:
    hall = {"surroundings": {"room": {"channel": "room"}, "hall": {"first": ["t_bed"]}}}
    given = four_bodies(**hall)
    bars = [c for c in of(given, "mandrel_fixture") if c.part]
    at = [c.part.at for c in bars if c.part]
    assert sorted(at, key=str) == sorted([*({"seat": b} for b in BODIES), {"air": "room"}, {"air": "hall"}], key=str)
    shapes = {next(iter(c.part.at)): c.shape for c in bars if isinstance(c.part.at, dict)}  # type: ignore[union-attr]
    assert shapes == {"seat": ("capacity", "conductance"), "air": ("capacity", "film")}
    for key in ("jacket_chiller", "coolant_jacket"):
        own = [c for c in of(given, key) if c.where.name == "head" and not c.variant_of]
        ports = {tuple(c.part.at): c for c in own if c.part and isinstance(c.part.at, dict)}
        assert set(ports) == {("jacket",), ("jacket", "room")}  # the hall is not recorded: nothing to follow
        plain, following = ports["jacket",], ports["jacket", "room"]
        assert "follow" not in plain.shape and "follow" in following.shape
        assert plain.part and not plain.part.parameters and following.part
        assert following.part.parameters["follow"].value == 1.0


def test_a_neighbour_radiates_where_no_link_or_air_joins_them() -> None:
    pairs = {tuple(c.part.at.values()) for c in of(four_bodies(), "radiation") if c.part}  # type: ignore[union-attr]
    apart = {("spindle", "column"), ("spindle", "bed"), ("head", "bed")}
    assert pairs == {*((b, "room") for b in BODIES), *apart}
    own = {"law": "radiation", "at": {"body": "bed", "surrounding": "head"}, "into": "bed"}
    left = {tuple(c.part.at.values()) for c in of(four_bodies(mechanisms__own=own), "radiation") if c.part}  # type: ignore[union-attr]
    assert left == pairs - {("head", "bed")}  # either way round it is there


def test_the_ground_is_no_air_that_a_gate_cools() -> None:
    assert {c.where.name for c in of(SAMPLE, "draught") if c.where.kind == "node"} == {"room"}


def test_every_value_that_is_looked_for_is_a_candidate_of_its_own() -> None:
    gates = [c for c in of(four_bodies(), "draught") if c.base_name == "draught_room"]
    stated = [{k: v.value for k, v in c.part.parameters.items()} for c in gates if c.part]
    by_clock = [s for s in stated if set(s) == {"start", "clock"}]
    assert len(gates) == 1 + len(by_clock) and len(by_clock) > 10
    assert {"start": "6 h", "clock": 1.0} in by_clock
    assert all(c.amplitudes == {"factor": 1.0, "drop": 0.0} for c in gates)
    units = [c for c in of(equipped(), "hydraulic_unit") if c.where.name == "bed"]
    named = ("hydraulic_unit_bed", "hydraulic_unit_bed_coolant")
    assert {len([c for c in units if c.base_name == p]) for p in named} == {
        6, 1,
    }  # fmt: skip


def test_a_draught_is_looked_for_in_every_part_of_a_run() -> None:
    now = fitted(two_bodies(), runs(two_bodies(), count=3))
    gates = [c for c in proposed(now) if c.base_name == "draught_room" and "_at_" in c.name]
    windows = [{k: v.value for k, v in c.part.parameters.items()} for c in gates if c.part]
    hours = [convert(w["start"], "h") for w in windows]
    run_h = now.batches[0].step_s * now.batches[0].n_rows / 3600.0
    assert len(hours) == POLICY.run_windows and min(hours) == 0.0 and 0.9 * run_h < max(hours) < run_h
    assert all(convert(w["duration"], "h") > run_h / POLICY.run_windows for w in windows)  # parts overlap


def test_a_lag_and_a_skew_of_any_size_are_finite_changes() -> None:
    now = fitted(two_bodies(), runs(two_bodies(), count=3))
    every = [c for c in of(two_bodies(), "sensor_lag", "time_skew") if c.where.name == "t_head"]
    finite = {c.name: c for c in every if c.variant_of}
    assert [(c.amplitudes, c.shape) for c in finite.values()] == [({}, ("lag",))] * 6 + [({}, ("delay",))] * 8
    changes, left_out = differences(now, every)
    assert not left_out and set(changes) == set(finite)
    head = now.problem.channels.index("t_head")

    def size(c: Candidate) -> float:
        for change, m in zip(changes[c.name], now.problem.measured, strict=True):
            assert np.abs(change[m.channel != head]).max() < 1e-9  # one sensor shows it, the machine does not
        return float(sum(np.sum(change**2) for change in changes[c.name]) ** 0.5)

    lags = {str(c.part.parameters["lag"].value): size(c) for c in finite.values() if c.part and c.shape == ("lag",)}
    assert list(lags) == ["30 s", "90 s", "240 s", "720 s", "2100 s", "7200 s"]
    assert (np.diff(list(lags.values())) > 0).all()
    skews = {str(c.part.parameters["delay"].value): size(c) for c in finite.values() if c.part and "delay" in c.shape}
    assert skews["600 s"] > skews["60 s"] > skews["20 s"] > 0 and skews["-600 s"] > skews["-20 s"] > 0


def test_what_multiplies_heat_goes_with_its_own_laws() -> None:
    oils = {"friction_spindle", "friction_head", "guides_column"}  # not that of the load
    assert names(equipped(), "viscosity_feedback") == {f"viscosity_feedback_{place}" for place in oils}
    multiplied = {c.part.acts_on for c in of(equipped(), "supply_sag") if c.part}
    assert multiplied == {"friction", "load", "guides"}


def test_what_a_sensor_states_is_fitted_and_not_proposed() -> None:
    given = four_bodies(sensors__t_bed__offset="0.1 K")
    assert {c.base_name for c in of(given, "sensor_lag")} == {"sensor_lag_t_spindle", "sensor_lag_t_bed"}
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


NAMED = {  # what the files of machines/ hint at
    "cell_30q": {"battery cell"},
    "tclab_board": {"heater"},
    "spindle_fl": {"rotating parts", "bearings", "motor", "belt", "cutting", "cabinet", "test bar"},
    "sample_lathe": {"guides", "ball screw", "rotating parts", "bearings", "motor", "belt", "cutting", "cabinet",
                     "test bar", "enclosure"},
}  # fmt: skip
NAMED |= {"sample_vmc": NAMED["sample_lathe"], "lathe_gv1203": NAMED["sample_lathe"]}


@pytest.mark.parametrize("name", NAMED)
def test_equipment_that_a_file_hints_at(name: str) -> None:
    machine = load_machine(MACHINES / f"{name}.yml")
    part = twin_part(machine) if machine.twin else None
    named = equipment_named(machine, part)
    assert named == NAMED[name] and named <= EQUIPMENT == set(HINTS)
    odds = {
        key: log_prior_odds(machine, part, Candidate(key, Where("node", "bed"), key, key))
        for key in (
            "heat_bridge",
            "sensor_lag",
            "wrong_parameter",
            "bearing_viscous",
            "screw_bearing",
            "coolant_jacket",
            "sun",
        )
    }
    assert odds["heat_bridge"] == odds["sensor_lag"] == odds["wrong_parameter"] == 0.0
    assert odds["sun"] == pytest.approx(np.log(1 / 20))  # a window may be anywhere, and no file names one
    still = name in ("cell_30q", "tclab_board")
    assert odds["bearing_viscous"] == (pytest.approx(np.log(1 / 1000)) if still else 0.0)
    assert odds["coolant_jacket"] == pytest.approx(np.log(1 / 1000 if still else 1 / 20))
    assert odds["screw_bearing"] == (
        0.0 if "ball screw" in named else pytest.approx(np.log(1 / 1000 if still else 1 / 20))
    )


@pytest.mark.parametrize(
    ("group", "name", "given", "equipment"),
    [
        ("bodies", "t", {"capacity": "1 kJ/K", "words": "Kühlmitteltank"}, {"coolant jacket", "cutting fluid"}),
        ("bodies", "Schaltschrank", {"capacity": "1 kJ/K"}, {"cabinet"}),
        ("bodies", "b", {"capacity": "1 kJ/K", "words": "Führung mit Kugelgewindetrieb"}, {"guides", "ball screw"}),
        ("surroundings", "air", {"value": "20 degC", "words": "under the hood"}, {"enclosure"}),
        ("mechanisms", "own", {"law": "hydraulic_unit", "into": "heater1"}, {"hydraulic unit"}),
        ("mechanisms", "own", {"law": "cabinet_heat", "into": "heater1", "words": "Spindellager"}, {"bearings"}),
        ("channels", "chiller_on", {"role": "driver", "unit": "1"}, {"coolant jacket"}),
        ("channels", "travel", {"role": "position", "unit": "mm"}, {"guides", "ball screw", "cabinet"}),
    ],
)
def test_words_laws_and_drivers_name_equipment(
    group: str, name: str, given: dict[str, Any], equipment: set[str]
) -> None:
    raw = yaml.safe_load((MACHINES / "tclab_board.yml").read_text(encoding="utf-8"))
    (raw if group == "channels" else raw["twin"])[group][name] = given
    machine = parse_machine(yaml.safe_dump(raw), "board.yml")
    assert equipment_named(machine, twin_part(machine)) >= {"heater", *equipment}


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
    # of two places the first is the file's first
    signed = ("column_bending", "sensor_swap", "heat_bridge", "radiation")
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


@pytest.mark.slow
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


def board(range_: list[float] | None) -> Machine:
    level: dict[str, Any] = {"role": "driver", "unit": "%"} | ({"range": range_} if range_ else {})
    return Machine(
        machine="board",
        channels={
            "one": level, "other": level,
            "t": {"role": "temperature", "unit": "degC", "resolution": 0.1},
            "room": {"role": "ambient", "unit": "degC"},
        },
        twin={
            "surroundings": {"room": {"channel": "room"}}, "bodies": {"plate": {"capacity": "3 J/K"}},
            "exposures": {"plate-room": "12 mW/K"}, "sensors": {"t": {"at": "plate"}},
            "mechanisms": {"heat": {"law": "electrical_heat", "drivers": {"level": "one"}, "into": "plate"}},
        },
    )  # fmt: skip


@pytest.mark.parametrize("range_, level", [([0.0, 100.0], 100.0), (None, 1.0)])
def test_a_sag_is_stated_at_the_other_ones_full_level(range_: list[float] | None, level: float) -> None:
    machine = board(range_)
    part = twin_part(machine)
    sags = [c for c in candidates(machine, part, ["supply_sag"]) if c.part and c.part.drivers == {"other": "other"}]
    network = with_disabled(machine, part, sags).network
    assert network.values[network.index("mechanisms.supply_sag_heat_other.rated")] == level
