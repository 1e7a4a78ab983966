"""The structural null: finer machines, the same recordings' evidence, and the gain that they make of nothing."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from diagnosis.contracts import Fitted
from diagnosis.fitting.fitted import carried_nuisances, carried_z, on_network
from diagnosis.policy import POLICY
from diagnosis.screening.screen import Screen, proposed, screen
from diagnosis.search.null import Null, refined, structural_null
from tests.diagnosis.small_cases import consistent, fitted, four_bodies, runs
from twin.calibration.least_squares import x_of
from twin.compile import compile_network


@cache
def four() -> Fitted:
    return fitted(four_bodies(), runs(four_bodies(), count=4))


@cache
def seen(machine: str) -> tuple[Fitted, Screen, dict[str, int]]:
    done = {"two": consistent, "four": four}[machine]()
    found = screen(done, proposed(done))
    return done, found, {s.candidate.name: s.column for s in found.scored if s.column >= 0}


# The threshold, from a null that is given


def given(gain: list[list[float]], density: list[list[float]]) -> Null:
    shape = (len(gain), len(gain[0]), 1)
    own = np.arange(float(np.prod(shape))).reshape(shape)  # as amplitudes
    return Null(np.array(gain), np.array(density), np.zeros(shape), own, ("lamp",))


def test_of_each_machine_the_largest_misfit_counts_that_predicts_no_worse() -> None:
    null = given([[1, 2, 3], [4, 5, 6], [7, 8, 9]], [[-1, -2, -3], [-5, -6, -7], [-1, -4, -2]])
    np.testing.assert_array_equal(null.typical(-2.0), [2, 4, 9])  # the second even at its smallest is worse
    np.testing.assert_array_equal(null.typical(-10.0), [3, 6, 9])
    np.testing.assert_array_equal(null.typical(0.0), [1, 4, 7])


def test_the_threshold_is_beyond_all_that_was_seen() -> None:
    rng = np.random.default_rng(0)
    gain = rng.gumbel(5.0, 2.0, 10)
    null = given([[g] for g in gain], [[-1.0]] * 10)
    assert null.threshold(-1.0) >= gain.max()
    many = given([[g] for g in rng.gumbel(5.0, 2.0, 4000)], [[-1.0]] * 4000)
    exact = 5.0 - 2.0 * np.log(-np.log(0.99))
    quantile = replace(many, gain=np.minimum(many.gain, exact))  # only the largest would lift it
    assert quantile.threshold(-1.0) == pytest.approx(POLICY.null_margin * exact, rel=0.05)
    assert quantile.threshold(-1.0, margin=1.0) == pytest.approx(exact, rel=0.05)
    assert null.threshold(-1.0, 0.999) > null.threshold(-1.0, 0.99) > 0


def test_amplitudes_scatter_as_those_of_the_machines_that_count() -> None:
    null = given([[1, 2, 3], [4, 5, 6]], [[-1, -2, -3], [-1, -1, -1]])
    assert null.scatter("lamp", -2.0) == pytest.approx(
        POLICY.amplitude_scatter_factor * (1.0 + 0.95 * 4.0)
    )  # all positive: that is half of it
    signed = replace(null, amplitude=null.amplitude * np.array([1.0, -1.0])[:, None, None])
    assert signed.scatter("lamp", -2.0) == pytest.approx(
        POLICY.amplitude_scatter_factor * (1.0 + 0.9 * 4.0)
    )  # nine tenths from 1 to 5
    assert null.scatter("sun", -2.0) == 0.0
    assert given([[3.0]], [[-1.0]]).scatter("lamp", -1.0) == 0.0


def test_two_machines_say_nothing() -> None:
    assert given([[3.0], [4.0]], [[-1.0]] * 2).threshold(-1.0) == float("inf")


def test_a_candidate_that_structure_never_looks_like_has_a_lower_threshold() -> None:
    gain = np.random.default_rng(0).gumbel(200.0, 40.0, 14)
    own = np.stack([gain, np.full(14, 2.0)], axis=-1)[:, None]
    null = replace(given([[g] for g in gain], [[-1.0]] * 14), names=("lever", "lamp"), gains=own)
    assert null.threshold(-1.0, name="lamp") < 60 < null.threshold(-1.0, name="lever") <= null.threshold(-1.0)
    assert null.threshold(-1.0, name="swap") == null.threshold(-1.0)


# Refined machines


def test_a_refined_machine_is_the_same_machine_cut_finer() -> None:
    done = four()
    part = refined(done.part, done.problem.network, done.values, 0)
    network = compile_network(done.machine, part=part)
    assert network.n_cells == POLICY.null_cells * done.problem.network.n_cells
    assert {p.name for p in done.problem.network.parameters} <= {p.name for p in network.parameters}
    free = [network.parameters[k].name for k in network.free]
    assert free == [done.problem.network.parameters[k].name for k in done.problem.network.free]
    again = refined(done.part, done.problem.network, done.values, 0)
    other = refined(done.part, done.problem.network, done.values, 1)
    assert again == part != other
    places = [part.sensors[s].at.partition("@") for s in part.sensors]
    assert all(0 <= float(at) <= 1 for _, _, at in places)
    assert [body for body, _, _ in places] == [s.at for s in done.part.sensors.values()]


def test_it_stores_and_loses_the_same_heat() -> None:
    done = four()
    part = refined(done.part, done.problem.network, done.values, 3)
    network = compile_network(done.machine, part=part)
    for name, cells in network.bodies.items():
        (one,) = done.problem.network.bodies[name]
        whole = network.capacity_J_per_K(network.values)[cells].sum()
        assert whole == pytest.approx(done.problem.network.capacity_J_per_K(done.problem.network.values)[one])
    lost = [
        w.conductance_W_per_K(w.values).sum() for w in (network, done.problem.network)
    ]  # all but to the air cancels
    assert lost[0] == pytest.approx(lost[1], rel=1e-6)


def test_its_misfit_is_structure_and_no_noise() -> None:
    done = four()
    network = compile_network(done.machine, part=refined(done.part, done.problem.network, done.values, 0))
    problem = on_network(done.problem, done.batches, network)
    x = x_of(problem.unknowns, carried_z(done.problem, problem, done.state.z))
    after = problem.residuals(x, carried_nuisances(done.problem, problem, done.state.nuisance))
    before = done.problem.residuals(done.x, done.state.nuisance)
    largest = 0.0
    for m, b, a in zip(done.problem.measured, before, after, strict=True):
        misfit = b - a
        largest = max(largest, float(np.abs(misfit).max()))
        for c in m.usable:
            own = misfit[m.channel == c]
            assert np.corrcoef(own[1:], own[:-1])[0, 1] > 0.5
    assert largest > 1  # of the noise


# The null itself


@pytest.mark.parametrize("machine", ["two", "four"])
def test_it_has_every_machine_at_every_scale(machine: str) -> None:
    done, found, counts = seen(machine)
    null = structural_null(done, found.evidence, counts)
    channels = len(done.problem.channels)
    assert null.gain.shape == null.density.shape == (POLICY.null_machines, len(POLICY.null_scales))
    assert null.mean_squares.shape == (POLICY.null_machines, len(POLICY.null_scales), channels)
    assert null.amplitude.shape == (POLICY.null_machines, len(POLICY.null_scales), len(counts)) and null.names == tuple(
        counts
    )
    assert np.isfinite(null.gain).all() and (null.gain > -1e-6).all()
    worse = null.mean_squares.mean(axis=(0, 2))
    assert (np.diff(worse) > -0.01).all() and worse[-1] > worse[
        0
    ]  # the larger the misfit, the worse batches left out are predicted
    assert null.density.mean(axis=0)[0] > null.density.mean(axis=0)[-1]
    assert worse[0] == pytest.approx(1.0, abs=0.2) and worse[-1] > 1.1


def test_the_more_structure_may_leave_the_more_it_may_gain() -> None:
    done, found, counts = seen("two")
    null = structural_null(done, found.evidence, counts)
    assert null.gain[:, 0].max() < 5 and null.gain[:, -1].max() > 10
    assert null.threshold(float(null.density.max())) < 8 < 10 < null.threshold(-np.inf)


def test_only_what_would_be_an_alarm_counts() -> None:
    done, found, counts = seen("four")
    some = dict(list(counts.items())[-10:])
    every, few = (structural_null(done, found.evidence, c) for c in (counts, some))
    assert (few.gain <= every.gain + 1e-9).all() and (few.gain < every.gain).any()
    np.testing.assert_array_equal(few.density, every.density)


def test_progress_counts_the_machines() -> None:
    done, found, counts = seen("two")
    told: list[tuple[int, int]] = []
    structural_null(done, found.evidence, counts, progress=lambda n, of: told.append((n, of)))
    assert told == [(k + 1, POLICY.null_machines) for k in range(POLICY.null_machines)]
