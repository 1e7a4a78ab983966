import itertools

import numpy as np
import pytest
from toy_problems import ToyProblem, linear

from twin.calibration.identifiability import (
    correlation,
    intervals90,
    prior_shrinkage,
    readable_names,
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


def nodes(count: int, **given) -> tuple[Unknown, ...]:
    return tuple(named(f"nodes.n{i}.capacity", **given) for i in range(count))


def besides(*rows: list[float]) -> np.ndarray:
    """These combinations of the first parameters, and every parameter after them by itself."""
    n = len(rows[0])
    return np.vstack([np.eye(n)[np.flatnonzero(~np.any(rows, axis=0))], rows])


OFFSETS = named("sensors.front.offset", "K", 0.5, "linear"), named("sensors.rear.offset", "K", 0.5, "linear")
SHARE = named("bearing.share", "1", 1.0, "logit")
UNSEEN = "the recordings do not see the move (in prior spreads)"
TOLD = {
    "signed, apart": (OFFSETS, [[1, -1]], "front offset and rear offset: only their difference"),
    "signed, together": (OFFSETS, [[1, 1]], "front offset and rear offset: only their sum"),
    "signed, weighted": (OFFSETS, [[1, -3]], "front offset and rear offset: only − 0.33 × front offset + rear offset"),
    "unequal spreads": (
        (named(CONDUCTANCE, spread=0.8), named(CAPACITY, "J/K", spread=0.4)),
        [[1, -1]],
        "shaft–housing conductance and shaft capacity: only their ratio",
    ),
    "different scales": (
        (SHARE, named(CAPACITY, "J/K", 1.0)),
        [[1, -1]],
        f"bearing share and shaft capacity: only one combination; {UNSEEN} bearing share up 0.71, "
        "shaft capacity up 0.71",
    ),
    "one alone": (
        (SHARE, *nodes(5)),
        np.eye(6)[1:],
        "bearing share: the recordings do not determine it; the prior does",
    ),
    "three in one": (
        nodes(6),
        besides([1, 1, -1, 0, 0, 0]),
        "n0 capacity, n1 capacity and n2 capacity: only n0 capacity × n1 capacity / n2 capacity",
    ),
    "three in a product": (
        nodes(6),
        besides([1, 1, 1, 0, 0, 0]),
        "n0 capacity, n1 capacity and n2 capacity: only their product",
    ),
    "three of which one combination is unseen": (
        nodes(5, spread=1.0),
        np.linalg.svd(np.array([[2.0, -1.0, 1.0, 0, 0]]))[2][1:],
        f"n0 capacity, n1 capacity and n2 capacity: one combination is not determined; {UNSEEN} "
        "n0 capacity up 0.82, n1 capacity down 0.41, n2 capacity up 0.41",
    ),
    "a long one": (
        nodes(9, spread=1.0),
        np.linalg.svd(np.linspace(1.0, 0.6, 9)[None])[2][1:],
        f"9 parameters together: one combination is not determined; {UNSEEN} n0 capacity up 0.41, "
        "n1 capacity up 0.39, n2 capacity up 0.37, n3 capacity up 0.35, n4 capacity up 0.33, n5 capacity up 0.31, "
        "and 3 more with smaller parts",
    ),
    "strong information elsewhere": (
        nodes(5, spread=1e5),
        1e4 * np.array([[1, 0, 0, 0, 0], [0, 1, 0, 0, 0], [0, 0, 1, 0, 0], [1, 1, 1, 1, -1]]),
        "n3 capacity and n4 capacity: only their ratio",
    ),
    "all determined": (nodes(4), np.eye(4), None),
}


@pytest.mark.parametrize("case", TOLD)
def test_what_is_undetermined_in_words(case):
    unknowns, seen, words = TOLD[case]
    found = undetermined(fitted(unknowns, np.asarray(seen)), unknowns)
    assert [u.summary for u in found] == ([words] if words else [])


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
    unknowns = nodes(10)
    rng = np.random.default_rng(3)
    seen = np.vstack([np.eye(10)[4:], [1, -1, 0, 0, 0, 0, 0, 0, 0, 0], [0, 0, 1, 1, 0, 0, 0, 0, 0, 0],
                      0.005 * rng.normal(size=(10, 10))])  # fmt: skip
    found = undetermined(fitted(unknowns, seen), unknowns)
    assert sorted(u.summary for u in found) == [
        "n0 capacity and n1 capacity: only their ratio",
        "n2 capacity and n3 capacity: only their product",
    ]
    assert all(0 < u.information < 1 for u in found)


def test_everything_undetermined_names_every_parameter():
    unknowns = nodes(4)
    found = undetermined(fitted(unknowns, np.zeros((1, 4))), unknowns)
    assert [u.names for u in found] == [(u.name,) for u in unknowns]


def test_the_threshold_is_the_priors_information():
    """One row of slope s: its information is (s spread)², so the posterior sd falls below 0.71 of the prior's at 1."""
    for slope, told in ((0.95, True), (1.05, False)):
        unknowns = (named("nodes.bed.capacity", spread=2.0),)
        found = fit(ToyProblem(unknowns, [np.zeros(1)], linear([np.array([[slope / 2.0]])])))
        assert bool(undetermined(found, unknowns)) is told
        assert (prior_shrinkage(found, unknowns)[0] > np.sqrt(0.5)) is np.bool_(told)


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
    unknowns = nodes(4)
    seen = np.array([[1.0, -1, 0, 0], [0, 0, 1, 1]])
    told = set()
    for order in itertools.permutations(range(4)):
        shuffled = tuple(unknowns[i] for i in order)
        found = undetermined(fitted(shuffled, seen[:, order]), shuffled)
        told.add(frozenset((frozenset(u.names), u.summary.split(": ")[1]) for u in found))
    assert len(told) == 1
