"""The families of the twin: what they learn, what they may see, and that sharing work changes nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch, Channel
from data.errors import InputError
from features.design import Design
from models.base import Family, family_from_plain
from models.families import FAMILIES
from models.families.twin import Twin
from models.families.twin_kalman import TwinKalman
from models.families.twin_residual import TwinResidual
from models.numerics.twin_folds import Calibrations, TwinRun, _thinned
from models.selection.crossing import Plan, cross_family, prepare
from models.selection.race import Job, in_order
from tests.models.twin_year import ROWS, true_values, year
from twin.compile import compile_network

TWINS = (Twin, TwinResidual, TwinKalman)
INPUTS = ("t_shaft", "t_head")
MACHINE, BATCHES = year(6)
SCATTERED = year(7, scatter=0.15)[1]
_DESIGNS: dict[str, Design] = {}


def design(batches: list[Batch] | None = None, target: str = "z") -> Design:
    key = f"{target} {id(batches)}"
    if key not in _DESIGNS:
        _DESIGNS[key] = Design.build(BATCHES if batches is None else batches, INPUTS, target, MACHINE)
    return _DESIGNS[key]


def rms(family: Family, given: Design, batch: int) -> float:
    e = given.y_um[given.rows(batch)] - family.predict_design(given, [batch])[0]
    return float(np.sqrt(np.nanmean(e**2)))


def changed(batch: Batch, **columns: object) -> Batch:
    return replace(batch, table=batch.table.assign(**columns))


def test_learns_what_the_file_has_wrong_and_predicts_to_the_noise():
    given = design()
    model = Twin().fit_design(given, range(5))
    network = compile_network(MACHINE)
    truth = true_values(network)
    for name in ("mechanisms.belt.power", "links.shaft-head.conductance", "bodies.head.capacity"):
        j = network.index(name)
        assert model.values()[j] == pytest.approx(truth[j], rel=0.1)
    assert model.fitted["start_K"].mean() == pytest.approx(0.5 * 5 / 6, abs=0.25)  # as with one batch that had none
    assert rms(model, given, 5) < 0.8
    assert np.ptp(given.y_um[given.rows(5)]) > 15.0


def test_the_twin_sees_no_temperature_of_the_machine_at_all():
    model = Twin().fit_design(design(), range(5))
    want = model.predict(BATCHES[5])
    np.testing.assert_array_equal(model.predict(changed(BATCHES[5], t_shaft=55.0, t_head=np.nan)), want)
    warmer = model.predict(changed(BATCHES[5], room=BATCHES[5].table["room"] + np.linspace(0, 3, ROWS)))
    assert np.abs(warmer - want).max() > 0.5


@pytest.mark.parametrize("family", TWINS)
def test_folds_at_once_are_the_folds_one_by_one(family):
    given = design(SCATTERED)
    folds = [[j for j in range(7) if j != k] for k in range(7)] + [[0, 1, 2, 3], [5]]
    together = family().fit_folds(given, folds)
    for fold in (0, 4, 7, 8):
        alone = family().fit_design(Design.build(SCATTERED, INPUTS, "z", MACHINE), folds[fold])
        out = folds[0][0] if fold else 0
        got, want = (m.predict_design(given, [out])[0] for m in (together[fold], alone))
        np.testing.assert_allclose(got, want, atol=0.02)  # µm, of 20 to 40
    got = together[0].predict_folds(given, together, [[3]] * len(together))[1][0]
    np.testing.assert_allclose(got, together[1].predict_design(given, [3])[0], atol=1e-6)


def test_where_a_fit_begins_does_not_matter_even_where_the_beginning_saw_a_spoilt_batch():
    spoilt = changed(SCATTERED[6], t_shaft=SCATTERED[6].table["t_shaft"] * 1.5, z=SCATTERED[6].table["z"] * 2)
    work = Calibrations(MACHINE, [*SCATTERED[:6], spoilt], 300.0, ())
    near = work.of(range(6), range(7))
    cold = Calibrations(MACHINE, SCATTERED[:6], 300.0, ()).of(range(6))

    run = TwinRun.of(work.network, BATCHES)
    got, want = (run.rows(np.stack([c.values]), c.start_K[None], 0)[0] for c in (near, cold))  # noqa: PD011, no pandas
    np.testing.assert_allclose(got, want, atol=0.05)  # µm, of 20 to 60
    far = work.of(range(7))
    assert np.abs(run.rows(np.stack([far.values]), far.start_K[None], 0)[0] - want).max() > 2.0  # noqa: PD011


def test_error_channels_share_one_calibration(monkeypatch):
    import models.numerics.twin_folds as folds

    calls = []
    real = folds._arrived
    monkeypatch.setattr(folds, "_arrived", lambda *a: calls.append(1) or real(*a))
    batches = [replace(b) for b in BATCHES]
    z, x = (Design.build(batches, INPUTS, t, MACHINE) for t in ("z", "x"))
    for family in TWINS:
        for given in (z, x):
            family().fit_design(given.subset(["t_head"]), [0, 1])
    assert len(calls) == 1


@pytest.mark.parametrize("family", [Twin(), TwinResidual("gp"), TwinKalman()])
def test_plain_data_predicts_where_no_machine_file_is(family):
    model = family.fit_design(design(), range(3))
    back = family_from_plain(model.as_plain())
    assert back.options() == model.options() and back.n_parameters() == model.n_parameters()
    np.testing.assert_array_equal(back.predict(BATCHES[5]), model.predict(BATCHES[5]))


def test_the_residual_learns_from_batches_that_its_twin_did_not_see():
    given = design(SCATTERED)
    fold = tuple(range(6))
    twin = Twin().fit_design(given, fold)
    _, left_um = TwinResidual()._left_out(given, fold)
    assert not np.isfinite(left_um[given.rows(6)]).any()
    seen = np.concatenate(
        [(given.y_um[given.rows(k)] - p) for k, p in zip(fold, twin.predict_design(given, fold), strict=True)]
    )
    left = np.concatenate([left_um[given.rows(k)] for k in fold])
    assert np.nanstd(left) > 1.02 * np.nanstd(seen)
    one = Twin().fit_design(given, [0, 1, 2, 4, 5])
    exact = given.y_um[given.rows(3)] - one.predict_design(given, [3])[0]
    np.testing.assert_allclose(left_um[given.rows(3)], exact, atol=0.25 * np.nanstd(exact) + 0.1)


def test_sensors_tell_what_the_batch_has_of_its_own():
    given = design(SCATTERED)
    S = {}
    for family in (*(f() for f in TWINS), TwinResidual("gp")):
        model = family.fit_design(given, range(5))
        S[f"{family.key} {family.options().get('residual', '')}".strip()] = np.mean(
            [rms(model, given, k) for k in (5, 6)]
        )
    assert S["twin_kalman ridge"] < 0.6 * S["twin"]
    assert S["twin_residual ridge"] < 0.6 * S["twin"]
    assert S["twin_residual gp"] < 0.8 * S["twin"]


def test_the_gaussian_process_says_how_sure_it_is():
    given = design(SCATTERED)
    model = TwinResidual("gp").fit_design(given, range(5))
    sd = model.sd_um(given, [5, 6])
    e = [given.y_um[given.rows(k)] - p for k, p in zip((5, 6), model.predict_design(given, [5, 6]), strict=True)]
    assert [s.shape for s in sd] == [(ROWS,), (ROWS,)] and all((s > 0.1).all() for s in sd)
    assert np.mean(np.abs(np.concatenate(e)) < 3 * np.concatenate(sd)) > 0.8
    with pytest.raises(InputError, match="residual 'ridge' has no predictive sd; choose 'gp'"):
        TwinResidual().fit_design(given, range(5)).sd_um(given, [5])


def test_the_filter_without_its_sensors_runs_free():
    given, batch = design(), BATCHES[5]
    model = TwinKalman().fit_design(given, range(4))
    nothing = changed(batch, t_shaft=np.nan, t_head=np.nan)
    free = Twin().fit_design(given, range(4)).predict(batch)
    np.testing.assert_allclose(model.predict(nothing), free, atol=1e-6)
    hole = batch.table["t_shaft"].where((np.arange(ROWS) < 20) | (np.arange(ROWS) > 30))
    assert np.isfinite(model.predict(changed(batch, t_shaft=hole))).all()


@pytest.mark.parametrize("family", TWINS)
def test_a_batch_without_its_driver_is_not_predicted_and_a_hole_is_bridged(family):
    given = design()
    model = family().fit_design(given, range(4))
    silent = changed(BATCHES[5], rpm=np.nan)
    both = Design.build([BATCHES[4], silent], INPUTS, None, MACHINE)
    first, second = model.predict_design(both, [0, 1])
    assert np.isfinite(first).all() and np.isnan(second).all()
    rpm = BATCHES[5].table["rpm"].astype(float).where((np.arange(ROWS) < 10) | (np.arange(ROWS) > 15))
    np.testing.assert_allclose(model.predict(changed(BATCHES[5], rpm=rpm)), model.predict(BATCHES[5]), atol=1e-9)


def test_a_training_batch_that_cannot_be_simulated_is_left_out_and_alone_it_is_told():
    silent = changed(BATCHES[1], rpm=np.nan)
    with_silent = Design.build([BATCHES[0], silent, BATCHES[2]], INPUTS, "z", MACHINE)
    got = Twin().fit_design(with_silent, [0, 1, 2]).predict(BATCHES[5])
    want = Twin().fit_design(Design.build([BATCHES[0], BATCHES[2]], INPUTS, "z", MACHINE), [0, 1]).predict(BATCHES[5])
    np.testing.assert_allclose(got, want, atol=1e-9)
    with pytest.raises(InputError, match="batch B2: channel 'rpm' has no value at all"):
        Twin().fit_design(with_silent, [1])


def test_a_machine_without_the_part_is_refused_in_one_line():
    bare = MACHINE.model_copy(update={"twin": None})
    for key in ("twin", "twin_residual", "twin_kalman"):
        with pytest.raises(InputError, match=f"family {key} needs the twin part of the machine file; add 'twin' to"):
            FAMILIES[key]().fit(BATCHES[:2], INPUTS, "z", bare)
        with pytest.raises(InputError, match=f"family {key} needs the twin part"):
            Plan(families=("zero", key)).suited(bare)
    less = MACHINE.model_copy(update={"twin": {**MACHINE.twin, "errors": {"z": MACHINE.twin["errors"]["z"]}}})
    with pytest.raises(InputError, match=r"the twin of two_bodies has no error 'x', only z; add it under twin\.errors"):
        Twin().fit(BATCHES[:2], INPUTS, "x", less)


def test_a_plan_takes_the_twin_where_the_machine_file_has_one():
    bare = MACHINE.model_copy(update={"twin": None})
    usual, without = Plan().suited(MACHINE).families, Plan().suited(bare).families
    assert set(usual) - set(without) == {"twin", "twin_residual"}
    assert without == Plan().suited(None).families
    assert "mlr" in without and not any(FAMILIES[k].needs_twin for k in without)
    assert Plan(families=("twin_kalman",)).suited(MACHINE).families == ("twin_kalman",)


def test_the_grid_starts_with_one_job_of_the_twin_and_ends_with_those_that_share_its_work():
    families = ("zero", "twin", "bp", "twin_residual")
    jobs = in_order([Job(t, f, "", (), {}, False) for f in families for t in ("z", "x")])
    named = [(j.target, j.family) for j in jobs]
    assert named[:5] == [("z", "twin"), ("z", "bp"), ("x", "bp"), ("z", "zero"), ("x", "zero")]
    assert named[5:] == [("x", "twin"), ("z", "twin_residual"), ("x", "twin_residual")]


def test_the_grid_crosses_them():
    plan = Plan(("none", "correlation"), ("twin", "twin_residual"), ("leave-batch-out", "train-on-one"), (1, 2))
    crossing = prepare(SCATTERED[:4], "z", plan, MACHINE)
    for key, cells in (("twin", 2), ("twin_residual", 4)):
        result = cross_family(crossing, key)
        assert not result.failures and len(result.cells) == cells
        assert np.isfinite(result.cells["S_mean_um"]).all()


def test_a_regression_learns_what_the_filter_leaves():
    """The recorded error has a part that follows a sensor and that no gain of the twin can give."""
    batches = [changed(b, z=b.table["z"] + 0.5 * (b.table["t_shaft"] - b.table["t_shaft"].iloc[0])) for b in BATCHES]
    given = Design.build(batches, INPUTS, "z", MACHINE)
    with_it, alone = (TwinKalman(residual=r).fit_design(given, range(4)) for r in ("ridge", "none"))
    S = {m.residual: np.mean([rms(m, given, k) for k in (4, 5)]) for m in (with_it, alone)}
    assert S["ridge"] < 0.5 * S["none"]


def test_calibration_thins_rows_and_keeps_the_mean_of_the_drivers():
    table = pd.DataFrame(
        {"time_s": np.arange(7) * 60.0, "rpm": [0.0, 6.0, 3.0, 3.0, 3.0, 9.0, 5.0], "t": np.arange(7.0)}
    )
    channels = {"rpm": Channel("rpm", "driver", "rpm"), "t": Channel("t", "temperature", "degC")}
    thin = _thinned(Batch("m", "one", table, channels), 180.0)
    assert thin.table["time_s"].tolist() == [0.0, 180.0, 360.0]
    assert thin.table["rpm"].tolist() == [3.0, 5.0, 5.0] and thin.table["t"].tolist() == [0.0, 3.0, 6.0]
    assert _thinned(thin, 180.0) is thin
