"""Forced responses against the simulation itself; free series against the dense Gaussian that they stand for."""

from __future__ import annotations

import numpy as np
import pytest

from diagnosis.localisation.free_series import Held, PlaceSearch, Point
from diagnosis.localisation.linearised import FitRows, ForcedNetwork, Hats
from tests.diagnosis.concealed import CHAIN, Case, case, coolant, empty, flux
from tests.twin.machines import machine
from twin.calibration.fit_problem import Noise
from twin.compile import compile_network
from twin.simulation import simulate
from twin.simulation.inputs import inputs_of


@pytest.fixture(scope="module")
def known() -> Case:
    return case(flux("saddle", linear="20 W"), count=3)


@pytest.fixture(scope="module")
def point(known: Case) -> Point:
    noise = Noise(np.linspace(1.0, 1.5, 6), np.linspace(1.0, 3.0, 6))
    return Point.of(known.problem, known.fit.x, known.fit.nuisance, Hats.over(4 * 3600.0), noise)


@pytest.mark.parametrize("substeps", [1, 3])
def test_heat_answers_as_the_simulation_does(substeps: int) -> None:
    """10 W more while the coolant is on: the linear network's channels move by ten times a watt's answer."""
    batches = empty(2)
    for k, b in enumerate(batches):
        for name in ("t_spindle", "t_head", "t_column", "t_bed"):
            b.table[name] = b.table["room"] + 0.1 * k
    changed = [
        compile_network(machine(CHAIN, mechanisms__flux=flux("saddle", linear=f"{p} W")["flux"])) for p in (0.0, 10.0)
    ]
    problem = Case.problem_of(changed[0], batches, substeps)
    x = np.array([u.prior for u in problem.unknowns])
    nuisance = [np.zeros(q) for q in problem.nuisance_sizes]
    forced = ForcedNetwork.of(problem, x, nuisance)
    inputs = inputs_of(changed[0], batches, substeps)
    before, after = (simulate(n, n.values, inputs, problem.start_degC[None]) for n in changed)
    on = np.stack([np.repeat(coolant(b, k)[:-1], substeps) for k, b in enumerate(batches)])
    channels = forced.answers(forced.weights[3:4], np.repeat(on[None, ..., None], 2, axis=-1))
    moved = np.concatenate([after.readings - before.readings, after.errors - before.errors], axis=-1)
    np.testing.assert_allclose(10 * channels, moved, atol=1e-9)
    assert np.abs(moved).max() > 0.5


def test_hats_are_a_watt_together(point: Point) -> None:
    time_s = np.linspace(0, 4 * 3600.0, 50)
    np.testing.assert_allclose(point.hats.at(time_s).sum(axis=-1), 1.0)
    np.testing.assert_allclose(point.hats.at(point.hats.knot_s), np.eye(9))
    assert len(Hats.over(60 * 3600.0).knot_s) == 25  # a long batch has them farther apart


def _dense(point: Point, held: list[Held], own: Held | None) -> float:
    """Log density of all rows as one Gaussian: noise, nuisances, parameters, series; up to a constant."""
    fitted, weight = point.search.fitted, point.search.noise.weight
    parts, residual, jacobian = [], [], []
    for b, block in enumerate(fitted.blocks):
        scale = np.sqrt(weight[block.channel])
        n = block.nuisance * scale[:, None]
        covariance = np.eye(len(n)) + n @ n.T
        for h in [*held, *([own] if own else [])]:
            rows = point.search.bases[h.basis].nuisance(h.place, h.sigma)[b] * scale[:, None]
            covariance += rows @ rows.T
        parts.append(covariance)
        # about the prior's centre: what the model shows there, if it were linear
        residual.append(scale * (block.residual + block.nuisance @ fitted.nuisance[b])
                        + scale * ((block.jacobian * fitted.spread) @ fitted.z))  # fmt: skip
        jacobian.append(block.jacobian * fitted.spread * scale[:, None])
    r, j = np.concatenate(residual), np.vstack(jacobian)
    whole = j @ j.T
    first = 0
    for c in parts:
        whole[first : first + len(c), first : first + len(c)] += c
        first += len(c)
    return float(-0.5 * (r @ np.linalg.solve(whole, r) + np.linalg.slogdet(whole)[1]))


@pytest.mark.parametrize("basis", [0, 1, 2])
@pytest.mark.parametrize("held", [[], [Held(0, 1, 12.0)], [Held(0, 1, 12.0), Held(2, 0, 0.2)]])
def test_gain_is_that_of_the_dense_gaussian(point: Point, basis: int, held: list[Held]) -> None:
    series = point.search.series(held)[basis]
    sigma = np.full(len(series.basis.places), 7.0 if basis == 0 else 0.4)
    gain = series.gains(sigma)
    for k in range(1, 2) if held else range(len(sigma)):
        if (basis, k) in [h.at for h in held]:
            continue
        dense = _dense(point, held, Held(basis, k, float(sigma[k]))) - _dense(point, held, None)
        assert gain[k] == pytest.approx(dense, abs=1e-5 * abs(dense) + 1e-4)


def test_best_amplitude_is_a_maximum(point: Point) -> None:
    for series in point.search.series():
        best = series.best
        for factor in (0.1, 0.5, 0.93, 1.07, 2.0, 10.0):
            assert (series.gains(best.sigma * factor) <= best.gain + 0.05).all()
        fine = np.geomspace(0.3, 3e4, 400)[:, None] * best.sigma / 100.0
        integral = np.logaddexp.reduce([series.gains(s) for s in fine], axis=0) - np.log(400)
        seen = best.gain > 5
        np.testing.assert_allclose(best.evidence[seen], integral[seen], atol=1.5)
        assert (best.evidence <= best.gain + 1e-9).all()


def test_posterior_is_that_of_the_dense_gaussian(point: Point) -> None:
    """Mean and sd of a series by the rows' own covariance, without any elimination."""
    search, place = point.search, 3
    series = search.series()[0]
    sigma = float(series.best.sigma[place])
    fitted, weight = search.fitted, search.noise.weight
    columns, residual, first = [], [], 0
    n_hats, p = len(point.hats.knot_s), len(fitted.z)
    count = sum(len(b.residual) for b in fitted.blocks)
    own = fitted.problem.nuisance_sizes
    prior_to_values = np.linalg.cholesky(np.exp(-np.abs(np.subtract.outer(*[point.hats.knot_s] * 2)) / 5400.0))
    whole = np.zeros((count, p + sum(own) + len(own) * n_hats))
    at = p
    for b, block in enumerate(fitted.blocks):
        rows = slice(first, first + len(block.residual))
        scale = np.sqrt(weight[block.channel])[:, None]
        whole[rows, :p] = block.jacobian * fitted.spread * scale
        whole[rows, at : at + own[b]] = block.nuisance * scale
        hats = slice(p + sum(own) + b * n_hats, p + sum(own) + (b + 1) * n_hats)
        whole[rows, hats] = scale * (search.bases[0].rows[b][place].T @ prior_to_values) * sigma
        residual.append(scale[:, 0] * block.residual)
        columns.append(hats)
        at, first = at + own[b], rows.stop
    stands = np.concatenate([fitted.z, *fitted.nuisance, np.zeros(len(own) * n_hats)])
    information = whole.T @ whole + np.eye(whole.shape[1])
    step = np.linalg.solve(information, whole.T @ np.concatenate(residual) - stands)
    covariance = np.linalg.inv(information)
    found = series.posterior(place)
    for b, hats in enumerate(columns):
        mean = sigma * prior_to_values @ step[hats]
        cov = sigma**2 * prior_to_values @ covariance[hats, hats] @ prior_to_values.T
        np.testing.assert_allclose(found.mean[b], mean, atol=1e-4 * np.abs(mean).max())
        np.testing.assert_allclose(found.sd[b], np.sqrt(np.diagonal(cov)), rtol=1e-4)
    weights = np.zeros((1, len(own), n_hats))
    weights[0, 0] = 1.0 / n_hats
    mean, sd = found.averages(weights)
    assert mean[0] == pytest.approx(found.mean[0].mean())
    cov = sigma**2 * prior_to_values @ covariance[columns[0], columns[0]] @ prior_to_values.T
    assert sd[0] == pytest.approx(np.sqrt(cov.mean()), rel=1e-4)


def test_noise_is_what_is_left_beside_the_series_held(known: Case, point: Point) -> None:
    """With the saddle's heat held nothing but noise is left; without it the sensors beside it show more."""
    search = PlaceSearch(FitRows.of(known.problem, known.fit.x, known.fit.nuisance), point.search.bases,
                         Noise.as_given(6))  # fmt: skip
    assert search.optimum([]).noise.factor[2] > 2.5
    assert search.optimum([search.best([])[0]]).noise.factor[2] < 2.0
