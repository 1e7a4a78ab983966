"""The published run of grey models inside one batch."""

import numpy as np
import pytest

from data.errors import InputError
from tests.toys.grey import literal_run, rises
from thermodrift_exam.studies.grey_sequences import sequence_outputs


def one_batch(seed=6, bend=0.0):
    rng = np.random.default_rng(seed)
    x = rises(116, 5, rng) + 20
    b = np.array([1.2, -0.7, 0.4, 0.9, -0.2])
    y = literal_run(x, 1.6, b, first=3.0)
    return x, y + bend * (y - y[15]) ** 2


def test_on_its_own_law_every_sequence_goes_on_exactly():
    x, y = one_batch()
    outputs = sequence_outputs(x, y, range(15, 55))
    assert outputs.shape == (116, 4)
    for g, start in enumerate((30, 25, 20, 15)):  # rows 16–55 counted from 1, the last 25, 30, 35, 40 of them
        assert np.isnan(outputs[:start, g]).all()
        assert outputs[start, g] == y[start]
    # A later start changes sums by a constant that this law does not have: only the first sequence's own law is exact.
    x, b = x[15:], np.array([1.2, -0.7, 0.4, 0.9, -0.2])
    y = literal_run(x, 1.6, b, first=4.0)
    free = sequence_outputs(x, y, range(40), (40,))
    np.testing.assert_allclose(free[:, 0], y, atol=1e-5)
    ahead = sequence_outputs(x, y, range(40), (40,), one_step=True)
    np.testing.assert_allclose(ahead[:, 0], y, atol=1e-5)


def test_one_step_ahead_leans_on_measured_errors_and_a_free_run_does_not():
    x, y = one_batch()
    drifted = y.copy()
    drifted[70:] += 10.0
    for one_step in (False, True):
        before = sequence_outputs(x, y, range(15, 55), one_step=one_step)
        after = sequence_outputs(x, drifted, range(15, 55), one_step=one_step)
        assert np.allclose(before, after, equal_nan=True) != one_step


@pytest.mark.parametrize("lengths", [(41,), (6,)])
def test_a_length_that_cannot_be_is_told(lengths):
    x, y = one_batch()
    with pytest.raises(
        InputError, match=f"length {lengths[0]} with 40 rows to fit and 5 inputs; expected from 7 to 40"
    ):
        sequence_outputs(x, y, range(15, 55), lengths)
