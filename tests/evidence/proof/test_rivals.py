"""Rivals on a machine of two bodies: each is a fair version of its method, and its reply has the agreed form."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from data.errors import WorkError
from diagnosis.candidates.priors import start_values
from diagnosis.fitting.regression import Memory
from diagnosis.policy import POLICY
from diagnosis.result import Diagnosis
from diagnosis.screening.linearisation import difference
from diagnosis.screening.screen import alone
from diagnosis.search.search import Search, search
from evidence.proof.baselines import replies
from evidence.proof.baselines.ablations import Stage
from evidence.proof.baselines.base import claimable, counted_in_full, plain_rows, without_nuisances
from evidence.proof.baselines.evaluate import ABLATIONS, BASELINES
from tests.diagnosis.small_cases import cold_floor, consistent
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


@pytest.mark.slow
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


@pytest.mark.parametrize("key", ["independent_noise", "in_sample", "no_structural_null", "no_floor_check"])
def test_an_ablation_keeps_what_all_its_other_rules_find(key: str) -> None:
    assert named(replied()["ablations"][key])[:1] == [("floor_sink", "head")]


def test_the_reference_is_what_the_search_itself_accepted() -> None:
    first = floor().accepted[0].best
    assert first is not None
    assert named(replied()["reference"]) == [(first.candidate.mechanism, first.candidate.where.name)]
    assert replies(nothing())["reference"]["findings"] == []


def test_rows_become_what_they_were_before_the_nuisances_were_integrated_out() -> None:
    batch = floor().rounds[0].screen.evidence.batches[0]
    rows = np.random.default_rng(0).standard_normal((len(batch.target), 3))
    np.testing.assert_allclose(batch.restored(batch.of(rows)), rows * batch.scale[:, None], atol=1e-9)


def test_signatures_are_what_a_little_of_the_mechanism_changes() -> None:
    """Against the difference of two simulations, which shares no code with derivatives."""
    done = floor().rounds[0]
    rows = plain_rows(done)
    k, s = next((k, s) for k, s in enumerate(rows.scored) if s.candidate.mechanism == "cabinet_heat")
    values, _ = start_values(replace(s, amplitudes={"heat": 1.0}), done.before)
    values = {"heat": values["heat"].model_copy(update={"value": "1 W"})}
    base = done.before.problem.residuals(done.before.x, done.before.state.nuisance)
    change = np.concatenate(difference(done.before, s.candidate.applied(done.before.part, values), base))
    channel = np.concatenate([b.channel for b in done.screen.evidence.batches])
    for c in np.unique(channel):
        own = channel == c
        change[own] = (change[own] - change[own].mean()) / np.sqrt(np.mean(np.concatenate(base)[own] ** 2))
    assert MECHANISMS["cabinet_heat"].off == {"heat": 0.0}
    assert np.corrcoef(change, rows.columns[:, k])[0, 1] > 0.999


def test_rows_counted_in_full_score_as_a_fit_without_memory() -> None:
    fitted = floor().baseline
    n = len(fitted.rows)
    memory = replace(fitted.memory, share=np.full(n, 0.6), keep=np.full(n, 0.8))
    full = counted_in_full(alone(fitted, memory))
    plain = alone(fitted, Memory.none(len(full.rows))).base_score()[0]
    assert full.base_score()[0] == pytest.approx(plain, rel=1e-6)
    assert abs(alone(fitted, memory).base_score()[0] - plain) > 1.0


def test_without_nuisances_the_targets_are_the_residuals() -> None:
    done = floor().rounds[0]
    residuals = done.before.problem.residuals(done.before.x, done.before.state.nuisance)
    evidence = without_nuisances(done.screen.evidence, residuals)
    pairs = zip(residuals, evidence.batches, strict=True)
    square = sum(float(np.sum(b.innovations(r * b.scale) ** 2)) for r, b in pairs)
    left = evidence.left_out()
    assert sum(float(np.sum(e**2)) for e in left) == pytest.approx(square)


def test_in_sample_a_fit_never_looks_worse_than_on_batches_left_out() -> None:
    evidence = floor().rounds[0].screen.evidence
    assert evidence.base_score(left_out=False)[0] >= evidence.base_score()[0]
    columns = [s.column for s in claimable(floor().rounds[0])]
    inside = evidence.gains(left_out=False)[0][0, columns]
    left_out = evidence.gains()[0][0, columns]
    assert (inside >= -1e-6).all()
    assert np.argmax(inside) == np.argmax(left_out)


def test_with_the_policy_of_a_diagnosis_the_round_is_decided_as_it_was() -> None:
    for done in (floor(), nothing()):
        stage = Stage(done)
        r, again = stage.round, stage.decided(POLICY)
        assert again.accepted is r.accepted
        assert again.threshold == pytest.approx(r.threshold, rel=1e-6)
        assert [t.candidate.name for t in again.tried[:1]] == [t.candidate.name for t in r.tried[:1]]


def test_an_ablation_changes_the_rule_that_it_takes_out_and_no_other() -> None:
    stage = Stage(floor())
    full = stage.decided(POLICY)
    without = stage.decided(replace(POLICY, uses_structural_null=False))
    assert full.best is not None and without.best is not None
    assert without.best.gain == full.best.gain  # the same refits
    assert POLICY.even_odds_gain_nats <= without.threshold <= full.threshold  # and the other bars stay
    inside = stage.decided(replace(POLICY, leaves_batches_out=False))
    in_full = stage.decided(replace(POLICY, counts_row_memory=False))
    assert inside.best is not None and inside.best.gain != full.best.gain
    assert in_full.best is not None and in_full.best.gain != full.best.gain
    assert not np.allclose(inside.null.gain, full.null.gain) and not np.allclose(in_full.null.gain, full.null.gain)


def test_a_fit_that_was_swapped_in_beside_later_effects_is_fitted_alone_again() -> None:
    stage = Stage(floor())
    first, *rest = stage.round.tried
    assert first.fitted is not None and first.candidate.part is not None
    later = first.candidate.part.model_copy(update={"law": "cabinet_heat", "at": None, "parameters": {}})
    part = first.fitted.part
    more = part.model_copy(update={"mechanisms": {**part.mechanisms, "later": later}})
    swapped = replace(first, gain=1.0, fitted=replace(first.fitted, part=more))
    rounds = (replace(stage.round, tried=(swapped, *rest)), *floor().rounds[1:])
    again = Stage(replace(floor(), rounds=rounds)).refits[0]
    assert again.fitted is not None
    assert set(again.fitted.part.mechanisms) == set(part.mechanisms)
    assert again.gain > 0.8 * first.gain


def test_a_diagnosis_without_its_search_is_refused() -> None:
    empty = object.__new__(Diagnosis)
    object.__setattr__(empty, "search", None)
    with pytest.raises(
        WorkError, match=r"baselines: the diagnosis kept no search; hand over one that `diagnose` has just"
    ):
        replies(empty)
