"""Evidence with structure, starts and values integrated out at any sizes of these, against dense normal densities."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.stats import multivariate_normal

from data.arrays import Array
from data.errors import WorkError
from diagnosis.fitting.covariance import Covariance, clipped, specific_component
from diagnosis.fitting.marginal import Grams, Hyper, Marginal
from diagnosis.policy import POLICY

ROWS, BATCHES, CHANNELS = 7, 3, 2
ALL = list(range(BATCHES))
P, K, OWN = 2, 3, 2
DRAWN, STARTS = 2, 1  # of the directions, and of each batch's own unknowns
HYPERS = [Hyper(), Hyper(0.5, 0.25, 0.3), Hyper(0.0, 0.0, 0.1), Hyper(1.0, 0.5, 1.0)]


@cache
def problem() -> dict[str, list[Array]]:
    rng = np.random.default_rng(4)
    n = ROWS * CHANNELS
    sizes = {"model": P, "directions": K, "own": OWN, "target": 1, "more": 1}
    return {name: [rng.standard_normal((n, q)) for _ in range(BATCHES)] for name, q in sizes.items()}


@cache
def blocks() -> list[Array]:
    rng = np.random.default_rng(5)
    roots = [rng.standard_normal((ROWS, ROWS)) for _ in range(CHANNELS * BATCHES)]
    return [np.eye(ROWS) + 0.3 * r @ r.T for r in roots]


@cache
def marginal() -> Marginal:
    channel = np.repeat(np.arange(CHANNELS), ROWS)
    roots = tuple(
        {c: np.linalg.inv(np.linalg.cholesky(blocks()[CHANNELS * b + c])) for c in range(CHANNELS)}
        for b in range(BATCHES)
    )
    factor = np.ones(CHANNELS)
    covariance = Covariance((channel,) * BATCHES, roots, tuple(problem()["directions"]), factor, drawn=DRAWN)
    return Marginal(covariance, problem()["own"], [np.zeros(OWN)] * BATCHES, STARTS)


def columns(*names: str) -> list[Array]:
    return marginal().white([np.hstack([problem()[n][b] for n in names]) for b in range(BATCHES)])


def grams(*names: str) -> Grams:
    return marginal().grams(columns(*names))


def dense(names: list[str], batches: list[int], hyper: Hyper, sd: dict[str, float] | None = None) -> float:
    """Log density of the target of some batches, everything else integrated out; `sd` of columns with a prior of their
    own."""
    size = np.repeat([hyper.structure, hyper.imperfections], [DRAWN, K - DRAWN])
    scaled = {"directions": size} | {n: np.ones(1) for n in names}
    scaled |= {n: np.array([value]) for n, value in (sd or {}).items()}
    every = [*names, *(sd or {}), "directions"]
    shared = np.vstack([np.hstack([problem()[n][b] * scaled[n] for n in every]) for b in batches])
    own_size = np.where(np.arange(OWN) < STARTS, hyper.starts, 1.0)
    own = block_diag(*(problem()["own"][b] * own_size for b in batches))
    noise = block_diag(*(blocks()[CHANNELS * b + c] for b in batches for c in range(CHANNELS)))
    target = np.concatenate([problem()["target"][b][:, 0] for b in batches])
    cov = noise + shared @ shared.T + own @ own.T
    constant = 0.5 * len(target) * np.log(2.0 * np.pi)
    return float(multivariate_normal(np.zeros(len(target)), cov).logpdf(target)) + constant


every_hyper = pytest.mark.parametrize("hyper", HYPERS, ids=str)


@every_hyper
def test_the_evidence_is_a_normal_density_at_any_sizes(hyper: Hyper) -> None:
    """Of what is integrated out; the sizes scale products that are worked out once."""
    assert marginal().level(hyper).log_evidence(grams("model", "target")) == pytest.approx(dense(["model"], ALL, hyper))


@every_hyper
def test_a_left_out_batch_has_its_conditional_density(hyper: Hyper) -> None:
    got = marginal().level(hyper).log_predictive_density(grams("model", "target"))
    for b in ALL:
        rest = [k for k in ALL if k != b]
        assert got[b] == pytest.approx(dense(["model"], ALL, hyper) - dense(["model"], rest, hyper))


@every_hyper
def test_a_candidate_is_screened_as_if_it_were_one_more_column_of_the_model(hyper: Hyper) -> None:
    """Its log Bayes factor for an amplitude of prior sd 3, its amplitude, and by how much the parameters move."""
    level, sd = marginal().level(hyper), 3.0
    scores = level.screened(grams("model", "target"), marginal().many(columns("model", "target"), columns("more")))
    precision = scores.left[0] + 1.0 / sd**2
    gain = 0.5 * scores.residual[0] ** 2 / precision - 0.5 * np.log(sd**2 * precision)
    assert gain == pytest.approx(dense(["model"], ALL, hyper, {"more": sd}) - dense(["model"], ALL, hyper))
    c = level.reduced(grams("model", "more", "target"))
    z = np.linalg.solve(c[:-1, :-1] + np.diag([1.0] * P + [1.0 / sd**2]), c[:-1, -1])
    assert scores.residual[0] / precision == pytest.approx(z[-1])
    without = level.optimum(grams("model", "target"))
    np.testing.assert_allclose(without - scores.shadow[:, 0] * z[-1], z[:-1])


def test_without_a_batch_all_of_it_is_as_if_that_had_not_been_recorded() -> None:
    """The optimum of a fold solves the normal equations of the dense covariance of the other batches."""
    hyper = HYPERS[1]
    for b in ALL:
        rest = [k for k in ALL if k != b]
        size = np.repeat([hyper.structure, hyper.imperfections], [DRAWN, K - DRAWN])
        shared = np.vstack([problem()["directions"][k] * size for k in rest])
        own_size = np.where(np.arange(OWN) < STARTS, hyper.starts, 1.0)
        own = block_diag(*(problem()["own"][k] * own_size for k in rest))
        cov = block_diag(*(blocks()[CHANNELS * k + c] for k in rest for c in range(CHANNELS)))
        inverse = np.linalg.inv(cov + shared @ shared.T + own @ own.T)
        x, y = (np.vstack([problem()[n][k] for k in rest]) for n in ("model", "target"))
        z = np.linalg.solve(x.T @ inverse @ x + np.eye(P), x.T @ inverse @ y)[:, 0]
        np.testing.assert_allclose(marginal().level(hyper).optimum(grams("model", "target"), b), z)


@pytest.mark.parametrize("begin", [Hyper(0.5, 0.5, 0.3), Hyper(), Hyper(0.0, 0.0, 0.1)], ids=str)
def test_the_climb_to_the_likeliest_sizes_never_ends_below_its_start_nor_beside_a_higher_neighbour(
    begin: Hyper,
) -> None:
    own = grams("model", "target")
    best, most = marginal().likeliest(own, begin)
    assert most == marginal().level(best).log_evidence(own) >= marginal().level(begin).log_evidence(own)
    assert all(marginal().level(h).log_evidence(own) <= most for h in best.near())


def test_a_step_of_the_grid_is_one_size_further_and_ends_with_it() -> None:
    grids = (POLICY.structure_scales, POLICY.imperfection_scales, POLICY.start_scales)
    low, high = (Hyper(*(grid[end] for grid in grids)) for end in (0, -1))
    names = ("structure", "imperfections", "starts")
    assert set(low.near()) == {replace(low, **{n: grid[1]}) for n, grid in zip(names, grids, strict=True)}
    assert set(high.near()) == {replace(high, **{n: grid[-2]}) for n, grid in zip(names, grids, strict=True)}
    assert len(set(Hyper(*(grid[1] for grid in grids)).near())) == 6


@every_hyper
def test_what_is_left_is_least(hyper: Hyper) -> None:
    level, x, own = marginal().level(hyper), columns("model", "target"), grams("model", "target")
    z = level.optimum(own)

    def cost(z: Array) -> float:
        """Twice the negative log posterior of directions, own unknowns and z, but for a constant."""
        c = level.reduced(own)
        return float(c[-1, -1] - 2.0 * z @ c[:-1, -1] + z @ (c[:-1, :-1] + np.eye(P)) @ z)

    assert all(cost(z) < cost(z + 0.1 * move) for move in (*np.eye(P), *-np.eye(P)))
    left = level.leftover(x, z, own)
    size = np.repeat([hyper.structure, hyper.imperfections], [DRAWN, K - DRAWN])
    own_size = np.where(np.arange(OWN) < STARTS, hyper.starts, 1.0)
    along = np.vstack([d * size for d in marginal().along])
    every = np.hstack([along, block_diag(*(n * own_size for n in marginal().nuisance))])
    aim = np.concatenate([r @ np.append(-z, 1.0) for r in x])
    taken = np.linalg.solve(every.T @ every + np.eye(every.shape[1]), every.T @ aim)
    np.testing.assert_allclose(np.concatenate(left), aim - every @ taken)


def test_the_specific_component_of_a_draw_is_what_no_other_shows() -> None:
    rng = np.random.default_rng(0)
    base = 100.0 * rng.standard_normal((40, 2))
    shared = [np.column_stack([base, base @ [1.0, 1.0], rng.standard_normal(40)])]
    alone = specific_component(shared)[0]
    assert np.linalg.norm(alone[:, :3], axis=0).max() < 3.0
    assert np.linalg.norm(alone[:, 3]) > 0.8 * np.linalg.norm(shared[0][:, 3])


def test_no_draw_is_the_only_direction() -> None:
    drawn = [np.ones((5, 9)) * np.array([1.0] * 8 + [100.0])]
    size = np.linalg.norm(clipped(drawn)[0], axis=0)
    assert size[:8] == pytest.approx(np.sqrt(5.0)) and size[8] == pytest.approx(4.0 * np.sqrt(5.0))


def test_derivatives_that_no_machine_has_are_said_to_be_so() -> None:
    """A start that has run away: its derivatives are beyond what numbers of 53 bits can be inverted with."""
    wild = [1e12 * np.column_stack([n[:, 0], n[:, 0]]) for n in problem()["own"]]
    at = [np.zeros(n.shape[1]) for n in wild]
    with pytest.raises(WorkError, match="cannot be linearised"):
        Marginal(marginal().covariance, wild, at, 1).level(Hyper())
