"""An effect of no listed form, concealed: its driver, its form and its size, as a mechanism that a file can state."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from data.errors import InputError
from tests.twin.diagnosis.concealed import Case, calibrated, case, flux, shift
from twin.calibration.least_squares import fit
from twin.calibration.problem import CalibrationProblem
from twin.compile import compile_network
from twin.diagnosis.places.left_out_terms import LeftOutTerms
from twin.diagnosis.places.reconstruct import Reconstruction, reconstruct
from twin.diagnosis.places.where_when import locate
from twin.schema import MechanismPart, twin_part


def found(given: Case, stateable: bool = False) -> Reconstruction:
    located = locate(given.problem, given.fit.x, given.fit.nuisance, given.batches)
    return reconstruct(located, given.batches, stateable=stateable)


def size(part: MechanismPart | None, parameter: str) -> float:
    assert part is not None
    return float(str(part.parameters[parameter].value).split()[0])


@pytest.mark.parametrize(
    ("concealed", "place", "parameter", "true", "words"),
    [
        (flux("bed", linear="40 W"), "bed", "linear", 40.0, "W into bed while coolant is on"),
        (flux("column", "rpm", product="0.0008 W/K"), "column", "product", 0.0008,
         "W into column per K of column above 20 degC, in proportion to rpm (at 5000 rpm)"),
        (flux("saddle", "rpm", square="-4e-6 W"), "saddle", "square", -4e-6,
         "W out of saddle with the square of rpm (at 5000 rpm)"),
        (flux("bed", "rpm", "coolant", cross="0.012 W"), "bed", "cross", 0.012,
         "W into bed in proportion to rpm (at 5000 rpm) while coolant is on"),
        (flux("bed", "rpm", "coolant", square_cross="3e-6 W"), "bed", "square_cross", 3e-6,
         "W into bed with the square of rpm (at 5000 rpm) while coolant is on"),
        (shift("z", linear="8 um"), "z", "linear", 8.0, "µm of z while coolant is on"),
        (shift("y", "column", "rpm", product="0.0005 um/K"), "y", "product", 0.0005,
         "µm of y per K of column's rise, in proportion to rpm (at 5000 rpm)"),
    ],
)  # fmt: skip
def test_law_is_recovered(concealed: dict[str, Any], place: str, parameter: str, true: float, words: str) -> None:
    given = case(concealed)
    out = found(given)
    assert out.place == place
    assert words in out.words
    assert size(out.part, parameter) == pytest.approx(true, rel=0.2)
    assert out.explained > 0.8 and out.improved == out.batches == 6
    assert out.part is not None and out.part.law == ("free_flux" if out.kind == "heat" else "free_shift")


def test_the_part_is_usable_and_a_refit_finds_the_truth() -> None:
    """The mechanism as written compiles; freed beside the rest it comes out right, and the misfit is gone."""
    given = case(flux("column", linear="30 W"))
    out = found(given)
    assert [c.term.name for c in out.terms] == ["coolant"] and out.terms[0].unit == "W" and out.terms[0].sd < 5
    assert out.part is not None
    part = twin_part(given.machine)
    mended = part.model_copy(update={"mechanisms": {**part.mechanisms, "missing": out.part}})
    network = compile_network(given.machine, part=mended)
    problem = CalibrationProblem.of(network, given.batches)
    refit = fit(problem, tolerance=1e-3, reweight=True)
    assert max(given.fit.noise_factor) > 5 and max(refit.noise_factor) < 1.3
    values = dict(zip([u.name for u in problem.unknowns], refit.x, strict=True))
    assert values["mechanisms.missing.linear"] == pytest.approx(30.0, rel=0.05)


def test_a_constant_is_told() -> None:
    out = found(case(flux("saddle", None, constant="25 W")))
    assert out.place == "saddle" and out.part is not None
    assert "constant" in out.part.parameters and out.part.drivers is None
    assert size(out.part, "constant") == pytest.approx(25.0, rel=0.2)


def test_a_tilt_is_told_as_the_difference_that_it_is() -> None:
    """Neither body's rise alone shows it, and no single mechanism of free form states it."""
    hot, cold = (shift("z", body, None, per_K=f"{g} um/K")["shift"] for body, g in (("column", 6.0), ("bed", -6.0)))
    out = found(case({"hot": hot, "cold": cold}))
    assert {c.term.name: round(c.value) for c in out.terms} == {"θ_column": 6, "θ_bed": -6}
    assert out.part is None and 0 < out.part_gain < 0.9 * out.gain
    assert "6.0 µm of z per K of column's rise" in out.words and "−6.0 µm of z per K of bed's rise" in out.words


def test_what_one_mechanism_can_state_of_it_is_told_on_demand() -> None:
    """Where a finding must be refitted, the best that a machine file can state goes before what no file can."""
    hot, cold = (shift("z", body, None, per_K=f"{g} um/K")["shift"] for body, g in (("column", 6.0), ("bed", -6.0)))
    given = case({"hot": hot, "cold": cold})
    free, stated = found(given), found(given, stateable=True)
    assert free.part is None and stated.part is not None and stated.part.law == "free_shift"
    assert stated.gain == pytest.approx(free.part_gain) and 0 < stated.explained < free.explained


def test_nothing_to_reconstruct() -> None:
    given = case()
    with pytest.raises(InputError, match="reconstruct: nothing was found; give a place of missing heat"):
        found(given)
    for b in given.batches:
        b.table["t_column"] += 0.3 * b.time_s / 3600
    with pytest.raises(InputError, match="the reading of t_column is a sensor's matter"):
        found(calibrated(given.machine, given.batches))


def _toy(seed: int, true: dict[int, float], terms: int = 8) -> tuple[LeftOutTerms, list[np.ndarray], list[np.ndarray]]:
    rng = np.random.default_rng(seed)
    z = np.array([0.7, -0.4])
    grams, columns, rows = [], [], []
    for _ in range(6):
        features, jacobian = rng.standard_normal((40, terms)), rng.standard_normal((40, 2))
        r = sum((c * features[:, k] for k, c in true.items()), np.zeros(40)) - jacobian @ z + rng.standard_normal(40)
        x = np.column_stack([features, jacobian, r])
        grams.append(x.T @ x)
        columns.append(np.column_stack([features, jacobian]))
        rows.append(r)
    return LeftOutTerms(np.stack(grams), z, np.full(6, 40.0)), columns, rows


def test_left_out_score_is_the_predictive_density() -> None:
    """Of each batch given the others, by dense Gaussians with the same priors."""
    scores, columns, rows = _toy(0, {1: 0.8, 4: -0.5})

    def log(which: list[int], terms: list[int]) -> float:
        x = np.vstack([columns[b][:, [*terms, 8, 9]] for b in which])
        y = np.concatenate([rows[b] for b in which]) + x[:, len(terms) :] @ scores.z  # about the prior's centre
        flat = 1e-6 * scores.grams.sum(axis=0)[terms, terms]
        cov = np.eye(len(y)) + x @ np.diag([*(1 / flat), 1.0, 1.0]) @ x.T
        return float(-0.5 * (y @ np.linalg.solve(cov, y) + np.linalg.slogdet(cov)[1]))

    def left_out(terms: list[int]) -> float:
        every = list(range(6))
        return sum(log(every, terms) - log([k for k in every if k != b], terms) for b in every)

    for terms in ([1], [1, 4], [0, 1, 4]):
        assert scores.gain(terms) == pytest.approx(left_out(terms) - left_out([]), abs=1e-3)


def test_what_is_exchanged_anyway_hides_nothing() -> None:
    """A term that is large and always in does not use up the room for others, nor count as what they explain."""
    scores, *_ = _toy(3, {1: 0.8, 4: -0.5, 6: 30.0})
    others = [k for k in range(8) if k != 6]
    assert scores.chosen(range(8), most=1) == [6]
    assert sorted(scores.chosen(others, beside=[6])) == [1, 4]
    assert scores.explained([1, 4], [6])[0] > 0.8 > scores.explained([0, 2], [6])[0]
    assert scores.gain([6]) > 20.0 * (scores.gain([1, 4, 6]) - scores.gain([6])) > 0.0


def test_terms_that_are_there_and_no_others() -> None:
    names = []
    for seed in range(20):
        scores, *_ = _toy(seed, {1: 0.8, 4: -0.5})
        names.append(sorted(scores.chosen(range(8))))
        assert scores.explained([1, 4])[0] > 0.8
        values, covariance = scores.coefficients([1, 4])
        np.testing.assert_allclose(values, [0.8, -0.5], atol=4 * np.sqrt(covariance.diagonal().max()))
    assert names.count([1, 4]) >= 19
    assert sum(bool(_toy(seed, {})[0].chosen(range(8))) for seed in range(20)) <= 1
