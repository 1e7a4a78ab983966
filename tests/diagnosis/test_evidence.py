"""Evidence against brute force: dense covariances, and a fit of its own for every batch that is left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from data.arrays import Array
from diagnosis.fitting.regression import Whitened
from diagnosis.policy import POLICY
from diagnosis.screening.evidence import Evidence
from twin.calibration.fit_problem import Block, Unknown

B, ROWS, P, C, Q = 5, (40, 30, 25), 3, 4, 2  # batches, rows of each channel, parameters, columns, nuisances
CHANNEL: NDArray[np.int64] = np.repeat(np.arange(len(ROWS)), ROWS)
UNKNOWNS = tuple(Unknown(f"p{k}", "W", 0.0, 0.5 + 0.5 * k, scale="linear") for k in range(P)) + tuple(
    Unknown(f"g{k}", "W", 0.0, 1.0, scale="linear") for k in range(C)
)
SPREAD = np.array([u.spread for u in UNKNOWNS[:P]])
WEIGHT = np.array([1.0, 0.25, 0.5])
COUNT = B * np.array(ROWS, float)
TRUE = 0.6  # amplitude of the first column
FAR = 50.0  # bounds of an amplitude


def blocks(seed: int = 0, rows: NDArray[np.int64] = CHANNEL, size: float = 1.0, true: float = TRUE) -> list[Block]:
    """Linear recordings: z drawn once, nuisances in every batch, the first column at work; residuals at z = 0."""
    rng = np.random.default_rng(seed)
    z = rng.standard_normal(P)
    out = []
    for b in range(B):
        jacobian = size * rng.standard_normal((len(rows), P + C))
        jacobian[:, P:] += jacobian[:, np.arange(C) % P]  # so that parameters absorb some
        nuisance = rng.standard_normal((len(rows), Q))
        noise = rng.standard_normal(len(rows)) / np.sqrt(WEIGHT[rows])
        shown = jacobian[:, :P] @ (SPREAD * z) + true * jacobian[:, P] + nuisance @ rng.standard_normal(Q) + noise
        out.append(Block(f"b{b}", shown, jacobian, nuisance, rows))
    return out


def evidence_of(given: list[Block]) -> Evidence:
    every = tuple(Whitened.at(b, np.zeros(Q), np.zeros(P), UNKNOWNS, range(P, P + C), WEIGHT) for b in given)
    rows = B * np.bincount(given[0].channel, minlength=len(ROWS)).astype(float)
    return Evidence(every, rows, WEIGHT, np.full(C, -FAR), np.full(C, FAR))


def covariance(b: Block) -> Array:
    """Of a batch's rows in units of their noise, dense."""
    own = b.nuisance * np.sqrt(WEIGHT[b.channel])[:, None]
    return np.eye(len(own)) + own @ own.T


def root(b: Block) -> Array:
    """The symmetric inverse square root of it, rows in units of the given noise before."""
    values, vectors = np.linalg.eigh(covariance(b))
    return (vectors / np.sqrt(values)) @ vectors.T @ np.diag(np.sqrt(WEIGHT[b.channel]))


def ridge(rows: list[Array], aims: list[Array]) -> Array:
    """The least squares with prior N(0, 1), by a solver of its own."""
    stacked = np.vstack([*rows, np.eye(rows[0].shape[1])])
    aim = np.concatenate([*aims, np.zeros(rows[0].shape[1])])
    return np.linalg.lstsq(stacked, aim, rcond=None)[0]


def refit_without(given: list[Block], left: set[int]) -> tuple[Array, list[Array]]:
    """Parameters of the other batches (P,), and the residuals of those left out, whitened."""
    rows = [root(b) @ (b.jacobian[:, :P] * SPREAD) for b in given]
    aims = [root(b) @ b.residual for b in given]
    rest = [k for k in range(B) if k not in left]
    z = ridge([rows[k] for k in rest], [aims[k] for k in rest])
    return z, [aims[k] - rows[k] @ z for k in sorted(left)]


@pytest.fixture(scope="module")
def given() -> list[Block]:
    return blocks()


@pytest.fixture(scope="module")
def seen(given: list[Block]) -> Evidence:
    return evidence_of(given)


def test_whitened_rows_are_independent_and_of_unit_variance(given: list[Block], seen: Evidence) -> None:
    for b, w in zip(given, seen.batches, strict=True):
        back = w.of(np.eye(len(CHANNEL)))
        raw = covariance(b) / np.sqrt(np.outer(WEIGHT[b.channel], WEIGHT[b.channel]))
        np.testing.assert_allclose(back @ raw @ back.T, np.eye(len(CHANNEL)), atol=1e-9)
        np.testing.assert_allclose(back, root(b), atol=1e-9)
        np.testing.assert_allclose(w.target, root(b) @ b.residual, atol=1e-9)
        np.testing.assert_allclose(w.columns, root(b) @ b.jacobian[:, P:], atol=1e-9)


def test_the_point_of_linearisation_does_not_matter(given: list[Block], seen: Evidence) -> None:
    z, v = np.array([0.3, -1.0, 2.0]), np.array([1.5, -0.5])
    there = replace(
        given[0], residual=given[0].residual - given[0].jacobian[:, :P] @ (SPREAD * z) - given[0].nuisance @ v
    )
    moved = Whitened.at(there, v, z, UNKNOWNS, range(P, P + C), WEIGHT)
    np.testing.assert_allclose(moved.target, seen.batches[0].target, atol=1e-9)


def test_left_out_residuals_are_those_of_refits(given: list[Block], seen: Evidence) -> None:
    for k, left in enumerate(seen.left_out()):
        np.testing.assert_allclose(left[:, 0], refit_without(given, {k})[1][0], atol=1e-9)


def test_the_score_is_the_log_density_of_refits(given: list[Block], seen: Evidence) -> None:
    squares = np.zeros(len(ROWS))
    volume = 0.0
    for k, b in enumerate(given):
        (left,) = refit_without(given, {k})[1]
        squares += np.bincount(CHANNEL, left**2)
        volume -= 0.5 * np.linalg.slogdet(covariance(b))[1]
    means = squares / (B * np.array(ROWS) * WEIGHT)
    np.testing.assert_allclose(seen.mean_squares(seen.left_out())[0], means)
    bent = -0.5 * float(np.sum(refit_without(given, set())[0] ** 2))  # how far from what the machine file says
    assert seen.base_score()[0] == pytest.approx(
        -0.5 * COUNT @ np.log(np.maximum(means, POLICY.min_noise_variance_share)) + volume + bent
    )


def test_noise_below_the_given_is_not_rewarded(given: list[Block]) -> None:
    quiet, quieter = (evidence_of([replace(b, residual=share * b.residual) for b in given]) for share in (0.01, 0.001))
    assert (quiet.mean_squares(quiet.left_out()) > 50 * quieter.mean_squares(quieter.left_out())).all()
    assert quiet.base_score()[0] == pytest.approx(quieter.base_score()[0], abs=0.01)


def test_a_group_left_out_is_predicted_by_all_others(given: list[Block], seen: Evidence) -> None:
    group = [1, 3]
    squares = sum(np.bincount(CHANNEL, e**2) for e in refit_without(given, set(group))[1])
    means = squares / (len(group) * np.array(ROWS) * WEIGHT)
    volume = -0.5 * sum(np.linalg.slogdet(covariance(given[k]))[1] for k in group)
    expected = -0.5 * (COUNT * len(group) / B) @ np.log(np.maximum(means, POLICY.min_noise_variance_share)) + volume
    assert seen.group_score(group) == pytest.approx(expected)


def test_the_absorbed_share_is_what_parameters_imitate(given: list[Block], seen: Evidence) -> None:
    rows = [root(b) @ (b.jacobian[:, :P] * SPREAD) for b in given]
    absorbed = seen.scores().absorbed
    for c in range(C):
        aims = [root(b) @ b.jacobian[:, P + c] for b in given]
        z = ridge(rows, aims)
        left = float(z @ z) + sum(float(np.sum((a - r @ z) ** 2)) for r, a in zip(rows, aims, strict=True))
        assert absorbed[c] == pytest.approx(1.0 - left / sum(float(a @ a) for a in aims))
    assert absorbed.min() > 0.05 and absorbed.max() < 0.95


def test_likeness_is_the_cosine_of_what_parameters_leave(given: list[Block], seen: Evidence) -> None:
    rows = [root(b) @ (b.jacobian[:, :P] * SPREAD) for b in given]
    left = []
    for c in (0, 2):
        aims = [root(b) @ b.jacobian[:, P + c] for b in given]
        z = ridge(rows, aims)
        left.append(np.concatenate([a - r @ z for r, a in zip(rows, aims, strict=True)]))
    cosine = abs(left[0] @ left[1]) / np.linalg.norm(left[0]) / np.linalg.norm(left[1])
    like = seen.likeness([0, 2])
    np.testing.assert_allclose(like, [[1.0, cosine], [cosine, 1.0]], atol=1e-9)


def one_channel(seed: int = 0, size: float = 6.0, true: float = TRUE) -> list[Block]:
    """Parameters so well determined that the prior says nothing."""
    return blocks(seed, np.zeros(60, np.int64), size, true)


def joint_fit(given: list[Block], column: int, without: int | None = None) -> tuple[Array, Array]:
    """Parameters and one amplitude (P + 1,) by least squares on the other batches and the prior, and their sd."""
    rows, aims = [np.column_stack([np.diag(1.0 / SPREAD), np.zeros(P)])], [np.zeros(P)]
    for k, b in enumerate(given):
        if k != without:
            both = np.column_stack([b.jacobian[:, :P], b.jacobian[:, P + column]])
            rows.append(root(b) @ both)
            aims.append(root(b) @ b.residual)
    stacked = np.vstack(rows)
    z = np.asarray(np.linalg.lstsq(stacked, np.concatenate(aims), rcond=None)[0], float)
    return z, np.asarray(np.sqrt(np.diag(np.linalg.inv(stacked.T @ stacked))), float)


def test_amplitudes_are_those_of_least_squares() -> None:
    given = one_channel()
    scores = evidence_of(given).scores()
    for c in range(C):
        z, sd = joint_fit(given, c)
        # the parameters stand where the given noise put them, the amplitude where the noise that is left does
        assert scores.amplitude[c] == pytest.approx(z[P], abs=0.5 * sd[P])
        assert scores.sd[c] == pytest.approx(sd[P], rel=1e-3)
        assert scores.z[c] == pytest.approx(z[P] / sd[P], rel=1e-3)


def test_what_bent_the_parameters_counts_for_the_column_that_takes_it_over() -> None:
    """A parameter that can do all that the column does hides it from the residuals, and stands far from its prior."""
    given = one_channel()
    far = 8.0
    blocks_ = []
    for b in given:
        j = b.jacobian.copy()
        j[:, P] = j[:, 0] * SPREAD[0]
        b = replace(b, jacobian=j)
        blocks_.append(replace(b, residual=b.residual + far * j[:, P]))
    scores = evidence_of(blocks_).scores()
    z, _ = joint_fit(blocks_, 0)
    assert scores.amplitude[0] == pytest.approx(z[P], rel=0.05)
    assert abs(z[P]) > 0.9 * far
    assert scores.gain[0] > 0.8 * 0.5 * far**2


def test_gains_are_those_of_refits_with_one_column_more() -> None:
    given = one_channel()
    seen = evidence_of(given)
    scores = seen.scores()
    before, after, better = np.float64(0.0), np.float64(0.0), 0
    for k, b in enumerate(given):
        left = refit_without(given, {k})[1][0]
        z, _ = joint_fit(given, 0, without=k)
        both = np.column_stack([b.jacobian[:, :P], b.jacobian[:, P]])
        right = root(b) @ (b.residual - both @ z)
        before, after = before + np.sum(left**2), after + np.sum(right**2)
        better += int(right @ right < left @ left)
        assert scores.by_batch[k, 0] == pytest.approx(left @ left - right @ right, rel=0.02)
    n = seen.rows[0]
    expected = (
        0.5 * n * (np.log(before / seen.rows[0]) - np.log(max(after / seen.rows[0], POLICY.min_noise_variance_share)))
    )
    assert scores.gain[0] == pytest.approx(expected, rel=0.01)
    assert scores.improved[0] == better == B
    assert scores.gain[0] > 10 > scores.gain[1:].max()


def test_several_channels_are_weighed_by_what_is_left_of_each(given: list[Block], seen: Evidence) -> None:
    """The amplitude of the highest density, searched by hand: no channel's misfit decides for the others."""
    rough = [
        replace(b, residual=b.residual + 20.0 * (b.channel == 2) * np.sin(np.arange(len(b.channel)))) for b in given
    ]
    seen = evidence_of(rough)
    fit = ridge([b.jacobian for b in seen.batches], [b.target for b in seen.batches])
    inside = [b.target - b.jacobian @ fit for b in seen.batches]

    def cost(g: float) -> float:
        squares = sum(np.bincount(CHANNEL, (e - g * c[:, 0]) ** 2) for e, c in zip(inside, seen.beyond, strict=True))
        return float(
            COUNT @ np.log(np.maximum(squares / (B * np.array(ROWS) * WEIGHT), POLICY.min_noise_variance_share))
        )

    best = minimize_scalar(cost, bounds=(-2, 2), method="bounded").x
    got = seen.scores()
    assert got.amplitude[0] == pytest.approx(best, abs=0.02)
    assert got.amplitude[0] == pytest.approx(TRUE, abs=0.1)
    plain = sum(float(e @ c[:, 0]) for e, c in zip(inside, seen.beyond, strict=True)) * got.sd[0] ** 2
    assert abs(plain - TRUE) > 2 * abs(got.amplitude[0] - TRUE)


def test_amplitudes_stay_within_their_bounds(seen: Evidence) -> None:
    bound = replace(seen, low=np.full(C, -FAR), high=np.full(C, 0.5 * TRUE))
    assert bound.scores().amplitude[0] == 0.5 * TRUE
    assert 0 < bound.scores().gain[0] < seen.scores().gain[0]
    never = replace(seen, low=np.zeros(C), high=np.zeros(C))
    assert never.scores().gain == pytest.approx(np.zeros(C), abs=1e-9)


def test_a_column_that_only_follows_noise_gains_nothing() -> None:
    gains = np.array([evidence_of(blocks(seed, true=0.0)).scores().gain for seed in range(20)])
    assert (gains.max(axis=1) < 6).all()
    assert gains.mean() < 0.1
    assert (gains < 1).mean() > 0.9  # shrunk away


def test_many_recordings_at_once_are_each_as_alone(seen: Evidence) -> None:
    rng = np.random.default_rng(1)
    targets = [b.target[:, None] + [[0, 1, 1]] * rng.standard_normal((len(b.target), 3)) for b in seen.batches]
    gain, amplitude, falls = seen.gains(targets)
    alone = seen.gains([t[:, 2:] for t in targets])
    for several, one in zip((gain, amplitude, falls), alone, strict=True):
        np.testing.assert_allclose(several[2], one[0], atol=1e-9)
    np.testing.assert_allclose(gain[0], seen.scores().gain, atol=1e-9)
    np.testing.assert_allclose(seen.base_score(targets)[0], seen.base_score()[0])


def test_an_unknown_of_each_batchs_own_is_one_nuisance_more() -> None:
    given = one_channel()
    seen = evidence_of(given)
    columns = [0.7 * b.jacobian[:, P + 1] for b in given]
    more = [replace(b, nuisance=np.column_stack([b.nuisance, c])) for b, c in zip(given, columns, strict=True)]
    every = tuple(Whitened.at(b, np.zeros(Q + 1), np.zeros(P), UNKNOWNS, range(P, P + C), WEIGHT) for b in more)
    expected = replace(seen, batches=every).base_score()[0] - seen.base_score()[0]
    got = seen.own_gain([w.of(c) for w, c in zip(seen.batches, columns, strict=True)])
    assert got == pytest.approx(expected, rel=1e-9)


def test_an_own_unknown_gains_where_batches_differ_and_not_where_they_agree() -> None:
    given, rng = one_channel(true=0.0), np.random.default_rng(3)
    columns = [b.jacobian[:, P + 1] for b in given]
    differ = [
        replace(b, residual=b.residual + g * c) for b, c, g in zip(given, columns, rng.normal(0, 1, B), strict=True)
    ]
    for recordings, told in ((given, False), (differ, True)):
        seen = evidence_of(recordings)
        assert (seen.own_gain([w.of(c) for w, c in zip(seen.batches, columns, strict=True)]) > 10) == told


def test_slack_is_a_shared_unknown_of_that_prior(given: list[Block]) -> None:
    sd = 0.3
    loose = [
        Whitened.at(b, np.zeros(Q), np.zeros(P), UNKNOWNS, range(P, P + C), WEIGHT).with_slack({1: sd}) for b in given
    ]
    for b, w in zip(given, loose, strict=True):
        assert w.jacobian.shape == (len(CHANNEL), P + 1) and w.columns.shape == (len(CHANNEL), C)
        np.testing.assert_allclose(w.jacobian[:, P], root(b) @ b.jacobian[:, P + 1] * sd, atol=1e-9)
    assert loose[0].with_slack({}) is loose[0]


def test_what_slack_can_do_is_no_evidence() -> None:
    given = blocks(size=3.0, true=0.2)
    seen = evidence_of(given)
    loose = replace(seen, batches=tuple(b.with_slack({0: 0.3}) for b in seen.batches))
    assert seen.scores().gain[0] > 5
    assert loose.scores().gain[0] < 0.5
    assert loose.scores().absorbed[0] > 0.95
    assert loose.base_score()[0] > seen.base_score()[0] + 5
