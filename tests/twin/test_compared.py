"""Simulated beside recorded: channels, units, residuals, and what does not fit together."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch, Channel
from data.errors import InputError
from tests.twin.drives import network
from twin.simulation import Simulation, simulate
from twin.simulation.inputs import inputs_of
from twin.views.compared import RMS_COLUMNS, compared, rms_table

CHANNELS = {
    "t_shaft": Channel("t_shaft", "temperature", "degC", 0.1),
    "t_head": Channel("t_head", "temperature", "degC", 0.1),
    "room": Channel("room", "ambient", "degC", 0.1),
    "rpm": Channel("rpm", "driver", "rpm"),
    "z": Channel("z", "error", "um", 1.0),
}


def recording(name: str, n: int, z_from_um: float = 0.0, without: str = "") -> Batch:
    table = pd.DataFrame({
        "time_s": 60.0 * np.arange(n), "t_shaft": 20.0, "t_head": 20.0, "room": 20.0, "rpm": 0.0, "z": z_from_um,
    })  # fmt: skip
    return Batch("two_bodies", name, table.drop(columns=without or []), CHANNELS, simulated=name == "computed")


def simulated(batches: list[Batch]) -> Simulation:
    net = network()
    return simulate(net, net.values, inputs_of(net, batches))


def test_at_rest_nothing_differs_and_the_probe_counts_from_its_first_reading() -> None:
    batches = [recording("computed", 30), recording("real", 20, z_from_um=7.0)]
    first, second = compared(simulated(batches), batches)
    assert first.channels == ("t_shaft", "t_head", "z") and first.units == ("K", "K", "um")
    assert first.simulated and not second.simulated
    assert first.recorded.shape == (3, 30) and second.recorded.shape == (3, 20)
    np.testing.assert_allclose(first.residual, 0.0, atol=1e-9)
    np.testing.assert_allclose(second.recorded[2], 0.0, atol=1e-9)
    np.testing.assert_allclose(second.rms, 0.0, atol=1e-9)


def test_residual_and_rms_by_hand() -> None:
    batch = recording("real", 30)
    batch.table.loc[15:, "t_head"] = 20.4
    batch.table.loc[0:4, "t_shaft"] = np.nan
    (shown,) = compared(simulated([batch]), [batch])
    assert shown.residual[1, -1] == pytest.approx(0.4) and shown.rms[1] == pytest.approx(0.4 * np.sqrt(0.5))
    table = rms_table([shown])
    assert list(table.columns) == list(RMS_COLUMNS)
    assert table.set_index("channel")["rows"].to_dict() == {"t_shaft": 25, "t_head": 30, "z": 30}


def test_a_channel_that_a_batch_lacks_is_left_out() -> None:
    batch = recording("real", 30, without="t_head")
    (shown,) = compared(simulated([batch]), [batch])
    assert shown.channels == ("t_shaft", "z")


def test_other_recordings_are_told() -> None:
    batches = [recording("one", 30), recording("two", 20)]
    done = simulated(batches)
    with pytest.raises(InputError, match="the simulation is of one, two, got recordings two, one; give the batches"):
        compared(done, batches[::-1])
    with pytest.raises(InputError, match="batch one: the simulation has 30 rows, the recording 25"):
        compared(done, [recording("one", 25), batches[1]])
