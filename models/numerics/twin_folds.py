"""Calibrations of many training sets of one machine's batches, with shared work, and runs of calibrated twins.

The first training set is found by Gauss–Newton steps from the machine file's values. Others begin where a larger
set ended and reuse its derivatives: the misfit is simulated anew at every step, derivatives only after a long way,
so that where a fit begins does not matter for where it ends.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from threading import RLock

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from data.arrays import Array
from data.batch import Batch
from data.errors import InputError, WorkError
from data.machine import Machine
from features.rises import hold_last
from twin.calibration.arrow import Arrow, assemble
from twin.calibration.fit_problem import Block, Noise, estimate, x_of, z_bounds
from twin.calibration.least_squares import State, descend
from twin.calibration.problem import CalibrationProblem, Nuisances, measured
from twin.compile import compile_network
from twin.network import Network
from twin.simulation import choose_substeps, simulate
from twin.simulation.inputs import Inputs, inputs_of
from twin.simulation.start import start_of

SUBSTEPS_K = 0.03  # what the time step may cost; a third of a common sensor's last digit
FAR = 16.0  # squared way, in posterior standard deviations, beyond which derivatives are taken anew
NEAR = 0.1  # the same, beyond which derivatives are taken anew where a step brings less than they promise
CLOSE = 1e-2  # expected gain in cost below which a fit has arrived: a step of a tenth of a posterior standard deviation
CONVERGED = 1e-2  # relative change of the channels' weights
ROUNDS = 60
_SHARES = (1.0, 0.5, 0.2, 0.05)
_KEPT = 0.25  # of the gain that a step promises
_PATIENCE = 6  # rounds in which the noise follows the residuals at once
_ROUNDING = 1e-3  # of a cost, from the iterations within a simulation
_TOGETHER = 4


@dataclass(frozen=True)
class Calibrated:
    """Calibration of one training set: parameter values (n,), and the starts relative to the steady state.

    `start_K` (N,) is their mean deviation, shrunk towards 0 as by one batch that had none, `start_cov_K2` (N, N) the
    scatter of a batch's own about it. `left_out` gives, by training batch, the values and the start of the others.
    """

    values: Array
    start_K: Array
    start_cov_K2: Array
    left_out: dict[int, tuple[Array, Array]]
    message: str


class _InParts(CalibrationProblem):
    """The same problem, a few batches linearised at once: their arrays stay in the cache."""

    def linearise(self, x: Array, nuisance: Sequence[Array]) -> Iterator[Block]:
        for first in range(0, len(nuisance), _TOGETHER):
            part = list(range(first, min(first + _TOGETHER, len(nuisance))))
            yield from CalibrationProblem.linearise(self.only(part), x, [nuisance[b] for b in part])


@dataclass(frozen=True)
class _Point:
    """A fit on its way: its batches (by their number in the problem), where it is, derivatives and where from."""

    at: list[int]
    z: Array
    nuisance: list[Array]
    blocks: list[Block]
    taken_at: Array


class Calibrations:
    """The batches of one machine, ready to be calibrated in any combination; results are kept.

    Raises:
        InputError: no twin part, or nothing in it is free.
    """

    def __init__(self, machine: Machine, batches: Sequence[Batch], every_s: float, channels: tuple[str, ...]) -> None:
        self.network = compile_network(machine)
        if not len(self.network.free):
            raise InputError(f"machine {machine.machine}: no parameter of the twin is free; give one a prior spread")
        self.batches = tuple(batches)
        self._coarse = [_thinned(b, every_s) for b in batches]
        self.refused = _refused(self.network, self._coarse, every_s, channels)
        self._options = every_s, channels
        self._done: dict[tuple[int, ...], Calibrated] = {}
        self._ends: dict[tuple[int, ...], _Point] = {}
        self._left_out: dict[tuple[tuple[int, ...], bool], dict[int, tuple[Array, Array]]] = {}
        self._lock = RLock()

    @cached_property
    def used(self) -> dict[int, int]:
        """Batch number -> its number within the problem, of those that can be simulated."""
        return {k: i for i, k in enumerate(k for k in range(len(self.batches)) if k not in self.refused)}

    @cached_property
    def problem(self) -> CalibrationProblem:
        kept = [self._coarse[k] for k in self.used]
        inputs = _fine_enough(self.network, kept)
        start = start_of(self.network, self.network.values, inputs)
        seen = tuple(measured(self.network, kept, self._options[0], self._options[1] or None))
        return _InParts(self.network, inputs, seen, start, Nuisances.of(self.network))

    @cached_property
    def _inputs(self) -> Inputs:
        """What drives the same batches at all their rows."""
        return _fine_enough(self.network, [self.batches[k] for k in self.used])

    def thinned(self, k: int) -> tuple[Batch, Inputs]:
        """Batch k on the rows that are calibrated on, and what drives it there."""
        return self._coarse[k], self.problem.inputs.batch([self.used[k]])

    def of(self, train: Sequence[int], near: Sequence[int] | None = None) -> Calibrated:
        """Calibrated on the batches `train`, the work begun where the fit on `near`, a larger set, has ended.

        Raises:
            InputError: no batch of `train` can be simulated, or the rows are fewer than the free parameters.
            WorkError: the fit fails.
        """
        key = tuple(sorted(set(train)))
        with self._lock, threadpool_limits(limits=1):  # results must not depend on them
            if key not in self._done:
                if not any(k in self.used for k in key):
                    raise InputError(self.refused[key[0]])
                begin = None if near is None else self._end(tuple(sorted(set(near))))
                self._done[key], _ = self._calibrated(key, begin)
            return self._done[key]

    def left_out(self, train: Sequence[int], usual: bool) -> dict[int, tuple[Array, Array]]:
        """By training batch, errors (K, n_errors) and readings (K, n_sensors) that a twin without it predicts.

        Free-running; with `usual`, from the others' mean deviation from the steady state. Only of what `of` has done.
        """
        key = tuple(sorted(set(train)))
        with self._lock, threadpool_limits(limits=1):
            if (key, usual) not in self._left_out:
                out = {}
                for k, (values, start_K) in self._done[key].left_out.items():
                    inputs = self._inputs.batch([self.used[k]])
                    start = start_of(self.network, values, inputs, steady=True) + (start_K if usual else 0.0)
                    done = simulate(self.network, values, inputs, start[None])
                    n = self.batches[k].n_rows
                    out[k] = done.errors[0, 0, :n], done.readings[0, 0, :n]
                self._left_out[key, usual] = out
            return self._left_out[key, usual]

    def _end(self, key: tuple[int, ...]) -> _Point:
        if key not in self._ends:
            self._done[key], self._ends[key] = self._calibrated(key, None)
        return self._ends[key]

    def _calibrated(self, key: tuple[int, ...], begin: _Point | None) -> tuple[Calibrated, _Point]:
        kept = [k for k in key if k in self.used]
        at = [self.used[k] for k in kept]
        problem = self.problem.only(at)
        if begin is None:  # at the machine file's values, with starts from the first readings
            z, nuisance = np.zeros(len(problem.unknowns)), [np.zeros(q) for q in problem.nuisance_sizes]
            point = _Point(at, z, nuisance, _linearised(problem, z, nuisance), z)
        else:
            place = [begin.at.index(i) for i in at]
            nuisance, blocks = [begin.nuisance[k] for k in place], [begin.blocks[k] for k in place]
            point = _Point(at, begin.z, nuisance, blocks, begin.taken_at)
        point, noise, message = _arrived(problem, point)
        values = problem.values_at(x_of(problem.unknowns, point.z))
        own = _own_starts_K(problem, values, point.nuisance)
        typical, scatter = _typical(self.network, own)
        left_out = {
            k: (problem.values_at(x_of(problem.unknowns, z)), _typical(self.network, np.delete(own, i, axis=0))[0])
            for i, (k, z) in enumerate(zip(kept, _without_each(problem, point, noise), strict=True))
        }
        return Calibrated(values, typical, scatter, left_out, message), point


def _thinned(batch: Batch, every_s: float) -> Batch:
    """The batch on rows `every_s` apart, or its own where they are farther apart; drivers are means until the next."""
    stride = round(every_s / batch.step_s) if batch.step_s else 1
    if stride < 2 or batch.n_rows <= stride:
        return batch
    table = batch.table.iloc[::stride].reset_index(drop=True)
    for name in set(batch.names("driver")) & set(table.columns):
        held = hold_last(batch.masked(name))
        ends = np.full(-len(held) % stride, held[-1])
        table[name] = np.concatenate([held, ends]).reshape(-1, stride).mean(axis=1)
    return replace(batch, table=table)


def _fine_enough(network: Network, batches: Sequence[Batch]) -> Inputs:
    inputs = inputs_of(network, batches)
    start = start_of(network, network.values, inputs)
    return inputs.refined(choose_substeps(network, network.values, inputs, start[None], SUBSTEPS_K))


def _refused(network: Network, batches: Sequence[Batch], every_s: float, channels: tuple[str, ...]) -> dict[int, str]:
    """Batches that no calibration can use, and why."""
    out = {}
    for k, batch in enumerate(batches):
        try:
            inputs_of(network, [batch])
            measured(network, [batch], every_s, channels or None)
        except InputError as error:
            out[k] = str(error)
    return out


def _linearised(problem: CalibrationProblem, z: Array, nuisance: list[Array]) -> list[Block]:
    return list(problem.linearise(x_of(problem.unknowns, z), nuisance))


def _arrived(problem: CalibrationProblem, point: _Point) -> tuple[_Point, Noise, str]:
    """The optimum under noise that follows from its own residuals."""
    low, high = z_bounds(problem.unknowns)
    channels = [b.channel for b in point.blocks]
    residuals = problem.residuals(x_of(problem.unknowns, point.z), point.nuisance)
    noise, determined, stalled = Noise.as_given(len(problem.channels)), float(len(point.z)), False
    for number in range(1, ROUNDS + 1):
        before, noise = noise, estimate(residuals, channels, len(problem.channels), determined)
        noise = _towards(before, noise, min(1.0, _PATIENCE / number))
        blocks = [replace(b, residual=r) for b, r in zip(point.blocks, residuals, strict=True)]
        arrow = assemble(blocks, point.nuisance, point.z, problem.unknowns, noise.weight)
        determined = arrow.effective_parameters()
        dz = arrow.step(0.0, low - point.z, high - point.z)
        gain, cost = arrow.gain(dz), _cost(point.z, point.nuisance, residuals, blocks, noise)
        way = float(np.sum((arrow.root @ (point.z - point.taken_at)) ** 2))
        small = gain <= CLOSE
        if small and noise.change(before) < CONVERGED and way <= FAR:
            return replace(point, blocks=blocks), noise, f"arrived after {number} rounds"
        due = (way > FAR and (small or number % 3 == 0)) or (stalled and way > NEAR and not small)
        moved = None if due else _step(problem, point, arrow, dz, blocks, noise, cost)
        if moved is None and (due or way > 0):
            point = replace(point, blocks=_linearised(problem, point.z, point.nuisance), taken_at=point.z)
            stalled = False
            continue
        if moved is None:
            state = descend(problem, State.at(problem, point.z, point.nuisance, noise), ROUNDS, CLOSE)
            fresh = _linearised(problem, state.z, state.nuisance)
            moved = state.z, state.nuisance, [b.residual for b in fresh]
            point = replace(point, blocks=fresh, taken_at=state.z)
        z, nuisance, residuals = moved
        stalled = cost - _cost(z, nuisance, residuals, blocks, noise) < _KEPT * gain
        point = replace(point, z=z, nuisance=nuisance)
    return replace(point, blocks=blocks), noise, f"still moving after {ROUNDS} rounds"


def _towards(before: Noise, after: Noise, share: float) -> Noise:
    """Some of the way: how many rows count as one is no smooth function of the residuals; fits could go in circles."""
    factor = before.factor ** (1 - share) * after.factor**share
    return Noise(factor, before.inflation ** (1 - share) * after.inflation**share)


def _step(
    problem: CalibrationProblem, point: _Point, arrow: Arrow, dz: Array, blocks: list[Block], noise: Noise, cost: float
) -> tuple[Array, list[Array], list[Array]] | None:
    """Parameters, nuisances and residuals after the longest of some shares of a step that costs no more; or None."""
    for share in _SHARES:
        z = point.z + share * dz
        nuisance = [v + share * c.step(dz) for v, c in zip(point.nuisance, arrow.corners, strict=True)]
        try:
            residuals = problem.residuals(x_of(problem.unknowns, z), nuisance)
        except (InputError, WorkError):
            continue
        if _cost(z, nuisance, residuals, blocks, noise) <= cost + _ROUNDING:
            return z, nuisance, residuals
    return None


def _cost(z: Array, nuisance: list[Array], residuals: list[Array], blocks: list[Block], noise: Noise) -> float:
    rows = sum(float(noise.weight[b.channel] @ r**2) for b, r in zip(blocks, residuals, strict=True))
    return float(z @ z) + sum(float(v @ v) for v in nuisance) + rows


def _without_each(problem: CalibrationProblem, point: _Point, noise: Noise) -> list[Array]:
    """The point of the fit without each batch, in turn: the linearised cost less the batch's own part."""
    low, high = z_bounds(problem.unknowns)
    arrows: list[Arrow] = [
        assemble([b], [v], point.z, problem.unknowns, noise.weight)
        for b, v in zip(point.blocks, point.nuisance, strict=True)
    ]
    information = [a.information for a in arrows]
    pull = [a.root.T @ a.target + point.z for a in arrows]
    whole, all_pull = sum(information) + np.eye(len(point.z)), sum(pull) - point.z
    out = []
    for m, g in zip(information, pull, strict=True):
        dz = np.linalg.solve(whole - m, all_pull - g) if len(arrows) > 1 else -point.z
        out.append(np.clip(point.z + dz, low, high))
    return out


def _own_starts_K(problem: CalibrationProblem, values: Array, nuisance: list[Array]) -> Array:
    """How each batch's start (B, N) deviates from the steady state with its surroundings."""
    bodies = len(problem.nuisances.start_K)
    own = np.array([v[:bodies] for v in nuisance]).reshape(len(nuisance), bodies)
    start = problem.start_degC + own @ problem.nuisances.start_K
    return np.asarray(start - start_of(problem.network, values, problem.inputs, steady=True))


def _typical(network: Network, own_K: Array) -> tuple[Array, Array]:
    """Mean start (N,) of the batches and the scatter (N, N) about it; the file's spread counts as one batch more."""
    n = len(own_K)
    mean = own_K.sum(axis=0) / (n + 1)
    given = np.zeros((network.n_cells, network.n_cells))
    for cells in network.bodies.values():
        given[np.ix_(cells, cells)] = network.start_spread_K**2
    away = own_K - mean
    return mean, (away.T @ away + given) / (n + 1)


_REMEMBERED = 8  # simulations, which the cells of all selectors and error channels share


@dataclass(frozen=True)
class TwinRun:
    """Batches that can be simulated, numbered `used` among all `batches`; holes in what drives them are bridged."""

    network: Network
    batches: tuple[Batch, ...]
    used: NDArray[np.int64]
    inputs: Inputs | None
    _done: dict[bytes, tuple[Array, Array]] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, network: Network, batches: Sequence[Batch]) -> TwinRun:
        """A batch without a driver or a surrounding that the network needs cannot be simulated."""
        used = np.array([k for k, b in enumerate(batches) if _runs(network, b)], np.int64)
        if not len(used):
            return cls(network, tuple(batches), used, None)
        inputs = inputs_of(network, [batches[k] for k in used], max_gap_s=math.inf)
        substeps = choose_substeps(network, network.values, inputs, "settled", SUBSTEPS_K)
        return cls(network, tuple(batches), used, inputs.refined(substeps))

    def only(self, numbers: Sequence[int]) -> TwinRun:
        """Some of the batches."""
        place = {int(k): i for i, k in enumerate(self.used)}
        used = np.array([i for i, k in enumerate(numbers) if k in place], np.int64)
        inputs = self.inputs.batch([place[numbers[i]] for i in used]) if self.inputs is not None and len(used) else None
        return TwinRun(self.network, tuple(self.batches[k] for k in numbers), used, inputs)

    def start_degC(self, values: Array, start_K: Array) -> Array:
        """Start (…, used batches, N) of parameter sets (…, n_parameters): steady, and the usual deviation (…, N)."""
        assert self.inputs is not None
        return np.asarray(start_of(self.network, values, self.inputs, steady=True) + start_K[..., None, :])

    def by_batch(self, series: Array | None) -> list[Array]:
        """A series (used batches, K) as one array (n_k,) per batch, NaN for one that cannot be simulated."""
        out = [np.full(b.n_rows, np.nan) for b in self.batches]
        for i, k in enumerate(self.used):
            assert series is not None
            out[k] = series[i, : len(out[k])]
        return out

    def rows(self, values: Array, start_K: Array, error: int) -> tuple[Array, Array]:
        """One error (F, n) and the readings (F, n, sensors) at all rows, batch after batch, of F parameter sets.

        values (F, n_parameters); start_K (F, N): by how much batches start above the steady state with the first
        values of their surroundings. NaN in a batch that cannot be simulated.
        """
        key = values.tobytes() + start_K.tobytes()
        if key not in self._done:
            if len(self._done) >= _REMEMBERED:
                self._done.pop(next(iter(self._done)))
            self._done[key] = self._simulated(values, start_K)
        errors, readings = self._done[key]
        return errors[..., error], readings

    def _simulated(self, values: Array, start_K: Array) -> tuple[Array, Array]:
        n_sets, borders = len(values), np.cumsum([0, *(b.n_rows for b in self.batches)])
        errors = np.full((n_sets, borders[-1], len(self.network.errors)), np.nan)
        readings = np.full((n_sets, borders[-1], len(self.network.readings)), np.nan)
        if self.inputs is not None:
            done = simulate(self.network, values, self.inputs, self.start_degC(values, start_K))
            for i, k in enumerate(self.used):
                rows, n = slice(borders[k], borders[k + 1]), self.batches[k].n_rows
                errors[:, rows] = done.errors[:, i, :n]
                readings[:, rows] = done.readings[:, i, :n]
        return errors, readings


def _runs(network: Network, batch: Batch) -> bool:
    try:
        inputs_of(network, [batch], max_gap_s=math.inf)
    except InputError:
        return False
    return True
