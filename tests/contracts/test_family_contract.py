"""What the grid, the registry and a compensation rely on, for every registered model family."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from data.arrays import Array
from data.batch import Batch
from data.errors import InputError
from features.design import Design
from models.base import Family, family_from_plain
from models.families import FAMILIES
from models.metrics import residual_std_um
from models.program import replay
from tests.toys import runs
from tests.toys.runs import INPUTS, N

TRAIN, LEFT = (0, 1, 2, 3), 4
TURNS = 9  # seed of a run that begins like one training run and goes on like another


@dataclass(frozen=True)
class Case:
    """A family, fitted once on four runs of which the fifth is left out."""

    family: type[Family]

    @property
    def along(self) -> bool:
        return self.family.needs_position

    @cached_property
    def batches(self) -> list[Batch]:
        return runs.runs(self.along)

    @property
    def design(self) -> Design:
        return runs.design(self.along)

    @cached_property
    def fitted(self) -> Family:
        return self.family().fit_design(self.design, TRAIN)

    @cached_property
    def of_one(self) -> Family:
        return self.family().fit_design(self.design, [1])

    @cached_property
    def predicted(self) -> Array:
        """Of the left-out run, (N,)."""
        return self.of_left(self.fitted)

    @property
    def learns(self) -> bool:
        """False of the family that predicts no error at all."""
        return self.fitted.n_parameters() > 0

    def of_left(self, model: Family) -> Array:
        return model.predict_design(self.design, [LEFT])[0]

    def build(self, batches: Sequence[Batch], target: str | None = "z") -> Design:
        return Design.build(batches, INPUTS, target, runs.machine())

    def fit(self, batches: Sequence[Batch]) -> Family:
        return self.family().fit(batches, INPUTS, "z", runs.machine())


@pytest.fixture(scope="module", params=FAMILIES, name="c")
def case(request: pytest.FixtureRequest) -> Case:
    return Case(FAMILIES[request.param])


def near(got: Array, want: Array) -> None:
    """Equal to 1e-6 of their size: sums in another order, iterative solvers."""
    assert_allclose(got, want, rtol=0, atol=1e-6 * max(1.0, float(np.nanmax(np.abs(want), initial=0.0))))


def share_left(predicted: Array, error_um: Array) -> float:
    return float(np.std(predicted - error_um) / np.std(error_um))


def test_fit_gives_a_new_copy_the_same_every_time(c: Case) -> None:
    empty = c.family()
    assert empty.fitted == {} and empty.inputs == ()
    again = empty.fit(c.batches[:LEFT], INPUTS, "z", runs.machine())
    assert again is not empty and empty.fitted == {} and (c.fitted.inputs, c.fitted.target) == (INPUTS, "z")
    near(again.predict(c.batches[LEFT]), c.fitted.predict(c.batches[LEFT]))


def test_every_row_is_predicted(c: Case) -> None:
    for predicted in c.fitted.predict_design(c.design, [LEFT, 1]):
        assert predicted.shape == (N,) and predicted.dtype == np.float64 and np.isfinite(predicted).all()


def test_it_is_better_than_no_model(c: Case) -> None:
    assert c.learns or not c.family.uses_inputs
    assert not c.learns or share_left(c.predicted, c.design.y_um[c.design.rows(LEFT)]) < 0.6


def test_nothing_crosses_a_border_between_batches(c: Case) -> None:
    alone = c.fitted.predict_design(c.build([c.batches[LEFT]]), [0])[0]
    for order in ([LEFT, 0], [0, LEFT]):
        both = c.build([c.batches[k] for k in order])
        assert_allclose(c.fitted.predict_design(both, [order.index(LEFT)])[0], alone, rtol=0, atol=1e-9)


def test_prediction_does_not_read_the_error_channel(c: Case) -> None:
    assert_array_equal(c.fitted.predict_design(c.build(c.batches, None), [LEFT])[0], c.predicted)


def test_prediction_does_not_look_ahead(c: Case) -> None:
    whole = runs.runs(c.along, TURNS)[-1]
    for rows in (6, N // 4, N // 2):
        begun = Batch(whole.machine, whole.batch_id, whole.table.iloc[:rows].reset_index(drop=True), whole.channels)
        near(c.fitted.predict(begun), c.fitted.predict(whole)[:rows])


def test_prediction_is_zero_at_the_start(c: Case) -> None:
    start = 4 if c.along else 1  # along an axis throughout the first sweep
    (at_once,) = c.fitted.predict_folds(c.design, [c.fitted], [range(5)])
    for predicted in (*map(c.fitted.predict, c.batches), *at_once, *c.fitted.predict_design(c.design, range(5))):
        assert (predicted[:start] == 0.0).all() and (not c.learns or np.abs(predicted).max() > 1.0)


def test_late_first_readings_move_the_start(c: Case) -> None:
    """Loggers start one after the other; the first complete row is the start."""
    table = c.batches[LEFT].table.copy()
    table.loc[:2, "front"] = np.nan
    table.loc[:1, "column"] = np.nan
    late = Batch("vmc", "late", table, c.batches[LEFT].channels)
    for model in (c.fitted, c.fit([*c.batches[:3], late])):
        predicted = model.predict(late)
        known = np.isfinite(predicted)
        assert known.sum() >= N - 3 and predicted[np.argmax(known)] == 0.0


def test_the_published_form_keeps_its_level(c: Case) -> None:
    free = c.family().as_published().fit_design(c.design, TRAIN)
    back = family_from_plain(free.as_plain())
    assert not free.zero_start and not back.zero_start
    assert_array_equal(c.of_left(back), c.of_left(free))
    assert_array_equal(free.respond(c.design, [LEFT])[0], c.of_left(free))


def test_order_of_the_training_batches_does_not_matter(c: Case) -> None:
    turned = c.family().fit_design(c.design, (3, 1, 0, 2))
    assert_allclose(c.of_left(turned), c.predicted, rtol=0, atol=0.02)  # µm: an iteration may stop elsewhere


def test_the_stated_sd_does_not_shrink_from_the_start(c: Case) -> None:
    if c.family.has_sd:
        sd_um = c.fitted.sd_um(c.design, [LEFT])[0]
        assert np.isfinite(sd_um).all() and 0 < sd_um[0] <= 1.02 * np.median(sd_um)


def test_folds_at_once_are_the_folds_one_by_one(c: Case) -> None:
    together = c.family().fit_folds(c.design, [list(TRAIN), [1]])
    for model, alone in zip(together, [c.fitted, c.of_one], strict=True):
        near(c.of_left(model), c.of_left(alone))
    (first,), (_, second) = c.fitted.predict_folds(c.design, together, [[LEFT], [0, LEFT]])
    for model, got in zip(together, (first, second), strict=True):
        assert_allclose(got, c.of_left(model), rtol=0, atol=1e-6)


def test_fitting_accuracy_is_that_of_the_predictions(c: Case) -> None:
    if (S_um := c.fitted.fitting_S_um(c.design, [c.fitted], [[0, 2]])) is not None:
        own = [c.design.y_um[c.design.rows(k)] - c.fitted.predict_design(c.design, [k])[0] for k in (0, 2)]
        assert_allclose(S_um, [np.mean([residual_std_um(e) for e in own])], rtol=1e-8)


def test_one_batch_is_enough(c: Case) -> None:
    own = c.of_one.predict_design(c.design, [1])[0]
    assert np.isfinite(own).all() and (not c.learns or share_left(own, c.design.y_um[c.design.rows(1)]) < 0.3)


def test_nothing_is_learned_outside_the_training_batches(c: Case) -> None:
    other = c.build([*c.batches[:LEFT], runs.runs(c.along, 99)[-1]])
    model = c.family().fit_design(other, TRAIN)
    near(model.predict_design(other, [0])[0], c.fitted.predict_design(c.design, [0])[0])


def test_plain_data_give_the_same_predictions(c: Case) -> None:
    def encode(value: Any) -> Any:
        assert isinstance(value, np.ndarray) and value.dtype != object
        return {"array": value.tolist(), "dtype": str(value.dtype)}

    def decode(part: dict[str, Any]) -> Any:
        return np.array(part["array"], part["dtype"]) if set(part) == {"array", "dtype"} else part

    text = json.dumps(c.fitted.as_plain(), default=encode, allow_nan=False)
    back = family_from_plain(json.loads(text, object_hook=decode))
    assert type(back) is c.family and back.options() == c.fitted.options()
    assert_allclose(c.of_left(back), c.predicted, rtol=0, atol=1e-9)


def test_no_usable_row_is_one_line(c: Case) -> None:
    if c.learns:
        dead = Batch("vmc", "K9", c.batches[0].table.assign(z=np.nan), c.batches[0].channels)
        with pytest.raises(InputError, match=rf"\A(?=.*K9).*{c.family.key.split('_')[0]}.*\Z"):
            c.fit([dead])


def test_the_program_equals_predict(c: Case) -> None:
    """Exports and the compensation run it row by row in place of predict."""
    if not c.family.has_program() or c.along:  # along an axis its outputs are the offset and the slope
        return
    left = c.batches[LEFT]
    program = c.fitted.program(left.channels, left.step_s)
    rows = np.column_stack([left.masked(n) for n in program.channels] or [np.empty((left.n_rows, 0))])
    got = replay(program, rows)[:, 0]
    assert got[0] == 0.0
    assert_allclose(got, c.fitted.predict(left), rtol=0, atol=1e-6)
