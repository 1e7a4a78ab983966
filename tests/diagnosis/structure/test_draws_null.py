"""The null: thresholds and p-values are those of one distribution, and one odd machine does not decide."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from diagnosis.policy import POLICY
from diagnosis.structure.null import Null
from diagnosis.structure.policy import STRUCTURE


def drawn(count: int = 60, location: float = 12.0, scale: float = 5.0, seed: int = 0) -> Null:
    return Null(np.random.default_rng(seed).gumbel(location, scale, count))


def allowing(probability: float) -> float:
    return drawn().threshold(replace(STRUCTURE, false_alarms=probability))


def test_fewer_false_alarms_cost_a_higher_threshold() -> None:
    thresholds = [allowing(p) for p in (0.2, 0.05, 0.01, 0.001)]
    assert thresholds == sorted(thresholds) and len(set(thresholds)) == 4


@pytest.mark.parametrize("probability", [0.2, 0.05, 0.01, 1e-4])
def test_a_gain_at_the_threshold_has_the_probability_of_a_false_alarm(probability: float) -> None:
    assert drawn().p_value(allowing(probability)) == pytest.approx(probability)


def test_so_many_machines_exceed_the_threshold() -> None:
    """Of machines drawn from the distribution that 60 of them showed."""
    shares = []
    for seed in range(40):
        further = np.random.default_rng(1000 + seed).gumbel(12.0, 5.0, 2000)
        shares.append(float(np.mean(further > drawn(seed=seed).threshold(replace(STRUCTURE, false_alarms=0.05)))))
    assert 0.03 < np.mean(shares) < 0.08


def test_p_values_fall_with_the_gain_and_stay_probabilities() -> None:
    gains = np.linspace(-50.0, 400.0, 100)
    p = np.array([drawn().p_value(g) for g in gains])
    assert (np.diff(p) <= 0).all() and p[0] == pytest.approx(1.0) and 0.0 <= p[-1] < 1e-12


def test_one_odd_machine_in_sixty_does_not_decide() -> None:
    null = drawn()
    odd = null.gain.copy()
    odd[int(np.argmax(odd))] = 1e4
    assert Null(odd).threshold() == pytest.approx(null.threshold(), rel=0.05)
    half = np.where(np.arange(60) % 2, null.gain, null.gain + 100.0)
    assert Null(half).threshold() > 2.0 * null.threshold()


def test_where_structure_gains_nothing_the_evidence_itself_is_asked_for() -> None:
    calm = Null(np.full(60, -3.0))
    assert calm.threshold() == pytest.approx(STRUCTURE.null_min_threshold_nats)
    assert calm.p_value(calm.threshold()) < STRUCTURE.false_alarms


@pytest.mark.parametrize("count", range(POLICY.null_min_machines))
def test_too_few_machines_allow_no_claim(count: int) -> None:
    null = Null(np.full(count, -5.0))
    assert null.threshold() == np.inf and null.p_value(1e6) == 1.0
