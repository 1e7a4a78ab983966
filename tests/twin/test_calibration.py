"""Calibration on recordings that a network itself made: the truth, its intervals, what each batch has of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from data.batch import Batch, Finding
from data.errors import InputError, WorkError
from data.machine import Machine
from tests.twin.machines import machine
from tests.twin.recordings import drawn, empty_batches, recorded
from twin.calibration import Calibration, CalibrationOptions, calibrate
from twin.calibration.estimate import leave_batch_out
from twin.calibration.identifiability import intervals90
from twin.calibration.least_squares import FitOptions, fit
from twin.calibration.problem import CalibrationProblem
from twin.compile import compile_network
from twin.simulation import simulate
from twin.simulation.inputs import inputs_of
from twin.simulation.start import start_of

HEAD = {"capacity": "40 kJ/K", "material": "cast_iron"}  # fixed: else heat, capacities, conductances only scale


@pytest.fixture(scope="module")
def small() -> Machine:
    return machine(bodies__head=HEAD)


@pytest.fixture(scope="module")
def truth(small: Machine) -> np.ndarray:
    return drawn(compile_network(small), np.random.default_rng(5))


@pytest.fixture(scope="module")
def batches(small: Machine, truth: np.ndarray) -> list[Batch]:
    return recorded(small, empty_batches(small, 4), truth, seed=1)


@pytest.fixture(scope="module")
def found(small: Machine, batches: list[Batch]) -> Calibration:
    return calibrate(small, batches, CalibrationOptions(leave_out=True))


def test_the_truth_is_recovered(small: Machine, truth: np.ndarray, found: Calibration) -> None:
    assert found.fit.converged
    network = compile_network(small)
    for name, value in found.values.items():
        assert value == pytest.approx(truth[network.index(name)], rel=0.1), name
        assert found.network.parameters[network.index(name)].value == pytest.approx(value, rel=1e-12)
        assert found.network.parameters[network.index(name)].prior_value == pytest.approx(
            network.parameters[network.index(name)].value
        )
    assert all(i.prior_shrinkage < 0.2 for i in found.intervals90)
    assert found.undetermined == []


@pytest.mark.slow
def test_intervals_hold_the_truth_as_often_as_they_say(small: Machine) -> None:
    network = compile_network(small)
    empty = empty_batches(small, 2, hours=3.0)
    held = []
    for seed in range(60):
        values = drawn(network, np.random.default_rng(1000 + seed))
        problem = CalibrationProblem.of(network, recorded(small, empty, values, seed=seed))
        found = intervals90(fit(problem, FitOptions(tolerance=1e-3, reweight=True)), problem.unknowns)
        held += [i.low <= values[network.index(i.name)] <= i.high for i in found]
    assert len(held) == 240
    assert 0.85 <= np.mean(held) <= 0.95


def test_a_combination_that_only_scales_is_told() -> None:
    free = machine(**{"exposures__shaft-room": None})
    fitted = calibrate(free, recorded(free, empty_batches(free, 3), seed=2))
    assert len(fitted.undetermined) == 1
    assert set(fitted.undetermined[0].names) == set(fitted.values)


def test_a_batch_s_own_start_is_absorbed(truth: np.ndarray) -> None:
    """The shaft has no sensor and starts 1 K off in each batch's own way: that comes out, and bends no parameter."""
    own = machine(bodies__head=HEAD, sensors__t_shaft=None)
    network = compile_network(own)
    truth = drawn(network, np.random.default_rng(5))
    batches = recorded(own, empty_batches(own, 4), truth, seed=3, start_K=1.0)
    shaft = np.random.default_rng(3).standard_normal(4)  # as `recorded` draws them
    fitted = calibrate(own, batches)
    problem = CalibrationProblem.of(network, batches)
    began = problem.start_degC[:, 0] + np.array([v[0] for v in fitted.fit.nuisance])
    room = np.array([b.values("room")[0] for b in batches])
    np.testing.assert_allclose(began, room + shaft, atol=0.15)
    for name, value in fitted.values.items():
        assert value == pytest.approx(truth[network.index(name)], rel=0.1), name


def test_an_error_s_first_sample_is_absorbed(small: Machine, truth: np.ndarray) -> None:
    batches = recorded(small, empty_batches(small, 3), truth, seed=4)
    network = compile_network(small)
    noise = network.errors[0].noise
    shifted = []
    for batch in batches:
        table = batch.table.copy()
        table.loc[0, "z"] += 3 * noise
        shifted.append(replace(batch, table=table))
    one, other = calibrate(small, batches), calibrate(small, shifted)
    moved = [b[2] - a[2] for a, b in zip(one.fit.nuisance, other.fit.nuisance, strict=True)]
    assert np.mean(moved) == pytest.approx(-2.0, abs=0.3)  # 3 noise sd, in units of 1.5
    np.testing.assert_allclose(one.fit.x, other.fit.x, atol=0.01)


def test_a_batch_s_own_surroundings_are_absorbed(truth: np.ndarray) -> None:
    """An offset of the room's sensor in one batch, declared per batch, comes out as that batch's own."""
    own = machine(bodies__head=HEAD, surroundings__room={"channel": "room", "per_batch": "1 K"})
    batches = recorded(own, empty_batches(own, 3), truth, seed=5)
    table = batches[1].table.copy()
    table["room"] += 1.0
    fitted = calibrate(own, [batches[0], replace(batches[1], table=table), batches[2]])
    offsets = np.array([v[2] for v in fitted.fit.nuisance])
    np.testing.assert_allclose(offsets, [0.0, -1.0, 0.0], atol=0.1)


def test_derivatives_are_those_of_the_residuals(batches: list[Batch]) -> None:
    """As far as the derivative's own error of second order in the 300-s step goes."""
    own = machine(bodies__head=HEAD, surroundings__room={"channel": "room", "per_batch": "1 K"})
    problem = CalibrationProblem.of(compile_network(own), batches[:2])
    rng = np.random.default_rng(0)
    x = np.array([u.prior for u in problem.unknowns]) + 0.1 * rng.standard_normal(len(problem.unknowns))
    nuisance = [rng.standard_normal(q) for q in problem.nuisance_sizes]
    blocks = list(problem.linearise(x, nuisance))
    step = 1e-4

    def moved(dx: np.ndarray, dn: np.ndarray) -> list[np.ndarray]:
        ends = [problem.residuals(x + s * dx, [v + s * dn for v in nuisance]) for s in (step, -step)]
        return [-(a - b) / (2 * step) for a, b in zip(*ends, strict=True)]

    p, q = len(x), problem.nuisance_sizes[0]
    for j in range(p):
        for block, slope in zip(blocks, moved(np.eye(p)[j], np.zeros(q)), strict=True):
            np.testing.assert_allclose(block.jacobian[:, j], slope, atol=3e-3 * max(1.0, np.abs(slope).max()))
    for j in range(q):
        for block, slope in zip(blocks, moved(np.zeros(p), np.eye(q)[j]), strict=True):
            np.testing.assert_allclose(block.nuisance[:, j], slope, atol=3e-3 * max(1.0, np.abs(slope).max()))


def test_left_out_batches_are_predicted_from_their_first_readings_alone(
    small: Machine, batches: list[Batch], found: Calibration
) -> None:
    assert found.left_out is not None
    table = found.left_out.by_channel().set_index("channel")
    assert list(table["batches"]) == [4, 4, 4]
    for channel in ("t_shaft", "t_head", "z"):
        assert table.loc[channel, "left_out"] < 0.5 * table.loc[channel, "before"] < table.loc[channel, "zero"]
    # by hand: the first fold's values on the first batch
    network = compile_network(small)
    inputs = inputs_of(network, batches[:1])
    shown = simulate(network, found.left_out.folds[0].values, inputs)
    error = batches[0].values("t_head") - shown.readings[0, 0, :, 1]
    first = found.left_out.table.iloc[1]
    assert (first["batch"], first["channel"]) == ("b00", "t_head")
    assert first["left_out"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-6)


def test_what_a_left_out_batch_shows_never_reaches_its_fold(small: Machine, batches: list[Batch]) -> None:
    table = batches[2].table.copy()
    table.loc[5:, ["t_shaft", "t_head", "z"]] += 4.0
    other = [*batches[:2], replace(batches[2], table=table), batches[3]]
    network = compile_network(small)
    folds = [leave_batch_out(CalibrationProblem.of(network, b)).folds for b in (batches, other)]
    np.testing.assert_array_equal(folds[0][2].values, folds[1][2].values)
    assert np.abs(folds[0][1].values - folds[1][1].values).max() > 0


@pytest.mark.slow
def test_processes_change_nothing(small: Machine, batches: list[Batch]) -> None:
    problem = CalibrationProblem.of(compile_network(small), batches[:2])
    one, two = leave_batch_out(problem), leave_batch_out(problem, CalibrationOptions(processes=2))
    assert one.table.equals(two.table)


def test_starts_from_first_readings_undo_what_the_sensors_add() -> None:
    room = {"channel": "room"}
    shaft = {
        "at": "shaft",
        "air": "room",
        "offset": {"value": "0.5 K", "spread": "0.2 K"},
        "bonding": 0.8,
        "lag": "60 s",
    }
    own = machine(bodies__head=HEAD, surroundings__room=room, sensors__t_shaft=shaft)
    network = compile_network(own)
    inputs = inputs_of(network, recorded(own, empty_batches(own, 2), seed=1, noise=0.0, start_K=3.0))
    shown = simulate(network, network.values, inputs, start_of(network, network.values, inputs)[None])
    for c, channel in enumerate(("t_shaft", "t_head")):
        np.testing.assert_allclose(shown.readings[0, :, 0, c], inputs.first[channel], atol=0.01)


def test_masked_and_missing_channels_are_done_without(small: Machine, truth: np.ndarray, batches: list[Batch]) -> None:
    blind = [replace(b, table=b.table.assign(z=np.nan)) for b in batches[:2]]
    masked = batches[2].with_findings((Finding("stuck", "t_shaft", "stuck", 3000.0, 6000.0),))
    only_error = replace(batches[3], table=batches[3].table.assign(t_shaft=np.nan, t_head=np.nan))
    fitted = calibrate(small, [*blind, masked, only_error])
    counts = fitted.rms.set_index(["batch", "channel"])["rows"]
    assert ("b00", "z") not in counts.index and ("b03", "t_head") not in counts.index
    assert counts["b02", "t_head"] - counts["b02", "t_shaft"] == 11
    network = compile_network(small)
    for name, value in fitted.values.items():
        assert value == pytest.approx(truth[network.index(name)], rel=0.2), name


def test_rows_are_thinned(small: Machine, batches: list[Batch]) -> None:
    problem = CalibrationProblem.of(compile_network(small), batches, every_s=900.0)
    assert np.diff(problem.measured[0].row[problem.measured[0].channel == 0]).tolist() == [3] * 16


def test_several_starts_find_the_same_optimum(small: Machine, batches: list[Batch], found: Calibration) -> None:
    fitted = calibrate(small, batches, CalibrationOptions(starts=3, seed=2))
    assert "3 of 3 starts reached this optimum" in fitted.fit.message
    np.testing.assert_allclose(fitted.fit.x, found.fit.x, atol=2e-3)


def test_a_fit_that_does_not_converge_is_no_calibration(small: Machine, batches: list[Batch]) -> None:
    words = r"two_bodies: stopped after \d steps, cost still falling by [0-9.e-]+ % a step.*nothing is kept"
    with pytest.raises(WorkError, match=words):
        calibrate(small, batches, CalibrationOptions(max_iterations=1, tolerance=1e-12))


def test_bad_input_is_one_line(small: Machine, batches: list[Batch]) -> None:
    empty = replace(batches[0], table=batches[0].table.assign(z=np.nan, t_shaft=np.nan, t_head=np.nan))
    none = replace(batches[0], table=batches[0].table.drop(columns=["room", "rpm"]))
    room = batches[0].table["room"].where(batches[0].time_s < 3000.0)
    gap = replace(batches[0], table=batches[0].table.assign(room=room))
    short = replace(batches[0], table=batches[0].table.iloc[:2].assign(t_head=np.nan))
    other = replace(batches[0], machine="another")
    cases = [
        ([empty], "batch b00: has no usable value of the channels that the twin of two_bodies measures"),
        ([none], "batch b00: has none of the channels that the twin of two_bodies needs"),
        ([gap], "batch b00: channel 'room' has no value from 3000 s to .* longer than the 900 s"),
        ([short], r"calibration: \d usable rows for 4 free parameters; give more batches"),
        ([other], "batch b00: is of machine 'another', expected 'two_bodies'; leave it out"),
        ([batches[0], batches[0]], "batch b00: given 2 times; give it once"),
        ([], "machine two_bodies: no batches"),
    ]
    for given, words in cases:
        with pytest.raises(InputError, match=words) as caught:
            calibrate(small, given)
        assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="the twin has no sensor or error 't_shaf'; did you mean 't_shaft'"):
        calibrate(small, batches, CalibrationOptions(channels=["t_shaf"]))
    with pytest.raises(InputError, match="every_s: got 0, expected seconds above 0"):
        calibrate(small, batches, CalibrationOptions(every_s=0.0))
    with pytest.raises(InputError, match="leave-batch-out: got 1 batch, needs 2 or more"):
        calibrate(small, batches[:1], CalibrationOptions(leave_out=True))


def test_whiteness_has_a_sentence_per_channel(found: Calibration) -> None:
    assert set(found.whiteness_in_words) == {"t_shaft", "t_head", "z"}
    assert "white over 4 batches" in found.whiteness_in_words["z"] and found.whiteness_in_words["z"].endswith("um")
