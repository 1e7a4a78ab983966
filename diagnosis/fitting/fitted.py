"""Fits of a twin part under the covariance of its structure: the baseline, refits, predictions of batches left out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from itertools import product

import numpy as np
import pandas as pd

from data.arrays import Array, Mask
from data.batch import Batch
from data.errors import InputError, WorkError
from data.machine import Machine
from diagnosis.contracts import Point
from diagnosis.fitting.batches import coarse, spacing_s
from diagnosis.fitting.carried import carried_nuisances, carried_start, carried_z, on_network
from diagnosis.fitting.covariance import Covariance, Structure, clipped, independent, learned, white_noise
from diagnosis.fitting.fit import Fitted, nuisance_step
from diagnosis.fitting.marginal import Hyper, Marginal
from diagnosis.fitting.signatures import imperfections, rising_films
from diagnosis.fitting.twins import drawn_misfits, runaway
from diagnosis.policy import POLICY
from twin.calibration.estimate import check_batches
from twin.calibration.fit_problem import Block, Noise, Unknown, x_of, z_bounds
from twin.calibration.least_squares import FitOptions, State, annealed, converge, likelier, misfits, noise_left
from twin.calibration.problem import CalibrationProblem
from twin.calibration.recorder import converge_with_lead, first_lead_rows
from twin.compile import compile_network
from twin.schema import TwinPart
from twin.simulation.inputs import acting


def check(machine: Machine, batches: Sequence[Batch]) -> None:
    """Raises InputError: no batches, one of another machine, or the same twice."""
    if not batches:
        raise InputError(f"machine {machine.machine}: no batches to diagnose; give recordings")
    check_batches(machine, batches)


def baseline(
    machine: Machine,
    part: TwinPart,
    batches: Sequence[Batch],
    progress: Callable[[str, int, int], None] | None = None,
    runs: int = 0,
    seed: int = 0,
    lead_rows: float | None = None,
) -> Fitted:
    """The twin part fitted to all batches, under the covariance of what refined twins show.

    All fits are to `coarse` rows, so that their cost does not depend on how often a machine is recorded. Refined twins
    are drawn from the machine file's priors.

    Args:
        runs: the number of runs, where batches are blocks of fewer.
        seed: of the refined twins.
        lead_rows: when drivers changed within a row (`lead_of`); by default it is learned first.

    Raises:
        InputError: batches of another machine, twice the same, or that cannot be simulated.
        WorkError: the model fails at the priors' means, or no refined twin can be simulated.
    """
    check(machine, batches)
    report, runs = progress or (lambda step, n, of: None), runs or len(batches)
    report("baseline", 1, 3)
    at = _calibrated_first(machine, part, batches, lead_rows)
    report("baseline", 2, 3)
    fitted = structured(at, runs, seed=seed, report=report)
    report("baseline", 3, 3)
    return fitted


def lead_of(machine: Machine, part: TwinPart, batches: Sequence[Batch]) -> float:
    """By how many rows a driver's change comes before the row that first shows it: as the machine file states, or as is
    likeliest with a twin part. Effects that the part lacks may make another lead likelier.

    Raises:
        InputError, WorkError: as `baseline`.
    """
    if machine.recording.drivers is not None:
        return first_lead_rows(machine)
    return _calibrated_first(machine, part, batches).lead_rows


def _calibrated_first(
    machine: Machine, part: TwinPart, batches: Sequence[Batch], lead_rows: float | None = None
) -> Point:
    """Where a fit from the values of the machine file on ends, the lead learned unless it is given."""
    network, every_s = compile_network(machine, part=part), spacing_s(batches)
    options, noise = _first_calibration(len(network.readings) + len(network.errors))

    def problem_at(lead: float) -> CalibrationProblem:
        return CalibrationProblem.of(network, coarse(batches, every_s, lead), every_s)

    if lead_rows is None:
        lead_rows, problem, state, _ = converge_with_lead(machine, problem_at, options, noise)
    else:
        problem = problem_at(lead_rows)
        state, _ = converge(problem, options, noise=noise)
    rows = tuple(coarse(batches, every_s, lead_rows))
    return Point(machine, part, rows, problem, state.z, state.nuisance, lead_rows)


def structured(
    at: Point,
    runs: int,
    stated: frozenset[str] | None = None,
    seed: int = 0,
    report: Callable[[str, int, int], None] = lambda *_: None,
) -> Fitted:
    """The fit from a point on under the covariance of what refined twins show.

    Args:
        stated: unknowns that the machine file states, by default all: refined twins have them from their priors, and
            the others, of effects, as they are at the point.

    Raises:
        WorkError: no refined twin can be simulated.
    """
    names = [u.name for u in at.problem.unknowns]
    stated = frozenset(names) if stated is None else stated
    drawn, timing = _drawn(at, np.array([name in stated for name in names]), seed, report)
    structure = Structure(drawn, timing, imperfections(at), white_noise(at.problem), stated)
    return _learned(_begun(at, *_likeliest(at, structure), runs))


def restructured(fitted: Fitted) -> Fitted:
    """The fit under structure that is drawn with all effects that it holds; itself where none can be drawn."""
    structure = fitted.marginal.covariance.structure
    if structure is not None:
        with suppress(WorkError):
            return replace(structured(fitted, fitted.runs, structure.stated), base=fitted.base)
    return fitted


def _first_calibration(channels: int) -> tuple[FitOptions, Noise]:
    """How a fit descends from the values of the machine file: all channels with the same noise, so that none is
    neglected."""
    factor = np.full(channels, POLICY.initial_noise_factor)
    noise = Noise(factor, np.full(channels, POLICY.initial_rows_per_value))
    return FitOptions(max_iterations=POLICY.first_steps, tolerance=POLICY.fit_tolerance_nats), noise


def on_all_rows(fitted: Fitted, batches: Sequence[Batch]) -> Fitted:
    """The deterministic fit to all rows of the recordings; the fit itself where they have no others."""
    if [b.n_rows for b in batches] == [b.n_rows for b in fitted.batches]:
        return fitted
    one, batches = deterministic_fit(fitted), acting(batches, fitted.lead_rows)
    problem = CalibrationProblem.of(one.problem.network, batches, spacing_s(batches))
    at = Point(one.machine, one.part, tuple(batches), problem, one.z, one.nuisance, one.lead_rows)
    return replace(calibrated(at, one.noise, one.runs), base=fitted)


def relearned(fitted: Fitted) -> Fitted:
    """The fit at its optimum under the hyperparameters and channel noise that are likeliest now: those of the fit
    before may have imitated an effect."""
    done = replace(_under_own(fitted, fitted, fitted.hyper), base=fitted.base)
    return done if done.log_evidence > fitted.log_evidence else fitted


def refitted(now: Fitted, part: TwinPart, fresh: bool = False) -> Fitted:
    """The fit of a changed twin part to the same recordings.

    The descent begins at the values of the fit or, with `fresh`, at those of the machine file: the values of a fit that
    lacks an effect imitate it, and a descent from there may not leave them. The two may end at different optima.

    Raises:
        InputError: the part does not compile; WorkError: it cannot be simulated where the descent begins.
    """
    if fresh:
        problem = on_network(now.problem, now.batches, compile_network(now.machine, part=part), free_starts=True)
        options, noise = _first_calibration(len(problem.channels))
        state, _ = converge(problem, options, noise=noise)
        z, nuisance, hyper = state.z, state.nuisance, Hyper(*POLICY.first_hyper)
    else:
        (problem, z, nuisance), hyper = carried_start(now, part), now.hyper
    at = Point(now.machine, part, now.batches, problem, z, nuisance, now.lead_rows)
    return replace(_under_own(now, at, hyper), base=now)


def _under_own(now: Fitted, at: Point, begin: Hyper) -> Fitted:
    """A point at its optimum under the structure of a fit, and hyperparameters and noise of its own."""
    covariance = now.marginal.covariance
    if covariance.structure is None:
        return relinearised(_begun(at, covariance, now.hyper, now.runs))
    begun = _begun(at, covariance.scaled(np.ones(len(at.problem.channels))), begin, now.runs)
    return _learned(replace(begun, hyper=begun.marginal.likeliest(begun.grams, begin)[0]))


def _learned(begun: Fitted) -> Fitted:
    """The fit under the covariance that it begins under. A channel whose residual no draw shows, as where a nut passes
    a sensor, has more noise."""
    fitted, covariance = tuned(_fitted(begun)), begun.marginal.covariance
    for _ in range(POLICY.channel_rounds):
        before = fitted.marginal.covariance.factor
        factor = np.maximum(before * _excess(fitted), 1.0)
        if np.abs(np.log(factor / before)).max() < np.log(POLICY.channel_min_excess):
            break
        fitted = tuned(_fitted(_begun(fitted, covariance.scaled(factor), fitted.hyper, fitted.runs)))
    return fitted


def _drawn(
    at: Point, stated: Mask, seed: int, report: Callable[[str, int, int], None]
) -> tuple[list[Array], list[Array]]:
    """Misfits of refined twins and of times of changes (n_b, draws); unknowns that are `stated` (p,) scatter by their
    priors.

    A fit that lacks an effect imitates it by values that no machine has, and refined twins of such values would be made
    of the effect. What parameters may imitate of a misfit in one linear step is left in: priors and bounds say how far
    they go.
    """
    draws = POLICY.refined_twins
    drawn, timing = drawn_misfits(
        at.machine, at.part, at.batches, at.problem, np.where(stated, 0.0, at.z), stated.astype(float), draws, seed,
        lambda n, of: report("refined twins", n, of),
    )  # fmt: skip
    films = rising_films(at)  # linear about the fit: a film in every twin takes no simulation of its own
    sizes = np.abs(np.random.default_rng(seed).standard_normal((films[0].shape[1], draws)))
    return clipped([d + f @ sizes for d, f in zip(drawn, films, strict=True)]), timing


def _likeliest(at: Point, structure: Structure) -> tuple[Covariance, Hyper]:
    """The covariance and hyperparameters of the largest marginal likelihood, over the shares of the specific components
    and of the times of changes, and the sizes of all that is integrated out."""
    blocks, begin = list(at.problem.linearise(at.x, at.nuisance)), Hyper(*POLICY.first_hyper)
    best, most = None, -np.inf
    for share, timing in product(POLICY.specific_shares, POLICY.timing_shares):
        covariance = learned(at.problem, structure, share, timing)
        marginal = _marginal(covariance, blocks, at)
        hyper, likely = marginal.likeliest(marginal.grams(_columns(marginal, blocks, at)), begin)
        if likely > most:
            best, most = (covariance, hyper), likely
    if best is None:
        raise WorkError(f"machine {at.machine.machine}: the likelihood of its recordings is not finite")
    return best


def _marginal(covariance: Covariance, blocks: Sequence[Block], at: Point) -> Marginal:
    return Marginal(covariance, [b.nuisance for b in blocks], at.nuisance, len(at.problem.nuisances.start_K))


def _excess(fitted: Fitted) -> Array:
    """The sd (C,) of each channel's whitened rows; 1 where it is as it should be."""
    left = fitted.level.leftover(fitted.columns, fitted.z, fitted.grams)
    channels = np.concatenate([m.channel for m in fitted.problem.measured])
    rows = np.bincount(channels, minlength=len(fitted.problem.channels))
    squares = np.bincount(channels, np.concatenate(left) ** 2, minlength=len(rows))
    return np.asarray(np.sqrt(np.where(rows > 0, squares / np.maximum(rows, 1), 1.0)), float)


def _spread(unknowns: Sequence[Unknown]) -> Array:
    return np.array([u.spread for u in unknowns])


def _columns(marginal: Marginal, blocks: Sequence[Block], at: Point) -> list[Array]:
    """Whitened [model, target] (n_b, p + 1) of blocks linearised at a point."""
    spread = _spread(at.problem.unknowns)
    out = []
    for b, (block, offset) in enumerate(zip(blocks, marginal.offset, strict=True)):
        model = block.jacobian * spread
        out.append(marginal.covariance.white(b, np.column_stack([model, block.residual + offset + model @ at.z])))
    return out


def _fitted(begun: Fitted) -> Fitted:
    """The fit at its optimum under its covariance, the batches' nuisances linearised where they are in it."""
    covariance, hyper, runs = begun.marginal.covariance, begun.hyper, begun.runs
    for _ in range(POLICY.nuisance_rounds):
        done = relinearised(begun, POLICY.baseline_steps)
        begun = _begun(replace(done, nuisance=done.fitted_nuisance), covariance, hyper, runs)
    return begun


def _begun(at: Point, covariance: Covariance, hyper: Hyper, runs: int) -> Fitted:
    """A point under a covariance as it is; all that acts linearly is linearised there."""
    blocks = list(at.problem.linearise(at.x, at.nuisance))
    marginal = _marginal(covariance, blocks, at)
    given = {f.name: getattr(at, f.name) for f in fields(Point)}
    return Fitted(**given, marginal=marginal, hyper=hyper, columns=_columns(marginal, blocks, at), runs=runs)


def under(fitted: Fitted, covariance: Covariance) -> Fitted:
    """The fit under another covariance."""
    return _fitted(_begun(fitted, covariance, fitted.hyper, fitted.runs))


def tuned(fitted: Fitted) -> Fitted:
    """The fit under the hyperparameters that are likeliest for it, at its optimum there."""
    for _ in range(POLICY.hyper_rounds):
        hyper, _ = fitted.marginal.likeliest(fitted.grams, fitted.hyper)
        if hyper == fitted.hyper:
            break
        fitted = relinearised(replace(fitted, hyper=hyper))
    return fitted


def relinearised(fitted: Fitted, steps: int = POLICY.fit_steps) -> Fitted:
    """The fit at its optimum: Gauss-Newton with all derivatives taken anew at every step, which is shortened until the
    posterior rises (Levenberg and Marquardt).

    Raises:
        WorkError: not finite at the start.
    """
    problem, marginal, level, z = fitted.problem, fitted.marginal, fitted.level, fitted.z
    (low, high), spread = z_bounds(problem.unknowns), _spread(problem.unknowns)

    def rows(z: Array) -> tuple[list[Array], float]:
        """Whitened residuals at z, and twice the negative log posterior up to a constant."""
        with np.errstate(over="ignore", invalid="ignore"):
            left = problem.residuals(x_of(problem.unknowns, z), fitted.nuisance)
            white = marginal.white([r + offset for r, offset in zip(left, marginal.offset, strict=True)])
            if not all(np.isfinite(r).all() for r in white):
                return white, np.inf
            grams = marginal.grams([r[:, None] for r in white])
            return white, float(level.reduced(grams)[0, 0] + (z @ z))

    def at(z: Array, left: Sequence[Array]) -> Fitted:
        blocks = problem.linearise(x_of(problem.unknowns, z), fitted.nuisance)
        model = marginal.white([block.jacobian * spread for block in blocks])
        columns = [np.column_stack([m, r + m @ z]) for m, r in zip(model, left, strict=True)]
        return replace(fitted, z=z, columns=columns)

    left, cost = rows(z)
    if not np.isfinite(cost):
        raise WorkError(f"machine {fitted.machine.machine}: the twin cannot be simulated where a fit begins")
    here, damping = at(z, left), 0.0
    for _ in range(steps):
        c = level.reduced(here.grams)
        normal = c[:-1, :-1] + np.eye(len(z))
        slope = c[:-1, -1] - normal @ z
        for _ in range(POLICY.damping_tries):
            moved = np.clip(z + np.linalg.solve(normal + damping * np.diag(np.diag(normal)), slope), low, high)
            try:
                left, then = rows(moved)
            except (InputError, WorkError):
                then = np.inf  # too long a step: values that no machine has
            if np.isfinite(then) and then < cost:
                break
            damping = max(POLICY.damping_factor * damping, POLICY.damping_start)
        else:
            return here
        fallen, z, cost, damping = cost - then, moved, then, damping / POLICY.damping_factor**2
        here = at(z, left)
        if fallen < 2.0 * POLICY.negligible_nats:
            return here
    return here


RMS_COLUMNS = ("batch", "channel", "unit", "rows", "rms")


@dataclass(frozen=True)
class LeftOutRows:
    """Measured less predicted (n_b,) of every batch in the channels' units, and the rms by batch and channel."""

    error: list[Array]
    rms: pd.DataFrame


@lru_cache(maxsize=4)  # a fit holds some 100 MB
def deterministic_fit(fitted: Fitted) -> Fitted:
    """The same twin part calibrated without structure: the misfit of each channel is its noise, and correlated rows
    count as one (`twin.calibration`). What a machine file states is simulated without structure.

    Under structure a fit can end where no simulation without it is good. Where a misfit is taken for noise, the optimum
    of the higher posterior is returned, from here and from the deterministic fit of `base`, or the priors' means.
    """
    problem, tolerance = fitted.problem, POLICY.fit_tolerance_nats
    state = State.at(problem, fitted.z, fitted.fitted_nuisance, fitted.noise)
    state = annealed(problem, state, POLICY.deterministic_steps, tolerance)
    if misfits(noise_left(problem, state)):
        with suppress(WorkError, InputError):  # values that no machine has
            state = likelier(problem, state, _elsewhere(fitted))
    at = Point(fitted.machine, fitted.part, fitted.batches, problem, state.z, state.nuisance, fitted.lead_rows)
    return calibrated(at, state.noise, fitted.runs)


def _elsewhere(fitted: Fitted) -> State:
    """An optimum without structure that does not begin at the fit."""
    problem, base, tolerance = fitted.problem, fitted.base, POLICY.fit_tolerance_nats
    if base is None:
        options = FitOptions(max_iterations=POLICY.deterministic_steps, tolerance=tolerance, reweight=True)
        return converge(problem, options)[0]
    one = deterministic_fit(base)
    z = carried_z(one.problem, problem, one.z, fitted.z)
    state = State.at(problem, z, carried_nuisances(one.problem, problem, one.nuisance), one.noise)
    return annealed(problem, state, POLICY.deterministic_steps, tolerance)


def calibrated(at: Point, noise: Noise, runs: int = 0) -> Fitted:
    """A calibrated point as a fit of independent rows."""
    return _begun(at, independent(at.problem, 1.0 / np.sqrt(noise.weight)), Hyper(), runs)


@lru_cache(maxsize=4)  # a fit holds some 100 MB
def left_out_rows(fitted: Fitted) -> LeftOutRows:
    """Every batch predicted, free-running, by the `deterministic_fit` to all others; its starts and zeros are its
    own."""
    return _left_out(deterministic_fit(fitted))


def _left_out(one: Fitted) -> LeftOutRows:
    low, high = z_bounds(one.problem.unknowns)
    residuals = [
        _predicted(one, k, block, np.clip(one.level.optimum(one.grams, k), low, high))
        for k, block in enumerate(list(one.problem.linearise(one.x, one.nuisance)))
    ]
    return _rows_left(one.problem, residuals)


def _predicted(one: Fitted, k: int, block: Block, z: Array) -> Array:
    """Residual (n_b,) of a batch at the values that the others give it. These follow from one linear step, which is
    shortened where a machine of such values runs away.

    Raises:
        InputError: none of these can be simulated.
    """
    problem, white = one.problem, one.marginal.covariance.white
    step, most = _spread(problem.unknowns) * (z - one.z), runaway(problem)
    residual, refused = None, InputError("")
    for share in POLICY.left_out_shares:
        target = white(k, block.residual - block.jacobian @ (share * step))
        nuisance = one.nuisance[k] + nuisance_step(white(k, block.nuisance), one.nuisance[k], target)
        try:
            residual = _alone(problem, k, one.z + share * (z - one.z), nuisance)
        except InputError as error:
            refused = error
            continue
        if np.abs(residual).max() <= most:
            break
    if residual is None:
        raise refused
    return residual


def _alone(problem: CalibrationProblem, k: int, z: Array, nuisance: Array) -> Array:
    return problem.only([k]).residuals(x_of(problem.unknowns, z), [nuisance])[0]


def rows_as_given(fitted: Fitted) -> LeftOutRows:
    """Every batch predicted by the machine file's own values; only its starts and zeros are fitted."""
    problem = fitted.problem
    z = np.zeros(len(problem.unknowns))
    nuisance = [np.zeros_like(v) for v in fitted.nuisance]
    for _ in range(2):  # starts enter the temperatures linearly, through laws nearly so
        blocks = problem.linearise(x_of(problem.unknowns, z), nuisance)
        nuisance = [v + nuisance_step(b.nuisance, v, b.residual) for b, v in zip(blocks, nuisance, strict=True)]
    return _rows_left(problem, [_alone(problem, k, z, v) for k, v in enumerate(nuisance)])


def degraded_channels(before: LeftOutRows, after: LeftOutRows) -> dict[str, tuple[float, float]]:
    """Channels whose left-out rms rises, with the mean over runs before and after in the channel's unit.

    A rise counts that is larger than its standard error over runs, each run a sample of its own. So small a rise as
    that may come from other runs.
    """
    old, new = (r.rms.pivot(index="batch", columns="channel", values="rms") for r in (before, after))
    rise, n = new.mean() - old.mean(), len(old)
    se = np.sqrt((old.var(ddof=min(1, n - 1)) + new.var(ddof=min(1, n - 1))) / n)
    return {str(c): (float(old[c].mean()), float(new[c].mean())) for c in rise.index[rise > se]}


def harms(before: LeftOutRows, after: LeftOutRows) -> bool:
    """Whether left-out runs are predicted worse after, by more than the standard error over runs of the difference: the
    logarithm of the rms, mean over channels, each run paired with itself."""
    old, new = (np.log(r.rms.pivot(index="batch", columns="channel", values="rms")) for r in (before, after))
    rise = (new - old).mean(axis=1)
    return bool(rise.mean() > rise.std(ddof=min(1, len(rise) - 1)) / np.sqrt(len(rise)))


def _rows_left(problem: CalibrationProblem, residuals: Sequence[Array]) -> LeftOutRows:
    """The errors of each batch in the channels' units, and their rms, from its whitened residuals."""
    errors = []
    table = []
    for k, residual in enumerate(residuals):
        m = problem.measured[k]
        errors.append(residual * problem.noise[m.channel])
        for c in m.usable.tolist():
            at = m.channel == c
            rms = float(np.sqrt(np.mean(errors[-1][at] ** 2)))
            table.append((m.batch_id, problem.channels[c], problem.units[c], int(at.sum()), rms))
    return LeftOutRows(errors, pd.DataFrame(table, columns=list(RMS_COLUMNS)))
