"""Refits find what was concealed; batches left out are predicted as by fits that never saw them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pandas as pd
import pytest

from data.arrays import Array
from data.errors import InputError
from diagnosis.fitting import fitted
from diagnosis.fitting.fit import Fitted
from diagnosis.fitting.fitted import (
    LeftOutRows,
    deterministic_fit,
    left_out_rows,
    refitted,
    relearned,
    relinearised,
    restructured,
)
from diagnosis.fitting.twins import drawn_misfits
from tests.diagnosis.small_cases import FLOOR, cold_floor, consistent
from twin.calibration.estimate import CalibrationOptions, LeftOut, leave_batch_out
from twin.calibration.identifiability import intervals90
from twin.calibration.least_squares import result
from twin.calibration.problem import CalibrationProblem
from twin.quantity import Value
from twin.schema import MechanismPart, TwinPart

CONDUCTANCE = "exposures.head-floor.conductance"


def with_floor(part: TwinPart) -> TwinPart:
    own = {
        "conductance": Value(value="10 W/K", spread=1.5),
        "temperature": Value(value="16 degC", spread="4 K"),
        "follow": Value(value=0.5, spread=0.8),
    }
    floor = MechanismPart.model_validate({**FLOOR, "parameters": own})
    return part.model_copy(update={"mechanisms": {**part.mechanisms, "floor": floor}})


@cache
def with_the_floor() -> Fitted:
    return refitted(cold_floor(), with_floor(cold_floor().part), fresh=True)


@cache
def by_refits() -> LeftOut:
    """Every batch predicted by a calibration on all others."""
    return leave_batch_out(consistent().problem, CalibrationOptions(reweight=False))


@cache
def predicted() -> LeftOutRows:
    return left_out_rows(consistent())


def value_by_name(done: Fitted) -> dict[str, float]:
    """Of the free parameters."""
    return {u.name: u.value(v) for u, v in zip(done.problem.unknowns, done.x, strict=True)}


def test_a_refit_from_a_bent_baseline_finds_the_truth() -> None:
    done = with_the_floor()
    fit = result(done.problem, done.state, 0.01, "")
    told = {i.name: i for i in intervals90(fit, done.problem.unknowns)}
    found = told[CONDUCTANCE]
    assert found.value == pytest.approx(8.0, rel=0.1)
    assert told["surroundings.floor.value"].value == pytest.approx(18.0, abs=0.2)
    assert told["surroundings.floor.follow"].value == pytest.approx(0.5, abs=0.05)


def test_without_it_parameters_are_bent_and_with_it_they_are_not() -> None:
    truth = value_by_name(consistent())
    bent, right = (
        max(abs(np.log(value_by_name(f)[name] / truth[name])) for name in truth)
        for f in (cold_floor(), with_the_floor())
    )
    assert bent > 0.3
    assert right < 0.1


def test_a_better_part_leaves_less_noise() -> None:
    before, after = cold_floor(), with_the_floor()
    assert before.noise.factor.max() > 10
    assert after.noise.factor.max() < 2.0
    assert (after.rows == before.rows).all() and after.rows.sum() == sum(map(len, after.columns))


def test_from_the_files_values_it_is_found_and_from_those_of_a_fit_in_the_end() -> None:
    """Under structure a descent from the values of a bent fit may stay near them; without it both are the same."""
    done, other = with_the_floor(), refitted(cold_floor(), with_floor(cold_floor().part))
    assert done.log_evidence > other.log_evidence - 2.0
    assert np.abs(deterministic_fit(other).z - deterministic_fit(done).z).max() < 0.1
    assert np.abs(relinearised(done).z - done.z).max() < 0.1


def test_left_out_batches_are_predicted_as_by_fits_without_them() -> None:
    """By refits of all others from the priors' mean, then the batch's own start and offset from its rows."""
    done, noise = consistent(), consistent().problem.noise
    for k, (fold, got) in enumerate(zip(by_refits().folds, predicted().error, strict=True)):
        expected = own_start_estimated(done, k, fold.values)
        scale = noise[done.problem.measured[k].channel]
        assert np.abs((got - expected) / scale).max() < 0.15
        inside = done.problem.residuals(done.x, done.fitted_nuisance)[k]
        assert np.abs(got / scale - inside).max() > 1.5 * np.abs((got - expected) / scale).max()


def test_a_fit_that_structure_holds_elsewhere_still_simulates_alone_at_the_likeliest_optimum() -> None:
    """Channels whose rows are far off pass for noise where a fit begins there; the priors' means are nearer."""
    done = with_the_floor()
    held = replace(done, z=np.where(np.arange(len(done.z)) % 2, 6.0, -6.0))
    z, own = deterministic_fit(done).z, deterministic_fit(held).z
    assert np.abs(held.z - z).max() > 5.0
    assert np.abs(own - z).max() < 0.1


def test_learning_anew_never_lowers_the_evidence() -> None:
    done = with_the_floor()
    for again in (relearned(done), relearned(relearned(done))):
        assert again.log_evidence >= done.log_evidence
        done = again


def own_start_estimated(done: Fitted, k: int, values: Array) -> Array:
    """Measured less simulated of batch k (n_k,) at these parameter values, its own unknowns at their best."""
    one, network = done.problem.only([k]), done.problem.network
    x = np.array([float(network.parameters[j].to_x(values[j])) for j in network.free])
    own: Array = np.zeros(done.problem.nuisance_sizes[k])
    for _ in range(5):
        (block,) = one.linearise(x, [own])
        weight = deterministic_fit(done).noise.weight[block.channel]
        normal = (block.nuisance.T * weight) @ block.nuisance + np.eye(len(own))
        aim = (block.nuisance.T * weight) @ (block.residual + block.nuisance @ own)
        own = np.asarray(np.linalg.solve(normal, aim), float)
    return one.residuals(x, [own])[0] * done.problem.noise[done.problem.measured[k].channel]


def test_their_rms_is_near_that_of_free_running_ones() -> None:
    """Sensors' start is known to their noise either way; an error's first sample shifts a free-running batch."""
    both = pd.merge(predicted().rms, by_refits().table, on=["batch", "channel", "unit", "rows"])
    assert len(both) == len(predicted().rms) == 18
    for channel, own in both.groupby("channel"):
        ratio = float(np.sqrt((own["rms"] ** 2).mean() / (own["left_out"] ** 2).mean()))
        low = 0.9 if str(channel).startswith("t_") else 0.5
        assert low < ratio < 1.05, channel


def test_the_table_is_the_rms_of_the_rows() -> None:
    done = predicted()
    for k, m in enumerate(consistent().problem.measured):
        own = done.rms[done.rms["batch"] == m.batch_id].set_index("channel")
        for c, name in enumerate(consistent().problem.channels):
            error = done.error[k][m.channel == c]
            assert own.loc[name, "rms"] == pytest.approx(float(np.sqrt(np.mean(error**2))))
            assert own.loc[name, "rows"] == len(error)
    assert dict(zip(done.rms["channel"], done.rms["unit"], strict=True)) == {"t_shaft": "K", "t_head": "K", "z": "um"}


def test_values_that_run_away_are_met_half_way(monkeypatch: pytest.MonkeyPatch) -> None:
    one = deterministic_fit(consistent())
    block = next(iter(one.problem.linearise(one.x, one.nuisance)))
    asked: list[Array] = []

    def alone(problem: CalibrationProblem, k: int, z: Array, nuisance: Array) -> Array:
        asked.append(z)
        if len(asked) < 2:
            raise InputError("stiff beyond the step control")
        return np.full(len(block.residual), 1e30 if len(asked) < 3 else 0.0)

    monkeypatch.setattr(fitted, "_alone", alone)
    assert not fitted._predicted(one, 0, block, one.z + 1.0).any()
    np.testing.assert_allclose(asked, [one.z + 1.0, one.z + 0.5, one.z + 0.25])
    monkeypatch.setattr(fitted, "_alone", lambda *_: (_ for _ in ()).throw(InputError("stiff")))
    with pytest.raises(InputError, match="stiff"):
        fitted._predicted(one, 0, block, one.z + 1.0)


# Structure


@pytest.mark.integration
def test_refined_twins_have_what_the_machine_file_states_from_its_priors_and_effects_as_they_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Values that a fit without an effect goes to would be those of no machine."""
    done, asked = with_the_floor(), []

    def drawn(*given: object) -> object:
        asked.append(given[4:6])
        return drawn_misfits(*given)  # type: ignore[arg-type]

    monkeypatch.setattr(fitted, "drawn_misfits", drawn)
    off = replace(done, z=done.z + 0.5)
    for one in (done, off):
        restructured(one)
    own = np.array(["floor" in u.name for u in done.problem.unknowns])
    assert 0 < own.sum() < len(own)
    for one, (centre, spread) in zip((done, off), asked, strict=True):
        np.testing.assert_array_equal(centre, np.where(own, one.z, 0.0))
        np.testing.assert_array_equal(spread, np.where(own, 0.0, 1.0))


@pytest.mark.integration
def test_structure_drawn_anew_about_a_fit_leaves_its_evidence() -> None:
    """What refined twins show depends on the machine file alone, so a fit elsewhere is explained as well."""
    done = consistent()
    again = restructured(done)
    assert again.log_evidence == pytest.approx(done.log_evidence, abs=20.0)
    assert again.marginal.covariance.structure is not done.marginal.covariance.structure
