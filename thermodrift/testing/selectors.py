"""The contract of a selector of temperature-sensitive points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd

from data.batch import Batch, Channel
from features.design import Design
from features.selectors.base import Selector
from thermodrift.testing.contract import Suite, expect, expect_described, expect_refused
from thermodrift.testing.runs import LENGTHS, P, stack, year

TRAIN = (0, 1, 3)
ALL_N = tuple(range(1, P + 1))
Choice = dict[int, tuple[str, ...]]


@dataclass(frozen=True)
class SelectorCase:
    """A selector with its choice on the rows of `year`."""

    selector: type[Selector]

    @cached_property
    def design(self) -> Design:
        return stack(*year(), LENGTHS)

    @cached_property
    def usual(self) -> Choice:
        return self.chosen(self.design)

    @property
    def choosing(self) -> bool:
        return self.selector.takes_n_tsp

    @property
    def sizes(self) -> list[int]:
        """How many inputs come back for 1 to P."""
        return list(ALL_N) if self.choosing else [P] * P

    def chosen(self, design: Design, train: Sequence[int] = TRAIN) -> Choice:
        return self.selector().select_design(design, train, ALL_N)

    def expect_same(self, design: Design, what: str, train: Sequence[int] = TRAIN) -> None:
        got = self.chosen(design, train)
        expect(got == self.usual, f"the same choice {what}", _differing(got, self.usual))


def _differing(got: Choice, usual: Choice) -> str:
    return ", ".join(f"{got[n]} for {usual[n]}" for n in usual if got.get(n) != usual[n])[:300]


SUITE: Suite[SelectorCase] = Suite()


@SUITE.check("reports and the command line show these")
def says_what_it_is(c: SelectorCase) -> None:
    cls = c.selector
    expect_described(cls, Selector, "key", "summary", "source")


@SUITE.check("equal sets are fitted once, so they must be equal tuples")
def distinct_inputs_in_the_designs_order(c: SelectorCase) -> None:
    for (n, inputs), size in zip(c.usual.items(), c.sizes, strict=True):
        expect(len(inputs) == size, f"{size} inputs for n_tsp {n}", inputs)
        ordered = [i for i in c.design.inputs if i in set(inputs)]
        expect(list(inputs) == ordered, "distinct inputs in the design's order", inputs)


@SUITE.check("points that were chosen with the left-out run make its score worthless")
def nothing_is_learned_outside_the_training_batches(c: SelectorCase) -> None:
    x, y = year()
    design = stack(x.copy(), y.copy(), LENGTHS)
    for k in set(range(len(LENGTHS))) - set(TRAIN):
        design.x[design.rows(k)] = 50 + 40 * np.random.default_rng(k).normal(size=(LENGTHS[k], P))
        design.y_um[design.rows(k)] *= -9
    design.x[design.rows(2)][3:9, 1] = np.nan
    c.expect_same(design, "whatever the left-out batches hold")


@SUITE.check("a choice that no training batch can change is no choice")
def training_batches_change_the_choice(c: SelectorCase) -> None:
    if c.choosing:
        x, y = year()
        expect(
            c.chosen(stack(x[:, ::-1].copy(), y, LENGTHS)) != c.usual, "another choice from other inputs", "the same"
        )


@SUITE.check("a training must give the same model tomorrow, in whatever order files are read")
def order_of_batches_and_repeating_do_not_matter(c: SelectorCase) -> None:
    x, y = year()
    order = [4, 2, 0, 3, 1]
    rows = np.concatenate([np.arange(len(y))[c.design.rows(k)] for k in order])
    turned = stack(x[rows], y[rows], [LENGTHS[k] for k in order])
    c.expect_same(turned, "with the batches in another order", [order.index(k) for k in TRAIN])
    c.expect_same(c.design, "a second time")
    c.expect_same(c.design, "with the training batches named in another order", TRAIN[::-1])


@SUITE.check("a driver in rpm stands next to temperatures in K; no unit may win by its size")
def unit_and_sign_of_an_input_do_not_matter(c: SelectorCase) -> None:
    x, y = year()
    factor = np.array([1.8, 1000.0, 1.0, 0.01, -1.0, 3.0, -0.5])
    c.expect_same(stack(x * factor, y * 0.001, LENGTHS), "with inputs and error in other units")


@SUITE.check("the order of channels in a machine file says nothing; a last pair may tie")
def order_of_inputs_does_not_matter(c: SelectorCase) -> None:
    x, y = year()
    order = [3, 0, 6, 2, 5, 1, 4]
    names = tuple(f"t{i}" for i in range(P))
    turned = c.chosen(stack(x[:, order], y, LENGTHS, tuple(names[i] for i in order)))
    for n in ALL_N[1:]:
        expect(set(turned[n]) == set(c.usual[n]), f"{c.usual[n]} with the inputs in another order", turned[n])


@SUITE.check("a dead sensor correlates with nothing, and a ratio with its spread is 0/0")
def constant_inputs_come_last(c: SelectorCase) -> None:
    if not c.choosing:
        return
    x, y = year()
    x[:, 0], x[:, 4] = 0.0, 3000.0
    for n, inputs in c.chosen(stack(x, y, LENGTHS)).items():
        expect(len(inputs) == n, f"{n} inputs though two are constant", inputs)
        constant = {"t0", "t4"} & set(inputs)
        allowed = {P: {"t0", "t4"}, P - 1: {"t0"}}.get(n, set())
        expect(constant == allowed, f"{allowed or 'none'} of the constant inputs t0, t4 for n_tsp {n}", constant)


@SUITE.check("two loggers of one sensor are a tie; which one wins must not be chance")
def equal_inputs_are_a_tie_for_the_first(c: SelectorCase) -> None:
    if not c.choosing:
        return
    x, y = year()
    x[:, 5] = x[:, 1]
    x[:, 6] = x[:, 1] * 2.0
    for n, inputs in c.chosen(stack(x, y, LENGTHS)).items():
        expect(
            "t1" in inputs or not {"t5", "t6"} & set(inputs), f"t1 before its copies t5 and t6 for n_tsp {n}", inputs
        )


@SUITE.check("a run at rest has neither error nor rise; the grid goes on")
def a_constant_target_still_gives_a_choice(c: SelectorCase) -> None:
    x, y = year()
    for design in (stack(x, np.zeros_like(y), LENGTHS), stack(np.zeros_like(x), y, LENGTHS)):
        expect([len(v) for v in c.chosen(design).values()] == c.sizes, f"{c.sizes} inputs", "another number")


@SUITE.check("a plan from a file can state any number")
def a_number_that_cannot_be_is_refused(c: SelectorCase) -> None:
    for n in (0, -1, P + 1) if c.choosing else ():
        select = lambda n=n: c.selector().select_design(c.design, TRAIN, [2, n])  # noqa: E731
        expect_refused(select, f"selector {c.selector.key}: n_tsp is {n}; expected 1 to {P}, the number of inputs")


@SUITE.check("the reader must see which batch and which input to look at")
def no_usable_row_is_one_line(c: SelectorCase) -> None:
    if c.choosing:
        x, y = year()
        x[c.design.rows(1), 2] = np.nan
        select = lambda: c.selector().select_design(stack(x, y, LENGTHS), [1], [2])  # noqa: E731
        expect_refused(select, "0 usable rows in the training batches (b1), expected at least 3",
                       "'t2' is missing in 42 of 42 rows")  # fmt: skip


@SUITE.check("a notebook selects from batches")
def batches_go_in_too(c: SelectorCase) -> None:
    channels = {f"t{i}": Channel(f"t{i}", "temperature", "degC") for i in range(P)}
    channels["z_um"] = Channel("z_um", "error", "um")
    batches = []
    for k in TRAIN:
        rows = c.design.rows(k)
        table = pd.DataFrame({"time_s": c.design.time_s[rows]})
        for i in range(P):
            table[f"t{i}"] = c.design.x[rows, i] + 21
        batches.append(Batch("vmc", f"b{k}", table.assign(z_um=c.design.y_um[rows]), channels))
    chosen = c.selector().select(batches, "z_um", 3)
    expect(len(chosen) == c.sizes[2], f"{c.sizes[2]} inputs", chosen)


@SUITE.check("a plan may name some numbers of points only")
def a_number_alone_gives_what_it_gives_among_others(c: SelectorCase) -> None:
    for n in (1, 3, 5) if c.choosing else ():
        got = c.selector().select_design(c.design, TRAIN, [n])
        expect(got == {n: c.usual[n]}, f"{n}: {c.usual[n]}", got)


@SUITE.check("train-on-one is a protocol, and runs begin with missing values")
def little_to_learn_from_is_enough(c: SelectorCase) -> None:
    x, y = year()
    x[LENGTHS[0] + LENGTHS[1] + 4, 3] = np.nan
    for train in ([2], [0, 4]):
        got = [len(v) for v in c.chosen(stack(x, y, LENGTHS), train).values()]
        expect(got == c.sizes, f"{c.sizes} inputs from batches {train}", got)
    short = year()[1]
    short[3 : LENGTHS[0]] = np.nan
    expect(len(c.chosen(stack(year()[0], short, LENGTHS), [0])) == P, "a choice from three usable rows", "none")


@SUITE.check("machines have up to 300 points: all subsets cannot be tried")
def many_inputs_can_be_chosen_from(c: SelectorCase) -> None:
    if c.choosing:
        x, y = year(p=20)
        choice = c.selector().select_design(stack(x, y, LENGTHS), TRAIN, [1, 6, 20])
        expect([len(v) for v in choice.values()] == [1, 6, 20], "1, 6 and 20 of 20 inputs", choice)


@SUITE.check("the report prints them; NaN is no statistic")
def diagnostics_are_finite(c: SelectorCase) -> None:
    x, y = year()
    x[:, 4] = 7.0
    design = stack(x, y, LENGTHS)
    for train in (TRAIN, (2,)):
        for n in (1, 2, 5, P):
            for d in c.selector().diagnostics(design, train, n):
                expect(np.isfinite([d.value, d.threshold]).all() and isinstance(d.ok, bool), "finite numbers", d)
                expect(d.statistic and d.comment and "\n" not in d.comment, "a statistic and a comment of one line", d)
