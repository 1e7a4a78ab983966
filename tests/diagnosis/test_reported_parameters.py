"""What a finding tells of its mechanism's parameters."""

from __future__ import annotations

from diagnosis.contracts import Scored, Where
from diagnosis.findings.conclude import reported_parameters
from diagnosis.screening.screen import proposed
from diagnosis.search.refits import refit
from tests.diagnosis.small_cases import fitted, runs, two_bodies
from twin.calibration.identifiability import intervals90
from twin.calibration.least_squares import result

OPENED = {"start": "1 h", "duration": "30 min", "drop": "6 K"}


def test_a_parameter_that_does_nothing_at_its_place_is_not_told() -> None:
    """A draught multiplies what exposures exchange; where only the air of the room is colder, nothing is multiplied."""
    known = two_bodies()
    now = fitted(known, runs(known, {"gate": {"law": "draught", "acts_on": "room", "parameters": OPENED}}))
    c = next(c for c in proposed(now) if c.mechanism == "draught" and c.where == Where("node", "room"))
    done = refit(now, Scored(c, amplitudes={"drop": 5.0}))
    assert done is not None
    fit = result(done.problem, done.state, 1e-2, "")
    intervals = {i.name: i for i in intervals90(fit, done.problem.unknowns)}
    stated, _ = reported_parameters(done, c, intervals)
    assert f"mechanisms.{c.name}.factor" in intervals
    assert "factor" not in stated
    assert stated["drop"].value > 2.0
