"""How far a gain is trusted, and what it takes to be claimed."""

from __future__ import annotations

from typing import Any

import pytest

from diagnosis.contracts import Candidate, Kind, Scored, Tried, Where
from diagnosis.policy import POLICY
from diagnosis.search.acceptance import least_gain, trust

BATCHES = 12


def tried(mechanism: str, gain: float, worse: int = 0, kind: Kind = "node") -> Tried:
    c = Candidate(mechanism, Where(kind, "head"), mechanism, "")
    return Tried(Scored(c, gain, BATCHES - worse, 0.0, {}, 0.0, -1), gain, BATCHES - worse, c.name, 0.0, worse=worse)


def test_a_claim_is_as_likely_false_as_true_at_the_least_gain() -> None:
    every: list[tuple[str, int, Any]] = [
        ("cabinet_heat", 0, "node"), ("cabinet_heat", 2, "node"), ("heat_bridge", 0, "node"),
        ("column_bending", 1, "error"), ("sensor_drift", 0, "sensor"), ("varies_between_runs", 0, "node"),
    ]  # fmt: skip
    for mechanism, worse, kind in every:
        least = least_gain(tried(mechanism, 1.0, worse, kind))
        assert trust(tried(mechanism, least, worse, kind)) == pytest.approx(0.5)


def test_more_gain_more_trust() -> None:
    gained = [
        trust(tried("cabinet_heat", g))
        for g in (1.0, POLICY.even_odds_gain_nats, 2 * POLICY.even_odds_gain_nats, 20 * POLICY.even_odds_gain_nats)
    ]
    assert gained == sorted(gained)
    assert gained[0] < 0.01 and gained[-1] > 0.99


def test_batches_that_get_worse_ask_for_more() -> None:
    least = [least_gain(tried("cabinet_heat", 1.0, n)) for n in (0, 1, 2)]
    assert least[0] == POLICY.even_odds_gain_nats
    assert least[1] / least[0] == pytest.approx(least[2] / least[1]) and least[1] > 1.5 * least[0]


def test_so_does_what_says_how_a_network_or_a_lever_is_drawn() -> None:
    assert least_gain(tried("heat_bridge", 1.0)) > 1.5 * POLICY.even_odds_gain_nats
    assert least_gain(tried("joint_conductance", 1.0)) > 1.5 * POLICY.even_odds_gain_nats
    assert least_gain(tried("column_bending", 1.0, kind="error")) > 1.7 * POLICY.even_odds_gain_nats
    assert least_gain(tried("speed_shift", 1.0, kind="error")) == POLICY.even_odds_gain_nats  # a driver makes it
    assert (
        least_gain(tried("time_skew", 1.0, kind="error")) == POLICY.even_odds_gain_nats
    )  # and a clock's fault is no lever


def test_exchanged_labels_must_be_plain() -> None:
    assert least_gain(tried("sensor_swap", 1.0, kind="sensor")) > 630.0


def test_a_finer_network_claims_nothing() -> None:
    assert least_gain(tried("coarse_network", 1.0, 3)) == POLICY.coarse_min_gain_nats
