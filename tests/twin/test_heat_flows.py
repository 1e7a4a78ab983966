"""Where the watts go: the balance closes, and each part is what an independent integration says."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from data.errors import InputError
from tests.twin.drives import GREASE, at, drive, network
from twin.network import Network
from twin.simulation import simulate
from twin.views.heat_flows import COLUMNS, HeatFlows, heat_flows

TIME_S = np.arange(0, 14401.0, 300.0)
STOPS = np.where(np.arange(48) % 16 < 10, 5000.0, 0.0)


def flows(net: Network, refine: int = 1, **given: Any) -> HeatFlows:
    given = {"rpm": STOPS, "room": 20 + TIME_S / 3600} | given
    inputs = drive(TIME_S, **given).refined(refine)
    simulation = simulate(net, net.values, inputs, at([24.0, 19.0], net), keep_cells=True)
    return heat_flows(simulation, inputs)


@pytest.mark.parametrize("mechanisms", [None, GREASE])
@pytest.mark.parametrize("refine", [1, 4])
def test_put_in_is_stored_or_taken(mechanisms: dict[str, Any] | None, refine: int) -> None:
    f = flows(network(**({"mechanisms": mechanisms} if mechanisms else {})), refine)
    put_in = sum(np.abs(w).max() for w in f.heat_W.values())
    assert put_in > 50 and max(np.abs(w).max() for w in f.storage_W.values()) > 10
    np.testing.assert_allclose(f.gap_W, 0.0, atol=1e-9 * put_in)
    assert len(f.time_s) == 49 and len(f.gap_W) == 48


def test_every_body_balances_by_its_own_links() -> None:
    f = flows(network(mechanisms=GREASE), 2)
    friction = f.heat_W["friction"]
    shaft = 0.7 * friction - f.link_W["shaft-head"] - f.link_W["shaft-room"]
    head = 0.3 * friction + f.link_W["shaft-head"] - f.link_W["head-room"]
    np.testing.assert_allclose(f.storage_W["shaft"], shaft, atol=1e-9 * np.abs(friction).max())
    np.testing.assert_allclose(f.storage_W["head"], head, atol=1e-9 * np.abs(friction).max())
    np.testing.assert_allclose(f.loss_W["room"], f.link_W["shaft-room"] + f.link_W["head-room"], atol=1e-9)


def test_exchange_is_what_a_fine_trapezoid_of_the_cells_says() -> None:
    net = network(mechanisms=GREASE)
    coarse = flows(net, 60)
    fine = drive(TIME_S, rpm=STOPS, room=20 + TIME_S / 3600).refined(60)
    out = simulate(net, net.values, replace(fine, every=1), at([24.0, 19.0], net), keep_cells=True)
    assert out.cells_degC is not None and out.air_degC is not None
    head, room = out.cells_degC[0, 0, :, 1], out.air_degC[0, 0, :, 0]
    watts = 8 * (head - room)
    expected = (0.5 * (watts[1:] + watts[:-1])).reshape(48, 60).mean(axis=1)
    np.testing.assert_allclose(coarse.link_W["head-room"], expected, atol=5e-4)


def test_a_speed_that_never_stays_counts_its_exchange_too() -> None:
    """Conductance that varies within a regime: the constant's part and what goes beyond it are one link's heat."""
    rpm = 3000 + 2500 * np.sin(np.arange(96) ** 1.3)
    time_s = 150.0 * np.arange(97)
    net = network(mechanisms=GREASE)
    inputs = drive(time_s, rpm=rpm, room=20.0)
    f = heat_flows(simulate(net, net.values, inputs, at([24.0, 19.0], net), keep_cells=True), inputs)
    friction = f.heat_W["friction"]
    np.testing.assert_allclose(f.gap_W, 0.0, atol=1e-9 * friction.max())
    shaft = 0.7 * friction - f.link_W["shaft-head"] - f.link_W["shaft-room"]
    np.testing.assert_allclose(f.storage_W["shaft"], shaft, atol=1e-9 * friction.max())
    fine = inputs.refined(20)
    out = simulate(net, net.values, replace(fine, every=1), at([24.0, 19.0], net), keep_cells=True)
    assert out.cells_degC is not None
    spin = 1 + net.values[net.index("mechanisms.spin.gain")] * (np.repeat(rpm, 20) / 6000) ** (2 / 3)
    driving = out.cells_degC[0, 0, :, 0] - 20
    expected = (spin * 0.5 * (driving[1:] + driving[:-1])).reshape(96, 20).mean(axis=1)
    np.testing.assert_allclose(f.link_W["shaft-room"], expected, rtol=2e-2)


def test_heat_that_one_body_takes_from_another_is_put_into_none() -> None:
    net = network(mechanisms__air={
        "law": "natural_convection", "at": {"body": "shaft", "air": "head"}, "into": "shaft",
    })  # fmt: skip
    f = flows(net, 4)
    np.testing.assert_allclose(f.heat_W["air"], 0.0)
    np.testing.assert_allclose(f.gap_W, 0.0, atol=1e-7)


def test_tables_are_long_and_their_energies_add_up() -> None:
    f = flows(network())
    table, totals = f.table(), f.totals()
    assert list(table.columns) == list(COLUMNS) and len(table) == 48 * (1 + 2 + 1 + 3)
    energy = totals.set_index(["kind", "name"])["energy_kJ"]
    assert energy["heat"].sum() == pytest.approx(energy["storage"].sum() + energy["loss"].sum(), rel=1e-9)
    assert energy["heat", "belt"] == pytest.approx(120 * (5000 / 6000) ** 1.5 * 30 * 300 / 1e3, rel=1e-9)
    row = table[(table.kind == "heat") & (table.name == "belt")].iloc[0]
    assert row.start_s == 0 and row.end_s == 300 and row.watts == pytest.approx(120 * (5000 / 6000) ** 1.5)
    assert totals.set_index(["kind", "name"])["share"]["heat", "belt"] == pytest.approx(1.0)


def test_a_body_of_several_cells_is_told_as_one() -> None:
    bar = {"capacity": "40 kJ/K", "material": "cast_iron", "shape": "bar", "cells": 5, "conductance": "9 W/K"}
    net = network(bodies__head=bar)
    inputs = drive(TIME_S, rpm=STOPS)
    f = heat_flows(simulate(net, net.values, inputs, keep_cells=True), inputs)
    assert set(f.storage_W) == {"shaft", "head"} and set(f.link_W) == {"shaft-head", "shaft-room", "head-room"}
    np.testing.assert_allclose(f.gap_W, 0.0, atol=1e-9 * 120)


def test_what_cannot_be_told_is_one_line() -> None:
    net, inputs = network(), drive(TIME_S, rpm=STOPS, n_batches=2)
    bare = simulate(net, net.values, inputs)
    with pytest.raises(InputError, match="kept no cells; simulate with keep_cells=True"):
        heat_flows(bare, inputs)
    kept = simulate(net, net.values, inputs, keep_cells=True)
    assert heat_flows(kept, inputs, batch="b1").batch_id == "b1"
    with pytest.raises(InputError, match="no batch 'b7'; did you mean"):
        heat_flows(kept, inputs, batch="b7")
    with pytest.raises(InputError, match="these inputs are not the simulation's"):
        heat_flows(kept, replace(inputs, time_s=inputs.time_s * 2))
    spun = network(mechanisms=GREASE)
    with pytest.raises(
        InputError, match="batch b0: conductances change between two rows; simulate with inputs of every"
    ):
        heat_flows(simulate(spun, spun.values, replace(inputs, every=4), keep_cells=True), inputs)
