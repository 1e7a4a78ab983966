"""Batches as thinned sequences: every row once, nothing from later, nothing across a border."""

from dataclasses import replace

import numpy as np
import pytest

from features.design import Design
from features.rises import first_order_lag
from models.families.sequence_net import fit_memories
from models.numerics.sequences import LAG_STEPS, Sequences, Stack, memory_columns, strides
from tests.toys.runs import stack


def make_design(sizes=(7, 5), p=2, step_s=60.0, seed=0, **more) -> Design:
    rng = np.random.default_rng(seed)
    return replace(stack(rng.normal(size=(sum(sizes), p)), rng.normal(size=sum(sizes)), sizes, step_s=step_s), **more)


def test_rows_of_a_phase_are_a_stride_apart_and_every_row_is_in_one() -> None:
    design = make_design()
    s = Sequences.of(design, 3)
    assert s.x.shape == (2, 3, 3, 2)
    assert s.row[0].tolist() == [[0, 3, 6], [1, 4, -1], [2, 5, -1]]
    assert s.row[1].tolist() == [[7, 10, -1], [8, 11, -1], [9, -1, -1]]
    for k, phase, step in np.argwhere(s.row >= 0):
        np.testing.assert_array_equal(s.x[k, phase, step], design.x[s.row[k, phase, step]])
        assert s.y_um[k, phase, step] == design.y_um[s.row[k, phase, step]]
    assert not s.known[s.row < 0].any() and (s.x[s.row < 0] == 0).all()
    np.testing.assert_array_equal(s.rows(s.row), np.arange(12))


def test_training_takes_four_spread_phases_of_many() -> None:
    s = Sequences.of(make_design((40, 31)), 10).for_training()
    assert s.row[0, :, 0].tolist() == [0, 3, 6, 9]
    assert Sequences.of(make_design(), 3).for_training().row.shape[1] == 3


def test_holes_are_held_and_what_a_batch_lacks_stays_nan_and_unknown() -> None:
    design = make_design()
    x, y_um = design.x.copy(), design.y_um.copy()
    x[2, 0], x[7:, 1], y_um[4] = np.nan, np.nan, np.nan
    holed = replace(design, x=x, y_um=y_um)
    s = Sequences.of(holed, 1)
    assert s.x[0, 0, 2, 0] == x[1, 0]
    assert np.isnan(s.x[1, 0, :5, 1]).all()
    assert s.known[0, 0].tolist() == [True, True, False, True, False, True, True] and not s.known[1].any()
    trained = s.for_training()
    assert np.isfinite(trained.x).all()
    back = trained.as_design(trained.x)
    assert np.flatnonzero(np.isnan(back.y_um)).tolist() == [2, 4, 7, 8, 9, 10, 11]
    assert back.offsets.tolist() == [0, 7, 12] and back.batch_ids == design.batch_ids


def test_drivers_are_means_over_the_step_at_rest_before_the_start() -> None:
    speed = np.array([[4.0], [4, 0, 0, 8, 8, 8], [2, 2, np.nan, 2, 2]], object)
    speed = np.concatenate([np.array(part, float) for part in speed])[:, None]
    design = make_design(drivers=speed, driver_names=("rpm",), driver_units=("rpm",), input_units=("K", "K"))
    s = Sequences.of(design, 2, ("rpm", "feed"))
    assert s.units == ("K", "K", "rpm", "")
    np.testing.assert_allclose(s.rows(s.x)[:, 2], [2, 4, 2, 0, 4, 8, 8, 1, 2, 2, 2, 2])
    assert np.isnan(s.rows(s.x)[:, 3]).all()  # a driver that was not recorded


@pytest.mark.parametrize(("step_s", "spacing_s", "want"), [(300.0, 1200.0, 4), (60.0, 1200.0, 20), (1800.0, 1200.0, 1)])
def test_rows_per_step(step_s: float, spacing_s: float, want: int) -> None:
    assert strides(make_design((7, 1), step_s=step_s), spacing_s).tolist() == [want, 1]


def test_memory_columns_are_the_inputs_and_how_far_their_lags_are_behind() -> None:
    x = np.random.default_rng(0).normal(size=(2, 30, 3)).cumsum(axis=1)
    got = memory_columns(x).reshape(2, 30, len(LAG_STEPS) + 1, 3)
    np.testing.assert_array_equal(got[:, :, 0], x)
    for lag, steps in enumerate(LAG_STEPS):
        for k in range(2):
            for j in range(3):
                # first_order_lag begins at its first value; a step of rest before it makes that the zero state
                rested = np.concatenate([[0.0], x[k, :, j]])
                behind = first_order_lag(rested, steps * 60.0, 60.0)[1:] - x[k, :, j]
                np.testing.assert_allclose(got[k, :, lag + 1, j], behind, atol=1e-12)


def test_linear_memory_recovers_a_law_of_lagged_inputs() -> None:
    design = make_design((60, 50, 55, 60), p=2)
    design = replace(design, x=np.cumsum(design.x, axis=0))
    s = Sequences.of(design, 1)
    columns = memory_columns(s.x)
    law = np.random.default_rng(1).normal(size=columns.shape[-1])
    taught = Sequences(s.design, s.units, s.x, columns @ law + 4.0, s.known, s.row)
    coef, intercept_um = fit_memories(taught, columns, [[0, 1, 2], [0, 1, 2, 3]], zero_start=False)
    for f in range(2):
        told = columns[3, 0] @ coef[f] + intercept_um[f]
        assert np.std(told - taught.y_um[3, 0]) < 1e-2 * np.std(taught.y_um[3, 0])


def test_more_inputs_than_directions_still_use_every_input_itself() -> None:
    design = make_design((60, 50, 55), p=9)
    s = Sequences.of(design, 1)
    columns = memory_columns(s.x)
    taught = Sequences(s.design, s.units, s.x, s.x @ np.arange(1.0, 10.0), s.known, s.row)
    coef, _ = fit_memories(taught, columns, [[0, 1, 2]], zero_start=False)
    np.testing.assert_allclose(coef[0], np.concatenate([np.arange(1.0, 10.0), np.zeros(36)]), atol=1e-2)


def test_a_stack_is_scaled_by_its_known_rows_and_fills_up_with_unknown_batches() -> None:
    design = make_design((9, 9, 9), p=2)
    s = Sequences.of(design, 1)
    stack = Stack.joined([Stack.of(s, [0, 1, 2], 3.0 * s.y_um), Stack.of(s, [1], s.y_um)])
    assert stack.x.shape == (1, 2, 2, 9, 3) and stack.n_batches.tolist() == [3, 1]
    assert stack.known[0, 1].sum() == 9 and stack.known[0, 1, :, 0].all()
    np.testing.assert_allclose(stack.spread[0], np.sqrt((design.x**2).mean(axis=0)))
    np.testing.assert_allclose(stack.sigma_um[1], np.sqrt((design.y_um[9:18] ** 2).mean()))
    np.testing.assert_allclose((stack.rest**2 * stack.known).sum(axis=(0, 2, 3)), [27.0, 9.0])
    sums = np.einsum("shp,rsptb->rshtb", stack.unit_directions(np.array([[1.0, -2.0]])), stack.x)
    assert (sums[0, 0, 0] ** 2).mean() == pytest.approx(1.0)


def test_halves_are_the_even_and_the_odd_batches() -> None:
    s = Sequences.of(make_design((4, 4, 4), p=1), 1)
    stack = Stack.of(s, [0, 1, 2], s.y_um)
    halves = stack.halves()
    np.testing.assert_array_equal(halves.x[0, 0, 0], stack.x[0, 0, 0][:, [0, 2]])
    np.testing.assert_array_equal(halves.x[0, 1, 0, :, 0], stack.x[0, 0, 0, :, 1])
    assert halves.known[0, 1].sum() == 4 and halves.n_batches.tolist() == [2, 1]
