"""Evidence with structure and the batches' own unknowns integrated out, against dense normal distributions."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.stats import multivariate_normal

from data.arrays import Array
from diagnosis.fitting.covariance import Covariance, alone_in, clipped
from diagnosis.fitting.marginal import Marginal

ROWS, BATCHES, CHANNELS = 7, 3, 2
P, K, OWN = 2, 3, 2


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
    covariance = Covariance((channel,) * BATCHES, roots, tuple(problem()["directions"]))
    return Marginal(covariance, problem()["own"], [np.zeros(OWN)] * BATCHES)


def columns(*names: str) -> list[Array]:
    return marginal().white([np.hstack([problem()[n][b] for n in names]) for b in range(BATCHES)])


def dense(names: list[str], batches: list[int]) -> float:
    """Log density of the target of some batches, everything else integrated out."""
    shared = np.vstack([np.hstack([problem()[n][b] for n in (*names, "directions")]) for b in batches])
    own = block_diag(*(problem()["own"][b] for b in batches))
    noise = block_diag(*(blocks()[CHANNELS * b + c] for b in batches for c in range(CHANNELS)))
    target = np.concatenate([problem()["target"][b][:, 0] for b in batches])
    cov = noise + shared @ shared.T + own @ own.T
    constant = 0.5 * len(target) * np.log(2.0 * np.pi)
    return float(multivariate_normal(np.zeros(len(target)), cov).logpdf(target)) + constant


def test_the_evidence_is_a_normal_density() -> None:
    grams = marginal().grams(columns("model", "target"))
    assert marginal().log_evidence(grams) == pytest.approx(dense(["model"], [0, 1, 2]))


def test_a_left_out_batch_gains_what_its_conditional_density_does() -> None:
    before, after = (marginal().grams(columns(*n, "target")) for n in (["model"], ["model", "more"]))
    got = marginal().foretold(after) - marginal().foretold(before)
    for b in range(BATCHES):
        rest = [k for k in range(BATCHES) if k != b]

        def conditional(names: list[str], rest: list[int] = rest) -> float:
            return dense(names, [0, 1, 2]) - dense(names, rest)

        assert got[b] == pytest.approx(conditional(["model", "more"]) - conditional(["model"]))


def test_directions_of_another_size_need_no_new_products() -> None:
    scale = np.array([0.5, 2.0, 0.0])
    grams = marginal().grams(columns("model", "target"))
    one = marginal().rescaled(scale)
    afresh = Marginal(one.covariance, problem()["own"], [np.zeros(OWN)] * BATCHES)
    assert one.log_evidence(grams.rescaled(scale)) == pytest.approx(
        afresh.log_evidence(afresh.grams(columns("model", "target")))
    )


def test_many_columns_are_multiplied_as_few_are() -> None:
    few, many = columns("model", "target"), columns("more")
    mixed, cross, squares = marginal().products(few, many)
    every = marginal().grams(columns("model", "target", "more"))
    np.testing.assert_allclose(mixed[:, 0], every.inner.sum(axis=0)[:-1, -1])
    np.testing.assert_allclose(cross[:, 0], every.cross.sum(axis=0)[:, -1])
    np.testing.assert_allclose(squares, every.inner.sum(axis=0)[-1, -1])


def test_what_is_left_is_least() -> None:
    x, grams = columns("model", "target"), marginal().grams(columns("model", "target"))
    z = marginal().optimum(grams)
    left = marginal().leftover(x, z, grams)
    nearby = marginal().leftover(x, z + 0.1, grams)
    assert sum(float(r @ r) for r in left) + z @ z < sum(float(r @ r) for r in nearby) + (z + 0.1) @ (z + 0.1)


def test_a_draw_is_alone_in_what_no_other_shows() -> None:
    rng = np.random.default_rng(0)
    base = 100.0 * rng.standard_normal((40, 2))
    shared = [np.column_stack([base, base @ [1.0, 1.0], rng.standard_normal(40)])]
    alone = alone_in(shared)[0]
    assert np.linalg.norm(alone[:, :3], axis=0).max() < 3.0
    assert np.linalg.norm(alone[:, 3]) > 0.8 * np.linalg.norm(shared[0][:, 3])


def test_no_draw_is_the_only_direction() -> None:
    drawn = [np.ones((5, 9)) * np.array([1.0] * 8 + [100.0])]
    size = np.linalg.norm(clipped(drawn)[0], axis=0)
    assert size[:8] == pytest.approx(np.sqrt(5.0)) and size[8] == pytest.approx(4.0 * np.sqrt(5.0))
