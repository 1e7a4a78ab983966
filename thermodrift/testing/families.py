"""The contract of a model family."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from data.arrays import Array
from data.batch import Batch
from features.design import Design
from models.base import Family, family_from_plain
from models.metrics import residual_std_um
from models.program import replay
from thermodrift.testing import runs
from thermodrift.testing.contract import Suite, expect, expect_close, expect_described, expect_refused
from thermodrift.testing.runs import INPUTS, N

TRAIN = (0, 1, 2, 3)
LEFT = 4
TURNS = 9  # seed of a run that begins like one training run and goes on like another


@dataclass(frozen=True)
class FamilyCase:
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
        """Fitted on one run."""
        return self.family().fit_design(self.design, [1])

    @cached_property
    def predicted(self) -> Array:
        """Of the left-out run, (N,)."""
        return self.fitted.predict_design(self.design, [LEFT])[0]

    @property
    def learns(self) -> bool:
        """False of the family that predicts no error at all."""
        return self.fitted.n_parameters() > 0

    def build(self, batches: Sequence[Batch], target: str | None = "z") -> Design:
        return Design.build(batches, INPUTS, target, runs.machine())

    def near(self, got: Array, want: Array, what: str) -> None:
        """Equal to 1e-6 of their size: sums in another order, iterative solvers."""
        expect_close(got, want, what, atol=1e-6 * max(1.0, float(np.nanmax(np.abs(want), initial=0.0))))


SUITE: Suite[FamilyCase] = Suite()


@SUITE.check("reports and the registry show these; ties between models go to the smaller rank")
def says_what_it_is(c: FamilyCase) -> None:
    cls = c.family
    expect_described(cls, Family, "key", "summary", "source")
    expect(isinstance(cls.rank, int), "a whole rank", cls.rank)


@SUITE.check("the grid fits one object on many folds, a notebook on batches: all must give the model that is promoted")
def fit_gives_a_new_copy_the_same_every_time(c: FamilyCase) -> None:
    empty = c.family()
    expect(empty.fitted == {} and empty.inputs == (), "nothing learned before a fit", empty.fitted)
    again = empty.fit(c.batches[:LEFT], INPUTS, "z", runs.machine())
    expect(again is not empty and empty.fitted == {}, "a new fitted copy, the object itself unchanged", empty.fitted)
    expect((c.fitted.inputs, c.fitted.target) == (INPUTS, "z"), f"inputs {INPUTS} and target z", c.fitted.inputs)
    whole = c.batches[LEFT]
    c.near(again.predict(whole), c.fitted.predict(whole), "the predictions of fit on batches and of fit_design")


@SUITE.check("a compensation needs a value at every row whose inputs are known")
def predicts_every_row(c: FamilyCase) -> None:
    for predicted in c.fitted.predict_design(c.design, [LEFT, 1]):
        expect(predicted.shape == (N,) and predicted.dtype == np.float64, f"float64 of shape ({N},)", predicted.shape)
        expect(np.isfinite(predicted).all(), "finite predictions where every input is known", "NaN or infinity")


@SUITE.check("a model that is no better than none on a run with a clear law learns something else")
def is_better_than_no_model(c: FamilyCase) -> None:
    expect(c.learns or not c.family.uses_inputs, "learned numbers in `fitted` of a family that uses inputs", "none")
    if c.learns:
        error_um = c.design.y_um[c.design.rows(LEFT)]
        share = float(np.std(c.predicted - error_um) / np.std(error_um))
        expect(share < 0.6, "less than 60 % of the error left in a left-out run", f"{100 * share:.0f} %")


@SUITE.check("a batch's neighbours in a stack are chance; a filter that runs over the border mixes two days")
def nothing_crosses_a_border_between_batches(c: FamilyCase) -> None:
    alone = c.fitted.predict_design(c.build([c.batches[LEFT]]), [0])[0]
    for order in ([LEFT, 0], [0, LEFT]):
        both = c.build([c.batches[k] for k in order])
        got = c.fitted.predict_design(both, [order.index(LEFT)])[0]
        expect_close(got, alone, "the prediction of a batch alone and next to another", atol=1e-9)


@SUITE.check("at the machine no error is recorded: a prediction that reads it works in tests only")
def prediction_does_not_read_the_error_channel(c: FamilyCase) -> None:
    blind = c.fitted.predict_design(c.build(c.batches, None), [LEFT])[0]
    expect_close(blind, c.predicted, "the prediction with and without the recorded error")


@SUITE.check("at the machine the later rows are not there yet")
def prediction_does_not_look_ahead(c: FamilyCase) -> None:
    whole = runs.runs(c.along, TURNS)[-1]
    predicted = c.fitted.predict(whole)
    for rows in (6, N // 4, N // 2):
        begun = Batch(whole.machine, whole.batch_id, whole.table.iloc[:rows].reset_index(drop=True), whole.channels)
        c.near(c.fitted.predict(begun), predicted[:rows], f"the prediction of {N} rows and of the first {rows} of them")


@SUITE.check("the control starts with a correction of 0; along an axis throughout the first sweep")
def prediction_is_zero_at_the_start(c: FamilyCase) -> None:
    start = 4 if c.along else 1
    (at_once,) = c.fitted.predict_folds(c.design, [c.fitted], [range(5)])
    for predicted in (*map(c.fitted.predict, c.batches), *at_once, *c.fitted.predict_design(c.design, range(5))):
        expect((predicted[:start] == 0.0).all(), f"exactly 0 in the first {start} row(s)", predicted[:start])
        expect(not c.learns or np.abs(predicted).max() > 1.0, "more than 1 µm somewhere in the run", predicted.max())


@SUITE.check("loggers start one after the other; the first complete row is then the start")
def late_first_readings_move_the_start(c: FamilyCase) -> None:
    table = c.batches[LEFT].table.copy()
    table.loc[:2, "front"] = np.nan
    table.loc[:1, "column"] = np.nan
    late = Batch("vmc", "late", table, c.batches[LEFT].channels)
    for model in (c.fitted, c.family().fit([*c.batches[:3], late], INPUTS, "z", runs.machine())):
        predicted = model.predict(late)
        known = np.isfinite(predicted)
        expect(known.sum() >= N - 3, f"a value in at least {N - 3} rows", known.sum())
        expect(predicted[np.argmax(known)] == 0.0, "0 in the first row that has a value", predicted[np.argmax(known)])


@SUITE.check("studies are reproduced with the level free, as methods are published")
def published_form_keeps_its_level(c: FamilyCase) -> None:
    free = c.family().as_published().fit_design(c.design, TRAIN)
    back = family_from_plain(free.as_plain())
    expect(not free.zero_start and not back.zero_start, "zero_start False in the form as published, also stored", True)
    got = free.predict_design(c.design, [LEFT])[0]
    expect_close(back.predict_design(c.design, [LEFT])[0], got, "the prediction of the stored form as published")
    expect_close(free.respond(c.design, [LEFT])[0], got, "respond and predict_design in the form as published")


@SUITE.check("files are read in whatever order; the same runs must give the same model")
def order_of_the_training_batches_does_not_matter(c: FamilyCase) -> None:
    turned = c.family().fit_design(c.design, (3, 1, 0, 2))
    got = turned.predict_design(c.design, [LEFT])[0]
    what = "the predictions of a fit on the batches in another order"
    expect_close(got, c.predicted, what, atol=0.02)  # µm: an iteration may stop elsewhere, far below a probe's step


@SUITE.check("intervals are made from it; at the start the probe's own noise is there already")
def stated_sd_does_not_shrink_from_the_start(c: FamilyCase) -> None:
    if c.family.has_sd:
        sd_um = c.fitted.sd_um(c.design, [LEFT])[0]
        expect(np.isfinite(sd_um).all() and sd_um[0] > 0, "a finite sd_um above 0", sd_um.min())
        expect(sd_um[0] <= 1.02 * np.median(sd_um), "an sd_um at the start not above the usual one", sd_um[0])


@SUITE.check("the grid fits all folds at once; scores must be those of each fold alone")
def folds_at_once_are_the_folds_one_by_one(c: FamilyCase) -> None:
    together = c.family().fit_folds(c.design, [list(TRAIN), [1]])
    for model, alone in zip(together, [c.fitted, c.of_one], strict=True):
        want = alone.predict_design(c.design, [LEFT])[0]
        c.near(model.predict_design(c.design, [LEFT])[0], want, "predictions of fit_folds and fit_design")
    (first,), (_, second) = c.fitted.predict_folds(c.design, together, [[LEFT], [0, LEFT]])
    for model, got in zip(together, (first, second), strict=True):
        expect_close(got, model.predict_design(c.design, [LEFT])[0], "predict_folds and predict_design", atol=1e-6)


@SUITE.check("the grid takes it in place of predicting the training rows")
def fitting_accuracy_is_that_of_the_predictions(c: FamilyCase) -> None:
    S_um = c.fitted.fitting_S_um(c.design, [c.fitted], [[0, 2]])
    if S_um is not None:
        own = [c.design.y_um[c.design.rows(k)] - c.fitted.predict_design(c.design, [k])[0] for k in (0, 2)]
        expect_close(S_um, [np.mean([residual_std_um(e) for e in own])], "fitting_S_um of the predictions", rtol=1e-8)


@SUITE.check("train-on-one is a protocol: one run is all there is in the first week")
def one_batch_is_enough(c: FamilyCase) -> None:
    own = c.of_one.predict_design(c.design, [1])[0]
    error_um = c.design.y_um[c.design.rows(1)]
    expect(np.isfinite(own).all(), "finite predictions after a fit on one batch", "NaN or infinity")
    if c.learns:
        share = float(np.std(own - error_um) / np.std(error_um))
        expect(share < 0.3, "less than 30 % of the error left in the run that was learned", f"{100 * share:.0f} %")


@SUITE.check("what a left-out run teaches makes its score worthless")
def nothing_is_learned_outside_the_training_batches(c: FamilyCase) -> None:
    other = c.build([*c.batches[:LEFT], runs.runs(c.along, 99)[-1]])
    model = c.family().fit_design(other, TRAIN)
    want = c.fitted.predict_design(c.design, [0])[0]
    c.near(model.predict_design(other, [0])[0], want, "the same model whatever the left-out batch is")


@SUITE.check("a model is stored as JSON and arrays and loaded at the machine; nothing is pickled")
def plain_data_gives_the_same_predictions(c: FamilyCase) -> None:
    def encode(value: Any) -> Any:
        plain = isinstance(value, np.ndarray) and value.dtype != object
        expect(plain, "numbers, texts, lists and arrays in as_plain()", type(value))
        return {"array": value.tolist(), "dtype": str(value.dtype)}

    def decode(part: dict[str, Any]) -> Any:
        return np.array(part["array"], part["dtype"]) if set(part) == {"array", "dtype"} else part

    text = json.dumps(c.fitted.as_plain(), default=encode, allow_nan=False)
    back = family_from_plain(json.loads(text, object_hook=decode))
    expect(type(back) is c.family, f"the class {c.family.__name__} back", type(back).__name__)
    expect(back.options() == c.fitted.options(), f"options {c.fitted.options()}", back.options())
    got = back.predict_design(c.design, [LEFT])[0]
    expect_close(got, c.predicted, "the predictions of the stored and of the fitted model", atol=1e-9)


@SUITE.check("a batch without a usable value is common; its reader must see which batch and why")
def no_usable_row_is_one_line(c: FamilyCase) -> None:
    if c.learns:
        dead = Batch("vmc", "K9", c.batches[0].table.assign(z=np.nan), c.batches[0].channels)
        fit = lambda: c.family().fit([dead], INPUTS, "z", runs.machine())  # noqa: E731
        expect_refused(fit, "K9", c.family.key.split("_")[0])


@SUITE.check("exports and the compensation run the program row by row in place of predict")
def program_equals_predict(c: FamilyCase) -> None:
    if not c.family.has_program() or c.along:  # along an axis its outputs are the offset and the slope
        return
    left = c.batches[LEFT]
    program = c.fitted.program(left.channels, left.step_s)
    rows = np.column_stack([left.masked(n) for n in program.channels] or [np.empty((left.n_rows, 0))])
    got = replay(program, rows)[:, 0]
    expect(got[0] == 0.0, "0 in the program's first row", got[0])
    expect_close(got, c.fitted.predict(left), "the program's outputs and predict", atol=1e-6)
