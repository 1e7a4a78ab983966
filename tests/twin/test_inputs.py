"""Recordings and plans as inputs: gaps, padding, substeps, and what is told when they cannot be used."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch, Finding
from data.errors import InputError
from tests.twin.drives import network
from tests.twin.machines import machine
from twin.run_plan import load_run_plan
from twin.simulation import simulate
from twin.simulation.inputs import inputs_of, inputs_of_plan, start_of_plan


def batch(n: int = 6, step_s: float = 60.0, batch_id: str = "b1", **columns: Any) -> Batch:
    time_s = np.arange(n) * step_s
    table = {
        "time_s": time_s, "t_shaft": 21.0 + 0 * time_s, "t_head": 20.5 + 0 * time_s, "room": 20.0 + time_s / 60,
        "rpm": np.arange(n) * 1000.0, "z": 0 * time_s,
    }  # fmt: skip
    table |= columns
    frame = pd.DataFrame({k: v for k, v in table.items() if v is not None})
    start = pd.Timestamp("2025-03-01 07:30")
    return Batch("two_bodies", batch_id, frame, machine().batch_channels(), start=start)


def test_a_driver_holds_and_a_surrounding_stands_at_the_borders() -> None:
    inputs = inputs_of(network(), [batch()])
    np.testing.assert_array_equal(inputs.drivers["rpm"], [[0, 1000, 2000, 3000, 4000]])
    np.testing.assert_array_equal(inputs.recorded["room"], [[20, 21, 22, 23, 24, 25]])
    np.testing.assert_array_equal(inputs.first["t_shaft"], [21.0])
    assert inputs.clock_h[0] == 7.5
    assert set(inputs.drivers) == {"rpm"} and set(inputs.recorded) == {"room"}


def test_substeps_cut_every_interval() -> None:
    inputs = inputs_of(network(), [batch(3)], substeps=3)
    np.testing.assert_allclose(inputs.time_s, [[0, 20, 40, 60, 80, 100, 120]])
    np.testing.assert_array_equal(inputs.drivers["rpm"], [[0, 0, 0, 1000, 1000, 1000]])
    np.testing.assert_allclose(inputs.recorded["room"][0], 20 + np.arange(7) / 3)
    assert inputs.every == 3 and inputs.n_intervals.tolist() == [6]
    np.testing.assert_allclose(inputs.dt_s, 20)


def test_batches_of_other_steps_and_lengths_stand_side_by_side() -> None:
    inputs = inputs_of(network(), [batch(6), batch(3, step_s=300.0, batch_id="b2")])
    assert inputs.n_intervals.tolist() == [5, 2]
    np.testing.assert_array_equal(inputs.drivers["rpm"][1], [0, 1000, 1000, 1000, 1000])
    np.testing.assert_array_equal(inputs.recorded["room"][1], [20, 25, 30, 30, 30, 30])
    np.testing.assert_array_equal(inputs.dt_s[:, 0], [60, 300])
    assert inputs.batch([1]).batch_ids == ("b2",)
    net = network()
    both = simulate(net, net.values, inputs)
    np.testing.assert_array_equal(both.valid.sum(axis=1), [6, 3])
    alone = simulate(net, net.values, inputs_of(net, [batch(3, step_s=300.0)]))
    np.testing.assert_allclose(both.readings[0, 1, :3], alone.readings[0, 0], rtol=1e-12)
    np.testing.assert_allclose(both.readings[0, 1, 3:], alone.readings[0, 0, [2, 2, 2]], rtol=1e-12)


def test_short_gaps_are_bridged_as_drivers_and_surroundings_behave() -> None:
    holes = batch(
        rpm=[1000.0, np.nan, np.nan, 3000.0, np.nan, np.nan], room=[np.nan, 21.0, np.nan, np.nan, 24.0, np.nan]
    )
    inputs = inputs_of(network(), [holes])
    np.testing.assert_array_equal(inputs.drivers["rpm"], [[1000, 1000, 1000, 3000, 3000]])
    np.testing.assert_allclose(inputs.recorded["room"], [[21, 21, 22, 23, 24, 24]])


def test_a_masked_stretch_is_a_gap_and_a_long_one_is_told() -> None:
    frozen = Finding("stuck", "room", "frozen", 120.0, 1200.0)
    masked = batch(40).with_findings((frozen,))
    with pytest.raises(InputError) as caught:
        inputs_of(network(), [batch(40, batch_id="good"), masked])
    assert str(caught.value) == (
        "batch b1: channel 'room' has no value from 120 s to 1260 s, longer than the 900 s that may be bridged "
        "(masked by stuck; if the values are right, add to overrule: - {batch: b1, channel: room, check: stuck, "
        "reason: ...}); cut the batch there, or widen max_gap_s"
    )
    inputs = inputs_of(network(), [masked], max_gap_s=1200)
    np.testing.assert_allclose(inputs.recorded["room"][0], 20 + np.arange(40.0))
    with pytest.raises(InputError, match="channel 'rpm' has no value from 60 s to 300 s, longer than the 100 s"):
        inputs_of(network(), [batch(rpm=[0.0, *[np.nan] * 5])], max_gap_s=100)


def test_first_readings_are_those_near_the_start() -> None:
    late = batch(40, t_shaft=[np.nan, 22.0, *[30.0] * 38], t_head=[*[np.nan] * 20, *[30.0] * 20])
    inputs = inputs_of(network(), [late])
    np.testing.assert_array_equal(inputs.first["t_shaft"], [22.0])
    assert np.isnan(inputs.first["t_head"]).all()


def test_a_batch_without_the_needed_channels_is_told_in_one_line() -> None:
    net = network()
    with pytest.raises(InputError) as caught:
        inputs_of(net, [batch(), batch(batch_id="other", rpm=None, room=None)])
    assert str(caught.value) == (
        "batch other: has none of the channels that the twin of two_bodies needs (rpm, room); check that it is a "
        "recording of this machine, or leave it out"
    )
    with pytest.raises(InputError, match="batch b1: no channel 'rpm', which the twin of two_bodies needs; record it"):
        inputs_of(net, [batch(rpm=None)])
    with pytest.raises(InputError, match="batch b1: channel 'rpm' has no value at all; leave the batch out"):
        inputs_of(net, [batch(rpm=np.full(6, np.nan))])
    with pytest.raises(InputError, match="batch b1: has 1 rows, a simulation needs 2 or more; leave it out"):
        inputs_of(net, [batch(1)])
    with pytest.raises(InputError, match="machine two_bodies: no batches to simulate; name at least one"):
        inputs_of(net, [])


def test_a_surrounding_of_first_readings_needs_one() -> None:
    net = network(surroundings={"room": {"channel": "room"}, "floor": {"first": ["t_head"]}}, exposures__head={
        "of": "head", "to": "floor", "value": "5 W/K"})  # fmt: skip
    assert simulate(net, net.values, inputs_of(net, [batch()]), keep_cells=True).air_degC[0, 0, -1].tolist() == [
        25,
        20.5,
    ]
    with pytest.raises(InputError, match="batch b1: surrounding 'floor' needs a first reading of t_head, and there is"):
        inputs_of(net, [batch(t_head=np.full(6, np.nan))])


PLAN = """
stages:
  - {minutes: 10, rpm: 3000}
  - {minutes: 5, rpm: 0}
surroundings: {room: {start: 20 degC, drift: 2 K/h}}
start: {head: 24 degC}
"""


def test_a_plan_is_a_batch(tmp_path) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "plan.yml"
    path.write_text(PLAN)
    net, plan = network(), load_run_plan(path, machine())
    inputs = inputs_of_plan(net, plan)
    assert inputs.n_intervals.tolist() == [90]
    assert inputs.drivers["rpm"][0, [0, 59, 60]].tolist() == [3000, 3000, 0]
    assert inputs.recorded["room"][0, -1] == pytest.approx(20.5)
    np.testing.assert_allclose(start_of_plan(net, plan), [[[20, 24]]])
    out = simulate(net, net.values, inputs, start_of_plan(net, plan))
    np.testing.assert_allclose(out.readings[0, 0, 0], [20, 24])
    assert out.readings[0, 0, 60, 0] > 20.5


def test_a_plan_may_give_a_constant_surrounding_and_must_give_a_recorded_one(tmp_path) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "plan.yml"
    path.write_text(PLAN)
    plan = load_run_plan(path, machine())
    net = network(surroundings={"room": {"channel": "room"}, "floor": {"value": "15 degC"}}, exposures__head={
        "of": "head", "to": "floor", "value": "5 W/K"})  # fmt: skip
    warm = replace(plan, surroundings=plan.surroundings | {"floor": np.full(91, 18.0)})
    for given, floor in ((plan, 15.0), (warm, 18.0)):
        out = simulate(net, net.values, inputs_of_plan(net, given), keep_cells=True)
        assert out.air_degC is not None
        np.testing.assert_allclose(out.air_degC[0, 0, :, 1], floor)
    with pytest.raises(InputError) as caught:
        inputs_of_plan(net, replace(plan, surroundings={}))
    assert str(caught.value) == (
        "run plan plan.yml: no surrounding 'room'; add surroundings: {room: 20 degC} or a column 'room'"
    )
    with pytest.raises(InputError, match=r"run plan plan\.yml: no driver 'rpm', which the twin needs"):
        inputs_of_plan(net, replace(plan, drivers={}))
