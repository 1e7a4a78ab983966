"""A heat whose size differs from run to run: each batch has a deviation of its own, of known prior."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from data.arrays import Array
from data.batch import Batch
from data.errors import InputError
from tests.diagnosis.small_cases import four_bodies, two_bodies
from tests.twin.recordings import empty_batches, recorded
from twin.calibration.least_squares import Fit, FitOptions, fit
from twin.calibration.problem import CalibrationProblem, Nuisances
from twin.compile import compile_network
from twin.network import Network
from twin.simulation import simulate
from twin.simulation.inputs import inputs_of

FACTORS = (0.8, 1.25, 1.0, 0.7, 1.1, 1.4)
POWER = {"value": "120 W", "spread": 0.4}
VARYING: dict[str, Any] = {"mechanisms__belt__parameters__power": {**POWER, "per_batch": 0.3}}


def scattered() -> list[Batch]:
    """Runs whose belts make FACTORS times 120 W, each simulated by a machine of its own."""
    out = []
    for k, (batch, factor) in enumerate(zip(empty_batches(two_bodies(), len(FACTORS)), FACTORS, strict=True)):
        own = two_bodies(mechanisms__belt__parameters__power=f"{120 * factor} W")
        out += recorded(own, [batch], seed=k)
    return out


@cache
def calibrated(varying: bool) -> tuple[CalibrationProblem, Fit]:
    network = compile_network(two_bodies(**(VARYING if varying else {})))
    problem = CalibrationProblem.of(network, scattered())
    return problem, fit(problem, FitOptions(tolerance=1e-4, reweight=True))


def size_W(problem: CalibrationProblem, done: Fit) -> Array:
    """The belt's heat at its rated speed in every batch."""
    at = problem.nuisances.shared - 1
    power = problem.values_at(done.x)[problem.network.index("mechanisms.belt.power")]
    return np.array([power * np.exp(0.3 * own[at]) for own in done.nuisance])


def test_every_runs_own_size_is_found() -> None:
    problem, done = calibrated(True)
    assert done.converged
    got = size_W(problem, done) / problem.values_at(done.x)[problem.network.index("bodies.shaft.capacity")]
    np.testing.assert_allclose(got, 120.0 * np.array(FACTORS) / 5000.0, rtol=0.05)
    ratio = size_W(problem, done)
    np.testing.assert_allclose(ratio / ratio[2], FACTORS, rtol=0.03)
    assert done.noise_factor.max() < 1.2


def test_without_it_the_runs_contradict_each_other() -> None:
    _, done = calibrated(False)
    assert done.noise_factor.max() > 5


def blocks_problem() -> tuple[CalibrationProblem, Array, list[Array]]:
    """Two kinds of heat that vary, one of them by temperature too, at a point off the priors' mean."""
    known = two_bodies(
        surroundings={"room": {"channel": "room", "per_batch": "0.5 K"}},
        mechanisms__belt__parameters__power={**POWER, "per_batch": 0.3},
        mechanisms__friction={"law": "bearing_viscous", "drivers": "rpm", "into": {"shaft": 0.6, "head": "rest"},
                              "parameters": {"lubrication": {"value": 1.2, "per_batch": 0.2}}},
        mechanisms__grease={"law": "viscosity_feedback", "at": {"oil": "shaft"}, "acts_on": "friction"},
    )  # fmt: skip
    problem = CalibrationProblem.of(compile_network(known), scattered()[:3])
    problem = replace(problem, inputs=problem.inputs.refined(8))
    rng = np.random.default_rng(0)
    x = np.array([u.prior + 0.5 * u.spread * rng.standard_normal() for u in problem.unknowns])
    return problem, x, [rng.standard_normal(q) for q in problem.nuisance_sizes]


def test_derivatives_are_those_of_differences() -> None:
    problem, x, nuisance = blocks_problem()
    assert [problem.network.parameters[k].name for k in problem.nuisances.parameters] == [
        "mechanisms.belt.power", "mechanisms.friction.lubrication",
    ]  # fmt: skip
    blocks = list(problem.linearise(x, nuisance))
    step = 1e-3
    for b, block in enumerate(blocks):
        one = problem.only([b])
        for q in range(block.nuisance.shape[1]):
            move = step * np.eye(block.nuisance.shape[1])[q]
            up, down = (one.residuals(x, [nuisance[b] + s * move])[0] for s in (1, -1))
            expected = (down - up) / (2 * step)
            assert np.abs(expected).max() > 0.1
            np.testing.assert_allclose(block.nuisance[:, q], expected, atol=2e-3 * np.abs(expected).max())
    for p in range(len(x)):
        move = step * np.eye(len(x))[p]
        up, down = (np.concatenate(problem.residuals(x + s * move, nuisance)) for s in (1, -1))
        expected = (down - up) / (2 * step)
        got = np.concatenate([block.jacobian[:, p] for block in blocks])
        np.testing.assert_allclose(got, expected, atol=2e-3 * np.abs(expected).max())


def test_what_is_its_own_comes_after_starts_and_surroundings() -> None:
    problem, _, nuisance = blocks_problem()
    own = Nuisances.of(problem.network)
    assert (len(own.start_K), len(own.surroundings), len(own.parameters), own.shared) == (2, 1, 2, 5)
    np.testing.assert_allclose(own.size, [1.0, 1.0, 0.5, 0.3, 0.2])
    assert [len(v) for v in nuisance] == [6, 6, 6]  # and the first sample of z


def test_a_fixed_value_may_differ_from_run_to_run() -> None:
    network = compile_network(two_bodies(mechanisms__belt__parameters__power={"value": "120 W", "per_batch": 0.3}))
    assert network.index("mechanisms.belt.power") not in network.free
    problem = CalibrationProblem.of(network, scattered())
    done = fit(problem, FitOptions(tolerance=1e-4, reweight=True))
    np.testing.assert_allclose(size_W(problem, done), 120 * np.array(FACTORS), rtol=0.03)


# Inputs.with_own


def shown(network: Network, batches: list[Batch], times: dict[str, Array], values: Array | None = None) -> Array:
    inputs = inputs_of(network, batches, 2).with_own(times)
    start = np.full((1, len(batches), network.n_cells), 21.0)
    return simulate(network, network.values if values is None else values, inputs, start, tolerance_K=1e-9).readings[0]


@pytest.mark.parametrize("law", ["friction", "guides"])
def test_times_scale_the_heat_of_one_law_in_each_batch(law: str) -> None:
    known = four_bodies(mechanisms__grease={"law": "viscosity_feedback", "at": {"oil": "head"}, "acts_on": "friction"})
    network = compile_network(known)
    name = {"friction": "mechanisms.friction.lubrication", "guides": "mechanisms.guides.friction"}[law]
    for batch, factor in zip(empty_batches(known, 3), (0.5, 1.0, 2.0), strict=True):
        got = shown(network, [batch], {law: np.array([factor])})
        values = network.values.copy()
        values[network.index(name)] *= factor
        np.testing.assert_allclose(got, shown(network, [batch], {}, values), atol=1e-9)
        assert (np.abs(got - shown(network, [batch], {})).max() > 0.01) == (factor != 1.0)


def test_times_go_with_their_batches_and_leave_no_trace() -> None:
    network = compile_network(two_bodies())
    inputs = inputs_of(network, empty_batches(two_bodies(), 3))
    start = np.full((1, 3, 2), 21.0)
    before = simulate(network, network.values, inputs, start).readings
    double = inputs.with_own({"belt": np.array([1.0, 1.0, 2.0])})
    hot = simulate(network, network.values, double, start).readings
    np.testing.assert_array_equal(simulate(network, network.values, inputs, start).readings, before)
    np.testing.assert_array_equal(hot[0, :2], before[0, :2])
    one = double.batch([2])
    assert one.times["belt"].tolist() == [2.0]
    np.testing.assert_allclose(simulate(network, network.values, one, start[:, :1]).readings[0, 0], hot[0, 2])
    assert double.refined(2).times is double.times and inputs.times == {}


# What a machine file may say


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (0.0, r"got 0\.0, expected a number above 0 \(or leave it out"),
        (-0.2, r"got -0\.2, expected a number above 0 \(or leave it out"),
        ("20 W", r"unit 'W' cannot be read as '1' .*write e\.g\. '1 1'"),
        ("much", r"expected a number with a unit such as '1 1', got 'much'"),
        (float("nan"), r"expected a finite number such as '1 1', got nan"),
    ],
)
def test_a_bad_deviation_is_told_in_one_line(given: Any, words: str) -> None:
    with pytest.raises(InputError, match=words) as error:
        compile_network(two_bodies(mechanisms__belt__parameters__power={**POWER, "per_batch": given}))
    assert str(error.value).startswith("machine two_bodies: twin.mechanisms.belt.power.per_batch: ")
    assert "\n" not in str(error.value)


def test_a_surroundings_own_offset_is_in_kelvin() -> None:
    with pytest.raises(InputError, match=r"surroundings\.room\.per_batch: unit 'W' cannot be read as 'K'"):
        compile_network(two_bodies(surroundings={"room": {"channel": "room", "per_batch": "2 W"}}))
