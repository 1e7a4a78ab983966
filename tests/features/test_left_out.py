"""Left-out errors from sums against least squares done row by row, and the searches against trying everything."""

from itertools import combinations

import numpy as np
import pytest
from numpy.typing import NDArray
from stacked_rows import LENGTHS, orthonormal, stack, year

from features.design import Design
from features.selectors.exhaustive import Exhaustive
from features.selectors.left_out import LeftOut, beam, errors_of_all
from features.selectors.sequential_forward import SequentialForward

TRAIN = [0, 1, 3, 4]


def by_rows(design: Design, blocks: list[NDArray[np.int64]], columns: tuple[int, ...]) -> float:
    """Mean S over the blocks, each left out of a least squares fit with an intercept, over the target's spread."""
    S = []
    for i, block in enumerate(blocks):
        rest = np.concatenate([b for j, b in enumerate(blocks) if j != i])
        table = np.column_stack([np.ones(len(design.x)), design.x[:, list(columns)]])
        beta = np.linalg.lstsq(table[rest], design.y_um[rest], rcond=None)[0]
        e = design.y_um[block] - table[block] @ beta
        S.append(np.sqrt(e @ e / (len(e) - 1)))
    return float(np.mean(S) / design.y_um[np.concatenate(blocks)].std())


def usable(design: Design, train: list[int]) -> list[NDArray[np.int64]]:
    return [np.flatnonzero(design.usable & (design.group == k)) for k in train]


def with_holes() -> Design:
    x, y = year()
    x[5:9, 3] = np.nan
    y[40:44] = np.nan
    return stack(x, y, LENGTHS)


def test_every_subset_equals_least_squares_by_rows() -> None:
    design = with_holes()
    errors = errors_of_all(LeftOut.of(design, TRAIN, np.arange(5)))
    assert errors.shape == (32,)
    for n in range(6):
        for columns in combinations(range(5), n):
            index = sum(1 << (4 - j) for j in columns)
            assert errors[index] == pytest.approx(by_rows(design, usable(design, TRAIN), columns), rel=1e-9)


@pytest.mark.parametrize("train", [[1], [1, 3]])
def test_of_fewer_than_three_batches_quarters_are_left_out(train: list[int]) -> None:
    design = with_holes()
    blocks = [r[np.arange(len(r)) * 4 // len(r) == q] for r in usable(design, train) for q in range(4)]
    errors = errors_of_all(LeftOut.of(design, train, np.arange(3)))
    for columns in [(), (0,), (1, 2), (0, 1, 2)]:
        index = sum(1 << (2 - j) for j in columns)
        assert errors[index] == pytest.approx(by_rows(design, blocks, columns), rel=1e-9)


def test_an_input_that_repeats_taken_ones_changes_nothing() -> None:
    x, y = year()
    x[:, 3] = 2.0 * x[:, 0] - x[:, 1]
    errors = errors_of_all(LeftOut.of(stack(x, y, LENGTHS), TRAIN, np.arange(4)))
    assert errors[0b1101] == pytest.approx(errors[0b1100], rel=1e-9)
    assert errors[0b1111] == pytest.approx(errors[0b1110], rel=1e-9)


def test_all_subsets_finds_the_best_by_rows() -> None:
    design = with_holes()
    got = Exhaustive().select_design(design, TRAIN, [1, 2, 3, 6])
    for n, inputs in got.items():
        best = min(combinations(range(7), n), key=lambda c: by_rows(design, usable(design, TRAIN), c))
        assert inputs == tuple(f"t{i}" for i in best)


def test_forward_takes_the_best_next_one_by_rows() -> None:
    design = with_holes()
    taken: list[int] = []
    got = SequentialForward().select_design(design, TRAIN, range(1, 8))
    for n in range(1, 7):
        left = [j for j in range(7) if j not in taken]
        taken.append(min(left, key=lambda j: by_rows(design, usable(design, TRAIN), (*taken, j))))
        assert got[n] == tuple(f"t{i}" for i in sorted(taken))


def test_forward_misses_two_that_only_help_together_and_all_subsets_does_not() -> None:
    q = orthonormal(120, 3, seed=2)
    x = np.column_stack([q[:, 0] + 10 * q[:, 1], q[:, 1], 0.3 * q[:, 0] + q[:, 2]])  # t0 − 10 t1 is the error
    design = stack(x, q[:, 0], [40, 40, 40])
    assert SequentialForward().select_design(design, [0, 1, 2], [2])[2] != ("t0", "t1")
    assert Exhaustive().select_design(design, [0, 1, 2], [2])[2] == ("t0", "t1")


def test_a_wide_beam_is_all_subsets_and_a_narrow_one_is_never_better() -> None:
    design = with_holes()
    nothing = LeftOut.of(design, TRAIN, np.arange(7))
    errors = errors_of_all(nothing)
    size = np.bitwise_count(np.arange(128))
    wide, narrow = beam(nothing, 128), beam(nothing, 3)
    for n in range(1, 8):
        sets, error = wide[n - 1]
        assert error[0] == pytest.approx(errors[size == n].min(), rel=1e-9) and len(sets) == (size == n).sum()
        assert narrow[n - 1][1][0] >= error[0] - 1e-12
        np.testing.assert_allclose(error, errors[sets @ (1 << np.arange(7)[::-1])], rtol=1e-8)


def test_beyond_its_budget_all_subsets_searches_and_says_so() -> None:
    x, y = year(p=9)
    design = stack(x, y, LENGTHS)
    full, searched = Exhaustive(), Exhaustive(most_inputs=8, width=400)
    assert searched.select_design(design, TRAIN, range(1, 10)) == full.select_design(design, TRAIN, range(1, 10))
    said = searched.diagnostics(design, TRAIN, 3)
    assert [d.statistic for d in said] == ["inputs", "gap to the runner-up"]
    assert (said[0].value, said[0].threshold, said[0].ok) == (9.0, 8.0, False) and "beam search" in said[0].comment
    assert [d.statistic for d in full.diagnostics(design, TRAIN, 3)] == ["gap to the runner-up"]


def test_the_runner_up_is_named_with_its_gap() -> None:
    design = with_holes()
    blocks = usable(design, TRAIN)
    ranked = sorted((by_rows(design, blocks, c), c) for c in combinations(range(7), 3))
    (d,) = Exhaustive().diagnostics(design, TRAIN, 3)
    assert d.value == pytest.approx(ranked[1][0] / ranked[0][0] - 1, rel=1e-6)
    assert d.ok == (d.value >= 0.02) and d.comment.endswith(", ".join(f"t{i}" for i in ranked[1][1]))
