"""A machine of finite elements at finer steps and on a finer grid: the study of its convergence in small."""

from __future__ import annotations

import numpy as np
import pytest

from tests.plants.plant_cases import Array
from thermodrift_exam.plants.convergence import ELEMENTS_STEP_S, sensed_degC
from thermodrift_exam.plants.elements.geometry import draw_castings

pytestmark = pytest.mark.slow

SEED, EFFECT = 4, "preload_feedback"  # friction that the temperatures change: integrated explicitly


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_temperatures_at_the_sensors_converge_with_the_step_squared() -> None:
    drawn = draw_castings(SEED, False)
    at = [sensed_degC(drawn, drawn, SEED, EFFECT, step_s) for step_s in (100.0, 50.0, 25.0)]
    assert np.ptp(at[-1]) > 15.0
    assert np.log2(_rms(at[0] - at[1]) / _rms(at[1] - at[2])) == pytest.approx(2.0, abs=0.2)
    assert _rms(at[1] - at[2]) < 1e-3


@pytest.mark.slow
def test_a_grid_of_eight_cells_for_each_moves_the_sensors_by_little() -> None:
    plain, finer = draw_castings(SEED, False), draw_castings(SEED, False, 2)
    assert finer.structure.size > 4 * plain.structure.size
    one, other = (sensed_degC(d, plain, SEED, EFFECT, ELEMENTS_STEP_S) for d in (plain, finer))
    assert _rms(one - other) < 0.08  # of some 20 K
