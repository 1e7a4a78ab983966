"""What a failing sensor costs: hand-made models whose answer is known, with the guard of the toy machine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations

import numpy as np
import pytest

from compensation.faults import BEGINS, bridged, fault_cost, faults, watched, with_values
from compensation.substitutes import Guard, Substitutes
from data.arrays import Array
from data.batch import Batch

NAMES = ("t0", "t1", "t2", "t3", "t4", "room")


@pytest.fixture(scope="module")
def batches(toy_batches: Callable[..., list[Batch]]) -> list[Batch]:
    return toy_batches(k=8)


@pytest.fixture(scope="module")
def learned(batches: list[Batch]) -> Substitutes:
    return Substitutes.learn(batches, (*NAMES, "spindle_rpm"))


def of_one(batch: Batch) -> Array:
    """10 µm/K of t0 against t1."""
    return 10.0 * (batch.masked("t0") - batch.masked("t1"))


def of_each(batches: Sequence[Batch]) -> list[Array]:
    return [of_one(b) for b in batches]


def test_a_kelvin_costs_what_the_model_makes_of_it(learned: Substitutes, batches: list[Batch]) -> None:
    cost = fault_cost(of_each, learned, batches[-1], 1e6)
    assert cost is not None
    assert cost.um_per_K == pytest.approx({"t0": 10.0, "t1": 10.0, **dict.fromkeys(NAMES[2:], 0.0)}, abs=1e-9)
    assert "costs up to 10 µm (t0)" in cost.summary


def test_faults_are_what_they_are_called(batches: list[Batch]) -> None:
    batch = batches[-1]
    made = {kind: columns["t0"] - batch.masked("t0") for kind, at, columns in faults(batch, NAMES) if "t0" in at}
    first = batch.n_rows // BEGINS
    hours = (batch.time_s - batch.time_s[first]) / 3600.0
    assert all(not d[:first].any() for kind, d in made.items() if kind != "exchanged")
    np.testing.assert_allclose(made["a step of 5 K"][first:], 5.0)
    np.testing.assert_allclose(made["a drift of 10 K/h"][first:], 10.0 * hours[first:])
    np.testing.assert_allclose((made["frozen"] + batch.masked("t0"))[first:], batch.masked("t0")[first])


def test_the_dearest_fault_is_that_which_the_guard_leaves(learned: Substitutes, batches: list[Batch]) -> None:
    """Held against the same faults led through the guard one by one."""
    batch, most_um = batches[-1], 40.0
    cost = fault_cost(of_each, learned, batch, most_um)
    right = np.clip(of_one(batch), -most_um, most_um)
    left = {}
    for kind, at, columns in faults(batch, NAMES):
        wrong = with_values(batch, columns)
        if np.abs(np.clip(of_one(wrong), -most_um, most_um) - right).max() > 0.1 * most_um:
            seen = watched(Guard(learned), wrong, learned.names)
            sent = np.clip(of_one(seen.passed), -most_um, most_um)
            left[f"{' and '.join(sorted(at))}: {kind}"] = (
                np.abs(sent - right)[: seen.until].max(initial=0.0),
                seen.first,
            )
    assert cost is not None and cost.n == len(left) > 5 and cost.missed == sum(f is None for _, f in left.values())
    assert cost.worst_um == pytest.approx(max(um for um, _ in left.values())) and cost.worst_um <= 2 * most_um
    assert left[cost.worst][0] == pytest.approx(cost.worst_um)


def test_a_run_without_a_whole_sensor_says_nothing(learned: Substitutes, batches: list[Batch]) -> None:
    lost = {n: np.full(batches[-1].n_rows, np.nan) for n in NAMES}
    assert fault_cost(of_each, learned, with_values(batches[-1], lost), 40.0) is None


def test_fewer_looks_find_the_same_faults_a_little_later(learned: Substitutes, batches: list[Batch]) -> None:
    batch = batches[-1]
    stepped = with_values(batch, {"t2": batch.masked("t2") + 9.0 * (np.arange(batch.n_rows) >= 31)})
    often, rarely = (watched(Guard(learned), stepped, learned.names, every) for every in (1, 3))
    assert often.first == 31 and rarely.first == 33
    assert rarely.untrusted[33] == rarely.untrusted[35] == {"t2"}
    np.testing.assert_allclose(rarely.passed.values("t2")[:31], batch.masked("t2")[:31])
    assert np.abs(rarely.passed.values("t2") - batch.masked("t2"))[33:].max() < 4.0


def test_a_fault_that_begins_later_takes_the_looks_before_it_over(learned: Substitutes, batches: list[Batch]) -> None:
    batch, guard = batches[-1], Guard(learned)
    usual = watched(guard, batch, learned.names, 2)
    for _, _, columns in faults(batch, NAMES):
        wrong = with_values(batch, columns)
        own, short = watched(guard, wrong, learned.names, 2), watched(guard, wrong, learned.names, 2, usual)
        assert (own.untrusted, own.until) == (short.untrusted, short.until)
        for n in learned.names:
            np.testing.assert_array_equal(own.passed.values(n), short.passed.values(n))


@pytest.mark.parametrize("size", [1, 2])
def test_the_channels_that_misfit_most_are_those_of_the_best_regression_without_them(
    learned: Substitutes, batches: list[Batch], size: int
) -> None:
    rng, good = np.random.default_rng(size), np.array([True, True, True, False, True, True])
    assert learned.level is not None
    for _ in range(20):
        rise_K = np.where(good, rng.normal(0.0, 3.0, 6), 0.0)
        misfits = {}
        for out in combinations(np.flatnonzero(good), size):
            rest = good & ~np.isin(np.arange(6), out)
            found = learned.levels(rest)
            left_K = np.where(rest, rise_K - found.weights @ np.where(rest, rise_K, 0.0), 0.0)
            own_K2 = 1.0 / np.diag(np.linalg.inv(learned.level_K2[np.ix_(rest, rest)]))
            misfits[out] = np.sum(rise_K[rest] * left_K[rest] / own_K2)
        assert tuple(learned.levels(good).misfits(good, rise_K, size)) == min(misfits, key=misfits.get)


def test_a_sensor_may_be_missing_where_the_model_without_it_beats_no_correction(batches: list[Batch]) -> None:
    """z = 3 t0 − 2 t4: t0 carries most of it and follows from the others; a sensor of its own does not."""
    whole = bridged(lambda some: [3.0 * rise(b, "t0") - 2.0 * rise(b, "t4") for b in some], "z", batches, NAMES)
    assert whole == NAMES
    rng = np.random.default_rng(5)
    alone = []
    for b in batches:
        own = np.cumsum(rng.standard_normal(b.n_rows))
        alone.append(with_values(b, {"t2": b.values("t2")[0] + own, "z": 20.0 * own}))
    assert "t2" not in bridged(lambda some: [20.0 * rise(b, "t2") for b in some], "z", alone, NAMES)
    assert bridged(of_each, "z", batches[:3], NAMES) == (), "too few runs to tell"


def rise(batch: Batch, name: str) -> Array:
    values = batch.masked(name)
    return np.asarray(values - values[0])
