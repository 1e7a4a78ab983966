"""Detection limits: an effect well above its limit is seen by the screen, one well below is not."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pandas as pd
import pytest

from diagnosis.contracts import COLUMNS, Scored
from diagnosis.fitting.covariance import independent, white_noise
from diagnosis.fitting.fitted import under
from diagnosis.policy import POLICY
from diagnosis.screening.screen import Screen, limits, one_of_each, proposed, screen
from tests.diagnosis.small_cases import DRIFT, FLOOR, SHIFT, consistent, fitted, runs, two_bodies
from twin.mechanisms import MECHANISMS

THRESHOLD = 25.0
HIDDEN: dict[str, tuple[dict[str, Any], str]] = {
    "sensor_drift_t_head": (DRIFT, "rate"),
    "speed_shift_z_rpm": (SHIFT, "shift"),
    "floor_sink_head_room": (FLOOR, "conductance"),
    "spindle_growth_z_head": ({"law": "spindle_growth", "acts_on": "z", "at": {"spindle": "head"}}, "gain"),
}


@cache
def seen() -> Screen:
    return screen(consistent(), proposed(consistent()))


@cache
def table() -> pd.DataFrame:
    return limits(consistent(), seen(), THRESHOLD)


def rows() -> Iterator[Any]:
    return table().itertuples()


def of(found: Screen, name: str) -> tuple[int, Scored]:
    """Its rank among all, and what the screen says of it."""
    return next((k, s) for k, s in enumerate(found.scored) if s.candidate.name == name)


def limit_of(name: str) -> pd.Series:
    label = of(seen(), name)[1].candidate.label
    own = table()[table()["words"] == label]
    assert len(own) == 1
    return own.iloc[0]


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(k, marks=pytest.mark.slow if k in ("floor_sink_head_room", "spindle_growth_z_head") else [])
        for k in HIDDEN
    ],
)
def test_an_effect_of_three_times_its_limit_is_seen_and_of_a_third_is_not(name: str) -> None:
    law, parameter = HIDDEN[name]
    told = limit_of(name)
    for times, found in ((3.0, True), (0.3, False)):
        size = f"{times * told['limit']} {told['unit']}"
        batches = runs(two_bodies(), {"own": {**law, "parameters": {parameter: size}}})
        done = fitted(two_bodies(), batches)
        rank, scored = of(screen(done, proposed(done)), name)
        assert (rank < 3 and scored.gain > THRESHOLD / 2) == found


def test_noise_alone_gains_less_than_any_effect_that_is_claimed() -> None:
    """Of hundreds of candidates the best one gains little where nothing is missing, without refined twins too."""
    done = consistent()
    bare = under(done, independent(done.problem, white_noise(done.problem)))
    for one in (done, bare):
        gains = np.array([s.gain for s in screen(one, proposed(one)).scored])
        assert len(gains) > 20 and np.isfinite(gains).all() and gains.max() < POLICY.decisive_nats


def test_it_is_what_reaches_the_threshold_and_a_margin() -> None:
    for name in HIDDEN:
        scored = of(seen(), name)[1]
        assert limit_of(name)["limit"] == pytest.approx(scored.sd * (np.sqrt(2 * THRESHOLD) + POLICY.limit_power_sd))
    higher = limits(consistent(), seen(), 4 * THRESHOLD).set_index("words")["limit"]
    lower = table().set_index("words")["limit"]
    both = pd.concat([higher, lower], axis=1, keys=["higher", "lower"]).dropna()
    assert (both["higher"] > 1.5 * both["lower"]).all()
    assert higher.isna().sum() >= lower.isna().sum()


def test_every_mechanism_that_can_be_switched_off_has_one() -> None:
    assert tuple(table().columns) == COLUMNS["limits"]
    smooth = {s.candidate.base_name for s in one_of_each(seen().scored) if s.candidate.amplitudes}
    name_of = {c.label: c.base_name for c in proposed(consistent())}
    assert {name_of[words] for words in table()["words"]} == smooth and len(table()) == len(smooth)
    every = {c.base_name: c.label for c in proposed(consistent()) if c.amplitudes}
    assert len(every) == len(smooth)
    for row in rows():
        assert row.unit in {s.unit for s in MECHANISMS[row.mechanism].parameters}
        assert 0 <= row.absorbed <= 1
        assert np.isnan(row.limit) or row.limit > 0
    assert list(table()["mechanism"]) == sorted(table()["mechanism"])


def test_limits_that_differ_by_rounding_alone_stand_in_a_fixed_order() -> None:
    def order(seed: int) -> list[str]:
        rng = np.random.default_rng(seed)
        scored = tuple(replace(s, sd=1.0 + 1e-13 * rng.standard_normal()) for s in seen().scored)
        return list(limits(consistent(), replace(seen(), scored=scored), THRESHOLD)["words"])

    assert order(0) == order(1)


def test_what_a_sensor_in_a_casting_does_anyway_is_seen_only_far_beyond_it() -> None:
    """Where the recordings show imperfections of the usual size; where they show none, far shorter lags are seen."""
    done = replace(consistent(), hyper=replace(consistent().hyper, imperfections=1.0))
    every = [c for c in proposed(done) if c.mechanism == "sensor_lag"]
    usual = limits(done, screen(done, every), THRESHOLD).set_index("name")
    assert len(usual) == 2 and (usual["absorbed"] > 0.99).all()
    assert (usual["limit"] > 0.5 * POLICY.sensor_lag_sd_s).all()
    own = table()[table()["mechanism"] == "sensor_lag"].set_index("name")
    assert consistent().hyper.imperfections == 0.0
    assert (own["limit"] < 0.5 * usual["limit"]).all() and (own["limit"] < 0.5 * POLICY.sensor_lag_sd_s).all()


def test_what_absorbs_it_is_named_where_much_is_absorbed() -> None:
    free = {u.name for u in consistent().problem.unknowns}
    for row in rows():
        assert (row.absorbed_by in free) if row.absorbed > 0.3 else row.absorbed_by == ""
    head = table()[(table()["mechanism"] == "natural_convection") & (table()["name"] == "head")].iloc[0]
    assert head["absorbed"] > 0.9 and head["absorbed_by"] in free
