"""An effect of no listed form, concealed: its place, driver, form and size, as a mechanism that a file can state."""

from __future__ import annotations

from typing import Any

import pytest

from data.processes import Processes
from diagnosis.candidates.free_forms import phrases
from diagnosis.findings.conclude import usual_size
from diagnosis.fitting.fitted import baseline
from diagnosis.search.claims import Round
from diagnosis.search.search import one_round
from tests.diagnosis.concealed import Case, case, flux, shift
from twin.schema import twin_part

pytestmark = pytest.mark.integration  # a whole round of a search each


def found(given: Case) -> Round:
    """The first round, on the terms of no list alone."""
    now = baseline(given.machine, twin_part(given.machine), given.batches, None, len(given.batches))
    return one_round(now, Processes(), lambda *_: None, listed=False)


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
            "W out of saddle with the square of rpm (at 5000 rpm)",
            marks=[pytest.mark.slow, pytest.mark.xfail(reason="the bed under the saddle is named", strict=True)],
        ),
        pytest.param(
            flux("bed", "rpm", "coolant", cross="0.012 W"), "bed", {"cross": 0.012},
            "W into bed in proportion to rpm (at 5000 rpm) while coolant is on",
        ),
        pytest.param(
            flux("bed", "rpm", "coolant", square_cross="3e-6 W"), "bed", {"square_cross": 3e-6},
            "W into bed with the square of rpm (at 5000 rpm) while coolant is on", marks=pytest.mark.slow,
        ),
        pytest.param(
            flux("saddle", None, constant="25 W"), "saddle", {"constant": 25.0}, "W into saddle",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            shift("z", linear="8 um"), "z", {"linear": 8.0}, "µm of z while coolant is on",
        ),
        (shift("y", "column", "rpm", product="0.0005 um/K"), "y", {"product": 0.0005},
         "µm of y per K of column's rise, in proportion to rpm (at 5000 rpm)"),
    ],
)  # fmt: skip
def test_law_is_recovered(concealed: dict[str, Any], place: str, true: dict[str, float], label: str) -> None:
    out = found(case(concealed))
    assert out.best is not None
    c, fitted = out.best.candidate, out.best.fitted
    form = out.forms[c.name]
    network = fitted.problem.network
    values = {r: float(fitted.values[network.index(f"mechanisms.{c.name}.{r}")]) for r in c.amplitudes}
    assert c.where.name == place and values == pytest.approx(true, rel=0.15)
    assert label in phrases([form], values)
    assert out.best.gain > 50.0 and out.best.improved == 6


@pytest.mark.slow
def test_its_usual_size_is_stated() -> None:
    """Of a heat that is switched its watts while it runs, of a displacement what it adds to its error."""
    for concealed, size in ((flux("bed", linear="40 W"), 40.0), (shift("z", linear="8 um"), 8.0)):
        best = found(case(concealed)).best
        assert best is not None
        assert usual_size(best.fitted, best.candidate) == pytest.approx(size, rel=0.05)


def test_noise_follows_nothing() -> None:
    out = found(case())
    assert not out.accepted
