"""A fit whose rows remember each other: the same problem filtered, and no channel given up for the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from diagnosis.contracts import Fitted
from diagnosis.fitting.regression import Filtered, Memory, memory_left, settle_filtered
from diagnosis.policy import POLICY
from diagnosis.search import null as refined
from tests.diagnosis.small_cases import cold_floor, consistent, fitted, four_bodies
from tests.twin.recordings import empty_batches, recorded
from twin.calibration.least_squares import FitOptions, noise_left, x_of
from twin.calibration.least_squares import settled as annealed
from twin.compile import compile_network
from twin.schema import twin_part


def alike(done: Fitted, share: float, rows: float) -> Memory:
    """Every channel remembers the same."""
    k = len(done.problem.channels)
    return Memory(np.full(k, share), np.full(k, float(np.exp(-1.0 / rows))))


def test_rows_without_memory_are_the_problems_own() -> None:
    done = consistent()
    problem, state = done.problem, done.state
    plain = Filtered(problem, Memory.none(len(problem.channels)))
    for got, want in zip(
        plain.linearise(done.x, state.nuisance), problem.linearise(done.x, state.nuisance), strict=True
    ):
        np.testing.assert_array_equal(got.residual, want.residual)
        np.testing.assert_array_equal(got.jacobian, want.jacobian)
        np.testing.assert_array_equal(got.nuisance, want.nuisance)


def test_derivatives_are_those_of_the_filtered_rows() -> None:
    done = consistent()
    filtered = Filtered(done.problem, alike(done, 0.8, 6.0))
    step = 1e-4 * np.array([u.spread for u in done.problem.unknowns])
    before = filtered.residuals(done.x, done.state.nuisance)
    after = filtered.residuals(done.x + step, done.state.nuisance)
    for block, b, a in zip(filtered.linearise(done.x, done.state.nuisance), before, after, strict=True):
        np.testing.assert_allclose(block.residual, b, atol=1e-9)
        expected = block.jacobian @ step
        assert np.abs(expected).max() > 1e-4
        np.testing.assert_allclose(b - a, expected, atol=0.02 * np.abs(expected).max())


def test_noise_is_that_of_the_rows_and_not_less_than_given() -> None:
    done = cold_floor()
    none = Filtered(done.problem, Memory.none(len(done.problem.channels)))
    raw = noise_left(done.problem, done.state).factor
    left = done.problem.residuals(done.x, done.state.nuisance)
    noise = none.noise_of(left, done.state.arrow.effective_parameters())
    np.testing.assert_allclose(noise.factor, raw, rtol=1e-6)
    assert (consistent().noise.factor >= 1.0).all()
    # of the rows, not of their innovations: a slow misfit is as large as it looks
    assert cold_floor().noise.factor.max() > 5.0 and cold_floor().memory.inflation.max() > 5.0


def test_it_ends_where_it_stands() -> None:
    done = consistent()
    again = settle_filtered(done.problem, done.state, steps=4, tolerance=0.01, rounds=10)
    assert np.abs(again.z - done.state.z).max() < 0.1
    memory = memory_left(done.problem, done.problem.residuals(x_of(done.problem.unknowns, again.z), again.nuisance))
    np.testing.assert_array_equal(memory.share, done.memory.share)


def test_no_channel_is_given_up_for_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Castings that one temperature does not tell: by channels weighted alone the head would be left 50 times its
    noise, for a spindle and a displacement that fit to the last digit."""
    monkeypatch.setattr(refined, "POLICY", replace(POLICY, null_biot=(1.0, 5.0)))
    known, network = four_bodies(), compile_network(four_bodies())
    finer = refined.refined(twin_part(known), network, network.values, seed=7)
    truth = known.model_copy(update={"twin": finer.model_dump(mode="json", by_alias=True, exclude_none=True)})
    done = fitted(known, recorded(truth, empty_batches(known, 6), compile_network(truth).values, seed=7))
    started, _ = annealed(done.problem, FitOptions(reweight=True, tolerance=1e-2, max_iterations=40))
    assert noise_left(done.problem, started).factor.max() > 30.0
    assert done.noise.factor.max() < 12.0
