"""What a law says of being linear holds: its derivative is the law itself, less its constant."""

from __future__ import annotations

import numpy as np
import pytest

from twin.mechanisms import MECHANISMS
from twin.mechanisms.base import Mechanism, View

LINEAR = [m for m in MECHANISMS.values() if m.linear_reading]
STEP = 1e-30


def test_the_usual_sensor_laws_are_linear() -> None:
    assert {m.key for m in LINEAR} >= {"sensor_lag", "sensor_bonding", "sensor_offset", "sensor_drift"}


@pytest.mark.parametrize("mechanism", LINEAR, ids=lambda m: m.key)
@pytest.mark.parametrize("step_s", [10.0, np.nan])
def test_a_derivative_is_the_law_less_its_constant(mechanism: type[Mechanism], step_s: float) -> None:
    rng = np.random.default_rng(0)
    seen, d_seen = rng.normal(20, 5, (2, 3, 40))
    ports, d_ports = ({role: rng.normal(20, 5, (3, 40)) for role in mechanism.ports} for _ in range(2))
    p = {s.name: np.full((1, 1), s.value + 0.5 * (s.value == 0)) for s in mechanism.parameters}
    time_s = np.cumsum(np.full((3, 40), 10.0), axis=1) - 10.0

    def shown(seen: np.ndarray, ports: dict[str, np.ndarray]) -> np.ndarray:
        return mechanism().reading(seen, View(degC=ports, rise_K=ports, time_s=time_s, step_s=step_s), p)

    ahead = shown(seen + 1j * STEP * d_seen, {r: t + 1j * STEP * d_ports[r] for r, t in ports.items()}).imag / STEP
    nothing = shown(np.zeros((3, 40)), dict.fromkeys(ports, np.zeros((3, 40))))
    np.testing.assert_allclose(shown(d_seen, d_ports) - nothing, ahead, rtol=1e-12, atol=1e-12)
