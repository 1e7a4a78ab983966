"""Fits under the structural discrepancy: the baseline with its refined twins, refits with a changed part."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from data.arrays import Array
from data.batch import Batch
from data.errors import InputError, WorkError
from data.machine import Machine
from diagnosis.contracts import Fitted
from diagnosis.fitting.fitted import carried_start, check, spacing_s
from diagnosis.policy import POLICY
from diagnosis.structure.covariance import (
    Covariance,
    Normal,
    covariance_at,
    freedom,
    normal_equations,
    objective,
    white_noise,
)
from diagnosis.structure.mild import law_columns, varying_columns
from diagnosis.structure.policy import STRUCTURE
from diagnosis.structure.refined import misfits
from diagnosis.structure.rows import Linear
from twin.calibration.arrow import Arrow
from twin.calibration.fit_problem import Noise, estimate
from twin.calibration.least_squares import State, descend, x_of, z_bounds
from twin.calibration.problem import CalibrationProblem
from twin.compile import compile_network
from twin.schema import TwinPart


@dataclass(frozen=True, eq=False)
class Structure:
    """What refined twins of a machine show beyond its lumped network on the recorded inputs; n rows.

    Attributes:
        draws: (n, D) misfits that make the covariance, of every group from stiff to soft machines.
        other: (n, T) misfits of machines of another style, which it has not seen: the null; of the same groups.
        films: (n, k) natural convection where a constant film is stated, per prior sd.
    """

    draws: tuple[Array, ...]
    other: tuple[Array, ...]
    films: Array


@dataclass(frozen=True, eq=False)
class StructuralFit(Fitted):
    """A fit by generalised least squares under the structural discrepancy.

    Attributes:
        structure, covariance: the refined twins, and the covariance of all rows that they make about the fit.
        evidence: log marginal likelihood under that covariance, nats up to a constant of the covariance.
    """

    structure: Structure | None = None
    covariance: Covariance | None = None
    evidence: float = 0.0

    @property
    def full_evidence(self) -> float:
        """Log marginal likelihood, nats, comparable between fits that have covariances of their own."""
        assert self.covariance is not None
        return self.evidence - 0.5 * self.covariance.log_determinant


def baseline(
    machine: Machine,
    part: TwinPart,
    batches: Sequence[Batch],
    progress: Callable[[str, int, int], None] | None = None,
    runs: int = 0,
    seed: int = 0,
) -> StructuralFit:
    """The twin part fitted to all batches under the structural discrepancy that is simulated for it.

    First plain least squares, all channels alike, then Gauss-Newton steps under the covariance, which is built again
    at each. `runs` is the number of runs, where batches are blocks of fewer; `seed` draws the refined twins.

    Raises:
        InputError: batches of another machine, twice the same, or that cannot be simulated.
        WorkError: the model fails at the priors' means.
    """
    check(machine, batches)
    tell = progress or (lambda what, n, of: None)
    problem = CalibrationProblem.of(compile_network(machine, part=part), batches, _spacing_s(batches))
    k = len(problem.channels)
    alike = Noise(np.full(k, POLICY.initial_noise_factor), np.full(k, POLICY.initial_rows_per_value))
    tell("baseline", 0, 0)
    nothing = [np.zeros(q) for q in problem.nuisance_sizes]
    first = descend(
        problem, State.at(problem, np.zeros(len(problem.unknowns)), nothing, alike), STRUCTURE.first_steps, 1.0
    )
    tell("structure", 0, 0)
    structure = _structure(machine, part, problem, batches, first.nuisance, seed)
    fitted = StructuralFit(machine, part, tuple(batches), problem, first, runs or len(batches), structure)
    tell("calibrate", 0, 0)
    return settle(fitted)


def _structure(
    machine: Machine,
    part: TwinPart,
    problem: CalibrationProblem,
    batches: Sequence[Batch],
    nuisance: list[Array],
    seed: int,
) -> Structure:
    """Refined twins at the machine file's values, driven by the recorded inputs from the fitted starts."""
    stated = problem.values_at(x_of(problem.unknowns, np.zeros(len(problem.unknowns))))
    groups = STRUCTURE.biot_ranges
    each, rest = STRUCTURE.refined_twins // len(groups), STRUCTURE.null_twins // len(groups)
    draws, other = [], []
    for k, biot in enumerate(groups):
        draws.append(misfits(problem, stated, nuisance, "chain", biot, each, seed + 2 * k))
        other.append(misfits(problem, stated, nuisance, "web", biot, rest, seed + 2 * k + 1))
    films = law_columns(machine, part, problem, batches, nuisance)
    return Structure(tuple(draws), tuple(other), films)


def settle(fitted: StructuralFit, rounds: int = STRUCTURE.settle_rounds) -> StructuralFit:
    """The fit at its optimum, with the covariance built anew about it in every round."""
    problem = fitted.problem
    scales = fitted.covariance.scales if fitted.covariance is not None else np.ones(len(STRUCTURE.biot_ranges))
    z, own = fitted.state.z, fitted.state.nuisance
    names = [u.name for u in problem.unknowns]
    for k in range(rounds):
        linear = Linear.at(problem, z, own)
        covariance = covariance_of(fitted, linear, scales)
        last = k == rounds - 1
        point = descended(problem, linear, names, covariance, STRUCTURE.settle_steps if last else 2)
        moved, scales = not np.array_equal(covariance.scales, scales), covariance.scales
        z, own = point.z, point.own
        if point.fall < STRUCTURE.settled_nats and not moved:
            break
    return _at(fitted, covariance, point)


def covariance_of(fitted: StructuralFit, linear: Linear, scales: Array) -> Covariance:
    """The covariance of all rows about a linearised fit; `scales` (G,) are those of the last one."""
    structure = fitted.structure
    assert structure is not None, "a fit without simulated structure has no covariance"
    sd = white_noise(linear.rows, linear.residual)
    varying = varying_columns(fitted, linear)
    return covariance_at(linear, fitted.problem.unknowns, structure.draws, structure.films, varying, sd, scales)


@dataclass(frozen=True)
class Descent:
    """Where Gauss-Newton steps ended, the last normal equations and how far the objective fell, nats."""

    z: Array
    own: list[Array]
    normal: Normal
    value: float
    fall: float


def descended(
    problem: CalibrationProblem, linear: Linear, names: Sequence[str], covariance: Covariance, steps: int
) -> Descent:
    """Down from a linearised point; a step is damped as a whole until the objective falls, no parameter by itself.

    Raises:
        WorkError: the network cannot be simulated where a step leads.
    """
    prior = covariance.prior_of(names)
    low, high = _reach(problem)
    begun = value = objective(linear.residual, linear.z, linear.own, prior, covariance)
    z, own, first = linear.z, linear.own, 0
    normal = _finite(normal_equations(linear, names, covariance))
    for k in range(steps):
        if k:
            linear = Linear.at(problem, z, linear.of_batches(own))
            normal = _finite(normal_equations(linear, names, covariance))
        before = value
        for tried, damping in enumerate(STRUCTURE.dampings[first:], first):
            z1, own1 = normal.step(damping)
            z1 = np.clip(z1, low, high)
            there = _objective(problem, z1, linear.of_batches(own1), prior, covariance)
            if there < value:
                value, z, own, first = there, z1, own1, max(0, tried - 1)
                break
        if value == before or normal.expected_fall < STRUCTURE.settled_nats:
            break
    return Descent(z, linear.of_batches(own), normal, value, begun - value)


def _finite(normal: Normal) -> Normal:
    if not np.isfinite(normal.hessian).all():
        raise WorkError("a derivative is not finite: a share at 0 or 1, or a machine that cannot be simulated")
    return normal


def _reach(problem: CalibrationProblem) -> tuple[Array, Array]:
    """Bounds of z (p,): those of the file, and what no effective value of a lump goes beyond."""
    low, high = z_bounds(problem.unknowns)
    most = STRUCTURE.reach * freedom(problem.unknowns)
    return np.maximum(low, -most), np.minimum(high, most)


def _objective(problem: CalibrationProblem, z: Array, own: list[Array], prior: Array, covariance: Covariance) -> float:
    """Infinite where the network cannot be simulated: too far a step."""
    try:
        residual = np.concatenate(problem.residuals(x_of(problem.unknowns, z), own))
    except (InputError, WorkError):
        return np.inf
    value = objective(residual, z, np.concatenate(own), prior, covariance) if np.isfinite(residual).all() else np.inf
    return value if np.isfinite(value) else np.inf


def _at(fitted: StructuralFit, covariance: Covariance, point: Descent) -> StructuralFit:
    """The fit at a point, with the posterior of its unknowns under the covariance."""
    problem = fitted.problem
    posterior = point.normal.covariance()
    try:
        root = np.linalg.cholesky(np.linalg.inv(posterior)).T
    except np.linalg.LinAlgError as error:
        raise WorkError(f"the posterior of the parameters cannot be inverted ({error})") from None
    left = problem.residuals(x_of(problem.unknowns, point.z), point.own)
    channels = [m.channel for m in problem.measured]
    noise = estimate(left, channels, len(problem.channels), len(point.z) - float(np.trace(posterior)))
    arrow = Arrow(root, np.zeros(len(root)), ())
    state = State(point.z, point.own, point.value, arrow, channels, noise, expected=0.0)
    evidence = -0.5 * point.value - point.normal.log_volume
    return replace(fitted, state=state, covariance=covariance, evidence=evidence)


def refitted(
    old: StructuralFit, part: TwinPart, at: Mapping[str, float] | None = None, steps: int = STRUCTURE.refit_steps
) -> StructuralFit:
    """The same recordings fitted by a changed twin part under the old fit's covariance, starting from that fit.

    `at` gives start values by parameter name; other new parameters start at their value in the part.

    Raises:
        InputError: the part does not compile; WorkError: it cannot be simulated there.
    """
    assert old.covariance is not None
    problem, z, nuisance = carried_start(old, part, at)
    linear = Linear.at(problem, np.clip(z, *_reach(problem)), nuisance)
    point = descended(problem, linear, [u.name for u in problem.unknowns], old.covariance, steps)
    if not np.isfinite(point.value):
        raise WorkError(f"machine {old.machine.machine}: the changed network cannot be simulated")
    return _at(replace(old, part=part, problem=problem), old.covariance, point)


def _spacing_s(batches: Sequence[Batch]) -> float:
    """Seconds between the rows that are fitted; long recordings are thinned."""
    return max(spacing_s(batches), sum(b.step_s * b.n_rows for b in batches) / STRUCTURE.max_rows_per_channel)
