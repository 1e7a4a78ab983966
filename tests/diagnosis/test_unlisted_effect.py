"""An effect of no listed form, concealed: its place, driver, form and size, as a mechanism that a file can state."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from diagnosis.candidates.free_forms import Form, free_forms, phrases
from diagnosis.contracts import Fitted
from diagnosis.findings.conclude import usual_size
from diagnosis.fitting.fitted import baseline
from diagnosis.policy import POLICY
from diagnosis.search.residual import Terms, completed, strongest
from tests.diagnosis.concealed import Case, calibrated, case, flux, shift
from twin.schema import twin_part


def fitted(given: Case) -> tuple[Fitted, list[Form]]:
    part = twin_part(given.machine)
    now = baseline(given.machine, part, given.batches, None, len(given.batches))
    return now, free_forms(given.machine, part, given.batches)


def found(given: Case) -> Terms:
    now, forms = fitted(given)
    best = strongest(now, forms)
    assert best is not None
    return completed(now, best, forms)


def values(out: Terms) -> dict[str, float]:
    network = out.fitted.problem.network
    return {f.role: float(out.fitted.values[network.index(f"mechanisms.{out.name}.{f.role}")]) for f in out.forms}


@pytest.mark.parametrize(
    ("concealed", "place", "true", "label"),
    [
        pytest.param(
            flux("bed", linear="40 W"), "bed", {"linear": 40.0}, "W into bed while coolant is on",
            marks=pytest.mark.slow,
        ),
        (flux("column", "rpm", product="0.0008 W/K"), "column", {"product": 0.0008},
         "W into column per K of column above 20 degC, in proportion to rpm (at 5000 rpm)"),
        pytest.param(
            flux("saddle", "rpm", square="-4e-6 W"), "saddle", {"square": -4e-6},
            "W out of saddle with the square of rpm (at 5000 rpm)", marks=pytest.mark.slow,
        ),
        (flux("bed", "rpm", "coolant", cross="0.012 W"), "bed", {"cross": 0.012},
         "W into bed in proportion to rpm (at 5000 rpm) while coolant is on"),
        pytest.param(
            flux("bed", "rpm", "coolant", square_cross="3e-6 W"), "bed", {"square_cross": 3e-6},
            "W into bed with the square of rpm (at 5000 rpm) while coolant is on", marks=pytest.mark.slow,
        ),
        pytest.param(
            flux("saddle", None, constant="25 W"), "saddle", {"constant": 25.0}, "W into saddle",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            flux("column", "coolant", linear="30 W", product="8 W/K"), "column", {"linear": 30.0, "product": 8.0},
            "W into column while coolant is on", marks=pytest.mark.slow,
        ),
        (shift("z", linear="8 um"), "z", {"linear": 8.0}, "µm of z while coolant is on"),
        (shift("y", "column", "rpm", product="0.0005 um/K"), "y", {"product": 0.0005},
         "µm of y per K of column's rise, in proportion to rpm (at 5000 rpm)"),
    ],
)  # fmt: skip
def test_law_is_recovered(concealed: dict[str, Any], place: str, true: dict[str, float], label: str) -> None:
    out = found(case(concealed))
    assert out.forms[0].where.name == place
    assert values(out) == pytest.approx(true, rel=0.15)
    assert label in phrases(out.forms, values(out))
    assert out.tried.gain > POLICY.even_odds_gain_nats and out.tried.improved == 6
    assert out.name == f"unlisted_{place}" and max(out.fitted.noise.factor) < 1.3


@pytest.mark.slow
def test_its_usual_size_is_told() -> None:
    """Of a heat that is switched its watts while it runs, of a displacement what it adds to its error."""
    heat, moved = found(case(flux("bed", linear="40 W"))), found(case(shift("z", linear="8 um")))
    assert usual_size(heat.fitted, heat.tried.candidate) == pytest.approx(40.0, rel=0.05)
    assert usual_size(moved.fitted, moved.tried.candidate) == pytest.approx(8.0, rel=0.05)


def test_noise_and_a_drifting_sensor_follow_nothing() -> None:
    given = case()
    best = strongest(*fitted(given))
    assert best is None or best.tried.gain < POLICY.even_odds_gain_nats / 4
    for b in given.batches:
        b.table["t_column"] += 0.3 * b.time_s / 3600 * (1 + int(b.batch_id[-1]) % 2)
    best = strongest(*fitted(calibrated(given.machine, given.batches)))
    assert best is None or best.tried.gain < POLICY.even_odds_gain_nats or best.tried.improved < 6


@pytest.mark.slow
def test_a_place_that_has_one_already_gets_a_second_beside_it() -> None:
    """A file that a diagnosis mended before keeps what it states."""
    given = case(flux("bed", linear="40 W"))
    known = flux("bed", "rpm", linear="0.001 W")
    machine = given.machine.model_copy(
        update={"twin": {**(given.machine.twin or {}), "mechanisms": {
            **(given.machine.twin or {})["mechanisms"], "unlisted_bed": known["flux"]}}}
    )  # fmt: skip
    now = baseline(machine, twin_part(machine), given.batches, None, 6)
    best = strongest(now, free_forms(machine, twin_part(machine), given.batches))
    assert best is not None and best.name == "unlisted_bed_" and best.forms[0].label == "coolant"
    assert "unlisted_bed" in now.part.mechanisms and np.isfinite(best.tried.gain)
