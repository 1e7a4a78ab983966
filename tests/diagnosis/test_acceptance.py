"""When a gain counts: quantiles of a largest value, flipped signs, the sign test, and what must stand out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binomtest, gumbel_r

from diagnosis.contracts import Fitted, Scored, Tried
from diagnosis.policy import POLICY
from diagnosis.screening.screen import alone, proposed, screen
from diagnosis.search.acceptance import balanced_quantile, flipped_gains, flipped_threshold, gumbel, sign_p, stands_out
from diagnosis.search.refits import refit
from tests.diagnosis.small_cases import DRIFT, consistent, fitted, runs, two_bodies
from twin.calibration.identifiability import Z90


def test_the_quantile_of_a_gumbel_distribution() -> None:
    sample = np.asarray(gumbel_r.rvs(loc=3.0, scale=2.0, size=20000, random_state=0))
    for share in (0.5, 0.99):
        assert gumbel(sample, share) == pytest.approx(gumbel_r.ppf(share, loc=3.0, scale=2.0), rel=0.03)
    assert gumbel(sample) == gumbel(sample, 0.99)


def test_few_batches_have_few_patterns_of_signs() -> None:
    gains = np.asarray(gumbel_r.rvs(loc=3.0, scale=2.0, size=(POLICY.sign_flips, 3), random_state=1))
    assert flipped_threshold(gains, 4) == gains.max()
    assert flipped_threshold(gains, 8) == max(gumbel(gains.max(axis=1)), gains.max()) > np.median(gains)
    assert flipped_threshold(np.zeros((0, 0)), 8) == 0.0


def test_what_chance_makes_of_one_candidate_is_no_reason_to_doubt_another() -> None:
    """Of 200 candidates three gain hundreds of nats in draw after draw; the share of false alarms stays for all."""
    rng = np.random.default_rng(2)
    scale = np.r_[np.full(3, 150.0), np.full(197, 3.0)]

    def drawn(n: int) -> np.ndarray:
        return scale * rng.gumbel(0.5, 1.0, (n, 200))

    known = drawn(14)
    every, quiet, loud = (balanced_quantile(known, which) for which in (None, 50, 1))
    assert loud <= every
    assert quiet < 0.15 * every
    thresholds = np.array([balanced_quantile(known, k) for k in range(200)])
    alarms = (drawn(4000) > thresholds).any(axis=1).mean()
    assert alarms < 0.05  # fourteen draws know little of their own quantiles


def test_where_all_candidates_are_alike_the_largest_gain_decides() -> None:
    known = np.random.default_rng(3).gumbel(60.0, 20.0, (40, 50))
    assert balanced_quantile(known, 7) == pytest.approx(balanced_quantile(known, None), rel=0.3)


@pytest.mark.parametrize(("better", "n"), [(0, 6), (3, 6), (5, 6), (6, 6), (9, 12)])
def test_the_sign_test(better: int, n: int) -> None:
    assert sign_p(better, n) == pytest.approx(binomtest(better, n, 0.5, alternative="greater").pvalue)


def with_drift(per_batch_K_per_h: list[float]) -> Fitted:
    """Runs in each of which the head's sensor drifts by its own rate."""
    known = two_bodies()
    batches = []
    for b, rate in zip(runs(known, count=len(per_batch_K_per_h)), per_batch_K_per_h, strict=True):
        batches.append(replace(b, table=b.table.assign(t_head=b.table["t_head"] + rate * b.time_s / 3600)))
    return fitted(known, batches)


def largest_flipped(done: Fitted) -> float:
    found = screen(done, proposed(done))
    columns = [s.column for s in found.scored if s.candidate.mechanism == "sensor_drift"]
    after = alone(done, done.memory)
    gains = flipped_gains(found.evidence, after, columns, seed=0)
    assert gains.shape == (POLICY.sign_flips, len(columns))
    np.testing.assert_array_equal(gains, flipped_gains(found.evidence, after, columns, seed=0))
    return float(gains.max())


def test_what_varies_between_batches_lifts_the_threshold_and_noise_does_not() -> None:
    wild = largest_flipped(with_drift([0.3, -0.3, 0.3, -0.3, -0.3, 0.3]))
    assert wild > 5 > 1 > largest_flipped(consistent())


def drift(rate: str) -> Tried:
    known = two_bodies()
    hidden = {"own": {**DRIFT, "parameters": {"rate": rate}}}
    done = fitted(known, runs(known, hidden, count=4))
    c = next(c for c in proposed(done) if c.name == "sensor_drift_t_head")
    tried = refit(done, Scored(c, 1.0, 4, 0.0, {"rate": 0.0}, 0.01, 0))
    assert tried is not None
    return tried


def test_a_signed_amplitude_stands_out_where_its_interval_leaves_out_nothing() -> None:
    assert stands_out(drift("0.2 K/h"))
    none = drift("0 K/h")
    assert none.fitted is not None
    names = [u.name for u in none.fitted.problem.unknowns]
    at = names.index("mechanisms.sensor_drift_t_head.rate")
    sd = float(np.sqrt(none.fitted.state.arrow.covariance[at, at]))
    assert stands_out(none) == (abs(none.fitted.state.z[at]) >= Z90 * sd)
    assert not stands_out(none)


def test_what_has_no_amplitude_is_not_asked() -> None:
    assert stands_out(replace(drift("0 K/h"), fitted=None))
