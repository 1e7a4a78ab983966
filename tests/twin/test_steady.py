"""The steady state against hand calculation and a long simulation."""

from __future__ import annotations

import numpy as np
import pytest

from data.errors import InputError
from tests.twin.drives import GREASE, at, drive, network
from twin.simulation import simulate
from twin.simulation.start import steady_state


def test_two_bodies_by_hand() -> None:
    """120 W into the shaft: 1 W/K and 12 in series with 8 W/K to the room."""
    net = network()
    found = steady_state(net, {"rpm": 6000.0}, 20.0)
    shaft = 120 / (1 + 1 / (1 / 12 + 1 / 8))
    np.testing.assert_allclose(found.degC - 20, [shaft, shaft * 12 / 20], rtol=1e-8)
    np.testing.assert_allclose(found.heat_W, [120.0])
    np.testing.assert_allclose(sorted(found.edge_W_per_K), [1, 8, 12])


def test_with_feedback_as_a_long_simulation_settles() -> None:
    net = network(mechanisms=GREASE)
    found = steady_state(net, {"rpm": 4000.0}, {"room": 15.0})
    time_s = np.arange(0, 400_001.0, 1000.0)
    out = simulate(net, net.values, drive(time_s, rpm=4000.0, room=15.0), at(15, net), keep_cells=True)
    assert out.cells_degC is not None
    np.testing.assert_allclose(found.degC, out.cells_degC[0, 0, -1], atol=2e-4)
    np.testing.assert_allclose(found.heat_W[0], out.heat_W["friction"][0, 0, -1], rtol=1e-5)
    assert found.factor[0] > 2 and found.edge_W_per_K[1] == pytest.approx(found.factor[0])


def test_what_is_missing_or_misspelt_is_told() -> None:
    net = network()
    with pytest.raises(InputError, match="no value for driver 'rpm'; add it"):
        steady_state(net, {}, 20.0)
    with pytest.raises(InputError, match="no driver 'rmp' in the twin; did you mean 'rpm'"):
        steady_state(net, {"rpm": 1.0, "rmp": 1.0}, 20.0)
    with pytest.raises(InputError, match="no temperature for surrounding 'room'"):
        steady_state(net, {"rpm": 1.0}, {"floor": 20.0})


def test_a_body_that_only_radiates_settles_where_it_radiates_its_heat() -> None:
    glow = {"law": "radiation", "at": {"body": "head", "surrounding": "room"}, "into": "head"}
    net = network(exposures={}, mechanisms__glow=glow)
    found = steady_state(net, {"rpm": 6000.0}, 20.0)
    watts = dict(zip([h.law.name for h in net.heats], found.heat_W, strict=True))
    assert watts["belt"] == pytest.approx(120.0)
    assert watts["glow"] == pytest.approx(-120.0, abs=1e-6)
    assert found.degC[1] > 40.0
