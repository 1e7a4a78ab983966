"""What goes into a simulation and comes out of it: sets and batches at once, rows, starts, arrays that do not fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from data.errors import InputError
from tests.twin.drives import at, drive, network
from twin.simulation import simulate, start_of

# many at once


def test_many_sets_and_batches_are_what_they_are_one_by_one() -> None:
    net = network(mechanisms={
        "friction": {"law": "bearing_viscous", "drivers": "rpm", "into": {"shaft": 0.7, "head": "rest"}},
        "grease": {"law": "viscosity_feedback", "at": {"oil": "shaft"}, "acts_on": "friction"},
    })  # fmt: skip
    rng = np.random.default_rng(3)
    values = net.values * rng.uniform(0.8, 1.2, (4, len(net.values)))
    share = net.index("mechanisms.friction.into.shaft")
    values[:, share] = rng.uniform(0.2, 0.9, 4)
    time_s = np.arange(0, 3601.0, 60.0)
    rpm = rng.choice([0.0, 3000.0, 6000.0], (3, 60))
    inputs = drive(time_s, rpm=rpm, room=rng.uniform(15, 25, (3, 1)), n_batches=3)
    inputs = replace(inputs, n_intervals=np.array([60, 37, 5]))
    start = rng.uniform(15, 30, (4, 3, 2))
    offsets = rng.normal(0, 1, (4, 3, 1))
    out = simulate(net, values, replace(inputs, offsets_K=offsets), start, tolerance_K=1e-8)
    for p in range(4):
        for b in range(3):
            one = inputs.batch([b])
            m = int(one.n_intervals[0])
            cut = replace(
                one, time_s=one.time_s[:, : m + 1], drivers={"rpm": one.drivers["rpm"][:, :m]},
                recorded={"room": one.recorded["room"][:, : m + 1]},
            )  # fmt: skip
            cut = replace(cut, offsets_K=offsets[p : p + 1, b : b + 1])
            alone = simulate(net, values[p], cut, start[p : p + 1, b : b + 1], tolerance_K=1e-8)
            np.testing.assert_allclose(out.readings[p, b, : m + 1], alone.readings[0, 0], atol=1e-7)
            np.testing.assert_allclose(out.errors[p, b, : m + 1], alone.errors[0, 0], atol=1e-6)
            np.testing.assert_array_equal(out.valid[b], np.arange(61) <= m)


def test_sets_are_worked_on_in_groups_of_bounded_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    net = network()
    values = net.values * np.linspace(0.9, 1.1, 5)[:, None]
    inputs = drive(np.arange(0, 3601.0, 60.0), rpm=4000.0)
    whole = simulate(net, values, inputs, keep_cells=True)
    monkeypatch.setattr("twin.simulation.run.CHUNK_BYTES", 1)
    parts = simulate(net, values, inputs, keep_cells=True)
    np.testing.assert_allclose(parts.readings, whole.readings, rtol=1e-13)
    assert whole.cells_degC is not None and parts.cells_degC is not None
    np.testing.assert_allclose(parts.cells_degC, whole.cells_degC, rtol=1e-13)
    np.testing.assert_allclose(parts.heat_J["belt"], whole.heat_J["belt"], rtol=1e-13)


def test_rows_may_be_fewer_than_intervals() -> None:
    net = network()
    inputs = drive(np.arange(0, 3601.0, 60.0), rpm=4000.0)
    every = simulate(net, net.values, inputs)
    some = simulate(net, net.values, replace(inputs, every=6))
    np.testing.assert_allclose(some.readings, every.readings[:, :, ::6], rtol=1e-13)
    np.testing.assert_allclose(some.time_s, every.time_s[:, ::6])


# start


def test_the_start_follows_the_first_readings_and_settles_the_rest() -> None:
    net = network(sensors__t_head=None)
    inputs = drive(np.array([0.0, 60.0]), room=20.0, first=26.0)
    start = start_of(net, net.values, inputs)
    np.testing.assert_allclose(start, [[26.0, (12 * 26 + 8 * 20) / 20]], rtol=1e-5)
    np.testing.assert_allclose(start_of(net, net.values, inputs, steady=True), [[20.0, 20.0]], atol=1e-6)
    blind = replace(inputs, first={"t_shaft": np.array([np.nan])})
    np.testing.assert_allclose(start_of(net, net.values, blind), [[20.0, 20.0]], atol=1e-9)
    assert start_of(net, net.values[None], inputs).shape == (1, 1, 2)


def test_a_law_of_the_start_is_added() -> None:
    warm = {"law": "initial_state", "into": "head", "parameters": {"excess": "3 K"}}
    net = network(mechanisms={"warm": warm})
    out = simulate(net, net.values, drive(np.array([0.0, 60.0])), at(20, net))
    np.testing.assert_allclose(out.readings[0, 0, 0], [20, 23])


def test_bad_arrays_are_told_in_one_line() -> None:
    net = network()
    inputs = drive(np.array([0.0, 60.0]))
    wrong = net.values.copy()
    wrong[2] = np.nan
    name = net.parameters[2].name
    with pytest.raises(InputError, match=f"machine two_bodies: parameter {name} is nan .* in set 0, expected a finite"):
        simulate(net, wrong, inputs)
    with pytest.raises(InputError, match=r"start temperatures have shape \(1, 1, 3\), expected .* = \(…, 1, 2\)"):
        simulate(net, net.values, inputs, np.zeros((1, 1, 3)))
    with pytest.raises(InputError, match="start is 'cold', expected 'settled' or temperatures"):
        simulate(net, net.values, inputs, "cold")
    with pytest.raises(InputError, match=r"offsets of surroundings have shape \(1, 1, 4\), expected"):
        simulate(net, net.values, replace(inputs, offsets_K=np.zeros((1, 1, 4))))


@pytest.mark.parametrize(
    ("sensor", "body_degC"),
    [
        ({"offset": "2 K"}, 24.0),
        ({"air": "room", "bonding": 0.75}, 28.0),  # 26 = 20 + 0.75 (28 - 20)
        ({"air": "room", "bonding": 0.75, "offset": "3 K"}, 24.0),
        ({"lag": "60 s"}, 26.0),
        ({"air": "room", "bonding": 0.1}, 26.0),  # shows the air: taken as it is
    ],
)
def test_the_start_undoes_what_a_sensor_adds(sensor: dict[str, object], body_degC: float) -> None:
    net = network(sensors__t_shaft={"at": "shaft", **sensor})
    inputs = drive(np.array([0.0, 60.0]), room=20.0, first=26.0)
    assert start_of(net, net.values, inputs)[0, 0] == pytest.approx(body_degC, abs=1e-4)
    if sensor.get("bonding") != 0.1:
        assert simulate(net, net.values, inputs).readings[0, 0, 0, 0] == pytest.approx(26.0, abs=1e-4)
