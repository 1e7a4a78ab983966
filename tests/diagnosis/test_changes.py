"""What a diagnosis changes of a machine file, and how much values that differ from run to run really differ."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from diagnosis.contracts import Fitted
from diagnosis.export.machine_file import changed_parts, deviations, with_deviations
from tests.diagnosis.small_cases import FLOOR, fitted, runs, two_bodies
from twin.compile import compile_network
from twin.quantity import Value
from twin.schema import Body, MechanismPart, TwinPart, twin_part

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


def varying(sizes: list[float]) -> Fitted:
    """A fit in which the batches' deviations are these, in units of their prior."""
    known = two_bodies(mechanisms__belt__parameters__power=POWER)
    done = fitted(known, runs(two_bodies(), count=len(sizes)))
    at = done.problem.nuisances.shared - 1
    own = [np.concatenate([v[:at], [size], v[at + 1 :]]) for v, size in zip(done.own, sizes, strict=True)]
    out = replace(done)
    vars(out)["own"] = own
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
