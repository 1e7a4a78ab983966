"""A round under the structural discrepancy names what is planted at its place, and nothing where nothing is."""

from __future__ import annotations

import numpy as np
import pytest

from diagnosis.structure.fit import refitted
from diagnosis.structure.naming import detect
from tests.diagnosis.structure.test_screen import PLANTED, consistent, of


@pytest.mark.parametrize("case", ["drift", pytest.param("shift", marks=pytest.mark.slow)])
def test_what_is_planted_is_named_first(case: str) -> None:
    *_, name, _, _ = PLANTED[case]
    found = detect(of(case)[0])
    assert found.best is not None and found.best.candidate.plain == name
    assert found.score > 1.0 and found.best.gain > found.threshold


def test_where_nothing_is_missing_no_listed_mechanism_reaches_the_threshold() -> None:
    found = detect(consistent())
    assert all(r.gain < found.threshold for r in found.listed)


def test_a_refit_without_a_change_gains_nothing() -> None:
    """The baseline is at its optimum: descending further from it is worth less than any claim."""
    now = consistent()
    again = refitted(now, now.part, steps=5)
    assert abs(again.evidence - now.evidence) < 1.0


def test_a_refit_of_no_steps_stays_where_it_begins() -> None:
    now = consistent()
    np.testing.assert_allclose(refitted(now, now.part, steps=0).state.z, now.state.z)
