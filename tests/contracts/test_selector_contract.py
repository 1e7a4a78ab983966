"""What a choice of temperature-sensitive points must not depend on, for every registered selector."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch, Channel
from data.errors import InputError
from features.design import Design
from features.selectors import SELECTORS
from features.selectors.base import Selector
from tests.toys.runs import LENGTHS, P, stack, year

TRAIN, ALL_N = (0, 1, 3), range(1, P + 1)
Choice = dict[int, tuple[str, ...]]


@dataclass(frozen=True)
class Case:
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

    def chosen(self, design: Design, train: Sequence[int] = TRAIN, n_tsps: Sequence[int] = ALL_N) -> Choice:
        return self.selector().select_design(design, train, n_tsps)

    def numbers(self, design: Design, train: Sequence[int] = TRAIN) -> list[int]:
        return [len(inputs) for inputs in self.chosen(design, train).values()]


@pytest.fixture(scope="module", params=SELECTORS, name="c")
def case(request: pytest.FixtureRequest) -> Case:
    return Case(SELECTORS[request.param])


def test_distinct_inputs_in_the_designs_order(c: Case) -> None:
    assert [len(inputs) for inputs in c.usual.values()] == c.sizes
    for inputs in c.usual.values():
        assert list(inputs) == [i for i in c.design.inputs if i in set(inputs)]


def test_nothing_is_learned_outside_the_training_batches(c: Case) -> None:
    design = stack(*year(), LENGTHS)
    for k in set(range(len(LENGTHS))) - set(TRAIN):
        design.x[design.rows(k)] = 50 + 40 * np.random.default_rng(k).normal(size=(LENGTHS[k], P))
        design.y_um[design.rows(k)] *= -9
    design.x[design.rows(2)][3:9, 1] = np.nan
    assert c.chosen(design) == c.usual


def test_training_batches_change_the_choice(c: Case) -> None:
    x, y = year()
    assert not c.choosing or c.chosen(stack(x[:, ::-1].copy(), y, LENGTHS)) != c.usual


def test_order_of_batches_and_repeating_do_not_matter(c: Case) -> None:
    x, y = year()
    order = [4, 2, 0, 3, 1]
    rows = np.concatenate([np.arange(len(y))[c.design.rows(k)] for k in order])
    turned = stack(x[rows], y[rows], [LENGTHS[k] for k in order])
    assert c.chosen(turned, [order.index(k) for k in TRAIN]) == c.usual
    assert c.chosen(c.design) == c.chosen(c.design, TRAIN[::-1]) == c.usual


def test_unit_and_sign_of_an_input_do_not_matter(c: Case) -> None:
    """A driver in rpm stands next to temperatures in K."""
    x, y = year()
    factor = np.array([1.8, 1000.0, 1.0, 0.01, -1.0, 3.0, -0.5])
    assert c.chosen(stack(x * factor, y * 0.001, LENGTHS)) == c.usual


def test_order_of_inputs_does_not_matter(c: Case) -> None:
    x, y = year()
    order = [3, 0, 6, 2, 5, 1, 4]
    turned = c.chosen(stack(x[:, order], y, LENGTHS, tuple(f"t{i}" for i in order)))
    for n in ALL_N[1:]:  # a last pair may tie
        assert set(turned[n]) == set(c.usual[n])


def test_constant_inputs_come_last(c: Case) -> None:
    x, y = year()
    x[:, 0], x[:, 4] = 0.0, 3000.0
    design = stack(x, y, LENGTHS)
    for n, inputs in c.chosen(design).items() if c.choosing else ():
        assert len(inputs) == n
        assert {"t0", "t4"} & set(inputs) == {P: {"t0", "t4"}, P - 1: {"t0"}}.get(n, set())


def test_equal_inputs_are_a_tie_for_the_first(c: Case) -> None:
    x, y = year()
    x[:, 5], x[:, 6] = x[:, 1], x[:, 1] * 2.0
    design = stack(x, y, LENGTHS)
    for inputs in c.chosen(design).values() if c.choosing else ():
        assert "t1" in inputs or not {"t5", "t6"} & set(inputs)


def test_a_constant_target_still_gives_a_choice(c: Case) -> None:
    x, y = year()
    for design in (stack(x, np.zeros_like(y), LENGTHS), stack(np.zeros_like(x), y, LENGTHS)):
        assert c.numbers(design) == c.sizes


def test_a_number_that_cannot_be_is_refused(c: Case) -> None:
    for n in (0, -1, P + 1) if c.choosing else ():
        words = f"selector {c.selector.key}: n_tsp is {n}; expected 1 to {P}, the number of inputs"
        with pytest.raises(InputError, match=rf"\A.*{words}.*\Z"):
            c.chosen(c.design, TRAIN, [2, n])


def test_no_usable_row_is_one_line(c: Case) -> None:
    if c.choosing:
        x, y = year()
        x[c.design.rows(1), 2] = np.nan
        words = r"0 usable rows in the training batches \(b1\), expected at least 3.*'t2' is missing in 42 of 42 rows"
        with pytest.raises(InputError, match=rf"\A.*{words}.*\Z"):
            c.chosen(stack(x, y, LENGTHS), [1], [2])


def test_batches_go_in_too(c: Case) -> None:
    channels = {f"t{i}": Channel(f"t{i}", "temperature", "degC") for i in range(P)}
    channels["z_um"] = Channel("z_um", "error", "um")
    batches = []
    for k in TRAIN:
        rows = c.design.rows(k)
        table = pd.DataFrame(c.design.x[rows] + 21, columns=list(channels)[:P])
        table = table.assign(time_s=c.design.time_s[rows], z_um=c.design.y_um[rows])
        batches.append(Batch("vmc", f"b{k}", table, channels))
    assert len(c.selector().select(batches, "z_um", 3)) == c.sizes[2]


def test_a_number_alone_gives_what_it_gives_among_others(c: Case) -> None:
    for n in (1, 3, 5) if c.choosing else ():
        assert c.chosen(c.design, TRAIN, [n]) == {n: c.usual[n]}


def test_little_to_learn_from_is_enough(c: Case) -> None:
    x, y = year()
    x[LENGTHS[0] + LENGTHS[1] + 4, 3] = np.nan
    for train in ([2], [0, 4]):
        assert c.numbers(stack(x, y, LENGTHS), train) == c.sizes
    short = year()[1]
    short[3 : LENGTHS[0]] = np.nan
    assert len(c.chosen(stack(year()[0], short, LENGTHS), [0])) == P


def test_many_inputs_can_be_chosen_from(c: Case) -> None:
    """Machines have up to 300 points: all subsets cannot be tried."""
    if c.choosing:
        choice = c.chosen(stack(*year(p=20), LENGTHS), TRAIN, [1, 6, 20])
        assert [len(v) for v in choice.values()] == [1, 6, 20]


def test_diagnostics_are_finite(c: Case) -> None:
    x, y = year()
    x[:, 4] = 7.0
    for train, n in ((t, n) for t in (TRAIN, (2,)) for n in (1, 2, 5, P)):
        for d in c.selector().diagnostics(stack(x, y, LENGTHS), train, n):
            assert np.isfinite([d.value, d.threshold]).all() and isinstance(d.ok, bool)
            assert d.statistic and d.comment and "\n" not in d.comment
