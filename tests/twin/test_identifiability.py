import itertools

import numpy as np
import pytest
from toy_problems import ToyProblem, linear

from twin.calibration.identifiability import (
    correlation,
    intervals90,
    prior_shrinkage,
    readable_names,
    sparse_basis,
    undetermined,
)
from twin.calibration.least_squares import Fit, Unknown, fit

CONDUCTANCE = "links.shaft-housing.conductance"
CAPACITY = "nodes.shaft.capacity"


def named(name: str, unit: str = "W/K", spread: float = 0.7, scale: str = "log") -> Unknown:
    return Unknown(name, unit, 0.0, spread, scale=scale)


def fitted(unknowns: tuple[Unknown, ...], seen: np.ndarray, rows: int = 300, seed: int = 0) -> Fit:
    """A fit of which the rows see only the combinations `seen` (k, p) of x."""
    rng = np.random.default_rng(seed)
    design = 3 * rng.normal(size=(rows, len(seen))) @ np.asarray(seen, float)
    return fit(ToyProblem(unknowns, [rng.normal(size=rows)], linear([design])))


def amid(pair: tuple[Unknown, Unknown], weights: tuple[float, float], others: int = 8) -> tuple:
    """A pair of which only ``weights @ x`` is seen, among `others` that are determined well, well mixed."""
    unknowns = [named(f"nodes.n{i}.capacity", "J/K") for i in range(others)]
    unknowns[2:2], unknowns[7:7] = [pair[0]], [pair[1]]
    seen = np.zeros((others + 1, others + 2))
    place = [i for i, u in enumerate(unknowns) if u not in pair]
    seen[range(others), place] = 1.0
    seen[others, [unknowns.index(u) for u in pair]] = weights
    mixed = np.random.default_rng(4).normal(size=(others + 1, others + 1)) @ seen
    return tuple(unknowns), mixed


@pytest.mark.parametrize("others", [0, 8])
@pytest.mark.parametrize(
    ("weights", "words"),
    [
        ((1, -1), "only their ratio"),
        ((1, 1), "only their product"),
        ((1, -0.5), "only shaft–housing conductance / (shaft capacity)^0.5"),
        ((0.5, 1), "only (shaft–housing conductance)^0.5 × shaft capacity"),
    ],
)
def test_pairs_in_words(others, weights, words):
    pair = named(CONDUCTANCE), named(CAPACITY, "J/K")
    unknowns, seen = amid(pair, weights, others) if others else (pair, np.array([weights]))
    found = undetermined(fitted(unknowns, seen), unknowns)
    assert [u.summary for u in found] == [f"shaft–housing conductance and shaft capacity: {words}"]
    assert found[0].names == (CONDUCTANCE, CAPACITY)
    assert found[0].information < 1e-6


@pytest.mark.parametrize(("weights", "words"), [((1, -1), "only their difference"), ((1, 1), "only their sum"),
                                                ((1, -3), "only − 0.33 × front offset + rear offset")])  # fmt: skip
def test_signed_pairs_in_words(weights, words):
    pair = named("sensors.front.offset", "K", 0.5, "linear"), named("sensors.rear.offset", "K", 0.5, "linear")
    found = undetermined(fitted(pair, np.array([weights])), pair)
    assert [u.summary for u in found] == [f"front offset and rear offset: {words}"]


def test_pairs_with_unequal_spreads_are_judged_in_x():
    pair = named(CONDUCTANCE, spread=0.8), named(CAPACITY, "J/K", spread=0.4)
    found = undetermined(fitted(pair, np.array([[1, -1]])), pair)
    assert [u.summary.split(": ")[1] for u in found] == ["only their ratio"]


def test_a_pair_of_different_scales_says_how_they_move():
    pair = named("bearing.share", "1", 1.0, "logit"), named(CAPACITY, "J/K", 1.0)
    found = undetermined(fitted(pair, np.array([[1, -1]])), pair)
    assert found[0].summary == (
        "bearing share and shaft capacity: only one combination; the recordings do not see the move (in prior spreads) "
        "bearing share up 0.71, shaft capacity up 0.71"
    )


def test_a_single_parameter_in_words():
    unknowns = (named("bearing.share", "1", scale="logit"), *(named(f"nodes.n{i}.capacity") for i in range(5)))
    found = undetermined(fitted(unknowns, np.eye(6)[1:]), unknowns)
    assert [u.summary for u in found] == ["bearing share: the recordings do not determine it; the prior does"]


def test_three_that_share_one_combination_are_told_as_one():
    unknowns = tuple(named(f"nodes.n{i}.capacity") for i in range(6))
    seen = np.vstack([np.eye(6)[3:], [1, 1, -1, 0, 0, 0]])
    found = undetermined(fitted(unknowns, seen), unknowns)
    words = "n0 capacity, n1 capacity and n2 capacity: only n0 capacity × n1 capacity / n2 capacity"
    assert [u.summary for u in found] == [words]
    product = np.vstack([np.eye(6)[3:], [1, 1, 1, 0, 0, 0]])
    assert undetermined(fitted(unknowns, product), unknowns)[0].summary.endswith(": only their product")


def test_three_of_which_one_combination_is_unseen_are_listed_with_signs_and_weights():
    unknowns = tuple(named(f"nodes.n{i}.capacity", spread=1.0) for i in range(5))
    unseen = np.array([2.0, -1.0, 1.0, 0, 0])
    seen = np.linalg.svd(unseen[None])[2][1:]
    found = undetermined(fitted(unknowns, seen), unknowns)
    assert [u.summary for u in found] == [
        "n0 capacity, n1 capacity and n2 capacity: one combination is not determined; "
        "the recordings do not see the move (in prior spreads) "
        "n0 capacity up 0.82, n1 capacity down 0.41, n2 capacity up 0.41"
    ]


def test_a_long_combination_names_its_largest_parts():
    unknowns = tuple(named(f"nodes.n{i}.capacity", spread=1.0) for i in range(9))
    unseen = np.linspace(1.0, 0.6, 9)
    found = undetermined(fitted(unknowns, np.linalg.svd(unseen[None])[2][1:]), unknowns)
    assert found[0].summary.startswith("9 parameters together: one combination is not determined; ")
    assert found[0].summary.endswith("n5 capacity up 0.31, and 3 more with smaller parts")


@pytest.mark.parametrize("seed", range(6))
def test_mixed_directions_are_told_apart(seed):
    """A lone parameter, a ratio and a product have the same information, nil: their eigenvectors mix at will."""
    rng = np.random.default_rng(seed)
    unknowns = tuple(named(f"nodes.n{i}.capacity", spread=s) for i, s in enumerate(rng.uniform(0.5, 0.9, 14)))
    place = rng.permutation(14)
    seen = [np.eye(14)[place[i]] for i in range(5, 14)]
    seen += [np.eye(14)[place[1]] - np.eye(14)[place[2]], np.eye(14)[place[3]] + np.eye(14)[place[4]]]
    found = undetermined(fitted(unknowns, rng.normal(size=(11, 11)) @ np.array(seen), seed=seed), unknowns)
    told = {(u.names, u.summary.split(": ")[1]) for u in found}

    def pair(a: int, b: int) -> tuple[str, ...]:
        return tuple(unknowns[i].name for i in sorted((place[a], place[b])))

    assert told == {
        ((unknowns[place[0]].name,), "the recordings do not determine it; the prior does"),
        (pair(1, 2), "only their ratio"),
        (pair(3, 4), "only their product"),
    }


def test_weakly_seen_directions_are_still_told_apart():
    """With a little information in every direction the null space is only nearly sparse."""
    unknowns = tuple(named(f"nodes.n{i}.capacity", spread=0.7) for i in range(10))
    rng = np.random.default_rng(3)
    seen = np.vstack([np.eye(10)[4:], [1, -1, 0, 0, 0, 0, 0, 0, 0, 0], [0, 0, 1, 1, 0, 0, 0, 0, 0, 0],
                      0.005 * rng.normal(size=(10, 10))])  # fmt: skip
    found = undetermined(fitted(unknowns, seen), unknowns)
    assert sorted(u.summary for u in found) == [
        "n0 capacity and n1 capacity: only their ratio",
        "n2 capacity and n3 capacity: only their product",
    ]
    assert all(0 < u.information < 1 for u in found)


def test_strong_information_elsewhere_does_not_hide_a_pair():
    pair = named("nodes.a.capacity", spread=1e5), named("nodes.b.capacity", spread=1e5)
    others = tuple(named(f"nodes.n{i}.capacity", spread=1e5) for i in range(3))
    seen = 1e4 * np.hstack([np.vstack([np.eye(3), np.ones((1, 3))]), [[0, 0]] * 3 + [[1, -1]]])
    unknowns = (*others, *pair)
    found = undetermined(fitted(unknowns, seen), unknowns)
    assert [u.summary for u in found] == ["a capacity and b capacity: only their ratio"]


def test_nothing_to_say_when_all_is_determined():
    unknowns = tuple(named(f"nodes.n{i}.capacity") for i in range(4))
    assert undetermined(fitted(unknowns, np.eye(4)), unknowns) == []


def test_everything_undetermined_names_every_parameter():
    unknowns = tuple(named(f"nodes.n{i}.capacity") for i in range(4))
    found = undetermined(fitted(unknowns, np.zeros((1, 4))), unknowns)
    assert [u.names for u in found] == [(u.name,) for u in unknowns]


def test_the_threshold_is_the_priors_information():
    """One row of slope s: its information is (s spread)², so the posterior sd falls below 0.71 of the prior's at 1."""
    for slope, told in ((0.95, True), (1.05, False)):
        unknowns = (named("nodes.bed.capacity", spread=2.0),)
        found = fit(ToyProblem(unknowns, [np.zeros(1)], linear([np.array([[slope / 2.0]])])))
        assert bool(undetermined(found, unknowns)) is told
        assert (prior_shrinkage(found, unknowns)[0] > np.sqrt(0.5)) is np.bool_(told)


def test_sparse_basis_spans_the_null_space():
    rng = np.random.default_rng(0)
    null = np.linalg.qr(rng.normal(size=(12, 4)))[0]
    basis = sparse_basis(null)
    assert basis.shape == (12, 4)
    np.testing.assert_allclose(null @ (null.T @ basis), basis, atol=1e-9)
    assert np.linalg.matrix_rank(basis) == 4


def test_sparse_basis_finds_hidden_sparse_vectors():
    rng = np.random.default_rng(1)
    hidden = np.zeros((20, 3))
    hidden[[2, 9], 0], hidden[[8, 11, 15], 1], hidden[[4], 2] = (1, -1), (1, 2, 2), 1
    basis = sparse_basis(np.linalg.qr(hidden @ rng.normal(size=(3, 3)))[0])
    supports = {tuple(np.flatnonzero(np.abs(v) > 1e-9)) for v in basis.T}
    assert supports == {(2, 9), (8, 11, 15), (4,)}


def test_intervals_are_in_the_parameters_own_unit():
    unknowns = (
        Unknown("a.b.log", "W/K", np.log(10.0), 0.5),
        Unknown("a.b.share", "1", 0.0, 0.5, scale="logit"),
        Unknown("a.b.signed", "K", -2.0, 0.5, low=-2.5, scale="linear"),
    )
    # No information: the posterior is the prior.
    intervals = intervals90(fit(ToyProblem(unknowns, [np.zeros(3)], linear([np.zeros((3, 3))]))), unknowns)
    log, share, signed = intervals
    assert (log.value, log.low, log.high) == pytest.approx((10, 10 * np.exp(-0.82243), 10 * np.exp(0.82243)), rel=1e-5)
    assert (share.value, share.low, share.high) == pytest.approx((0.5, 0.30525, 0.69475), rel=1e-4)
    assert (signed.low, signed.high) == pytest.approx((-2.5, -1.17757), rel=1e-5)  # ends at its bound
    assert [i.prior_shrinkage for i in intervals] == pytest.approx([1, 1, 1])
    assert [i.unit for i in intervals] == ["W/K", "1", "K"]


def test_correlation_is_that_of_the_covariance():
    unknowns = (named(CONDUCTANCE, spread=1.0), named(CAPACITY, spread=2.0))
    found = fitted(unknowns, np.array([[1.0, -1.0]]))
    matrix = correlation(found)
    np.testing.assert_allclose(np.diag(matrix), 1)
    assert matrix[0, 1] == pytest.approx(found.covariance[0, 1] / np.sqrt(np.prod(np.diag(found.covariance))))
    assert matrix[0, 1] > 0.99


def test_names_are_readable_and_unique():
    names = ["links.shaft-front.conductance", "heat.front_bearing.share", "bearing.share", "lag"]
    assert readable_names(names) == ["shaft–front conductance", "front bearing share", "bearing share", "lag"]
    twins = ["nodes.bed.capacity", "bodies.bed.capacity"]
    assert readable_names(twins) == twins


def test_the_order_of_parameters_changes_no_words():
    unknowns = tuple(named(f"nodes.n{i}.capacity") for i in range(4))
    seen = np.array([[1.0, -1, 0, 0], [0, 0, 1, 1]])
    told = set()
    for order in itertools.permutations(range(4)):
        shuffled = tuple(unknowns[i] for i in order)
        found = undetermined(fitted(shuffled, seen[:, order]), shuffled)
        told.add(frozenset((frozenset(u.names), u.summary.split(": ")[1]) for u in found))
    assert len(told) == 1
