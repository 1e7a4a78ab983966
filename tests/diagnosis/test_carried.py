"""A fit carried to another network of the same machine: everything by name, nothing by place in a list."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from data.arrays import Array
from diagnosis.fitting.carried import carried_nuisances, carried_z, on_network
from diagnosis.fitting.fit import Fitted
from diagnosis.fitting.fitted import refitted
from tests.diagnosis.small_cases import fitted, runs, two_bodies
from twin.calibration.fit_problem import x_of
from twin.calibration.problem import CalibrationProblem
from twin.compile import compile_network
from twin.quantity import Value
from twin.schema import Body, Link, MechanismPart, TwinPart

POWER = {"value": "120 W", "spread": 0.4, "per_batch": 0.2}
SMALL = {"capacity": "1 mJ/K", "conductance": "1 uW/K"}  # of a body that nobody would miss


@cache
def old() -> Fitted:
    """Two bodies whose belt differs from run to run, in a room whose sensor is off by another amount in each."""
    known = two_bodies(
        mechanisms__belt__parameters__power=POWER, surroundings={"room": {"channel": "room", "per_batch": "0.5 K"}}
    )
    return fitted(known, runs(known, mechanisms__belt__parameters__power=POWER, count=4))


def first(part: TwinPart, group: str, **new: Any) -> TwinPart:
    """The part with these members before all others."""
    return part.model_copy(update={group: {**new, **getattr(part, group)}})


def larger() -> TwinPart:
    """Two bodies more and a heat more, each before what was there."""
    part = first(
        old().part, "bodies", quill=Body(capacity=Value(value="2 J/K")), cover=Body(capacity=Value(value="1 J/K"))
    )
    part = first(
        part,
        "links",
        **{
            "cover-shaft": Link(between=("cover", "shaft"), conductance=Value(value="1 uW/K")),
            "quill-head": Link(between=("quill", "head"), conductance=Value(value="2 uW/K", spread=0.5)),
            "quill-shaft": Link(between=("quill", "shaft"), conductance=Value(value="1 uW/K")),
        },
    )
    lamp = MechanismPart(
        law="cabinet_heat", into="head", parameters={"heat": Value(value="1 uW", spread=0.5, per_batch=0.3)}
    )
    return first(part, "mechanisms", lamp=lamp)


def carried(part: TwinPart, free_starts: bool = False) -> tuple[CalibrationProblem, Array, list[Array]]:
    network = compile_network(old().machine, part=part)
    new = on_network(old().problem, old().batches, network, free_starts)
    z = carried_z(old().problem, new, old().z)
    return new, x_of(new.unknowns, z), carried_nuisances(old().problem, new, old().fitted_nuisance)


def gap(problem: CalibrationProblem, x: Array, nuisance: list[Array]) -> float:
    """The largest change of a residual, in units of its noise."""
    before = old().problem.residuals(old().x, old().fitted_nuisance)
    after = problem.residuals(x, nuisance)
    return max(float(np.abs(b - a).max()) for b, a in zip(before, after, strict=True))


@pytest.mark.parametrize("free_starts", [False, True])
def test_what_nobody_would_miss_changes_nothing(free_starts: bool) -> None:
    assert max(float(np.abs(v).max()) for v in old().fitted_nuisance) > 0.5  # else a mix-up would not show
    problem, x, nuisance = carried(larger(), free_starts)
    assert gap(problem, x, nuisance) < 1e-3


def test_parameters_keep_their_values_and_new_ones_stand_at_their_priors() -> None:
    problem, x, _ = carried(larger())
    before = dict(zip((u.name for u in old().problem.unknowns), old().x, strict=True))
    after = dict(zip((u.name for u in problem.unknowns), x, strict=True))
    assert set(after) - set(before) == {"links.quill-head.conductance", "mechanisms.lamp.heat"}
    assert {n: after[n] for n in before} == pytest.approx(before)
    assert after["links.quill-head.conductance"] == pytest.approx(np.log(2e-6))


def test_a_value_stays_where_its_prior_moves() -> None:
    link = Link(between=("shaft", "head"), conductance=Value(value="20 W/K", spread=0.2))
    part = old().part.model_copy(update={"links": {"shaft-head": link}})
    problem, x, nuisance = carried(part)
    assert gap(problem, x, nuisance) < 1e-9


def test_each_batchs_own_unknowns_are_carried_by_name() -> None:
    _, _, nuisance = carried(larger())
    for before, after in zip(old().fitted_nuisance, nuisance, strict=True):
        shaft, head, room, belt, *errors = before
        quill, cover, *bodies, own_room, lamp, own_belt, z = after
        assert (bodies, own_room, own_belt, [z]) == ([shaft, head], room, belt, errors)
        assert quill == cover == lamp == 0.0


def test_a_new_body_starts_as_the_one_that_it_is_linked_with_most() -> None:
    for free_starts, spread in ((False, 0.0), (True, 1.0)):
        problem, _, _ = carried(larger(), free_starts)
        bodies = list(problem.network.bodies)
        start = dict(zip(bodies, problem.start_degC.T, strict=True))
        known = dict(zip(old().problem.network.bodies, old().problem.start_degC.T, strict=True))
        assert np.abs(known["shaft"] - known["head"]).max() > 0.1
        for name, like in (("shaft", "shaft"), ("head", "head"), ("cover", "shaft"), ("quill", "head")):
            np.testing.assert_array_equal(start[name], known[like])
        own = problem.nuisances.start_K.max(axis=1)
        assert own.tolist() == [spread, spread, 1.0, 1.0]


def test_a_body_that_is_cut_finer_starts_at_its_mean() -> None:
    bar = (
        old().part.bodies["head"].model_copy(update={"shape": "bar", "cells": 3, "conductance": Value(value="1 MW/K")})
    )
    part = old().part.model_copy(update={"bodies": {**old().part.bodies, "head": bar}})
    problem, x, nuisance = carried(part)
    cells = problem.network.bodies["head"]
    np.testing.assert_array_equal(problem.start_degC[:, cells], np.repeat(old().problem.start_degC[:, [1]], 3, axis=1))
    assert gap(problem, x, nuisance) < 0.02  # a thousandth of a kelvin: the bar conducts as well as it can
    coarse = on_network(problem, old().batches, old().problem.network)
    np.testing.assert_allclose(coarse.start_degC, old().problem.start_degC)


def test_batches_keep_the_substeps_that_they_need() -> None:
    problem, _, _ = carried(larger())
    assert problem.inputs.every == old().problem.inputs.every
    assert problem.measured is old().problem.measured


def test_a_refit_of_the_same_part_stays_where_it_is() -> None:
    again = refitted(old(), old().part)
    assert np.abs(again.z - old().z).max() < 0.05
    assert again.batches is old().batches and again.runs == 4
