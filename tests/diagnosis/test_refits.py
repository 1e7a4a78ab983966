"""Where refits begin, and which of two is kept."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from data.errors import InputError
from diagnosis.contracts import Scored, Tried
from diagnosis.policy import POLICY
from diagnosis.screening.screen import proposed, screen
from diagnosis.search import refits
from diagnosis.search.refits import optimised, refit
from tests.diagnosis.small_cases import SHIFT, fitted, four_bodies, runs


@pytest.fixture(scope="module")
def shifted() -> tuple[Any, Scored, Scored]:
    """A fit that lacks a shift of its error, the shift, and a heat."""
    known = four_bodies()
    now = fitted(known, runs(known, {"shift": SHIFT}))
    every = screen(now, proposed(now)).scored
    shift = next(s for s in every if s.candidate.mechanism == "speed_shift")
    return now, shift, next(s for s in every if s.candidate.mechanism == "cabinet_heat")


def test_at_an_error_the_better_of_two_beginnings_counts(
    shifted: tuple[Any, Scored, Scored], monkeypatch: pytest.MonkeyPatch
) -> None:
    now, shift, heat = shifted
    begun: list[str] = []
    afresh = refits._with_equal_weights

    def watched(now: Any, part: Any, begin: Any) -> Any:
        begun.append("afresh")
        return afresh(now, part, begin)

    monkeypatch.setattr(refits, "_with_equal_weights", watched)
    got = refit(now, shift)
    assert got is not None and got.gain > 100.0 and begun == ["afresh"]
    plain = replace(shift, candidate=replace(shift.candidate, where=replace(shift.candidate.where, kind="node")))
    once = refit(now, plain)
    assert once is not None and got.gain >= once.gain
    refit(now, heat)
    assert begun == ["afresh"]  # what acts on temperatures begins where the fit is
    monkeypatch.setattr(
        refits, "POLICY", replace(POLICY, discounted_channel_noise_factor=1.01 * float(max(now.noise.factor)))
    )
    refit(now, shift)
    assert begun == ["afresh"]  # and so does an error that the fit counts as it should


def test_a_refit_begins_smaller_where_all_of_the_effect_cannot_be_simulated(
    shifted: tuple[Any, Scored, Scored], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of preload that tightens with its own heat: what runs away at the screen's amplitude is still there."""
    now, _, heat = shifted
    name, real = f"mechanisms.{heat.candidate.name}.heat", refits.refitted
    begun: list[float] = []

    def runs_away(now: Any, part: Any, at: Any) -> Any:
        begun.append(at[name])
        if at[name] > 4.0:
            raise InputError("stiff beyond the step control")
        return real(now, part, at)

    monkeypatch.setattr(refits, "refitted", runs_away)
    got = refit(now, replace(heat, amplitudes={"heat": 20.0}))
    assert got is not None and got.fitted is not None
    assert begun == pytest.approx([20.0, 20.0, 6.0, 2.0])  # W


def test_a_fit_is_not_taken_on_to_where_it_predicts_worse(
    shifted: tuple[Any, Scored, Scored], monkeypatch: pytest.MonkeyPatch
) -> None:
    now, shift, _ = shifted
    good = refit(now, shift)
    assert good is not None
    monkeypatch.setattr(refits, "settle", lambda *_, **__: now)  # as if the way down led back to the fit before
    kept = optimised(now, good)
    assert kept.fitted is good.fitted and kept.gain > 50.0
    assert isinstance(kept, Tried)
