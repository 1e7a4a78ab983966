"""Pairs that are called alike are alike: signatures of an effect and of its rivals on one plant and its runs."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from data.arrays import Array
from thermodrift_exam.plants.effects.base import Effect
from thermodrift_exam.plants.plant import Posed, posed, with_amounts
from thermodrift_exam.plants.runs import Now
from thermodrift_exam.plants.simulation import shown, simulated
from thermodrift_exam.plants.structure import Plant
from thermodrift_exam.proof.suite.setting import setting
from thermodrift_exam.proof.suite.suite import ALWAYS, PAIRS, alternatives_of
from twin.mechanisms import MECHANISMS
from twin.mechanisms.base import View

SEED = 12
LENGTH: dict[str, Any] = {"batches": 5, "hours": 4.0, "before_h": 6.0, "solver_s": 60.0, "step_s": 300.0}
EFFECT_OF = {"mandrel_fixture": "mandrel", "spindle_growth": "spindle_growth"}  # rivals that plants have themselves
MEANS = ("hydraulic_unit",)  # of a cycle shorter than a row its mean is seen: checked by its equation


class Law(Effect):
    """The heat of a mechanism of the library, at its usual values, spread evenly over a body."""

    def __init__(self, plant: Plant, law: str, body: str) -> None:
        self.plant, self.size, self.law = plant, 1.0, MECHANISMS[law]()
        self.at = plant.part(body)
        self.values = {s.name: np.asarray(float(s.value)) for s in self.law.parameters}

    def add_heat_W(self, heat_W: Array, cells_degC: Array, now: Now) -> None:
        """As the library states it."""
        known = {"speed": now.speed_rpm, "feed": now.feed_mm_per_min, "running": now.coolant, "level": now.coolant}
        degC = {"body": self.at.mean(cells_degC), "air": now.room_degC}
        view = View(degC=degC, driver={role: known[role] for role in self.law.drivers})
        self.at.add(heat_W, self.law.heat_W(view, self.values))


def channels(at: Posed, effects: list[Any]) -> dict[str, Array]:
    """Noiseless readings, (rows, B), in units of a usual noise."""
    plant = with_amounts(at.plant, at.effects)
    course = simulated(plant, at.runs, effects, at.options.solver_s, at.options.before_h)
    inside = (course.time_s >= 0) & (course.time_s <= 3600.0 * at.runs[0].hours)
    return {k: v[inside] / (0.03 if k.startswith("t_") else 1.0) for k, v in shown(plant, course, effects).items()}


def posed_with(name: str, habit: str | None = None, **sizes: float) -> Posed:
    options = {**PAIRS[name].imposed(setting(SEED, "development")), **LENGTH, "everyday": False}
    return posed(SEED, sizes, **(options if habit is None else {**options, "habit": habit}))


def likeness(one: dict[str, Array], other: dict[str, Array], base: dict[str, Array], among: str = "") -> float:
    """|cos| of two signatures less every batch's constants, over the channels that begin so."""

    def signature(of: dict[str, Array]) -> Array:
        added = [of[c] - base[c] for c in base if c.startswith(among)]
        return np.concatenate([(a - a.mean(axis=0)).ravel() for a in added])

    u, v = signature(one), signature(other)
    return float(abs(u @ v) / np.sqrt((u @ u) * (v @ v)))


@cache
def alike(name: str, truth: str, rival: str, habit: str | None = None) -> float:
    at, none = posed_with(name, habit, **{truth: 1.0}), posed_with(name, habit, **{truth: 0.0})
    base, one = channels(none, none.effects), channels(at, at.effects)
    if rival in EFFECT_OF:  # of the tool alone: how a bar cools the nose is what a recalibration takes
        other = posed_with(name, habit, **{EFFECT_OF[rival]: 1.0})
        return likeness(one, channels(other, other.effects), base, "z")
    body = at.effects[0].answer().name
    return likeness(one, channels(none, [Law(none.plant, rival, body)]), base)


CLAIMED = [
    (name, truth, rival)
    for name, pair in PAIRS.items()
    for truth, rivals in pair.alternatives.items()
    for rival in rivals
    if rival not in MEANS
]


FIRST = {pair[0]: pair for pair in reversed(CLAIMED)}.values()  # of each habit


def one_of(*pair: str) -> object:
    return pytest.param(*pair, marks=[] if pair in FIRST else pytest.mark.slow)


@pytest.mark.parametrize(("name", "truth", "rival"), [one_of(*pair) for pair in CLAIMED])
def test_an_effect_and_its_rival_leave_the_same_signature(name: str, truth: str, rival: str) -> None:
    assert alike(name, truth, rival) > 0.95


@pytest.mark.parametrize(
    ("name", "truth", "rival"),
    [
        ("nose", "spindle_growth", "mandrel_fixture"),
        pytest.param("one_speed", "motor_loss", "bearing_viscous", marks=pytest.mark.slow),
    ],
)
def test_without_the_habit_they_differ(name: str, truth: str, rival: str) -> None:
    assert 1.0 - alike(name, truth, rival, "ordinary") > 3.0 * (1.0 - alike(name, truth, rival)) + 1e-4


def test_a_cycle_within_a_row_is_its_mean() -> None:
    law = MECHANISMS["hydraulic_unit"]()
    values = {"heat": np.asarray(500.0), "duty": np.asarray(0.4), "period": np.asarray(10.0)}
    rows_s = 300.0 * np.arange(24)
    view = View(time_s=rows_s, driver={"running": np.ones(24)}, step_s=300.0)
    watts = law.heat_W(view, values)
    assert watts.reshape(12, 2).mean(axis=1) == pytest.approx(np.full(12, 200.0))


def test_a_pair_holds_where_it_is_imposed_and_not_elsewhere() -> None:
    plain = setting(SEED, "development")
    for name, pair in PAIRS.items():
        options = pair.imposed(plain)
        assert pair.holds(options)
        assert sorted(options["has"] + options["lacks"]) == sorted(plain["has"] + plain["lacks"])
        for truth, rivals in pair.alternatives.items():
            assert set(rivals) <= set(alternatives_of(truth, options)), name
        if pair.habit:
            assert not pair.holds({**options, "habit": "ordinary"})


def test_what_is_always_the_same_equation_is_told_in_every_case() -> None:
    for effect, mechanisms in ALWAYS.items():
        assert set(mechanisms) <= set(alternatives_of(effect, setting(SEED, "development")))
        assert set(mechanisms) <= set(MECHANISMS)
