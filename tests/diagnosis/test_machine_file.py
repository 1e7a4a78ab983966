"""The new machine file: what a diagnosis changes, in the user's text, which every command can use as it is."""

from __future__ import annotations

import difflib
import json
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from data.errors import InputError, WorkError
from data.machine import parse_machine
from diagnosis.export import machine_file
from diagnosis.export.machine_file import changed_parts, deviations, diagnosed_text, drafted_text, with_deviations
from diagnosis.fitting.fit import Fitted
from tests.diagnosis.small_cases import FLOOR, fitted, runs, two_bodies
from twin.calibration.calibrated_file import calibrated_text
from twin.calibration.identifiability import Interval
from twin.compile import compile_network, own_paths
from twin.network import Network
from twin.quantity import Value
from twin.schema import Body, Calibrated, Link, MechanismPart, Sensor, TwinPart, twin_part

SAMPLE = (Path(__file__).parents[2] / "machines" / "sample_vmc.yml").read_text(encoding="utf-8")
WHERE = "OUT/machine.yml"
NOTE = "Found 2026-11-21 in 12 batches: probability 0.97, gain 41 nats in runs left out of the fit"
ORIGIN = Calibrated(
    batches=("b1", "b2"), when="2026-11-21T10:00:00+01:00", simulated=True, left_out_rms={"z_um": 1.4321},
    words="diagnosed",
)  # fmt: skip
SINK = MechanismPart(
    law="floor_sink",
    at="head",
    parameters={
        "conductance": Value(value=10.0, spread=0.7, bounds=(0.0, 1000.0)),
        "temperature": Value(value=18.0, spread=4.0),
    },
)
CABINET = MechanismPart(law="cabinet_heat", into="head", parameters={"heat": Value(value=200.0, spread=0.8)})
HEAD = """# by hand
machine: two
recording: {step_s: 60}
channels:
  t: {role: temperature, unit: degC, resolution: 0.1}
  room: {role: ambient, unit: degC, resolution: 0.1}
  rpm: {role: driver, unit: rpm}
"""
TWIN = """twin:
  surroundings: {room: {channel: room}}
  bodies:
    head: {capacity: {value: 40 kJ/K, spread: 0.3}}  # guessed
  exposures:
    head-room: {value: 8 W/K, spread: 0.5} # measured once
"""
MECHANISMS = """  mechanisms:
    motor: # the drive
      law: motor_loss
      drivers: rpm
      into: head
      parameters: {idle: 40 W, linear: {value: 110 W, spread: 0.4}}

  # where it is measured
"""
SENSORS = "  sensors:\n    t: {at: head} # glued\n"
TEXT = HEAD + TWIN + MECHANISMS + SENSORS


def diagnosed(
    values: Mapping[str, float], added: Mapping[str, Any], notes: Mapping[str, str] | None = None, text: str = TEXT
) -> str:
    intervals = [Interval(n, "", v, v - 0.1 * abs(v), v + 0.1 * abs(v), 0.2) for n, v in values.items()]
    return diagnosed_text(text, WHERE, values, intervals, added, notes or {}, ORIGIN)


def network_of(text: str) -> Network:
    return compile_network(parse_machine(text, "read"))


def value_of(text: str, name: str) -> float:
    network = network_of(text)
    return network.parameters[network.index(name)].value


def new_lines(text: str, old: str = TEXT) -> list[str]:
    """Lines that were added; no line of the old text may be lost."""
    lines = list(difflib.ndiff(old.splitlines(), text.splitlines()))
    assert not [line for line in lines if line.startswith("- ")]
    return [line[2:] for line in lines if line.startswith("+ ")]


def test_an_accepted_mechanism_is_put_in_with_units_spread_interval_and_origin() -> None:
    values = {"mechanisms.floor_sink_head.conductance": 10.23456, "mechanisms.floor_sink_head.temperature": 17.5}
    new = diagnosed(values, {"floor_sink_head": SINK}, {"floor_sink_head": NOTE})
    told = [line for line in new_lines(new) if "calibrated" not in line]
    assert told[-7:] == [
        f"    # {NOTE}",
        "    floor_sink_head:",
        "      law: floor_sink",
        "      at: head",
        "      parameters:",
        "        conductance: {value: 10.235 W/K, spread: 0.7, bounds: [0, 1000], prior: 10 W/K, "
        "interval90: [9.2111, 11.258]}",
        "        temperature: {value: 17.5 degC, spread: 4 K, prior: 18 degC, interval90: [15.75, 19.25]}",
    ]
    assert new.index("linear: {value: 110") < new.index(NOTE) < new.index("# where it is measured")
    network = network_of(new)
    sink = network.parameters[network.index("exposures.head-floor_sink_head.conductance")]
    assert (sink.value, sink.prior_value, sink.spread, sink.low, sink.high) == (10.235, 10.0, 0.7, 0.0, 1000.0)
    part = twin_part(parse_machine(new, "read"))
    assert part.calibrated is not None and part.calibrated.left_out_rms == {"z_um": 1.43}


def test_values_of_the_network_find_their_mechanism_in_the_file() -> None:
    new = diagnosed({"exposures.head-sink.conductance": 12.0}, {"sink": SINK})
    assert value_of(new, "exposures.head-sink.conductance") == 12.0
    assert twin_part(parse_machine(new, "read")).mechanisms["sink"].parameters["conductance"].value == "12 W/K"


def test_other_free_values_are_recalibrated_in_place() -> None:
    values = {"exposures.head-room.conductance": 7.77777, "mechanisms.motor.linear": 123.0, "mechanisms.c.heat": 60.0}
    new = diagnosed(values, {"c": CABINET})
    assert (
        "    head-room: {value: 7.7778 W/K, spread: 0.5, prior: 8 W/K, interval90: [7, 8.5555]} # measured once" in new
    )
    assert "heat: {value: 60 W, spread: 0.8, prior: 200 W, interval90: [54, 66]}" in new
    assert value_of(new, "mechanisms.motor.linear") == 123.0
    kept = [line for line in TEXT.splitlines() if "#" in line]
    assert all(any(line.split("#")[1] in other for other in new.splitlines()) for line in kept)


@pytest.mark.parametrize(
    "mechanisms",
    [
        "",
        "  mechanisms: {}\n",
        "  mechanisms: {} # none yet\n",
        "  mechanisms: {motor: {law: motor_loss, drivers: rpm, into: head}}\n",
        "  mechanisms: {\n    motor: {law: motor_loss, drivers: rpm, into: head}, # the drive\n  } # end\n",
        "  mechanisms:\n    motor: {law: motor_loss, drivers: rpm, into: head,\n            words: 'a\n # b'}\n",
        MECHANISMS,
    ],
)
@pytest.mark.parametrize("behind", [True, False])
def test_every_style_of_the_file_takes_it(mechanisms: str, behind: bool) -> None:
    text = HEAD + TWIN + (mechanisms + SENSORS if behind else SENSORS + mechanisms.rstrip("\n"))
    new = diagnosed({"mechanisms.c.heat": 60.0}, {"c": CABINET}, {"c": NOTE}, text)
    assert value_of(new, "mechanisms.c.heat") == 60.0
    assert f"# {NOTE}" in new
    for line in text.splitlines():
        if "#" in line:
            assert line.split("#")[1] in new
    old, read = yaml.safe_load(text), yaml.safe_load(new)
    del read["twin"]["calibrated"], read["twin"]["mechanisms"]["c"]
    assert (read["twin"].pop("mechanisms") or None) == (old["twin"].pop("mechanisms", None) or None)
    assert read == old


def test_a_file_in_json_takes_it() -> None:
    text = json.dumps(yaml.safe_load(TEXT))
    new = diagnosed({"mechanisms.c.heat": 60.0, "mechanisms.motor.linear": 90.0}, {"c": CABINET}, {"c": NOTE}, text)
    assert value_of(new, "mechanisms.c.heat") == 60.0 and value_of(new, "mechanisms.motor.linear") == 90.0


def test_a_wrong_value_is_changed_in_place_with_a_comment() -> None:
    name = "mechanisms.motor.idle"
    new = diagnosed({name: 71.0}, {}, {name: "The value was wrong: 40 W -> 71 W"})
    lines = new.splitlines()
    at = next(k for k, line in enumerate(lines) if "idle" in line)
    assert lines[at - 1] == "      # The value was wrong: 40 W -> 71 W"
    assert (
        "idle: {value: 71 W, prior: 40 W, interval90: [63.9, 78.1]}, linear: {value: 110 W, spread: 0.4}" in lines[at]
    )
    network = network_of(new)
    assert not network.parameters[network.index(name)].free


def test_a_wrong_value_that_stood_only_in_the_class_is_written_out() -> None:
    new = diagnosed({"mechanisms.motor.rated": 8000.0}, {})
    assert "parameters: {idle: 40 W, linear: {value: 110 W, spread: 0.4}, " in new
    assert "rated: {value: 8000 rpm, prior: 6000 rpm, interval90: [7200, 8800]}" in new


def test_refined_bodies_and_moved_sensors_come_along() -> None:
    added = {
        "bodies.head": Body(capacity=Value(value="34 kJ/K", spread=0.3)),
        "bodies.near_t": Body(capacity=Value(value="6 kJ/K", spread=0.5), words="head near t"),
        "links.near_t-head": Link(between=("near_t", "head"), conductance=Value(value="20 W/K", spread=1.0)),
        "sensors.t": Sensor(at="near_t"),
    }
    new = diagnosed({"links.near_t-head.conductance": 33.0}, added, {"bodies.near_t": "t sits off-centre"})
    assert "    head: {capacity: {value: 34 kJ/K, spread: 0.3}}  # guessed" in new
    assert "    t: {at: near_t} # glued" in new
    assert "    # t sits off-centre\n    near_t: {capacity: {value: 6 kJ/K, spread: 0.5}, words: head near t}" in new
    assert "  links:\n    near_t-head: {value: 33 W/K, spread: 1, prior: 20 W/K, interval90: [29.7, 36.3]}\n" in new
    assert network_of(new).cells == ("head", "near_t")


def test_what_stands_in_for_unlisted_physics_comes_through() -> None:
    flux = MechanismPart(
        law="free_flux",
        at={"body": "head"},
        into="head",
        drivers={"level": "rpm"},
        parameters={"constant": Value(value=0.0), "linear": Value(value=0.0, spread=0.02)},
    )
    new = diagnosed({"mechanisms.flux.linear": 0.0123456}, {"flux": flux})
    assert "linear: {value: 0.012346 W, spread: 0.02 W, prior: 0 W, interval90: [0.011111, 0.01358]}" in new
    assert value_of(new, "mechanisms.flux.linear") == 0.012346


def test_the_new_file_can_be_calibrated_and_diagnosed_again() -> None:
    new = diagnosed({"mechanisms.c.heat": 60.0}, {"c": CABINET}, {"c": NOTE})
    network = network_of(new)
    free = [network.parameters[k] for k in network.free]
    assert "mechanisms.c.heat" in [p.name for p in free]
    values = {p.name: 1.1 * p.value for p in free}
    intervals = [Interval(n, "", v, 0.9 * v, 1.1 * v, 0.2) for n, v in values.items()]
    again = calibrated_text(new, network, values, intervals, ORIGIN, WHERE)
    assert value_of(again, "mechanisms.c.heat") == pytest.approx(66.0) and f"# {NOTE}" in again
    twice = diagnosed({"mechanisms.c.heat": 61.0, "mechanisms.d.heat": 5.0}, {"d": CABINET}, {"d": "too"}, again)
    assert twice.count("calibrated:") == 1 and value_of(twice, "mechanisms.c.heat") == 61.0
    network = network_of(twice)
    assert network.parameters[network.index("mechanisms.c.heat")].prior_value == 200.0


def test_the_sample_machine_keeps_every_line_and_comment() -> None:
    sink = SINK.model_copy(update={"at": {"body": "table", "room": "room"}})
    new = diagnosed({"mechanisms.sink.conductance": 7.0}, {"sink": sink}, {"sink": NOTE}, SAMPLE)
    added = new_lines(new, SAMPLE)
    assert len(added) == 13 and added[0] == "  calibrated:" and added[6] == f"    # {NOTE}"


def test_parameters_of_structural_mechanisms_know_their_place_in_the_file() -> None:
    machine = parse_machine(TEXT, "two")
    part = twin_part(machine)
    with_sink = part.model_copy(update={"mechanisms": {**part.mechanisms, "sink": SINK}})
    assert own_paths(machine, part) == {}
    assert own_paths(machine, with_sink) == {
        "surroundings.sink.value": "mechanisms.sink.temperature",
        "surroundings.sink.follow": "mechanisms.sink.follow",
        "exposures.head-sink.conductance": "mechanisms.sink.conductance",
    }


def test_one_value_for_two_places_must_be_the_same_for_both() -> None:
    bending = MechanismPart(law="column_bending", at={"hot": "motor", "cold": "bed"}, acts_on=("x", "y"),
                            parameters={"gain": Value(value=1.0, spread=3.0)})  # fmt: skip
    names = ("errors.x.tilts[1].gain", "errors.y.tilts[1].gain")
    words = r"mechanisms.bend.gain is one value in the file and was fitted as 2 and 3; give each place a mechanism"
    with pytest.raises(WorkError, match=words):
        diagnosed(dict(zip(names, (2.0, 3.0), strict=True)), {"bend": bending}, text=SAMPLE)
    both = diagnosed(dict(zip(names, (2.0, 2.0), strict=True)), {"bend": bending}, text=SAMPLE)
    assert [value_of(both, n) for n in names] == [2.0, 2.0]


def test_what_cannot_be_written_is_told() -> None:
    with pytest.raises(InputError, match=r"OUT/machine.yml: no twin parameter 'mechanisms.c.haet'; did you mean "):
        diagnosed({"mechanisms.c.haet": 60.0}, {"c": CABINET})
    with pytest.raises(WorkError, match=r"mechanisms.c.heat has no finite value and interval; nothing was written"):
        diagnosed_text(TEXT, WHERE, {"mechanisms.c.heat": 60.0}, [], {"c": CABINET}, {})
    with pytest.raises(WorkError, match=r"mechanisms.c.heat has no finite value and interval"):
        diagnosed({"mechanisms.c.heat": float("nan")}, {"c": CABINET})
    with pytest.raises(WorkError, match=r"the new file does not read back .*outside the bounds.*; nothing was written"):
        diagnosed({"mechanisms.c.heat": 1e6}, {"c": CABINET})
    with pytest.raises(ValueError, match=r"bodes.x: no part of a twin is called 'bodes'; did you mean 'bodies'"):
        diagnosed({}, {"bodes.x": Body(capacity=Value(value="1 J/K"))})


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("value: 60 W", "value: 61 W", "mechanisms.c.heat reads back as 61 instead of 60"),
        ("spread: 0.8", "spread: 0.7", "mechanisms.c.heat reads back as 0.7 instead of 0.8"),
        ("prior: 200 W", "prior: 190 W", "mechanisms.c.heat reads back as 190 instead of 200"),
        ("t\n      into: head", "t\n      into: {head: rest}", "twin.mechanisms does not read back as it was meant"),
        ("t: {at: head}", "t: {at: head, words: x}", "twin.sensors does not read back as it was meant"),
        (
            "head-room: {value: 8",
            "head-room: {value: 9",
            "exposures.head-room.conductance reads back as 9 instead of 8",
        ),
        ("at: head}", "at: head, lag: 5 s}", "twin.sensors does not read back"),
        ("step_s: 60", "step_s: 30", "writing would change more than the twin part"),
    ],
)
def test_a_text_that_says_something_else_is_never_given(
    before: str, after: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(machine_file, "with_calibrated", lambda text, rows: text.replace(before, after))
    with pytest.raises(WorkError, match=f"OUT/machine.yml: .*{words}.*; nothing was written"):
        diagnosed({"mechanisms.c.heat": 60.0}, {"c": CABINET})


def drafted_part() -> TwinPart:
    return twin_part(parse_machine(TEXT, "two"))


def test_a_draft_is_appended_in_short_style() -> None:
    new = drafted_text(HEAD, drafted_part(), WHERE, "Drafted from 12 batches")
    assert new == HEAD + (
        "# Drafted from 12 batches\n"
        "twin:\n"
        "  surroundings:\n"
        "    room: {channel: room}\n"
        "  bodies:\n"
        "    head: {capacity: {value: 40 kJ/K, spread: 0.3}}\n"
        "  exposures:\n"
        "    head-room: {value: 8 W/K, spread: 0.5}\n"
        "  mechanisms:\n"
        "    motor: {law: motor_loss, into: head, drivers: rpm, parameters: "
        "{idle: 40 W, linear: {value: 110 W, spread: 0.4}}}\n"
        "  sensors:\n"
        "    t: {at: head}\n"
    )


@pytest.mark.parametrize("text", [HEAD, HEAD.rstrip("\n"), HEAD + "twin: # later\n", json.dumps(yaml.safe_load(HEAD))])
def test_a_draft_fits_every_file_and_takes_what_is_found(text: str) -> None:
    drafted = drafted_text(text, drafted_part(), WHERE)
    assert network_of(drafted).parameters == network_of(TEXT).parameters
    new = diagnosed({"mechanisms.c.heat": 60.0, "exposures.head-room.conductance": 7.0}, {"c": CABINET}, text=drafted)
    assert value_of(new, "mechanisms.c.heat") == 60.0


def test_the_sample_machines_whole_part_survives_a_draft() -> None:
    machine = parse_machine(SAMPLE, "sample")
    text = yaml.safe_dump({k: v for k, v in yaml.safe_load(SAMPLE).items() if k != "twin"}, sort_keys=False)
    new = drafted_text(text, twin_part(machine), WHERE)
    assert max(len(line) for line in new[new.index("\ntwin:") :].splitlines()) < 200
    assert network_of(new).parameters == compile_network(machine).parameters


def test_nothing_is_drafted_over_a_twin_part() -> None:
    with pytest.raises(InputError, match=r"OUT/machine.yml: has a twin part already; nothing is drafted over it"):
        drafted_text(TEXT, drafted_part(), WHERE)


PART = twin_part(two_bodies())
POWER = {"value": "120 W", "spread": 0.4, "per_batch": 0.3}
FLOOR_PART = MechanismPart.model_validate(FLOOR)


def test_nothing_changed_is_nothing_told() -> None:
    assert changed_parts(PART, PART.model_copy()) == {}
    assert changed_parts(PART, TwinPart.model_validate(PART.model_dump())) == {}


def test_new_and_different_parts_are_told_by_path() -> None:
    after = PART.model_copy(
        update={
            "mechanisms": {**PART.mechanisms, "floor": FLOOR_PART},
            "bodies": {**PART.bodies, "head": PART.bodies["head"].model_copy(update={"words": "cast"}),
                       "cover": Body(capacity=Value(value="1 kJ/K"))},
        }
    )  # fmt: skip
    told = changed_parts(PART, after)
    assert set(told) == {"mechanisms.floor", "bodies.head", "bodies.cover"}
    assert told["mechanisms.floor"] == FLOOR_PART


def test_a_value_alone_is_a_change() -> None:
    power = Value(value="120 W", spread=0.4, per_batch=0.2)
    belt = PART.mechanisms["belt"].model_copy(update={"parameters": {"power": power}})
    after = PART.model_copy(update={"mechanisms": {"belt": belt}})
    assert changed_parts(PART, after) == {"mechanisms.belt": belt}


@cache
def fitted_with_own_powers(count: int) -> Fitted:
    return fitted(two_bodies(mechanisms__belt__parameters__power=POWER), runs(two_bodies(), count=count))


def varying(sizes: list[float]) -> Fitted:
    """A fit in which the batches' deviations are these, in units of their prior."""
    done = fitted_with_own_powers(len(sizes))
    at = done.problem.nuisances.shared - 1
    own = [np.concatenate([v[:at], [size], v[at + 1 :]]) for v, size in zip(done.fitted_nuisance, sizes, strict=True)]
    out = replace(done)
    vars(out)["fitted_nuisance"] = own
    return out


def test_deviations_are_what_the_batches_show() -> None:
    done = varying([1.0, -1.0, 2.0, 0.0])
    expected = 0.3 * np.sqrt((1 + 1 + 4 + 0) / 4)
    assert deviations(done) == {"mechanisms.belt.power": pytest.approx(expected)}
    given = with_deviations(done).mechanisms["belt"].parameters["power"]
    assert given.per_batch == float(f"{expected:.2g}") == 0.37
    assert (given.value, given.spread) == ("120 W", 0.4)
    network = compile_network(done.machine, part=with_deviations(done))
    assert network.parameters[network.index("mechanisms.belt.power")].per_batch == 0.37


def test_no_deviation_is_written_as_nothing_at_all() -> None:
    given = with_deviations(varying([0.0] * 4)).mechanisms["belt"].parameters["power"]
    assert given.per_batch == 0.01  # a file cannot say 0


def test_where_nothing_varies_the_part_is_as_it_was() -> None:
    done = fitted(two_bodies(), runs(two_bodies(), count=4))
    assert deviations(done) == {}
    assert with_deviations(done) == done.part
