"""Baselines and ablations on two small machines: their form, and that each names what it can see."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from diagnosis.candidates.priors import free_values
from diagnosis.fitting.signatures import difference
from diagnosis.search.search import Search, search
from tests.diagnosis.small_cases import cold_floor, consistent
from thermodrift_rivals import baselines, replies
from thermodrift_rivals.base import plain_rows
from thermodrift_rivals.evaluate import ABLATIONS, BASELINES
from twin.mechanisms import MECHANISMS

pytestmark = pytest.mark.slow


@cache
def floor() -> Search:
    return search(cold_floor())


@cache
def nothing() -> Search:
    return search(consistent())


@cache
def replied() -> dict[str, Any]:
    return replies(floor())


def named(reply: dict[str, Any]) -> list[tuple[str, str]]:
    return [(f["mechanism"], f["where"]["name"]) for f in reply["findings"]]


def test_a_reply_has_the_agreed_form() -> None:
    out = replied()
    assert set(out) == {"baselines", "ablations", "reference"}
    assert set(out["baselines"]) == set(BASELINES)
    assert set(out["ablations"]) == set(ABLATIONS) - {"reference"}
    for reply in (*out["baselines"].values(), *out["ablations"].values(), out["reference"]):
        assert set(reply) == {"verdict", "findings", "seconds"}
        assert reply["verdict"] in ("consistent", "explained", "partly_explained", "unlisted", "undecidable")
        assert all(f["where"].keys() == {"kind", "name"} for f in reply["findings"])
    assert json.loads(json.dumps(out, allow_nan=False)) == out
    assert set(baselines(floor())) == {"baselines"}


@pytest.mark.parametrize("key", ["sparse_regression", "in_sample_bic"])
def test_regression_sees_a_strong_effect_of_the_twins_own_law(key: str) -> None:
    assert ("floor_sink", "head") in named(replied()["baselines"][key])


def test_the_largest_correlation_is_named() -> None:
    rows = plain_rows(floor().rounds[0])
    r = [float(np.corrcoef(rows.residual, column)[0, 1]) for column in rows.columns.T]
    allowed = [(k, v) for k, v in enumerate(r) if (v > 0 and rows.high[k] > 0) or (v < 0 and rows.low[k] < 0)]
    best, _ = max(allowed, key=lambda kv: abs(kv[1]))
    c = rows.scored[best].candidate
    assert named(replied()["baselines"]["raw_correlation"]) == [(c.mechanism, c.where.name)]


def test_without_the_check_of_the_residual_the_same_effect_is_named() -> None:
    assert named(replied()["ablations"]["no_floor_check"])[:1] == named(replied()["reference"])[:1]


def test_the_reference_is_what_the_first_round_accepted() -> None:
    first = floor().rounds[0].best
    assert first is not None
    assert named(replied()["reference"]) == [(first.candidate.mechanism, first.candidate.where.name)]
    assert replies(nothing())["reference"]["findings"] == []


def test_signatures_are_what_a_little_of_the_mechanism_changes() -> None:
    """Against the difference of two simulations, which shares no code with derivatives."""
    done = floor().rounds[0]
    rows = plain_rows(done)
    k, s = next((k, s) for k, s in enumerate(rows.scored) if s.candidate.mechanism == "cabinet_heat")
    values = free_values(replace(s, amplitudes={"heat": 1.0}), done.before)
    values = {"heat": values["heat"].model_copy(update={"value": "1 W"})}
    problem = done.before.problem
    base = problem.residuals(done.before.x, done.before.nuisance)
    change = np.concatenate(difference(done.before, s.candidate.applied(done.before.part, values), base))
    channel = np.concatenate([m.channel for m in problem.measured])
    residual = np.concatenate(problem.residuals(done.before.x, done.before.fitted_nuisance))
    for c in np.unique(channel):
        own = channel == c
        change[own] = (change[own] - change[own].mean()) / np.sqrt(np.mean(residual[own] ** 2))
    assert MECHANISMS["cabinet_heat"].off == {"heat": 0.0}
    assert np.corrcoef(change, rows.columns[:, k])[0, 1] > 0.999
