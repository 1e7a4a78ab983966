"""When an effect is said to be at work."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from diagnosis.contracts import Candidate, Fitted, Where
from diagnosis.findings.conclude import activity
from diagnosis.fitting.fitted import refitted
from diagnosis.screening.screen import proposed
from tests.diagnosis.small_cases import cold_floor, fitted, four_bodies, runs, two_bodies
from twin.schema import MechanismPart

GATE = {"law": "draught", "acts_on": "room", "parameters": {"start": "1 h", "duration": "30 min", "drop": "6 K"}}


@cache
def four() -> Fitted:
    return fitted(four_bodies(), runs(four_bodies()))


def proposal(now: Fitted, mechanism: str, where: Where) -> Candidate:
    return next(c for c in proposed(now) if (c.mechanism, c.where) == (mechanism, where))


def test_a_law_that_states_its_window_is_at_work_within_it_in_every_batch() -> None:
    known = two_bodies()
    now = fitted(known, runs(known, {"gate": GATE}))
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
