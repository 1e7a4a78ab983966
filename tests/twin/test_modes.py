"""Modes against closed forms, weights against 60-digit arithmetic, and the wording of what cannot be used."""

from decimal import Decimal, localcontext

import numpy as np
import pytest

from data.errors import InputError
from twin.simulation.modes import first_order_hold, modes_of


def chain(n_nodes: int, conductance_W_per_K: float, to_room_W_per_K: float = 0.0) -> np.ndarray:
    """Conductance matrix (N, N) of a row of nodes, the first one also tied to the room."""
    matrix = np.zeros((n_nodes, n_nodes))
    for i in range(n_nodes - 1):
        matrix[i : i + 2, i : i + 2] += conductance_W_per_K * np.array([[1, -1], [-1, 1]])
    matrix[0, 0] += to_room_W_per_K
    return matrix


def weights_to_60_digits(x: float, dt_s: float) -> tuple[Decimal, Decimal]:
    with localcontext() as context:
        context.prec = 1200  # x may be 1e-300: the differences below cancel twice
        y, dt = Decimal(x), Decimal(dt_s)
        decay = (-y).exp()
        return dt * (1 - decay * (1 + y)) / y**2, dt * (y - 1 + decay) / y**2


@pytest.mark.parametrize("x", [1e-300, 1e-12, 1e-5, 0.01, 0.3, 0.999999, 1.0, 1.000001, 1.7, 6.0, 60.0, 900.0])
def test_weights_are_exact_to_a_few_roundings(x: float) -> None:
    _, start, end = first_order_hold(np.array([x / 8.0]), 8.0)  # a power of two keeps x itself exact
    exact_start, exact_end = weights_to_60_digits(x, 8.0)
    assert abs(float(Decimal(float(start[0])) / exact_start - 1)) < 1e-15
    assert abs(float(Decimal(float(end[0])) / exact_end - 1)) < 1e-15


def test_without_decay_each_end_weighs_half_the_interval() -> None:
    decay, start, end = first_order_hold(np.zeros(1), 7.0)
    assert (decay[0], start[0], end[0]) == (1.0, 3.5, 3.5)


def test_two_bodies_even_out_with_the_reduced_capacity() -> None:
    modes = modes_of(np.array([[2e3, 5e3]]), chain(2, 12.0)[None, None])
    assert modes.rate_per_s[0, 0] == pytest.approx([0.0, 12.0 * (1 / 2e3 + 1 / 5e3)], rel=1e-14)
    assert modes.rate_per_s[0, 0, 0] == 0.0  # exactly: a closed network keeps its energy
    assert modes.time_constants_s()[0, 0, 0] == np.inf
    assert modes.time_constants_s()[0, 0, 1] == pytest.approx(1 / (12.0 * (1 / 2e3 + 1 / 5e3)))


def test_modes_rebuild_the_network_in_every_regime_and_set() -> None:
    rng = np.random.default_rng(0)
    capacity = rng.uniform(1e3, 1e6, (3, 5))
    matrices = np.array([[chain(5, g, 2.0) for g in (5.0, 50.0)] for _ in range(3)]) * rng.uniform(1, 2, (3, 1, 1, 1))
    modes = modes_of(capacity, matrices)
    assert (modes.n_sets, modes.n_regimes, modes.n_nodes) == (3, 2, 5)
    rebuilt = modes.shape @ (modes.rate_per_s[..., None] * modes.inverse)
    assert rebuilt == pytest.approx(matrices / capacity[:, None, :, None], rel=1e-10, abs=1e-16)
    assert modes.shape @ modes.inverse == pytest.approx(np.broadcast_to(np.eye(5), (3, 2, 5, 5)), abs=1e-12)
    assert (np.diff(modes.time_constants_s(), axis=-1) < 0).all()  # slowest first


def test_one_capacity_set_serves_many_conductance_sets() -> None:
    matrices = np.array([[chain(3, g, 1.0)] for g in (2.0, 3.0)])
    both = modes_of(np.array([[1e3, 2e3, 3e3]]), matrices)
    second = modes_of(np.array([[1e3, 2e3, 3e3]]), matrices[1:])
    assert np.array_equal(both.rate_per_s[1], second.rate_per_s[0])
    assert both.of_sets(slice(1, 2)).n_sets == 1


@pytest.mark.parametrize("capacity", [0.0, -5.0, np.nan, np.inf])
def test_a_capacity_that_is_none_names_set_and_node(capacity: float) -> None:
    with pytest.raises(InputError, match=r"^parameter set 1, node 2: heat capacity is \S+ J/K, expected a positive"):
        modes_of(np.array([[1.0, 1, 1], [1, 1, capacity]]), np.zeros((2, 1, 3, 3)))


def test_a_conductance_that_is_not_finite_names_its_nodes() -> None:
    matrix = chain(3, 1.0)[None, None].repeat(2, axis=1)
    matrix[0, 1, 0, 2] = np.nan
    with pytest.raises(
        InputError, match=r"^parameter set 0, regime 1, nodes 0 and 2: conductance is nan W/K, expected"
    ):
        modes_of(np.ones((1, 3)), matrix)


def test_one_way_heat_is_no_link() -> None:
    matrix = chain(3, 1.0)
    matrix[1, 2] = -1.5
    with pytest.raises(InputError, match=r"nodes 1 and 2: conductances -1.5 and -1 W/K, expected a symmetric matrix"):
        modes_of(np.ones((1, 3)), matrix[None, None])


def test_a_negative_conductance_grows() -> None:
    with pytest.raises(InputError, match=r"^parameter set 0, regime 0: .* grows at 0.5 /s, .* negative conductance$"):
        modes_of(np.array([[4.0, 4.0]]), chain(2, -1.0)[None, None])


@pytest.mark.parametrize(
    ("capacity", "matrix", "words"),
    [
        ((1, 3), (1, 1, 2, 2), r"capacities of shape \(1, 3\) and conductances of shape \(1, 1, 2, 2\), expected"),
        ((2, 2), (3, 1, 2, 2), "got 2 sets of capacities and 3 of conductances, expected as many"),
    ],
)
def test_shapes_that_disagree(capacity: tuple[int, ...], matrix: tuple[int, ...], words: str) -> None:
    with pytest.raises(InputError, match=words):
        modes_of(np.ones(capacity), np.zeros(matrix))
