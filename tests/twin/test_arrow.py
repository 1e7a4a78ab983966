"""Steps of parameters and nuisances together: what they promise is what a linear cost falls by."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from twin.calibration.arrow import assemble
from twin.calibration.fit_problem import Block, Unknown

UNKNOWNS = tuple(Unknown(f"p{k}", "1", 0.0, 1.0) for k in range(3))
FREE = np.full(3, np.inf)


@pytest.mark.parametrize("damping", [0.0, 1.0, 1e4, 1e10])
@pytest.mark.parametrize("share", [1.0, 0.3, 1e-6])
def test_a_step_falls_by_what_it_promises_however_little_of_the_nuisances_moves(damping: float, share: float) -> None:
    rng = np.random.default_rng(5)
    blocks = [
        Block(f"b{k}", 30 * rng.standard_normal(20), rng.standard_normal((20, 3)), np.zeros((20, 2)), np.zeros(20, int))
        for k in range(2)
    ]
    for block in blocks:  # nuisances that a parameter imitates, far from their optimum
        block.nuisance[:] = block.jacobian[:, :2] + 0.05 * rng.standard_normal((20, 2))
    nuisance, z = [np.array([40.0, -30.0]), np.array([-20.0, 50.0])], np.zeros(3)
    arrow = assemble(blocks, nuisance, z, UNKNOWNS, np.ones(1))

    def cost(dz: NDArray[np.float64], moves: list[NDArray[np.float64]]) -> float:
        left = [b.residual - b.jacobian @ dz - b.nuisance @ m for b, m in zip(blocks, moves, strict=True)]
        prior = float(dz @ dz) + sum(float((n + m) @ (n + m)) for n, m in zip(nuisance, moves, strict=True))
        return prior + sum(float(r @ r) for r in left)

    dz = arrow.step(damping, -FREE, FREE)
    fall = cost(z, [np.zeros(2)] * 2) - cost(dz, [c.step(dz, share) for c in arrow.corners])
    assert fall > 0
    assert arrow.gain(dz, share) == pytest.approx(fall, rel=1e-3, abs=1e-6 * cost(z, [np.zeros(2)] * 2))
