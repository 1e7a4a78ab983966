"""A simulation starts where its sensors show the first readings, whatever they add to what they see."""

from __future__ import annotations

import numpy as np
import pytest

from tests.twin.drives import drive, network
from twin.simulation import simulate, start_of

TIMES_S = np.array([0.0, 60.0])


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
    inputs = drive(TIMES_S, room=20.0, first=26.0)
    assert start_of(net, net.values, inputs)[0, 0] == pytest.approx(body_degC, abs=1e-4)
    if sensor.get("bonding") != 0.1:
        assert simulate(net, net.values, inputs).readings[0, 0, 0, 0] == pytest.approx(26.0, abs=1e-4)
