"""What alternative explanations predict of runs that nobody has done yet, and how much better the true one fits them.

T-optimality (Atkinson and Fedorov 1975, Biometrika 62, 57): data of one alternative, and the least squares that another
reaches after it has moved its parameters within what the recordings allow, and the run's own start and offsets.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve

from data.arrays import Array
from diagnosis.fitting.fit import Fitted
from diagnosis.next_experiment.menu import Run
from diagnosis.policy import POLICY
from twin.calibration.fit_problem import Block
from twin.calibration.problem import CalibrationProblem, Measured, Nuisances
from twin.network import Network, Reading
from twin.simulation import simulate
from twin.simulation.coupling import Trajectory
from twin.simulation.inputs import Inputs, inputs_of_plan
from twin.simulation.start import start_of

EXTRA_SENSOR = "one more sensor at "  # the channel of a sensor that is not there yet


@dataclass(frozen=True)
class Foreseen:
    """How well R runs separate A alternatives: nats (A, A, R) by which the log likelihood of data of the first drops
    when the second explains them, both refitted; `with_sensor` (A, A, R, E) with one more sensor at a body of `places`.
    """

    nats: Array
    with_sensor: Array
    places: tuple[str, ...]


def foreseen(alternatives: Sequence[Fitted], runs: Sequence[Run]) -> Foreseen:
    """All ordered pairs of alternatives in all runs; every alternative is linearised once.

    What the true alternative itself misses, since a hot machine's inner temperatures are not known at the start, counts
    as noise.

    Raises:
        ValueError: alternatives that show different channels.
        InputError, WorkError: a run that cannot be simulated.
    """
    channels = alternatives[0].problem.channels
    if any(f.problem.channels != channels for f in alternatives):
        raise ValueError("alternatives of a next experiment must show the same channels")
    places = _unsensed(alternatives)
    weight, count = _worst(alternatives, len(places))
    models = [AlternativeModel.of(f, runs, places) for f in alternatives]
    squares = np.zeros((len(models), len(models), len(runs), 1 + len(places)))
    for b, model in enumerate(models):
        predicted = [model.predicted(m.first) if m is not model else model.expected for m in models]
        for r, block in enumerate(model.blocks):
            difference = np.column_stack([f[r] - m.shown[r] for f, m in zip(predicted, models, strict=True)])
            squares[:, b, r] = model.least_squares(block, difference, weight, len(places)).T
    own = np.einsum("aare->are", squares)[:, None]
    rows = np.array([run.rows * count for run in runs])[:, None]
    nats = np.maximum(0.5 * (squares - own) / (1.0 + own / np.maximum(rows, 1.0)), 0.0)
    return Foreseen(nats[..., 0], nats[..., 1:], places)


@dataclass(frozen=True)
class AlternativeModel:
    """One alternative on R runs, as a problem in which all measurements are 0: a residual is minus the prediction, in
    units of the given noise. `problem` begins every run in the state that it predicts.
    """

    fitted: Fitted
    problem: CalibrationProblem

    @classmethod
    def of(cls, fitted: Fitted, runs: Sequence[Run], places: Sequence[str]) -> AlternativeModel:
        network = _with_sensors(fitted.problem.network, places)
        finer = int(
            np.clip(round(runs[0].row_s / float(fitted.problem.inputs.dt_s[0, 0])), 1, POLICY.prediction_max_refinement)
        )
        inputs = _side_by_side(fitted, runs).refined(finer)
        state = _before(fitted, runs, finer)
        return cls(
            fitted, CalibrationProblem(network, inputs, _rows(network, runs), state, Nuisances.of(network))
        )  # fmt: skip

    @cached_property
    def shown(self) -> list[Array]:
        """Minus what the machine shows, (n_r,) of every run, if this alternative is true."""
        return self.problem.residuals(self.fitted.x, self._none)

    @cached_property
    def first(self) -> dict[str, Array]:
        """What its sensors show first, (R,) by channel."""
        out = {}
        for c, reading in enumerate(self.fitted.problem.network.readings):
            rows = [int(np.argmax(m.channel == c)) for m in self.problem.measured]
            out[reading.channel] = -reading.noise * np.array([s[k] for s, k in zip(self.shown, rows, strict=True)])
        return out

    @cached_property
    def blocks(self) -> list[Block]:
        """Every run linearised where this alternative expects it."""
        return list(self._started(self.first).linearise(self.fitted.x, self._none))

    @property
    def expected(self) -> list[Array]:
        """`predicted` from its own first readings: by run the rows (n,), in given noises."""
        return [block.residual for block in self.blocks]

    def predicted(self, first: Mapping[str, Array]) -> list[Array]:
        """Minus what this alternative expects, (n_r,) of every run, given the first readings (R,) by channel."""
        return self._started(first).residuals(self.fitted.x, self._none)

    def least_squares(self, block: Block, difference: Array, weight: Array, places: int) -> Array:
        """What is left (1 + E, A) of A data sets (n, A), without and with each of the E sensors that come last.

        The prior is the posterior of the recordings for the parameters and N(0, 1) for the run's own unknowns.
        """
        spread = np.array([u.spread for u in self.problem.unknowns])
        scale = np.sqrt(weight[block.channel])[:, None]
        known = scale * np.column_stack([block.nuisance, block.jacobian * spread])
        difference = scale * difference
        root = self.fitted.state.arrow.root
        prior = block_diag(np.eye(block.nuisance.shape[1]), root.T @ root)
        sensors = len(self.problem.network.readings)
        extra = [block.channel == c for c in range(sensors - places, sensors)]
        there = ~np.any(extra, axis=0) if extra else np.ones(len(difference), bool)
        gram, cross, square = _sums(known[there], difference[there])
        out = [_left(gram + prior, cross, square)]
        for rows in extra:
            offset = POLICY.extra_sensor_offset_sd_K / self.problem.noise[block.channel[rows][0]] * scale[rows]
            more = _sums(with_free_offset(known[rows], offset), with_free_offset(difference[rows], offset))
            out.append(_left(gram + more[0] + prior, cross + more[1], square + more[2]))
        return np.array(out)

    @cached_property
    def _none(self) -> list[Array]:
        return [np.zeros(q) for q in self.problem.nuisance_sizes]

    def _started(self, first: Mapping[str, Array]) -> CalibrationProblem:
        """The runs begun from first readings, as a calibration begins them."""
        inputs = replace(self.problem.inputs, first={**self.problem.inputs.first, **first})
        start = start_of(self.problem.network, self.fitted.values, inputs)
        return replace(self.problem, inputs=inputs, start_degC=start, _last={}, _trajectory=Trajectory())


def begun(fitted: Fitted, run: Run) -> dict[str, float]:
    """Temperatures of the bodies, degC, in which a run finds the machine if this fit is true."""
    state = _before(fitted, [run], 1)[0]
    return {name: float(state[cells].mean()) for name, cells in fitted.problem.network.bodies.items()}


def _before(fitted: Fitted, runs: Sequence[Run], finer: int) -> Array:
    """The state (R, N) in which every run finds the machine; runs with the same preparation share one simulation."""
    different: list[Run] = []
    at = []
    for run in runs:
        same = [k for k, p in enumerate(different) if p.stages == run.before and p.begins == run.begins]
        at += same[:1] or [len(different)]
        different += [] if same else [run.preparation]
    inputs = _side_by_side(fitted, different).refined(finer)
    network = fitted.problem.network
    start = start_of(network, fitted.values, inputs, steady=True)
    cells = simulate(network, fitted.values, inputs, start[None], keep_cells=True).cells_degC
    assert cells is not None
    last = inputs.n_intervals // inputs.every
    return np.asarray(cells[0, np.arange(len(last)), last][at])


def _side_by_side(fitted: Fitted, runs: Sequence[Run]) -> Inputs:
    """All runs as batches on one grid, the shorter ones held at their end."""
    each = [inputs_of_plan(fitted.problem.network, r.plan(fitted.machine), r.clock_h) for r in runs]
    longest = max(int(i.n_intervals[0]) for i in each)

    def padded(rows: list[Array], size: int) -> Array:
        return np.stack([np.pad(v, (0, size - len(v)), mode="edge") for v in rows])

    return Inputs(
        batch_ids=tuple(r.label for r in runs),
        time_s=np.repeat(runs[0].row_s * np.arange(longest + 1.0)[None], len(runs), axis=0),
        n_intervals=np.concatenate([i.n_intervals for i in each]),
        drivers={n: padded([i.drivers[n][0] for i in each], longest) for n in each[0].drivers},
        recorded={n: padded([i.recorded[n][0] for i in each], longest + 1) for n in each[0].recorded},
        clock_h=np.concatenate([i.clock_h for i in each]),
        first={n: np.concatenate([i.first[n] for i in each]) for n in each[0].first},
    )


def _rows(network: Network, runs: Sequence[Run]) -> tuple[Measured, ...]:
    """Every channel at every row; errors count from the first."""
    sensors, errors = len(network.readings), len(network.errors)
    is_error = np.arange(sensors + errors) >= sensors
    out = []
    for run in runs:
        row = [np.arange(int(e), run.rows + 1) for e in is_error]
        channel = np.repeat(np.arange(len(is_error)), [len(r) for r in row])
        nothing = np.zeros(len(channel)), np.zeros(len(is_error), np.int64)
        out.append(Measured(run.label, np.concatenate(row), channel, *nothing, is_error))
    return tuple(out)


def _unsensed(alternatives: Sequence[Fitted]) -> tuple[str, ...]:
    """Bodies of all alternatives on which no sensor sits."""
    network = alternatives[0].problem.network
    seen = np.sum([r.cells for r in network.readings], axis=0) if network.readings else np.zeros(network.n_cells)
    bare = [name for name, cells in network.bodies.items() if not np.any(seen[cells])]
    return tuple(name for name in bare if all(name in f.problem.network.bodies for f in alternatives))


def _with_sensors(network: Network, places: Sequence[str]) -> Network:
    """The network with a sensor on each of these bodies, after those that it has."""
    noise = float(np.median([r.noise for r in network.readings])) if network.readings else POLICY.extra_sensor_noise_K
    extra = []
    for place in places:
        cells = np.zeros(network.n_cells)
        cells[network.bodies[place]] = 1.0 / len(network.bodies[place])
        extra.append(Reading(EXTRA_SENSOR + place, cells, (), noise))
    return replace(network, readings=(*network.readings, *extra))


def _worst(alternatives: Sequence[Fitted], places: int) -> tuple[Array, float]:
    """The weight of a row of each channel by the alternative that knows it worst, and how many independent values a row
    of all channels holds; 0 where nothing was recorded. New sensors are as good as the usual one."""
    noises = [f.noise for f in alternatives]
    recorded = alternatives[0].rows > 0
    weight = np.where(recorded, np.min([n.weight for n in noises], axis=0), 0.0)
    count = np.where(recorded, 1.0 / np.max([n.inflation for n in noises], axis=0), 0.0)
    sensors = len(alternatives[0].problem.network.readings)
    usual = weight[:sensors][recorded[:sensors]]
    extra = np.full(places, float(np.median(usual)) if len(usual) else 1.0)
    return np.insert(weight, np.full(places, sensors), extra), float(count.sum())


def _sums(known: Array, difference: Array) -> tuple[Array, Array, Array]:
    return known.T @ known, known.T @ difference, np.einsum("na,na->a", difference, difference)


def _left(system: Array, cross: Array, square: Array) -> Array:
    """Minimum (A,) of |difference − known y|² + yᵀ prior y."""
    return np.asarray(np.maximum(square - np.einsum("pa,pa->a", cross, cho_solve(cho_factor(system), cross)), 0.0))


def with_free_offset(rows: Array, offset: Array) -> Array:
    """Rows (n, …) of unit noise whitened for one more constant unknown, offset (n, 1) per unit of prior N(0, 1)."""
    size = float(np.sum(offset**2))
    if size == 0:
        return rows
    damping = (1.0 - 1.0 / np.sqrt(1.0 + size)) / size
    return np.asarray(rows - damping * offset @ (offset.T @ rows))
