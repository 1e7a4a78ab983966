"""Offset and slope along an axis: planted lines, an independent forward choice on the rows, and where it is offered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch, Channel
from data.errors import InputError
from data.machine import parse_machine
from features.design import Design
from models.families.axis_coupled import AxisCoupled
from models.families.baselines import MeanCurve
from models.selection.crossing import Plan, prepare
from models.selection.grid import run_grid

INPUTS = ("room", "spindle", "nut", "bed")
AT_MM = np.array([-500.0, -240.0, 20.0])
CHANNELS = {
    "room": Channel("room", "ambient", "degC"),
    "spindle": Channel("spindle", "temperature", "degC"),
    "nut": Channel("nut", "temperature", "degC"),
    "bed": Channel("bed", "temperature", "degC"),
    "at": Channel("at", "position", "mm"),
    "x": Channel("x", "error", "um", position="at"),
    "z": Channel("z", "error", "um"),
}
MACHINE = """
machine: lathe
channels:
  at: {role: position, unit: mm, fixed_end: -600}
  x: {role: error, unit: um, position: at}
"""


def run(k: int, noise_um: float = 0.0, fixed_end_mm: float = -500.0) -> Batch:
    """40 rows; a sweep of three positions every eight rows, the first at rest. Each sensor warms in its own way."""
    rng = np.random.default_rng(k)
    n, t = 40, np.maximum(np.arange(40) - 2.0, 0.0)
    rise = {
        name: rng.uniform(2, 8) * (1 - np.exp(-t / rng.uniform(3, 40))) * rng.choice([1, 1, 1, -1]) for name in INPUTS
    }
    at = np.where(np.arange(n) % 8 < 3, AT_MM[np.minimum(np.arange(n) % 8, 2)], np.nan)
    error = (
        1.1 * rise["room"] + 3.8 * rise["spindle"] + (0.004 * rise["room"] + 0.012 * rise["nut"]) * (at - fixed_end_mm)
    )
    error += noise_um * rng.standard_normal(n) + 0.02 * at + 7.0  # what stays at a position is no thermal error
    columns = {"time_s": 300.0 * np.arange(n), **{name: 15.0 + k + r for name, r in rise.items()}}
    table = pd.DataFrame({**columns, "at": at, "x": error, "z": rise["spindle"]})
    return Batch("lathe", f"b{k}", table, CHANNELS)


def design(n: int = 5, target: str = "x", machine: str = "", **options) -> Design:
    read = parse_machine(machine, "m") if machine else None
    return Design.build([run(k, **options) for k in range(n)], INPUTS, target, read)


def test_the_planted_line_is_found_term_by_term() -> None:
    fitted = AxisCoupled(fixed_end_mm=-500.0).fit_design(design(), range(5)).fitted
    offset = dict(zip(fitted["offset_inputs"], fitted["offset_um_per_K"], strict=True))
    slope = dict(zip(fitted["slope_inputs"], fitted["slope_um_per_mm_K"], strict=True))
    assert offset == pytest.approx({"room": 1.1, "spindle": 3.8}, abs=1e-6)
    assert slope == pytest.approx({"room": 0.004, "nut": 0.012}, abs=1e-9)
    assert fitted["along"] == "at" and fitted["n_rows"] == 5 * 15


@pytest.mark.parametrize("fixed_end_mm", [-500.0, 20.0, -630.0])
def test_the_fixed_end_is_found_at_an_end_or_beyond(fixed_end_mm: float) -> None:
    # of the published form without the room, whose two terms leave P0 open
    batches = []
    for k in range(5):
        b = run(k)
        rise = b.table - b.table.iloc[0]
        error = 3.8 * rise["spindle"] + 0.012 * rise["nut"] * (b.table["at"] - fixed_end_mm)
        batches.append(replace(b, table=b.table.assign(x=error)))
    found = AxisCoupled().fit_design(Design.build(batches, INPUTS, "x"), range(5)).fitted
    assert found["fixed_end_mm"] == pytest.approx(fixed_end_mm)
    assert (found["offset_inputs"], found["slope_inputs"]) == (["spindle"], ["nut"])
    assert found["slope_um_per_mm_K"] == pytest.approx([0.012])


def test_the_fixed_end_is_the_option_then_the_machine_files() -> None:
    d = design(machine=MACHINE)
    assert AxisCoupled(fixed_end_mm=-100.0).fit_design(d, range(5)).fitted["fixed_end_mm"] == -100.0
    assert AxisCoupled().fit_design(d, range(5)).fitted["fixed_end_mm"] == -600.0
    # wherever the line is said to turn, it is the same line: the room drives both parts
    batch = run(9)
    lines = [AxisCoupled(fixed_end_mm=e).fit_design(design(), range(5)).predict(batch) for e in (-500.0, -100.0)]
    np.testing.assert_allclose(lines[0], lines[1], atol=1e-6)


def by_hand(batches: list[Batch], end_mm: float, max_terms: int) -> tuple[list[int], np.ndarray]:
    """Forward choice by leave-batch-out least squares on the rows themselves."""
    rows, errors, group = [], [], []
    for k, b in enumerate(batches):
        there = np.isfinite(b.values("at"))
        rise = np.column_stack([b.values(i) - b.values(i)[0] for i in INPUTS])[there]
        first = b.values("x")[there][:3]
        rows.append(np.hstack([rise, (b.values("at")[there] - end_mm)[:, None] * rise]))
        errors.append(b.values("x")[there] - np.tile(first, 5))
        group += [k] * int(there.sum())
    x, y, g = np.vstack(rows), np.concatenate(errors), np.array(group)

    def score(terms: list[int]) -> float:
        S = []
        for k in range(len(batches)):
            coef = np.linalg.lstsq(x[g != k][:, terms], y[g != k], rcond=None)[0]
            left = y[g == k] - x[g == k][:, terms] @ coef
            S.append(np.sqrt(left @ left / (len(left) - 1)))
        return float(np.mean(S))

    p, everything = len(INPUTS), range(2 * len(INPUTS))
    path = min(([i, p + j] for i in range(p) for j in range(p)), key=score)
    met = [[], path]
    while len(path) < max_terms:
        path = min(([*path, t] for t in everything if t not in path), key=score)
        met.append(path)
    terms = min(met, key=score)
    while terms:
        fewer = min(([t for t in terms if t != gone] for gone in terms), key=score)
        if score(terms) < 0.99 * score(fewer):
            break
        terms = fewer
    return terms, np.linalg.lstsq(x[:, terms], y, rcond=None)[0]


@pytest.mark.parametrize("end_mm", [-500.0, 200.0])
@pytest.mark.parametrize("noise_um", [0.7, 5.0])
def test_the_choice_is_that_of_least_squares_on_the_rows(end_mm: float, noise_um: float) -> None:
    batches = [run(k, noise_um) for k in range(6)]
    d = Design.build(batches, INPUTS, "x")
    folds = [[0, 1, 2, 3, 4, 5], [1, 2, 4, 5], [0, 3, 5]]
    for fold, model in zip(folds, AxisCoupled(fixed_end_mm=end_mm).fit_folds(d, folds), strict=True):
        terms, coef = by_hand([batches[k] for k in fold], end_mm, 8)
        want = {t: c for t, c in zip(terms, coef, strict=True)}
        f = model.fitted
        got = {INPUTS.index(i): c for i, c in zip(f["offset_inputs"], f["offset_um_per_K"], strict=True)}
        got |= {4 + INPUTS.index(i): c for i, c in zip(f["slope_inputs"], f["slope_um_per_mm_K"], strict=True)}
        assert got == pytest.approx(want, rel=1e-6)


def test_no_more_terms_than_allowed_and_none_for_nothing() -> None:
    d = design(noise_um=0.5)
    few = AxisCoupled(max_terms=2).fit_design(d, range(5))
    assert few.n_parameters() == 2
    nothing = [replace(run(k), table=run(k).table.assign(x=np.tile(run(k).values("at") * 0.1, 1))) for k in range(4)]
    model = AxisCoupled().fit_design(Design.build(nothing, INPUTS, "x"), range(4))
    assert model.n_parameters() == 0
    there = np.isfinite(nothing[0].values("at"))
    assert (
        np.array_equal(np.isfinite(model.predict(nothing[0])), there) and (model.predict(nothing[0])[there] == 0).all()
    )


def test_the_line_is_the_prediction_and_stands_on_every_row() -> None:
    d = design()
    model = AxisCoupled().fit_design(d, range(4))
    offset_um, slope_um_per_mm = model.line(d, 4)
    assert np.isfinite(offset_um).all() and np.isfinite(slope_um_per_mm).all()
    at = d.batches[4].values("at")
    predicted = model.predict(d.batches[4])
    np.testing.assert_allclose(predicted, offset_um + slope_um_per_mm * (at - model.fitted["fixed_end_mm"]))
    assert np.array_equal(np.isnan(predicted), np.isnan(at))
    there = np.isfinite(at)
    np.testing.assert_allclose(predicted[there], d.y_um[d.rows(4)][there], atol=1e-6)


def test_rises_count_from_the_first_reading_as_the_error_does() -> None:
    d = design()
    model = AxisCoupled().fit_design(d, range(4))
    late = run(4)
    table = late.table.copy()
    table.loc[:2, ["at", "x"]] = np.nan  # the first sweep is read in the warm machine
    late = replace(late, table=table)
    got, want = model.predict(late), Design.build([late], INPUTS, "x").y_um
    # within the first sweep the machine warms on, so each position's zero is a little later than the first reading
    again = np.flatnonzero(np.isfinite(want))[3:]
    zero = got[8:11]
    np.testing.assert_allclose(got[again] - np.tile(zero, len(again) // 3), want[again], atol=1e-6)
    assert got[8] == 0.0


def test_mistakes_are_told_in_one_line() -> None:
    with pytest.raises(
        InputError, match="axis_coupled: z is not measured along an axis; give that channel a position:"
    ):
        AxisCoupled().fit_design(design(target="z"), range(5))
    with pytest.raises(InputError, match="axis_coupled: no inputs given for x; name at least one channel"):
        AxisCoupled().fit_design(design().subset(()), range(5))
    bare = Design(INPUTS, "x", ("b",), np.zeros((9, 4)), np.zeros(9), np.arange(9.0), np.array([0, 9]))
    with pytest.raises(InputError, match="x is not measured along an axis"):
        AxisCoupled().fit_design(bare, [0])


def test_it_is_offered_along_an_axis_and_nowhere_else() -> None:
    batches = [run(k, 0.5) for k in range(4)]
    assert "axis_coupled" not in Plan().suited(None).families
    assert "axis_coupled" in Plan().suited(parse_machine(MACHINE, "m")).families
    plan = Plan(selectors=("none",), protocols=("leave-batch-out",))
    unnamed = replace(plan, families=Plan().suited(None, [CHANNELS["x"]]).families)
    assert {"zero", "mean_curve", "mlr", "axis_coupled"} <= set(unnamed.families)
    assert "axis_coupled" in prepare(batches, "x", plan).plan.families
    assert "axis_coupled" not in prepare(batches, "z", plan).plan.families
    with pytest.raises(
        InputError,
        match="family axis_coupled needs the position of every reading, and error channel z has none; add position: to "
        "the channel in the machine file, train channels along an axis alone, or leave the family out",
    ):
        run_grid(batches, ["x", "z"], replace(plan, families=("zero", "axis_coupled")))
    with pytest.raises(InputError, match="family axis_coupled needs the position of every reading"):
        prepare(batches, "z", replace(plan, families=("axis_coupled",)))


def test_the_grid_crosses_channels_with_and_without_an_axis() -> None:
    batches = [run(k, 0.5) for k in range(3)]
    plan = Plan(selectors=("none",), protocols=("leave-batch-out",), n_tsps=(4,))
    results = {t: r for t, (_, r) in run_grid(batches, ["x", "z"], plan, parse_machine(MACHINE, "m")).items()}
    tried = {t: {*r.cells["family"], *r.race["family"]} - {"stack"} for t, r in results.items()}
    assert tried["x"] == {"axis_coupled", *tried["z"]} and "axis_coupled" not in tried["z"]
    table = results["x"].predictions
    assert np.array_equal(table["position_mm"], np.concatenate([b.values("at") for b in batches]), equal_nan=True)
    assert "position_mm" not in results["z"].predictions


def test_the_mean_curve_along_an_axis_is_one_curve_for_each_position() -> None:
    d = design(4)
    model = MeanCurve().fit_design(d, [0, 1, 2])
    assert model.fitted["position_mm"].tolist() == AT_MM.tolist() and model.n_parameters() == 15
    error_um = np.array([d.y_um[d.rows(k)] for k in range(4)])
    there = np.isfinite(error_um[3])
    predicted = model.predict_design(d, [3])[0]
    np.testing.assert_allclose(predicted[there], error_um[:3].mean(axis=0)[there])
    assert np.isnan(predicted[~there]).all()
    between = replace(run(3), table=run(3).table.assign(at=-110.0))  # half-way between two positions, on every row
    at_s = d.time_s[d.rows(0)]
    swept = [np.arange(p, 40, 8) for p in (1, 2)]
    curves = [np.interp(at_s, at_s[rows], error_um[:3, rows].mean(axis=0)) for rows in swept]
    np.testing.assert_allclose(model.predict(between), (curves[0] + curves[1]) / 2)
    beyond = replace(run(3), table=run(3).table.assign(at=99.0))
    np.testing.assert_allclose(model.predict(beyond), curves[1])
    with pytest.raises(InputError, match="mean_curve: got 0 usable rows of x in b1"):
        dead = replace(run(1), table=run(1).table.assign(x=np.nan))
        MeanCurve().fit([dead], (), "x")
