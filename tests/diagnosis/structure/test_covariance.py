"""The covariance of all rows against dense matrices, its scales against data drawn from it, and its white noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from data.arrays import Array
from diagnosis.structure import covariance as module
from diagnosis.structure.covariance import (
    Blocks,
    Covariance,
    covariance_at,
    freedom,
    normal_equations,
    objective,
    recalibrated,
    white_noise,
    with_columns,
)
from diagnosis.structure.policy import STRUCTURE
from diagnosis.structure.rows import Linear, Rows
from twin.calibration.fit_problem import Unknown

P, OWN, CHANNELS, PER_CHANNEL = 3, 2, 3, (7, 5, 8)  # shared and own unknowns, rows of each channel in a batch
UNKNOWNS = (Unknown("a", "W/K", 0.0, 0.5), Unknown("b", "um/K", 1.0, 2.0, scale="linear"), Unknown("c", "W", 0.0, 3.0))
SD = np.array([1.0, 1.5, 2.0])
SCALES = np.array([1.0, 0.4])
WAVES = 15  # of a channel's misfit


def rows_of(batches: int, counts: tuple[int, ...] = PER_CHANNEL) -> Rows:
    one = np.repeat(np.arange(len(counts)), counts)
    return Rows(np.tile(one, batches), np.arange(batches + 1) * len(one), len(counts))


def linear_of(rows: Rows, residual: Array, seed: int = 0) -> Linear:
    """Random columns about a point off the priors' means."""
    rng = np.random.default_rng(seed)
    nuisance = np.zeros((rows.n, OWN * rows.batches))
    for k in range(rows.batches):
        nuisance[rows.batch(k), OWN * k : OWN * (k + 1)] = rng.standard_normal((len(rows.channel[rows.batch(k)]), OWN))
    return Linear(
        rows, rng.standard_normal(P), rng.standard_normal(OWN * rows.batches), residual,
        2.0 * rng.standard_normal((rows.n, P)), nuisance, np.arange(rows.batches + 1) * OWN,
    )  # fmt: skip


@dataclass(frozen=True)
class Dense:
    """A small problem, its covariance as the module makes it, and the same as a matrix."""

    linear: Linear
    draws: tuple[Array, ...]
    mild: tuple[Array, Array]  # films, varying
    made: Covariance

    @property
    def free(self) -> Array:
        return freedom(UNKNOWNS)

    def recalibrated(self, draws: Array) -> Array:
        """What least squares with priors leaves of each draw."""
        weight = 1.0 / SD[self.linear.rows.channel][:, None]
        columns = np.hstack([self.linear.jacobian * self.free, self.linear.nuisance])
        stacked = np.vstack([columns * weight, np.eye(columns.shape[1])])
        aim = np.vstack([draws * weight, np.zeros((columns.shape[1], draws.shape[1]))])
        return np.asarray(draws - columns @ np.linalg.lstsq(stacked, aim, rcond=None)[0])

    @property
    def blocks(self) -> Array:
        """Σ without its low-rank part: noise, and what a ridge regression on all other draws leaves of each."""
        scaled = np.hstack([s * self.recalibrated(d) for s, d in zip(SCALES, self.draws, strict=True)])
        scaled /= SD[self.linear.rows.channel][:, None]
        left = np.empty_like(scaled)
        for k in range(scaled.shape[1]):
            others = np.delete(scaled, k, axis=1)
            weight = np.linalg.solve(others.T @ others + np.eye(others.shape[1]), others.T @ scaled[:, k])
            left[:, k] = scaled[:, k] - others @ weight
        own = np.eye(len(left)) + left @ left.T / left.shape[1]
        alike = self.linear.rows.channel[:, None] == self.linear.rows.channel
        sd = SD[self.linear.rows.channel]
        return np.asarray(own * alike * np.outer(sd, sd))

    def low_rank(self, scales: Array) -> Array:
        films, varying = self.mild
        parts = [s * self.recalibrated(d) / np.sqrt(d.shape[1]) for s, d in zip(scales, self.draws, strict=True)]
        return np.hstack([*parts, self.recalibrated(films), varying])

    def sigma(self, scales: Array | None = None) -> Array:
        columns = self.low_rank(self.made.scales if scales is None else scales)
        return self.blocks + columns @ columns.T

    @property
    def columns(self) -> Array:
        """Of all unknowns per prior sd."""
        prior = self.made.prior_of([u.name for u in UNKNOWNS])
        return np.hstack([self.linear.jacobian * prior, self.linear.nuisance])


@pytest.fixture(params=[1, 3], ids=["one batch", "three batches"])
def dense(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Dense:
    """Nothing left out as too small."""
    monkeypatch.setattr(module, "STRUCTURE", replace(STRUCTURE, block_min_variance=0.0, least_energy=0.0))
    return small(request.param)


def small(batches: int) -> Dense:
    rows, rng = rows_of(batches), np.random.default_rng(1)
    linear = linear_of(rows, 3.0 * rng.standard_normal(rows.n))
    draws = tuple(scale * rng.standard_normal((rows.n, d)) for scale, d in ((3.0, 4), (6.0, 3)))
    films, varying = rng.standard_normal((rows.n, 2)), rng.standard_normal((rows.n, 1))
    made = covariance_at(linear, UNKNOWNS, draws, films, varying, SD, SCALES)
    return Dense(linear, draws, (films, varying), made)


def test_whitened_takes_out_what_joins_rows_of_a_channel(dense: Dense) -> None:
    back = dense.made.whitened(np.eye(dense.linear.rows.n))
    np.testing.assert_allclose(back @ dense.blocks @ back.T, np.eye(len(back)), atol=1e-8)
    one = np.random.default_rng(2).standard_normal(len(back))
    np.testing.assert_allclose(dense.made.whitened(one), back @ one, atol=1e-12)  # a vector as well as a matrix


def test_projected_does_the_rest_of_the_dense_inverse(dense: Dense) -> None:
    white = dense.made.whitened(np.eye(dense.linear.rows.n))
    inverse = white.T @ dense.made.projected(white)
    np.testing.assert_allclose(inverse @ dense.sigma(), np.eye(len(inverse)), atol=1e-7)
    assert np.abs(inverse - np.linalg.inv(dense.blocks)).max() > 0.01  # the low rank matters here


def test_further_columns_are_further_variance(dense: Dense) -> None:
    more = 2.0 * np.random.default_rng(3).standard_normal((dense.linear.rows.n, 2))
    wider = with_columns(dense.made, more)
    white = wider.whitened(np.eye(len(more)))
    np.testing.assert_allclose(
        white.T @ wider.projected(white), np.linalg.inv(dense.sigma() + more @ more.T), atol=1e-8
    )


def test_normal_equations_are_dense_generalised_least_squares(dense: Dense) -> None:
    """As the conditional of a joint Gaussian: rows have Σ, unknowns their priors about 0."""
    made, linear = dense.made, dense.linear
    prior = made.prior_of([u.name for u in UNKNOWNS])
    assert ((prior >= 1.0) & (prior <= dense.free)).all() and prior.max() > 1.0
    marginal = dense.columns @ dense.columns.T + dense.sigma()
    mean = dense.columns.T @ np.linalg.solve(marginal, linear.target)
    spread = np.eye(len(mean)) - dense.columns.T @ np.linalg.solve(marginal, dense.columns)
    normal = normal_equations(linear, [u.name for u in UNKNOWNS], made)
    z, own = normal.step(0.0)
    np.testing.assert_allclose(np.concatenate([z / prior, own]), mean, atol=1e-8)
    np.testing.assert_allclose(normal.covariance(), spread[:P, :P] * np.outer(prior, prior), atol=1e-8)
    assert normal.log_volume == pytest.approx(-0.5 * np.linalg.slogdet(spread)[1])
    still, _ = normal.step(1e9)
    np.testing.assert_allclose(still, linear.z, atol=1e-6)  # damped, it stays


def test_objective_and_volume_are_the_marginal_likelihood(dense: Dense) -> None:
    made, linear = dense.made, dense.linear
    names = [u.name for u in UNKNOWNS]
    prior = made.prior_of(names)
    normal = normal_equations(linear, names, made)
    z, own = normal.step(0.0)
    there = linear.residual - linear.jacobian @ (z - linear.z) - linear.nuisance @ (own - linear.own)
    least = objective(there, z, own, prior, made)
    marginal = dense.columns @ dense.columns.T + dense.sigma()
    assert least == pytest.approx(float(linear.target @ np.linalg.solve(marginal, linear.target)))
    before = objective(linear.residual, linear.z, linear.own, prior, made)
    assert before - least == pytest.approx(normal.expected_fall)
    evidence = -0.5 * least - normal.log_volume - 0.5 * np.linalg.slogdet(dense.sigma())[1]
    dense_evidence = -0.5 * (linear.target @ np.linalg.solve(marginal, linear.target) + np.linalg.slogdet(marginal)[1])
    assert evidence == pytest.approx(dense_evidence)


def test_no_other_scale_is_likelier(dense: Dense) -> None:
    def likelihood(scales: Array) -> float:
        marginal = dense.columns @ dense.columns.T + dense.sigma(scales)
        target = dense.linear.target
        return float(-0.5 * (target @ np.linalg.solve(marginal, target) + np.linalg.slogdet(marginal)[1]))

    best = likelihood(dense.made.scales)
    for g in range(len(SCALES)):
        for s in STRUCTURE.scales:
            other = dense.made.scales.copy()
            other[g] = s
            assert likelihood(other) <= best + 1e-8


def test_what_is_left_out_as_too_small_changes_next_to_nothing() -> None:
    lean = small(3)
    white = lean.made.whitened(np.eye(lean.linear.rows.n))
    target = lean.linear.target
    exact = float(target @ np.linalg.solve(lean.sigma(), target))
    assert float(target @ (white.T @ lean.made.projected(white)) @ target) == pytest.approx(exact, rel=0.02)


def test_recalibration_leaves_nothing_that_the_lump_can_do(dense: Dense) -> None:
    linear, free = dense.linear, dense.free
    left, _ = recalibrated(linear, np.hstack(dense.draws), SD, free)
    np.testing.assert_allclose(left, dense.recalibrated(np.hstack(dense.draws)), atol=1e-8)
    far = 50.0 * np.random.default_rng(5).standard_normal((P, 1))
    shown, moved = recalibrated(linear, linear.jacobian @ far, SD, np.full(P, 1e3))
    assert np.abs(shown).max() < 1e-2 and moved == pytest.approx(far, rel=1e-3)
    stiff, hardly = recalibrated(linear, linear.jacobian @ far, SD, np.full(P, 1e-3))
    assert np.abs(hardly).max() < 1e-2 * np.abs(far).max() and np.abs(stiff).max() > np.abs(shown).max()


# Data drawn from it


def smooth(rows: Rows, count: int, rng: np.random.Generator) -> Array:
    """Misfits (n, count) of about unit size: random sums of waves, the faster the smaller, channel by channel."""
    out = np.zeros((rows.n, count))
    for own in rows.of_channel:
        part = np.linspace(0.0, 1.0, len(own))[:, None]
        waves = np.hstack([np.cos(np.pi * k * part) / (1.0 + k) for k in range(WAVES)])
        out[own] = waves @ rng.standard_normal((WAVES, count))
    return out


@pytest.mark.parametrize("true", [0.2, 0.7, 2.2])
def test_the_scale_of_data_that_were_drawn_from_it_is_found(true: float) -> None:
    rows, rng = rows_of(3, (40, 40, 40)), np.random.default_rng(7)
    draws = 4.0 * smooth(rows, 150, rng)
    none = np.zeros((rows.n, 0))
    found = []
    for _ in range(6):
        shown = 4.0 * true * smooth(rows, 1, rng)[:, 0] + rng.standard_normal(rows.n)
        linear = linear_of(rows, shown)
        linear = replace(linear, z=np.zeros(P), own=np.zeros_like(linear.own))
        scales = np.ones(1)
        for _ in range(3):  # blocks take the scales of the round before
            made = covariance_at(linear, UNKNOWNS, [draws], none, none, np.ones(3), scales)
            scales = made.scales
        found.append(float(scales[0]))
    grid = list(STRUCTURE.scales)
    near = grid[grid.index(true) - 1 : grid.index(true) + 2]
    assert set(found) <= set(near) and float(np.exp(np.mean(np.log(found)))) == pytest.approx(true, rel=0.25)


def test_where_there_is_nothing_but_noise_the_scale_is_the_smallest() -> None:
    rows, rng = rows_of(3, (40, 40, 40)), np.random.default_rng(8)
    linear = replace(linear_of(rows, rng.standard_normal(rows.n)), z=np.zeros(P), own=np.zeros(OWN * 3))
    none = np.zeros((rows.n, 0))
    made = covariance_at(linear, UNKNOWNS, [4.0 * smooth(rows, 60, rng)] * 2, none, none, np.ones(3), np.ones(2))
    assert (made.scales == min(STRUCTURE.scales)).all()


def surprise(draws: Array, further: Array, blocks: Blocks) -> float:
    """Mean square of further machines under the covariance of these draws."""
    columns, white = blocks.whitened(draws) / np.sqrt(draws.shape[1]), blocks.whitened(further)
    inner = np.eye(draws.shape[1]) + columns.T @ columns
    rest = white - columns @ np.linalg.solve(inner, columns.T @ white)
    return float(np.einsum("nt,nt->t", white, rest).mean())


def test_few_draws_do_not_pass_for_all_machines() -> None:
    """A further machine is hardly an outlier: what draws leave of one another stands for what they do not span."""
    rows, rng = rows_of(2, (40, 40, 40)), np.random.default_rng(9)
    further = 5.0 * smooth(rows, 30, rng)

    def with_and_without(count: int) -> tuple[float, float]:
        draws = 5.0 * smooth(rows, count, rng)
        own = Blocks.of(rows, np.ones(3), draws)
        none = replace(own, bases=tuple(b[:, :0] for b in own.bases), power=tuple(p[:0] for p in own.power))
        return surprise(draws, further, own), surprise(draws, further, none)

    few, few_alone = with_and_without(20)
    assert few < 0.4 * few_alone
    many, many_alone = with_and_without(150)
    assert many < 2 * 3 * WAVES and many == pytest.approx(many_alone)  # they span all that there is
    one = Blocks.of(rows, np.ones(3), further[:, :1])  # one draw has no others
    assert all(b.shape[1] == 0 for b in one.bases)


# White noise


def test_white_noise_is_that_of_rows_whatever_is_slow_or_jumps() -> None:
    rows, rng = rows_of(2, (150, 150)), np.random.default_rng(3)
    noise = np.array([2.0, 0.3])  # the second is less than what the machine file gives
    residual = noise[rows.channel] * rng.standard_normal(rows.n)
    calm = white_noise(rows, residual)
    assert calm[0] == pytest.approx(2.0, rel=0.15) and calm[1] == 1.0
    bent = residual + 40.0 * np.sin(np.arange(rows.n) / 25.0) + 60.0 * (np.arange(rows.n) % 150 > 70)
    bent[::40] += 25.0
    rough = white_noise(rows, bent)
    assert rough[0] == pytest.approx(2.0, rel=0.3) and rough[1] < 1.2


def test_white_noise_does_not_compare_rows_of_two_batches() -> None:
    rows = rows_of(60, (3, 3))
    apart = 500.0 * np.random.default_rng(4).standard_normal(60)
    residual = np.repeat(apart, 6) + 1.5 * np.random.default_rng(5).standard_normal(rows.n)
    assert white_noise(rows, residual) == pytest.approx([1.5, 1.5], rel=0.25)
    np.testing.assert_array_equal(white_noise(rows_of(4, (2, 1)), np.ones(12)), [1.0, 1.0])  # too few to say
