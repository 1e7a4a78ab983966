"""Sensors under each other's names are seen before a fit bends towards them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from diagnosis.contracts import Scored
from diagnosis.fitting.fitted import refitted
from diagnosis.screening.exchanged import suspected_swaps
from diagnosis.screening.screen import proposed
from diagnosis.search.refits import refit
from tests.diagnosis.small_cases import consistent, fitted, four_bodies, runs

PAIRS = [("t_spindle", "t_head"), ("t_head", "t_bed")]


@pytest.mark.parametrize("pair", [PAIRS[0], pytest.param(PAIRS[1], marks=pytest.mark.slow)])
def test_the_pair_that_was_exchanged_comes_first(pair: tuple[str, str]) -> None:
    known = four_bodies()
    given = runs(known, {"swap": {"law": "sensor_swap", "acts_on": list(pair)}})
    now = fitted(known, given)
    first = suspected_swaps(now, proposed(now))[0]
    assert first.part is not None and first.part.acts_on == pair
    # a refit from where the fit has been bent to would not come back: it begins at the machine file's values
    done = refit(now, Scored(first))
    assert done is not None and done.log_evidence - now.log_evidence > 100.0
    assert done.noise.factor.max() < 0.5 * now.noise.factor.max()


@pytest.mark.slow
def test_so_it_does_where_readings_are_missing() -> None:
    """One sensor was away for a run, the other misses every seventh row: what both have tells enough."""
    known = four_bodies()
    given = runs(known, {"swap": {"law": "sensor_swap", "acts_on": ["t_spindle", "t_bed"]}})
    holes = []
    for k, b in enumerate(given):
        table = b.table.copy()
        table.loc[3::7, "t_spindle"] = np.nan
        if k == 1:
            table["t_bed"] = np.nan
        holes.append(replace(b, table=table))
    now = fitted(known, holes)
    first = suspected_swaps(now, proposed(now))[0]
    assert first.part is not None and first.part.acts_on == ("t_spindle", "t_bed")


@pytest.mark.slow
def test_labels_come_before_physics() -> None:
    known = four_bodies()
    now = fitted(known, runs(known, {"swap": {"law": "sensor_swap", "acts_on": ["t_spindle", "t_head"]}}))
    assert suspected_swaps(now, proposed(now))
    heat = next(c for c in proposed(now) if c.mechanism == "cabinet_heat")
    assert suspected_swaps(refitted(now, heat.applied(now.part)), proposed(now)) == []


def test_labels_that_are_right_are_not_suspect() -> None:
    now = consistent()
    assert suspected_swaps(now, proposed(now)) == []
    known = four_bodies()
    now = fitted(known, runs(known, seed=2))
    assert suspected_swaps(now, proposed(now)) == []
