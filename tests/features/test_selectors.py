"""Every selector of the registry under the same rules, and the correlations that they share against numpy."""

import numpy as np
import pandas as pd
import pytest
from stacked_rows import LENGTHS, P, stack, year

from data.batch import Batch, Channel
from data.errors import InputError
from features.design import Design
from features.selectors import SELECTORS
from features.selectors.statistics import training_statistics

TRAIN = [0, 1, 3]
ALL_N = list(range(1, P + 1))
CHOOSING = [key for key in SELECTORS if SELECTORS[key].takes_n_tsp]


def chosen(key: str, design: Design, train: list[int] | None = None) -> dict[int, tuple[str, ...]]:
    result: dict[int, tuple[str, ...]] = SELECTORS[key]().select_design(design, train or TRAIN, ALL_N)
    return result


@pytest.mark.parametrize("key", SELECTORS)
def test_returns_the_asked_number_of_distinct_inputs_in_the_designs_order(key: str) -> None:
    design = stack(*year(), LENGTHS)
    for n, inputs in chosen(key, design).items():
        assert len(inputs) == (n if SELECTORS[key].takes_n_tsp else P)
        assert list(inputs) == [i for i in design.inputs if i in set(inputs)]


@pytest.mark.parametrize("key", SELECTORS)
def test_left_out_batches_change_nothing(key: str) -> None:
    x, y = year()
    before = chosen(key, stack(x, y, LENGTHS))
    design = stack(x.copy(), y.copy(), LENGTHS)
    for k in set(range(len(LENGTHS))) - set(TRAIN):
        design.x[design.rows(k)] = 50 + 40 * np.random.default_rng(k).normal(size=(LENGTHS[k], P))
        design.y_um[design.rows(k)] *= -9
    design.x[design.rows(2)][3:9, 1] = np.nan
    assert chosen(key, design) == before


@pytest.mark.parametrize("key", CHOOSING)
def test_training_batches_do_change_the_choice(key: str) -> None:
    x, y = year()
    design = stack(x.copy(), y.copy(), LENGTHS)
    before = chosen(key, design)
    others = stack(x[:, ::-1].copy(), y, LENGTHS)
    assert chosen(key, others) != before


@pytest.mark.parametrize("key", SELECTORS)
def test_order_of_batches_and_repeating_do_not_matter(key: str) -> None:
    x, y = year()
    design = stack(x, y, LENGTHS)
    order = [4, 2, 0, 3, 1]
    rows = np.concatenate([np.arange(len(y))[design.rows(k)] for k in order])
    turned = stack(x[rows], y[rows], [LENGTHS[k] for k in order])
    assert chosen(key, turned, [order.index(k) for k in TRAIN]) == chosen(key, design)
    assert chosen(key, design) == chosen(key, design)
    assert chosen(key, design, TRAIN[::-1]) == chosen(key, design)


@pytest.mark.parametrize("key", SELECTORS)
def test_unit_and_sign_of_an_input_do_not_matter(key: str) -> None:
    x, y = year()
    factor = np.array([1.8, 1000.0, 1.0, 0.01, -1.0, 3.0, -0.5])
    assert chosen(key, stack(x * factor, y * 0.001, LENGTHS)) == chosen(key, stack(x, y, LENGTHS))


@pytest.mark.parametrize("key", SELECTORS)
def test_order_of_inputs_does_not_matter_without_ties(key: str) -> None:
    x, y = year()
    order = [3, 0, 6, 2, 5, 1, 4]
    names = tuple(f"t{i}" for i in range(P))
    turned = stack(x[:, order], y, LENGTHS, tuple(names[i] for i in order))
    plain = stack(x, y, LENGTHS)
    for n, inputs in chosen(key, turned).items():
        if key != "pca_elimination" or n > 1:  # the last two inputs are always tied
            assert set(inputs) == set(chosen(key, plain)[n])


@pytest.mark.parametrize("key", CHOOSING)
def test_constant_inputs_are_never_chosen_before_others(key: str) -> None:
    x, y = year()
    x[:, 0], x[:, 4] = 0.0, 3000.0
    for n, inputs in chosen(key, stack(x, y, LENGTHS)).items():
        assert len(inputs) == n
        if n <= P - 2:
            assert not {"t0", "t4"} & set(inputs)
        elif n == P - 1:
            assert "t0" in inputs and "t4" not in inputs


@pytest.mark.parametrize("key", CHOOSING)
def test_equal_inputs_are_a_tie_for_the_first(key: str) -> None:
    x, y = year()
    x[:, 5] = x[:, 1]
    x[:, 6] = x[:, 1] * 2.0
    for n, inputs in chosen(key, stack(x, y, LENGTHS)).items():
        if "t5" in inputs or "t6" in inputs:
            assert "t1" in inputs, n


@pytest.mark.parametrize("key", CHOOSING)
def test_a_target_that_stands_still_still_gives_a_choice(key: str) -> None:
    x, y = year()
    assert [len(v) for v in chosen(key, stack(x, np.zeros_like(y), LENGTHS)).values()] == ALL_N
    assert [len(v) for v in chosen(key, stack(np.zeros_like(x), y, LENGTHS)).values()] == ALL_N


@pytest.mark.parametrize("key", CHOOSING)
@pytest.mark.parametrize("n", [0, -1, 8])
def test_a_number_that_cannot_be_is_refused(key: str, n: int) -> None:
    with pytest.raises(InputError, match=rf"^selector {key}: n_tsp is {n}; expected 1 to 7, the number of inputs$"):
        SELECTORS[key]().select_design(stack(*year(), LENGTHS), TRAIN, [2, n])


@pytest.mark.parametrize("key", CHOOSING)
def test_training_without_usable_rows_is_refused_with_the_input_to_blame(key: str) -> None:
    x, y = year()
    design = stack(x, y, LENGTHS)
    x[design.rows(1), 2] = np.nan
    expected = r"0 usable rows in the training batches \(b1\), expected at least 3; 't2' is missing in 42 of 42 rows"
    with pytest.raises(InputError, match=expected):
        SELECTORS[key]().select_design(design, [1], [2])


@pytest.mark.parametrize("key", SELECTORS)
def test_batches_of_temperatures_go_in_too(key: str) -> None:
    x, y = year()
    design = stack(x, y, LENGTHS)
    channels = {f"t{i}": Channel(f"t{i}", "temperature", "degC") for i in range(P)}
    channels["z_um"] = Channel("z_um", "error", "um")
    batches = []
    for k in TRAIN:
        rows = design.rows(k)
        table = pd.DataFrame({"time_s": design.time_s[rows], **{f"t{i}": x[rows, i] + 21 for i in range(P)}})
        batches.append(Batch("vmc", f"b{k}", table.assign(z_um=y[rows]), channels))
    assert len(SELECTORS[key]().select(batches, "z_um", 3)) == (3 if SELECTORS[key].takes_n_tsp else P)


@pytest.mark.parametrize("key", CHOOSING)
def test_a_number_asked_alone_gives_what_it_gives_among_others(key: str) -> None:
    design = stack(*year(), LENGTHS)
    every = chosen(key, design)
    for n in (1, 3, 5):
        assert SELECTORS[key]().select_design(design, TRAIN, [n]) == {n: every[n]}


@pytest.mark.parametrize("key", SELECTORS)
@pytest.mark.parametrize("train", [[2], [0, 4]])
def test_one_or_two_batches_are_enough(key: str, train: list[int]) -> None:
    x, y = year()
    x[LENGTHS[0] + LENGTHS[1] + 4, 3] = np.nan
    choice = chosen(key, stack(x, y, LENGTHS), train)
    assert [len(v) for v in choice.values()] == (ALL_N if SELECTORS[key].takes_n_tsp else [P] * P)


@pytest.mark.parametrize("key", SELECTORS)
def test_three_usable_rows_are_enough(key: str) -> None:
    x, y = year()
    y = y.copy()
    y[3 : LENGTHS[0]] = np.nan
    assert len(chosen(key, stack(x, y, LENGTHS), [0])) == P


@pytest.mark.parametrize("key", CHOOSING)
def test_more_inputs_than_all_subsets_can_be_tried_of(key: str) -> None:
    x, y = year(p=20)
    choice = SELECTORS[key]().select_design(stack(x, y, LENGTHS), TRAIN, [1, 6, 20])
    assert [len(v) for v in choice.values()] == [1, 6, 20]


@pytest.mark.parametrize("key", SELECTORS)
def test_diagnostics_are_finite_and_say_something(key: str) -> None:
    x, y = year()
    x[:, 4] = 7.0
    design = stack(x, y, LENGTHS)
    for train in (TRAIN, [2]):
        for n in (1, 2, 5, P):
            for d in SELECTORS[key]().diagnostics(design, train, n):
                assert np.isfinite([d.value, d.threshold]).all() and d.statistic and d.comment
                assert "\n" not in d.comment and isinstance(d.ok, bool)


def test_correlations_from_sums_equal_numpy_on_stacked_rows() -> None:
    x, y = year()
    x[5:9, 3] = np.nan
    y[40:44] = np.nan
    design = stack(x, y, LENGTHS)
    statistics = training_statistics(design, TRAIN, "any")
    rows, target, _ = design.stacked(TRAIN)
    truth = np.corrcoef(np.column_stack([rows, target]), rowvar=False)
    assert np.allclose(statistics.between, truth[:P, :P], atol=1e-12)
    assert np.allclose(statistics.with_target, truth[:P, P], atol=1e-12)
    order = np.argsort(-np.abs(truth[:P, P]))
    for n, inputs in chosen("correlation", design).items():
        assert set(inputs) == {f"t{i}" for i in order[:n]}
