"""A model as a program gives what `predict` gives: features, delays, holes, state; the contract has every family."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from data.batch import Batch
from data.errors import InputError
from models.base import Family
from models.families import FAMILIES
from models.program import Program, State, replay

PROGRAMS = [key for key, family in FAMILIES.items() if family.has_program()]
KINDS = ("t0", "t1@rate", "t2@ambient", "t3@lag30min", "t1@start", "spindle_rpm", "spindle_rpm@lag20min", "room")
Batches = Callable[..., list[Batch]]


def rows_of(program: Program, batch: Batch) -> np.ndarray:
    return np.column_stack([batch.masked(c) for c in program.channels] or [np.empty((batch.n_rows, 0))])


def outputs(family: Family, batch: Batch) -> np.ndarray:
    program = family.program(batch.channels, batch.step_s)
    return replay(program, rows_of(program, batch))[:, 0]


@pytest.mark.parametrize("key", ["ridge", "distributed_lag", "lssvm", "gaussian_process"])
def test_every_kind_of_feature_and_the_level_as_published(key: str, toy_batches: Batches) -> None:
    *train, left = toy_batches(6, 40)
    for family in (FAMILIES[key](), FAMILIES[key]().as_published()):
        fitted = family.fit(train, KINDS, "z")
        assert np.abs(outputs(fitted, left) - fitted.predict(left)).max() < 1e-6


@pytest.mark.parametrize("options", [{"lags": "free", "lag_min": 7.0}, {"lags": "almon", "lag_min": 12.0}])
def test_delays_that_are_no_multiple_of_the_step(options: dict[str, object], toy_batches: Batches) -> None:
    *train, left = toy_batches(6, 40)
    fitted = FAMILIES["distributed_lag"](**options).fit(train, ("t0", "spindle_rpm"), "z")
    assert np.abs(outputs(fitted, left) - fitted.predict(left)).max() < 1e-6


@pytest.mark.parametrize("key", ["ridge", "distributed_lag", "lag_dictionary", "transfer_function"])
def test_a_hole_is_no_output_or_bridged_as_in_the_whole_batch(key: str, toy_batches: Batches) -> None:
    *train, left = toy_batches(6, 40)
    fitted = FAMILIES[key]().fit(train, ("t0", "t2"), "z")
    table = left.table.copy()
    table.loc[10:14, "t0"] = np.nan
    holed = replace(left, table=table)
    wanted, got = fitted.predict(holed), outputs(fitted, holed)
    assert (np.isnan(wanted) == np.isnan(got)).all()
    assert np.nanmax(np.abs(got - wanted)) < 1e-6


def test_it_and_its_state_are_plain_and_go_on_in_another_process(toy_batches: Batches) -> None:
    *train, left = toy_batches(6, 40)
    fitted = FAMILIES["lag_dictionary"]().fit(train, ("t0", "t1@rate"), "z")
    program = fitted.program(left.channels, left.step_s)
    rows = rows_of(program, left)
    text = json.dumps(program.as_plain(), default=lambda a: a.tolist())
    again = Program.from_plain(json.loads(text))
    run, state, got = program.runner(), program.begin(), []
    for k, row in enumerate(rows):
        if k == 3:
            run, state = again.runner(), State.from_plain(json.loads(json.dumps(state.as_plain())))
        got.append(run(state, row)[0])
    assert got == replay(program, rows)[:, 0].tolist()


def test_it_begins_where_every_channel_has_been_seen(toy_batches: Batches) -> None:
    *train, left = toy_batches(6, 40)
    fitted = FAMILIES["ridge"]().fit(train, ("t0", "t2"), "z")
    table = left.table.copy()
    table.loc[:4, "t2"] = np.nan
    late = replace(left, table=table)
    got = outputs(fitted, late)
    assert np.isnan(got[:5]).all() and got[5] == 0.0
    assert np.nanmax(np.abs(got - fitted.predict(late))) < 1e-6


def test_a_family_without_one_names_those_that_have_one(toy_batches: Batches) -> None:
    with pytest.raises(InputError, match=r"^family gru cannot be written as a program; those that can: zero, mean_"):
        FAMILIES["gru"]().program(toy_batches(1)[0].channels, 300.0)


def test_sums_that_count_rows_need_the_step_they_learned(toy_batches: Batches) -> None:
    fitted = FAMILIES["gm1n"]().fit(toy_batches(4, 40), ("t0", "t2"), "z")
    with pytest.raises(InputError, match=r"the step it learned from, 300 s; got difference, t0, t2 and 10 s"):
        fitted.program(toy_batches(1)[0].channels, 10.0)


def test_most_families_have_one() -> None:
    linear = {"mlr", "ridge", "pcr", "pls", "huber", "elastic_net"}
    lagged = {"distributed_lag", "lag_dictionary", "transfer_function", "thermal_exponential"}
    assert linear | lagged | {"bp", "lssvm", "svr", "random_forest", "axis_coupled"} <= set(PROGRAMS)
