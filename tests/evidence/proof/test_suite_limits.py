"""The detection limit that `limits.yml` is made by, on regressions whose limit is known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from data.arrays import Array
from diagnosis.fitting.regression import Whitened
from diagnosis.screening.evidence import Evidence
from evidence.proof.suite.limits import SIZES, Bench, renewed

ROWS, BATCHES, THRESHOLD = 50, 8, 10.0


@dataclass(frozen=True)
class Rows:
    """One channel of unit noise, one parameter: the batches' mean."""

    seed: int

    def evidence(self) -> Evidence:
        rng = np.random.default_rng(self.seed)
        batches = []
        for k in range(BATCHES):
            one, none = np.ones((ROWS, 1)), np.zeros((ROWS, 0))
            batches.append(
                Whitened(
                    f"b{k}", rng.standard_normal(ROWS), one, none, np.zeros(ROWS, int), np.ones(ROWS), none, np.zeros(0)
                )
            )
        count = np.array([float(ROWS * BATCHES)])
        return Evidence(tuple(batches), count, np.ones(1), np.zeros(0), np.zeros(0))


def bench(evidence: Evidence, threshold: float = THRESHOLD) -> Bench:
    nothing: Any = None
    return Bench(1, "volumes", {}, nothing, evidence, threshold)


def wave(size: float) -> list[Array]:
    """The same in every batch, of this root mean square, without a mean."""
    phase = 2.0 * np.pi * np.arange(ROWS) / ROWS
    return [size * np.sqrt(2.0) * np.sin(3.0 * phase) for _ in range(BATCHES)]


def test_the_limit_is_where_the_density_gains_the_threshold_or_the_error_falls_by_a_tenth() -> None:
    """n/2 log(1 + a²) nats for rows of mean square 1 + a²: here the cut of a tenth, 1 + a² = 1/0.81, comes last."""
    n = ROWS * BATCHES
    by_gain = np.sqrt(np.exp(2.0 * THRESHOLD / n) - 1.0)
    by_cut = np.sqrt(1.0 / 0.81 - 1.0)
    assert by_cut > by_gain
    found = [bench(Rows(seed).evidence())._times(wave(1.0)) for seed in range(9)]
    assert np.median(found) == pytest.approx(by_cut, rel=0.15)
    high = 100.0  # nats: now the gain comes last
    found = [bench(Rows(seed).evidence(), high)._times(wave(1.0)) for seed in range(9)]
    assert np.median(found) == pytest.approx(np.sqrt(np.exp(2.0 * high / n) - 1.0), rel=0.15)


def test_twice_the_signature_is_seen_at_half_the_size() -> None:
    evidence = Rows(3).evidence()
    step = SIZES[1] / SIZES[0]
    assert bench(evidence)._times(wave(1.0)) / bench(evidence)._times(wave(2.0)) == pytest.approx(2.0, rel=step - 1.0)


def test_what_a_recalibration_can_do_is_never_seen() -> None:
    evidence = Rows(3).evidence()
    assert bench(evidence)._times([np.ones(ROWS) for _ in range(BATCHES)]) == SIZES[-1]


def test_the_table_keeps_every_plant_and_takes_the_median() -> None:
    old = {"limits": {"volumes": {"sun": 9.0}, "elements": {"sun": 1.0}}}
    new = renewed(old, "volumes", [("sun", 1, 0.1), ("sun", 2, 0.4), ("sun", 3, 0.2)])
    assert new["limits"] == {"volumes": {"sun": 0.2}, "elements": {"sun": 1.0}}
    assert new["plants"] == {"volumes": {"sun": [0.1, 0.4, 0.2]}}
