"""The stacked design: borders, masks, subsets and sums."""

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch, Channel, Finding
from data.errors import InputError
from features.design import Design, Moments
from features.rises import feature

CHANNELS = {
    "a": Channel("a", "temperature", "degC"),
    "b": Channel("b", "temperature", "degC"),
    "room": Channel("room", "ambient", "degC"),
    "z": Channel("z", "error", "um"),
}
INPUTS = ("a", "b", "room")


def batch(name: str, n: int, seed: int, findings: tuple[Finding, ...] = (), step_s: float = 60.0) -> Batch:
    walk = np.random.default_rng(seed).normal(size=(n, len(CHANNELS))).cumsum(axis=0) + 20
    table = pd.DataFrame(walk, columns=list(CHANNELS))
    table.insert(0, "time_s", step_s * np.arange(n))
    return Batch("vmc", name, table, CHANNELS, findings=findings)


def year() -> list[Batch]:
    dead = Finding("dead", "b", "…", 120.0, 300.0)
    silent = Finding("gap", "z", "…", 600.0, None)
    return [batch("one", 12, 1), batch("two", 9, 2, (dead,)), batch("three", 15, 3, (silent,))]


def assert_same(one: Moments, other: Moments) -> None:
    for key in ("count", "sum_x", "sum_y", "xx", "xy", "yy", "shift_x"):
        assert np.allclose(getattr(one, key), getattr(other, key)), key


def totals(m: Moments) -> tuple[np.ndarray, np.ndarray]:
    """Mean and raw cross-product of the inputs over all batches, free of the shift."""
    n, s = m.count.sum(), m.sum_x.sum(axis=0)
    mean = s / n + m.shift_x
    return mean, m.xx.sum(axis=0) - np.outer(s, s) / n


def test_nothing_crosses_a_batch_border() -> None:
    names = ("a", "b@lag30min", "a@rate", "b@ambient", "room@start", "room@lag2h")
    together = Design.build(year(), names, "z")
    for k, b in enumerate(year()):
        alone = Design.build([b], names, "z")
        assert np.array_equal(together.x[together.rows(k)], alone.x, equal_nan=True)
        assert np.array_equal(together.y_um[together.rows(k)], alone.y_um, equal_nan=True)
        assert together.time_s[together.rows(k)][0] == 0.0
        assert together.x[together.rows(k)][0] == pytest.approx([0, 0, 0, 0, b.values("room")[0], 0])
    shouted = [year()[0], batch("two", 9, 99), year()[2]]
    changed = Design.build(shouted, names, "z")
    assert np.array_equal(changed.x[together.rows(2)], together.x[together.rows(2)])


def test_masked_stretches_are_not_usable_and_no_row_is_lost() -> None:
    design = Design.build(year(), INPUTS, "z")
    assert design.offsets.tolist() == [0, 12, 21, 36] and len(design.usable) == 36
    lost = np.flatnonzero(~design.usable)
    assert lost.tolist() == [14, 15, 16, 17, 31, 32, 33, 34, 35]
    x, y_um, group = design.stacked([1, 2])
    assert len(x) == len(y_um) == 5 + 10 and np.isfinite(x).all() and np.isfinite(y_um).all()
    assert np.bincount(group).tolist() == [0, 5, 10]
    assert np.array_equal(x[:2, 0], feature(year()[1], "a")[:2])
    assert len(design.stacked([])[0]) == 0


def test_usable_rows_of_a_subset_are_its_own() -> None:
    design = Design.build(year(), INPUTS, "z")
    for inputs in [("a",), ("b",), ("room", "a"), ("b", "room"), INPUTS, ()]:
        part = design.subset(inputs)
        alone = Design.build(year(), inputs, "z")
        assert part.inputs == inputs and part.x.shape == alone.x.shape
        assert np.array_equal(part.usable, alone.usable)
        assert np.array_equal(part.x, alone.x, equal_nan=True)
        again = part.subset(inputs[:1])
        assert np.array_equal(again.usable, Design.build(year(), inputs[:1], "z").usable)
    assert design.subset(("a",)).usable is design.subset(("a", "room")).usable  # found once
    with pytest.raises(ValueError, match="read-only"):
        design.usable[0] = False


def test_moments_equal_sums_over_the_rows() -> None:
    design = Design.build(year(), INPUTS, "z")
    m = design.moments
    for k in range(3):
        x, y_um, _ = design.stacked([k])
        x, y_um = x - m.shift_x, y_um - m.shift_y
        assert m.count[k] == len(x) and m.yy[k] == pytest.approx(y_um @ y_um)
        assert np.allclose(m.xx[k], x.T @ x) and np.allclose(m.xy[k], x.T @ y_um)
        assert np.allclose(m.sum_x[k], x.sum(axis=0)) and m.sum_y[k] == pytest.approx(y_um.sum())


def test_moments_of_a_subset_equal_those_of_its_own_rows() -> None:
    design = Design.build(year(), INPUTS, "z")
    for inputs in [("room", "b"), ("a",), ("a", "room")]:
        for found, truth in zip(
            totals(design.subset(inputs).moments), totals(Design.build(year(), inputs, "z").moments), strict=True
        ):
            assert np.allclose(found, truth)
    assert_same(design.subset(("b", "room")).moments, design.moments.subset([1, 2]))  # the same rows: taken over


def test_without_a_target_no_row_teaches() -> None:
    design = Design.build(year(), INPUTS, None)
    assert not design.usable.any() and design.moments.count.tolist() == [0, 0, 0]
    assert design.target == ""


def test_a_batch_without_usable_rows_has_empty_sums() -> None:
    dead = batch("two", 9, 2, (Finding("dead", None, "…"),))
    design = Design.build([year()[0], dead], INPUTS, "z")
    assert design.moments.count.tolist() == [12, 0] and np.isfinite(design.moments.xx).all()


def test_faults_are_told_in_one_line() -> None:
    design = Design.build(year(), INPUTS, "z")
    with pytest.raises(InputError, match=r"subset of a design: no input 'rom'; did you mean 'room'\?"):
        design.subset(("rom",))
    with pytest.raises(InputError, match=r"time steps of 60 s and 300 s; expected one step for all, ingest them"):
        Design.build([year()[0], batch("slow", 5, 4, step_s=300.0)], INPUTS, "z")
    assert Design.build([batch("blink", 1, 5), year()[0]], INPUTS, "z").step_s == 60.0
