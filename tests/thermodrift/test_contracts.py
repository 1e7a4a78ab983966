"""Each suite catches a broken plug-in of its kind, with what was expected, what came and why."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, Self

import numpy as np
import pytest

import thermodrift as td
from data.arrays import Array, Numeric
from features.design import Design
from features.selectors.correlation import Correlation
from models.mlr import MLR
from thermodrift.testing import ContractCheck, ContractError, check_family, check_mechanism, check_selector
from thermodrift.testing.points import Case, U
from twin.mechanisms.base import Mechanism, View, size
from twin.quantity import Spec


def failing(checks: Iterator[ContractCheck], name: str) -> str:
    """The message of the one check with this name, which must fail."""
    (check,) = (c for c in checks if c.name == name)
    with pytest.raises(ContractError) as error:
        check()
    assert str(error.value).startswith(f"{check}: expected ") and f"Why: {check.why}" in str(error.value)
    return str(error.value)


# ----- families


class SeesTheError(MLR):
    def respond(self, design: Design, batches: Sequence[int]) -> list[Array]:
        return [0.5 * design.y_um[design.rows(k)] for k in batches]


class LooksAhead(MLR):
    def respond(self, design: Design, batches: Sequence[int]) -> list[Array]:
        return [values * (1 + 0.01 * len(values)) for values in super().respond(design, batches)]


class LearnsFromAll(MLR):
    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        return super().fit_folds(design, [list(range(design.n_batches))] * len(folds))


class Unseeded(MLR):
    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        fitted = super().fit_folds(design, folds)
        for model in fitted:
            model.fitted["coef_um_per_K"] = np.asarray(model.fitted["coef_um_per_K"]) * (
                1 + 0.1 * np.random.default_rng().random()
            )
        return fitted


class KeepsAnObject(MLR):
    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        fitted = super().fit_folds(design, folds)
        for model in fitted:
            model.fitted["when"] = {1, 2}
        return fitted


class Offset(MLR):
    def program(self, channels: Any, step_s: float) -> Any:
        program = super().program(channels, step_s)
        self.fitted["coef_um_per_K"] = 1.01 * np.asarray(self.fitted["coef_um_per_K"])
        return program


@pytest.mark.parametrize(
    ("family", "name", "got"),
    [
        (SeesTheError, "prediction_does_not_read_the_error_channel", "NaN on one side"),
        (LooksAhead, "prediction_does_not_look_ahead", "got a difference of"),
        (LearnsFromAll, "nothing_is_learned_outside_the_training_batches", "got a difference of"),
        (Unseeded, "fit_gives_a_new_copy_the_same_every_time", "got a difference of"),
        (KeepsAnObject, "plain_data_gives_the_same_predictions", "lists and arrays in as_plain(), got <class 'set'>"),
        (Offset, "program_equals_predict", "got a difference of"),
    ],
)
def test_a_broken_family_is_caught(family: type[MLR], name: str, got: str) -> None:
    assert got in failing(check_family(family, generate_only=True), name)


# ----- selectors


class ChoosesFromAll(Correlation):
    def select_design(self, design: Design, train: Sequence[int], n_tsps: Sequence[int]) -> dict[int, tuple[str, ...]]:
        return super().select_design(design, range(design.n_batches), n_tsps)


class LargestValue(Correlation):
    def select_design(self, design: Design, train: Sequence[int], n_tsps: Sequence[int]) -> dict[int, tuple[str, ...]]:
        order = np.argsort(-np.abs(np.nan_to_num(design.stacked(train)[0])).max(axis=0))
        return {n: tuple(design.inputs[i] for i in sorted(order[:n])) for n in n_tsps}


class BestFirst(Correlation):
    def select_design(self, design: Design, train: Sequence[int], n_tsps: Sequence[int]) -> dict[int, tuple[str, ...]]:
        return {n: names[::-1] for n, names in super().select_design(design, train, n_tsps).items()}


@pytest.mark.parametrize(
    ("selector", "name"),
    [
        (ChoosesFromAll, "nothing_is_learned_outside_the_training_batches"),
        (LargestValue, "unit_and_sign_of_an_input_do_not_matter"),
        (LargestValue, "a_number_that_cannot_be_is_refused"),
        (BestFirst, "distinct_inputs_in_the_designs_order"),
    ],
)
def test_a_broken_selector_is_caught(selector: type[Correlation], name: str) -> None:
    failing(check_selector(selector, generate_only=True), name)


# ----- mechanisms


class Drag(Mechanism):
    """A brush that rubs."""

    key = "drag"
    summary = "drag of a brush"
    equation = "P = force |v|"
    source = "Coulomb 1785; 20 to 100 N a brush, by data sheets"
    signature = "only while the axis moves; warms the brush's holder"
    acts_at = ("node",)
    drivers: ClassVar[Mapping[str, str]] = {"feed": "mm/min"}
    parameters = (Spec("force", "N", "drag of all brushes", 60.0, 0.6, 0.0, 2000.0),)
    off: ClassVar[Mapping[str, float] | None] = {"force": 0.0}

    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return np.asarray(p["force"] * size(view.driver["feed"]) / 60e3)


class WrongFactor(Drag):
    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return 1000.0 * super().heat_W(view, p)


class NotAnalytic(Drag):
    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return np.asarray(np.abs(p["force"]) * size(view.driver["feed"]) / 60e3)


class HeatsAtRest(Drag):
    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return super().heat_W(view, p) + p["force"] * 0.1


class Cools(Drag):
    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return -super().heat_W(view, p)


class NeverOff(Drag):
    off: ClassVar[Mapping[str, float] | None] = {"force": 10.0}


CASE = Case(lambda q: q.force * q.feed)


def test_a_whole_mechanism_passes() -> None:
    assert check_mechanism(Drag, CASE)


@pytest.mark.parametrize(
    ("law", "name"),
    [
        (WrongFactor, "units_agree_with_the_equation"),
        (NotAnalytic, "derivatives_are_those_of_differences"),
        (HeatsAtRest, "without_its_driver_it_does_nothing"),
        (Cools, "finite_and_of_its_sign_over_the_whole_prior"),
        (NeverOff, "switched_off_it_does_nothing"),
    ],
)
def test_a_broken_mechanism_is_caught(law: type[Mechanism], name: str) -> None:
    failing(check_mechanism(law, CASE, generate_only=True), name)


def test_an_equation_that_hides_a_unit_is_caught() -> None:
    unit = Case(lambda q: U.Quantity(q.force.magnitude, "N") * q.feed)
    text = failing(check_mechanism(Drag, unit, generate_only=True), "equation_finds_every_wrong_unit")
    assert "the equation to differ with force in " in text and "instead of N" in text


# ----- how a suite runs


def test_all_failures_are_named_at_once() -> None:
    with pytest.raises(ContractError) as error:
        td.testing.check_selector(ChoosesFromAll)
    first, *others = str(error.value).splitlines()
    assert first == f"{len(others)} of {len(list(check_selector('none', generate_only=True)))} checks failed"
    assert all(line.startswith("selector correlation: ") for line in others)


def test_an_error_of_the_plug_in_is_told_with_its_kind() -> None:
    class Divides(Correlation):
        def select_design(self, design: Design, train: Sequence[int], n_tsps: Sequence[int]) -> Any:
            return 1 / 0

    every = list(check_selector(Divides, generate_only=True))
    text = failing(iter(every), "distinct_inputs_in_the_designs_order")
    assert "expected no error, got ZeroDivisionError: division by zero" in text


def test_checks_have_names_for_pytest() -> None:
    names = [str(c) for c in check_family("ridge", generate_only=True)]
    assert "family ridge: prediction_does_not_look_ahead" in names and len(set(names)) == len(names)
    _: Callable[[], None] = next(check_family("ridge", generate_only=True))
