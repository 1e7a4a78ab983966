"""What is concluded: verdicts by what is left, when an effect is at work, which parameters are reported."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from diagnosis.contracts import Candidate, Scored, Where
from diagnosis.findings.conclude import (
    activity,
    moved_rms,
    reported_parameters,
    residual_remarks,
    slow_residual_ratio,
    verdict_of,
)
from diagnosis.findings.report_data import Effect, Rms
from diagnosis.fitting.fit import Fitted
from diagnosis.fitting.fitted import refitted
from diagnosis.policy import POLICY
from diagnosis.screening.screen import proposed
from diagnosis.search.refits import refit
from tests.diagnosis.small_cases import cold_floor, fitted, four_bodies, runs, two_bodies
from twin.calibration.identifiability import intervals90
from twin.calibration.least_squares import result
from twin.calibration.problem import Measured
from twin.schema import MechanismPart


def moving(**moves: float) -> Any:
    """A fit of one run whose channels are 0 and then go on at that much beside 0; errors are x, y and z."""
    channels = tuple(moves)
    value = np.array([v for size in moves.values() for v in (0.0, size * math.sqrt(2.0))])
    number = np.repeat(np.arange(len(channels)), 2)
    is_error = np.array([c in "xyz" for c in channels])
    m = Measured("run", np.tile([0, 1], len(channels)), number, value, np.zeros(len(channels), int), is_error)
    return SimpleNamespace(problem=SimpleNamespace(channels=channels, measured=[m]))


def test_a_slow_misfit_counts_by_what_its_channel_moves() -> None:
    rms = [
        Rms("t_head", "K", 9.0, 0.5, 0.3, sensor=True),  # 0.4 K beyond the noise
        Rms("z", "um", 9.0, 30.0),
        Rms("x", "um", 9.0, 1.0, 1.0),
    ]
    fit = moving(t_head=8.0, z=60.0, x=20.0)
    assert moved_rms(fit) == pytest.approx({"t_head": 8.0, "z": 60.0, "x": 20.0})
    assert slow_residual_ratio(rms, fit) == pytest.approx(
        0.4 / 8.0 / POLICY.structure_error_share
    )  # the median channel
    assert slow_residual_ratio(rms, moving(t_head=0.2, z=60.0, x=0.5)) == pytest.approx(
        0.5 / POLICY.structure_error_share
    )  # noise moves both
    assert slow_residual_ratio([], fit) == 0.0


def test_finer_sensors_are_no_reason_to_doubt_the_same_misfit() -> None:
    fit = moving(t_head=8.0)
    coarse, fine = (Rms("t_head", "K", 0.4, math.hypot(0.3, noise), noise, sensor=True) for noise in (0.1, 0.006))
    assert slow_residual_ratio([coarse], fit) == pytest.approx(slow_residual_ratio([fine], fit))


@pytest.mark.parametrize(
    ("slow", "runs", "verdict"),
    [
        (0.9 * POLICY.residual_max_units, 12, "consistent"),
        (1.1 * POLICY.residual_max_units, 12, "undecidable"),
        (0.9 * POLICY.residual_max_units, 4, "undecidable"),
        (0.9 * POLICY.few_runs_residual_max_units, 4, "consistent"),
    ],
)
def test_where_nothing_is_found_and_much_is_left_nothing_is_decided(slow: float, runs: int, verdict: str) -> None:
    assert verdict_of([], False, (), slow, runs) == verdict
    assert verdict_of([], True, (), slow, runs) == "unlisted"


@pytest.mark.parametrize(("after", "verdict"), [(1.4, "explained"), (1.6, "partly_explained")])
def test_what_was_found_explains_the_difference_where_it_leaves_noise_alone(after: float, verdict: str) -> None:
    sink = Effect("floor_sink", Where("node", "bed"), "the bed", {}, 0.95)
    rms = (Rms("z", "um", 9.0, 1.0, 1.0), Rms("t_rear", "K", 9.0, 0.1 * after, 0.1, sensor=True))
    assert verdict_of([sink], False, rms, 0.0, 12) == verdict
    assert verdict_of([sink], True, rms, 0.0, 12) == "partly_explained"


def test_what_is_left_is_told_with_what_it_is_compared_with() -> None:
    share = "left-out errors are 20 % of what their channels move (median over channels); up to 15 % may be the coarse"
    assert residual_remarks(0.20 / POLICY.structure_error_share, 12) == (f"{share} network's",)
    assert residual_remarks(0.20 / POLICY.structure_error_share, 4)[0].endswith(
        "up to 10 % may be the coarse network's"
    )
    assert residual_remarks(POLICY.residual_max_units, 12) == ()


OPENED = {"start": "1 h", "duration": "30 min", "drop": "6 K"}
GATE = {"law": "draught", "acts_on": "room", "parameters": OPENED}


@cache
def gated() -> Fitted:
    """Two bodies and a gate that the machine file does not know."""
    return fitted(two_bodies(), runs(two_bodies(), {"gate": GATE}))


@cache
def four() -> Fitted:
    return fitted(four_bodies(), runs(four_bodies()))


def proposal(now: Fitted, mechanism: str, where: Where) -> Candidate:
    return next(c for c in proposed(now) if (c.mechanism, c.where) == (mechanism, where))


def test_a_law_that_states_its_window_is_at_work_within_it_in_every_batch() -> None:
    now = gated()
    c = Candidate("draught", Where("node", "room"), "gate", "a gate", MechanismPart.model_validate(GATE))
    done = refitted(now, c.applied(now.part))
    regime, windows = activity(done, c)
    assert regime == "at times"
    assert [w[0] for w in windows] == [b.batch_id for b in now.batches]
    step_s = now.step_s
    np.testing.assert_allclose([w[1:] for w in windows], [[3600.0, 5400.0]] * len(windows), atol=2 * step_s)


def test_what_multiplies_a_heat_is_at_work_while_its_drivers_run() -> None:
    now = four()
    c = next(c for c in proposed(now) if c.mechanism == "viscosity_feedback")
    regime, windows = activity(now, c)
    assert regime == "rpm > 0"
    turning = sum(float((b.values("rpm") != 0)[:-1].sum()) * b.step_s for b in now.batches)
    assert sum(end - start for _, start, end in windows) == turning


def test_a_driver_that_is_negative_where_it_is_on_is_said_so() -> None:
    now = four()
    c = next(c for c in proposed(now) if c.mechanism == "viscosity_feedback")
    reverse = tuple(replace(b, table=b.table.assign(rpm=-b.table["rpm"])) for b in now.batches)
    assert activity(replace(now, batches=reverse), c)[0] == "rpm < 0"
    assert activity(replace(now, batches=(*reverse, *now.batches)), c)[0] == "rpm ≠ 0"


def test_what_nothing_switches_is_always_at_work() -> None:
    assert activity(cold_floor(), proposal(cold_floor(), "radiation", Where("node", "head"))) == ("always", ())
    assert activity(four(), proposal(four(), "column_bending", Where("error", "z"))) == ("always", ())


def test_a_parameter_that_does_nothing_at_its_place_is_not_told() -> None:
    """A draught multiplies what exposures exchange; where only the air of the room is colder, nothing is multiplied."""
    now = gated()
    c = proposal(now, "draught", Where("node", "room"))
    done = refit(now, Scored(c, amplitudes={"drop": 5.0}))
    assert done is not None
    fit = result(done.problem, done.state, 1e-2, "")
    intervals = {i.name: i for i in intervals90(fit, done.problem.unknowns)}
    stated, _ = reported_parameters(done, c, intervals)
    assert f"mechanisms.{c.name}.factor" in intervals
    assert "factor" not in stated
    assert stated["drop"].value > 2.0
