"""The screen: evidence against quadrature and dense matrices, planted effects first, none where nothing is missing."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from data.arrays import Array
from data.batch import Batch
from data.machine import Machine
from diagnosis.candidates.library import candidates
from diagnosis.contracts import Scored
from diagnosis.policy import POLICY
from diagnosis.structure.fit import StructuralFit, baseline
from diagnosis.structure.mild import mild_laws
from diagnosis.structure.null import Null
from diagnosis.structure.rows import Linear
from diagnosis.structure.screen import Prior, Screen, best_variants, moved, never_reported, proposed, screen
from tests.diagnosis.small_cases import DRIFT, FLOOR, SHIFT, four_bodies, runs, two_bodies
from twin.schema import twin_part

LAMP = {"law": "cabinet_heat", "into": "head", "parameters": {"heat": "30 W"}}
COLD = {**FLOOR, "parameters": {"conductance": "2 W/K"}}
BACKWARDS = {**DRIFT, "acts_on": "t_shaft", "parameters": {"rate": "-0.4 K/h"}}
# by name: the machine, what it conceals, the candidate that says so, its amplitude and size
PLANTED: dict[str, tuple[Any, dict[str, Any], str, str, float]] = {
    "drift": (two_bodies, DRIFT, "sensor_drift_t_head", "rate", 0.3),
    "drift downwards": (two_bodies, BACKWARDS, "sensor_drift_t_shaft", "rate", -0.4),
    "cold floor": (two_bodies, COLD, "floor_sink_head_room", "conductance", 2.0),
    "shift": (four_bodies, SHIFT, "speed_shift_z_rpm", "shift", 6.0),
    "lamp": (four_bodies, LAMP, "cabinet_heat_head", "heat", 30.0),
}  # fmt: skip


def fitted(known: Machine, batches: list[Batch]) -> StructuralFit:
    return baseline(known, twin_part(known), batches)


@cache
def consistent() -> StructuralFit:
    """Two bodies, nothing concealed."""
    return fitted(two_bodies(), runs(two_bodies()))


@cache
def of(case: str) -> tuple[StructuralFit, Screen]:
    if case == "nothing":
        return consistent(), screen(consistent())
    make, hidden, *_ = PLANTED[case]
    now = fitted(make(), runs(make(), {"own": hidden}))
    return now, screen(now)


def threshold(seen: Screen) -> float:
    return Null(seen.gains.max(axis=1)).threshold()


# The evidence for one amplitude


@pytest.mark.parametrize("centre", [0.0, 1.0, -2.0])
@pytest.mark.parametrize(("b", "m"), [(0.0, 0.0), (0.0, 4.0), (3.0, 2.0), (-8.0, 5.0), (40.0, 30.0)])
def test_evidence_of_a_normal_prior_is_its_integral(centre: float, b: float, m: float) -> None:
    prior = Prior(centre, 1.5)
    whole, _ = quad(
        lambda g: np.exp(b * g - 0.5 * m * g**2) * norm.pdf(g, centre, 1.5), -20, 20, points=[0.0, 1.0], limit=200
    )
    assert float(prior.evidence(np.array(b), np.array(m))) == pytest.approx(np.log(whole), abs=1e-6)


@pytest.mark.parametrize(("centre", "log_sd"), [(2.0, 1.5), (0.05, 1.5), (30.0, 0.6)])
@pytest.mark.parametrize("share", [0.3, 1.0, 3.0])
@pytest.mark.parametrize("z", [-3.0, 0.0, 1.0, 3.0, 8.0])
def test_evidence_of_a_log_normal_prior_is_its_integral(centre: float, log_sd: float, share: float, z: float) -> None:
    """`z` is the amplitude over its sd, as the rows alone have it; the prior ends at three sd of the logarithm."""
    truth = share * centre
    m = (max(abs(z), 1.0) / truth) ** 2
    b = z * np.sqrt(m)
    whole, _ = quad(
        lambda s: np.exp(b * centre * np.exp(log_sd * s) - 0.5 * m * (centre * np.exp(log_sd * s)) ** 2) * norm.pdf(s),
        -3.0, 3.0, limit=400,
    )  # fmt: skip
    expected = float(np.log(whole / (norm.cdf(3.0) - norm.cdf(-3.0))))
    # against the sign all of it comes from the smallest amplitude, where the grid ends
    within = 0.2 if z < 0 else 0.02
    assert float(Prior(centre, 0.0, log_sd).evidence(np.array(b), np.array(m))) == pytest.approx(expected, abs=within)


def test_evidence_is_for_many_at_once_and_signs_are_in_the_prior() -> None:
    b, m = np.array([[-6.0, 0.0], [6.0, 2.0]]), np.full((2, 2), 4.0)
    for prior in (Prior(0.0, 2.0), Prior(1.5, 0.0, 1.0)):
        one = [[float(prior.evidence(np.array(x), np.array(4.0))) for x in row] for row in b]
        np.testing.assert_allclose(prior.evidence(b, m), one)
    signed, positive = Prior(0.0, 2.0), Prior(1.5, 0.0, 1.0)
    assert float(signed.evidence(b[0, 0], m[0, 0])) == pytest.approx(float(signed.evidence(b[1, 0], m[1, 0])))
    assert float(positive.evidence(b[0, 0], m[0, 0])) < 0.0 < float(positive.evidence(b[1, 0], m[1, 0]))
    assert signed.best(-6.0, 4.0) == pytest.approx(-6.0 / (4.0 + 0.25))
    assert positive.best(-6.0, 4.0) > 0.0


@pytest.mark.parametrize("log_sd", [0.6, 1.5])
def test_the_best_amplitude_is_the_rows_where_they_say_much_and_the_priors_else(log_sd: float) -> None:
    prior = Prior(2.0, 0.0, log_sd)
    assert prior.best(1e4 * 3.0, 1e4) == pytest.approx(3.0, rel=0.03)
    assert prior.best(0.0, 0.0) == pytest.approx(2.0, rel=0.03)


# Planted effects


USUAL = ("drift",)  # the others with -m slow


@pytest.mark.parametrize("case", [pytest.param(c, marks=[] if c in USUAL else pytest.mark.slow) for c in PLANTED])
def test_what_is_planted_comes_first_with_its_size(case: str) -> None:
    *_, name, amplitude, size = PLANTED[case]
    _, seen = of(case)
    first = best_variants(seen.scored)[0]
    assert first.candidate.plain == name and first.gain > threshold(seen)
    assert first.amplitudes[amplitude] == pytest.approx(size, rel=0.5)
    assert seen.best is seen.scored[0] and first.gain == seen.scored[0].gain


def test_where_nothing_is_missing_nothing_reaches_the_threshold() -> None:
    _, seen = of("nothing")
    assert len(seen.scored) > 50 and seen.scored[0].gain < 0.5 * threshold(seen)
    assert max(s.gain for s in seen.free) < 0.5 * threshold(seen)


@pytest.mark.parametrize("case", ["nothing", "drift", "lamp"])
def test_all_are_in_order_and_inflated_by_one_or_more(case: str) -> None:
    now, seen = of(case)
    for every in (seen.scored, seen.free):
        assert [s.gain for s in every] == sorted((s.gain for s in every), reverse=True)
    assert set(seen.inflation) == {s.candidate.name for s in (*seen.scored, *seen.free)}
    assert min(seen.inflation.values()) >= 1.0
    assert set(seen.names) == {s.candidate.name for s in seen.scored}
    assert now.structure is not None
    count = sum(d.shape[1] for d in now.structure.other)
    assert seen.gains.shape == (count, len(seen.scored)) and seen.free_gains.shape == (count, len(seen.free))
    assert all(0.0 <= s.absorbed <= 1.0 for s in seen.scored)


def test_what_structure_may_imitate_counts_less_where_there_is_structure() -> None:
    """A strong unknown heat passes for structure until it is named: then every signature is imitated more."""
    calm, structured = (np.array(list(of(case)[1].inflation.values())) for case in ("nothing", "lamp"))
    assert np.median(calm) < 1.1 and np.median(structured) > 2.0


def test_a_seed_draws_only_the_null() -> None:
    now, seen = of("drift")
    again, other = screen(now), screen(now, seed=1)
    assert [(s.candidate.name, s.gain) for s in again.scored] == [(s.candidate.name, s.gain) for s in seen.scored]
    assert not np.array_equal(other.gains, seen.gains)
    assert other.scored[0].candidate.name == seen.scored[0].candidate.name
    assert other.scored[0].gain == pytest.approx(seen.scored[0].gain, rel=0.2)


# Against dense matrices


def dense(now: StructuralFit) -> tuple[Array, Linear]:
    """The marginal covariance (n, n) of all rows: structure, parameters and the batches' own unknowns."""
    assert now.covariance is not None
    linear = Linear.at(now.problem, now.state.z, now.state.nuisance)
    prior = now.covariance.prior_of([u.name for u in now.problem.unknowns])
    white = now.covariance.whitened(np.eye(linear.rows.n))
    known = np.hstack([linear.jacobian * prior, linear.nuisance])
    return np.linalg.inv(white.T @ now.covariance.projected(white)) + known @ known.T, linear


def signature(now: StructuralFit, seen: Screen, s: Scored) -> Array:
    """The column (n,) of a candidate, in units of the given noise."""
    assert now.covariance is not None
    return np.linalg.solve(now.covariance.whitened(np.eye(now.covariance.rows.n)), seen.whitened[:, s.column])


def test_gain_amplitude_and_sd_are_those_of_the_dense_gaussian() -> None:
    now, seen = of("drift")
    marginal, linear = dense(now)
    for name in ("sensor_drift_t_head", "speed_shift_z_rpm", "sensor_offset_t_shaft"):
        s = next(s for s in seen.scored if s.candidate.name == name)
        column, inflation = signature(now, seen, s), seen.inflation[name]
        at = np.linalg.solve(marginal, column)
        b, m = float(at @ linear.target) / inflation, float(at @ column) / inflation
        assert seen.square[s.column] == pytest.approx(m * inflation, rel=1e-6)
        assert s.sd == pytest.approx(1.0 / np.sqrt(m), rel=1e-6)
        (amplitude,) = s.amplitudes.values()
        spread = np.sqrt(1.0 / (b / amplitude - m))  # of the prior about 0, as the shrinking says
        assert s.gain == pytest.approx(float(Prior(0.0, spread).evidence(np.array(b), np.array(m))), rel=1e-4)
        assert amplitude == pytest.approx(b / m, rel=0.1)


def test_what_is_projected_out_is_hardly_left_in_a_signature() -> None:
    """Starts and parameters that the rows determine: their own shape is gone from every candidate."""
    now, seen = of("drift")
    assert now.covariance is not None
    linear = Linear.at(now.problem, now.state.z, now.state.nuisance)
    prior = now.covariance.prior_of([u.name for u in now.problem.unknowns])
    known = now.covariance.whitened(np.hstack([linear.jacobian * prior, linear.nuisance]))
    rest = now.covariance.projected(known)
    shown = np.einsum("nk,nk->k", known, rest) > 100.0  # the rows say ten times what the prior does
    assert shown.sum() > 10
    chosen = [s.column for s in seen.scored[:40]]
    before = np.abs(rest[:, shown].T @ seen.whitened[:, chosen])
    after = np.abs(known[:, shown].T @ seen.projected[:, chosen])
    assert after.max() < 0.05 * before.max()
    unit = np.sqrt(seen.square[chosen])
    assert (after / unit / np.linalg.norm(known[:, shown], axis=0)[:, None]).max() < 0.1


def test_likeness_is_the_cosine_beyond_all_that_is_recalibrated() -> None:
    now, seen = of("drift")
    marginal, _ = dense(now)
    some = [s for s in seen.scored if s.candidate.amplitudes][:6]
    columns = np.column_stack([signature(now, seen, s) for s in some])
    gram = columns.T @ np.linalg.solve(marginal, columns)
    cosine = np.abs(gram) / np.sqrt(np.outer(np.diag(gram), np.diag(gram)))
    np.testing.assert_allclose(seen.likeness([s.column for s in some]), cosine, atol=1e-6)


def test_a_move_is_the_step_of_a_joint_least_squares_fit() -> None:
    """The fit's own parameters once the candidate enters: by a dense solution with one column more."""
    now, seen = of("cold floor")
    s = moved(seen.scored[0], seen)
    assert now.covariance is not None
    linear = Linear.at(now.problem, now.state.z, now.state.nuisance)
    prior = now.covariance.prior_of([u.name for u in now.problem.unknowns])
    white = now.covariance.whitened(np.eye(linear.rows.n))
    inverse = white.T @ now.covariance.projected(white)
    known = np.hstack([linear.jacobian * prior, linear.nuisance])
    (amplitude,) = s.amplitudes.values()
    shown = amplitude * signature(now, seen, s)
    hessian = known.T @ inverse @ known + np.eye(known.shape[1])
    expected = -np.linalg.solve(hessian, known.T @ inverse @ shown)[: len(prior)] * prior
    np.testing.assert_allclose(s.moves, expected, rtol=1e-5, atol=1e-8)
    assert np.abs(expected).max() > 0.1


# What is screened


def test_mild_physics_and_places_of_sensors_are_no_candidates() -> None:
    now, seen = of("lamp")
    every = proposed(now)
    loose = never_reported(every, now)
    assert "natural_convection_head_room" in loose and any(name.startswith("sensor_place") for name in loose)
    shown = {s.candidate.name for s in (*seen.scored, *seen.free)} | set(seen.left_out)
    assert not loose & shown
    assert {c.name for c in every if c.mechanism == "cabinet_heat"} <= shown


def test_mild_films_are_of_bodies_whose_film_is_stated() -> None:
    now, _ = of("lamp")
    every = candidates(now.machine, twin_part(now.machine), ("natural_convection",))
    found = mild_laws(now.part, now.problem, now.values, every)
    exposed = {"natural_convection_spindle_room", "natural_convection_head_room", "natural_convection_bed_room"}
    assert exposed <= set(found) and "natural_convection_column_room" not in found
    film = now.values[now.problem.network.index("exposures.head-room.conductance")]
    assert found["natural_convection_head_room"] == pytest.approx(POLICY.film_area_sd * film)
