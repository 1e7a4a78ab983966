"""The swarm on functions whose least value is known."""

import numpy as np
import pytest

from models.numerics.particle_swarm import least

BOX = np.array([-3.0, -2.0]), np.array([4.0, 5.0])


def bowl(at):
    return ((at - [1.3, -0.4]) ** 2 * [1, 20]).sum(axis=1)


def valley(at):
    return (1 - at[:, 0]) ** 2 + 100 * (at[:, 1] - at[:, 0] ** 2) ** 2  # Rosenbrock: least at (1, 1)


def waves(at):
    return 20 + (at**2 - 10 * np.cos(2 * np.pi * at)).sum(axis=1)  # Rastrigin: 56 hollows, least at (0, 0)


@pytest.mark.parametrize(("function", "where", "near"), [
    (bowl, [1.3, -0.4], 1e-4), (valley, [1, 1], 1e-2), (waves, [0, 0], 1e-2),
])  # fmt: skip
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_least_value_is_found(function, where, near, seed):
    at, value = least(function, *BOX, seed=seed, particles=40, steps=120)
    np.testing.assert_allclose(at, where, atol=near)
    assert value == function(at[None])[0]


def test_beyond_the_box_it_stops_at_the_wall():
    asked = []

    def slope(at):
        asked.append(at.copy())
        return at[:, 0] - at[:, 1]

    at, _ = least(slope, *BOX, seed=0)
    np.testing.assert_array_equal(at, [-3, 5])
    every = np.concatenate(asked)
    assert (every >= BOX[0]).all() and (every <= BOX[1]).all()


def test_the_same_seed_gives_the_same_points_and_values_that_are_no_numbers_are_passed_over():
    def holed(at):
        return np.where(at[:, 0] < 0, np.nan, bowl(at))

    first, again = (least(holed, *BOX, seed=7)[0] for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert np.any(least(holed, *BOX, seed=8)[0] != first)
    np.testing.assert_allclose(first, [1.3, -0.4], atol=0.05)
