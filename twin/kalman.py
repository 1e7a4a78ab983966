"""Kalman filter on a twin: readings correct the simulated state row by row, causally.

A Kalman filter (Kalman 1960) on deviations from the free-running simulation, linearised there (Gelb 1974, sec. 6.1):
laws enter to first order in the deviation. In addition to the cells the state holds a factor on
each heat, constant through a batch, what each sensor that lags shows, and the deviation at the start that errors,
which are shown less their first value, remember.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from data.arrays import Array
from data.errors import InputError
from twin.network import Network
from twin.simulation import TOLERANCE_K, Simulation, simulation_of
from twin.simulation.channels import Rows, Tangents, shown
from twin.simulation.inputs import Inputs
from twin.simulation.run import Solved, rows_of, solved_balance
from twin.simulation.start import start_of

_HOUR_S = 3600.0


@dataclass(frozen=True)
class Doubt:
    """Uncertainty of the network.

    start_K2 (N, N): covariance of the start temperatures, K². heat_spread: standard deviation of each heat's own
    factor from batch to batch. heat_W: white noise of the heat into every body, as the standard deviation in W of its
    mean over an hour.
    """

    start_K2: Array
    heat_spread: float = 0.15
    heat_W: float = 10.0


@dataclass(frozen=True)
class Filtered:
    """What is known at every row from the readings up to it; B batches, K rows.

    errors (B, K, n_errors) in the channels' units, 0 at the first row; cells_degC (B, K, N); heat_factor (B, K,
    n_heats) less 1; innovation (B, K, n_sensors): what each reading adds to what was known, over its standard
    deviation, one sensor after the other, NaN where there is none.
    """

    network: Network
    errors: Array
    cells_degC: Array
    heat_factor: Array
    innovation: Array


@dataclass(frozen=True)
class _Linear:
    """The linearised network, per batch and interval between the rows in use; n states as in `_linearised`.

    move (B, K - 1, n, n), noise (B, K - 1, n, n) for a heat noise of 1 W, sensor (B, K, n_sensors, n), error (B, K,
    n_errors, n), start (B, n, N + H): how the first state follows from cells and factors.
    """

    move: Array
    noise: Array
    sensor: Array
    error: Array
    start: Array

    def first(self, doubt: Doubt, n_cells: int, n_heats: int) -> Array:
        """Covariance (B, n, n) at the first row."""
        own = np.zeros((n_cells + n_heats, n_cells + n_heats))
        own[:n_cells, :n_cells] = doubt.start_K2
        own[n_cells:, n_cells:] = np.eye(n_heats) * doubt.heat_spread**2
        return np.asarray(self.start @ own @ self.start.swapaxes(-1, -2))


def filtered_each(
    network: Network,
    values: Array,
    inputs: Inputs,
    readings: Array,
    doubts: Sequence[Doubt],
    start_degC: Array | None = None,
    thin: int = 1,
) -> list[Filtered]:
    """Temperatures and errors of B batches at parameter values (n,), corrected by readings (B, K, n_sensors), degC.

    Under each of several uncertainties, which share the simulation and its linearisation. Sensors in the network's
    order; NaN is no reading. The rows are the recording's; only every `thin`-th row's readings are used, from the
    first on, and the rows behind it keep its corrections. `start_degC` (B, N) is the mean of the start, default steady
    with the surroundings.

    Raises:
        InputError: readings or a covariance of another shape; a sensor whose law remembers more than a lag.
    """
    for doubt in doubts:
        _check(network, inputs, readings, doubt)
    if start_degC is None:
        start_degC = start_of(network, values, inputs, steady=True)
    solved = solved_balance(network, values[None], inputs, start_degC[None], TOLERANCE_K)
    rows = rows_of(solved, 1)
    nominal = simulation_of(solved, *shown(rows, network)[:2], TOLERANCE_K, 1)
    used = np.flatnonzero(np.isfinite(readings).any(axis=(0, 1)))
    linear = _linearised(solved, rows, nominal, used, thin)
    return [_run(network, linear, nominal, readings, used, doubt, thin) for doubt in doubts]


def _run(
    network: Network,
    linear: _Linear,
    nominal: Simulation,
    readings: Array,
    used: NDArray[np.int64],
    doubt: Doubt,
    thin: int,
) -> Filtered:
    assert nominal.cells_degC is not None
    n_cells, n_heats = network.n_cells, len(network.heats)
    given = np.where(nominal.valid[..., None], readings - nominal.readings[0], np.nan)[:, ::thin, used]
    there = np.isfinite(given)
    given = np.where(there, given, 0.0)
    variance = np.where(there, np.array([r.noise for r in network.readings])[used] ** 2, 1.0)
    cov = linear.first(doubt, n_cells, n_heats)
    state = np.zeros(cov.shape[:2])
    states = np.empty((*given.shape[:2], cov.shape[-1]))
    news = np.full(given.shape, np.nan)
    for k in range(given.shape[1]):
        if k:
            move = linear.move[:, k - 1]
            state = (move @ state[..., None])[..., 0]
            cov = move @ cov @ move.swapaxes(-1, -2) + doubt.heat_W**2 * linear.noise[:, k - 1]
        if there[:, k].any():
            # With S = L Lᵀ, L⁻¹ (reading − expected) is what each sensor adds after those before it, over its own sd.
            row = linear.sensor[:, k][:, used] * there[:, k, :, None]
            spread = row @ cov
            own = spread @ row.swapaxes(-1, -2)
            np.einsum("bii->bi", own)[:] += variance[:, k]
            root = np.linalg.cholesky(own)
            away = given[:, k, :, None] - row @ state[..., None]
            solved = np.linalg.solve(root, np.concatenate([spread, np.where(there[:, k, :, None], away, 0.0)], axis=2))
            gain, own_news = solved[..., :-1], solved[..., -1]
            state = state + (own_news[:, None] @ gain)[:, 0]
            cov = cov - gain.swapaxes(-1, -2) @ gain
            news[:, k] = np.where(there[:, k], own_news, np.nan)
        states[:, k] = state
    innovation = np.full(readings.shape, np.nan)
    innovation[:, ::thin, used] = news
    held = np.arange(readings.shape[1]) // thin
    moved = np.einsum("bkei,bki->bke", linear.error, states)[:, held]
    states = states[:, held]
    return Filtered(
        network,
        nominal.errors[0] + moved,
        nominal.cells_degC[0] + states[..., :n_cells],
        states[..., n_cells : n_cells + n_heats],
        innovation,
    )


def _linearised(solved: Solved, rows: Rows, nominal: Simulation, used: NDArray[np.int64], thin: int) -> _Linear:
    """States: cells (N), factors on heats (H), what lagging sensors show (L), what errors remember (E)."""
    network, values = solved.balance.network, solved.balance.values[0]
    d_readings, d_errors = (d[:, ::thin] for d in _slopes(solved, rows))  # (B, K, n_sensors, N), (B, K, n_errors, N)
    time_s, valid = nominal.time_s[:, ::thin], nominal.valid[:, ::thin]
    lags = _lags_s(network, values, used)
    n_cells, n_heats, n_lags, n_errors = network.n_cells, len(network.heats), len(lags), len(network.errors)
    at_lag = n_cells + n_heats
    at_error, n = at_lag + n_lags, at_lag + n_lags + n_errors
    n_batches, n_rows = valid.shape
    dt_s = np.diff(time_s, axis=1)
    rate = np.zeros((n_batches, n_rows - 1, n, n))
    rate[..., :n_cells, :n_cells] = _cell_rates(solved, thin)
    capacity = network.capacity_J_per_K(values)
    for h, heat in enumerate(network.heats):
        watts = np.diff(nominal.heat_J[heat.law.name][0][:, ::thin], axis=1) / dt_s
        rate[..., :n_cells, n_cells + h] = watts[..., None] * heat.direction(values) / capacity
    sensor = np.zeros((n_batches, n_rows, len(network.readings), n))
    sensor[..., :n_cells] = d_readings
    for place, (j, lag_s) in enumerate(lags.items(), at_lag):
        rate[:, :, place, :n_cells] = d_readings[:, 1:, j] / lag_s
        rate[:, :, place, place] = -1.0 / lag_s
        sensor[:, 1:, j] = 0.0
        sensor[:, 1:, j, place] = 1.0
    error = np.zeros((n_batches, n_rows, n_errors, n))
    error[:, 1:, :, :n_cells] = d_errors[:, 1:]
    error[:, 1:, np.arange(n_errors), at_error + np.arange(n_errors)] = -1.0
    part, white = expm(rate * (dt_s[..., None, None] / 4)), _white(network, capacity, n)
    noise, move = white / 12, np.eye(n)
    for weight in (4, 2, 4, 1):  # Simpson's rule over the interval
        move = part @ move
        noise = noise + move @ white @ move.swapaxes(-1, -2) * (weight / 12)
    noise = noise * dt_s[..., None, None]
    behind = ~valid[:, 1:]
    move[behind], noise[behind] = np.eye(n), 0.0
    start = np.zeros((n_batches, n, n_cells + n_heats))
    start[:, : n_cells + n_heats] = np.eye(n_cells + n_heats)
    for place, j in enumerate(lags, at_lag):
        start[:, place, :n_cells] = d_readings[:, 0, j]
    start[:, at_error:, :n_cells] = d_errors[:, min(1, n_rows - 1)]
    return _Linear(move, noise, sensor, error, start)


def _cell_rates(solved: Solved, thin: int) -> Array:
    """d (dT/dt) / dT of the cells (B, K - 1, N, N), mean over each interval between two rows in use."""
    b = solved.balance
    inverse = 1.0 / b.capacity_J_per_K[0]
    own = -b.conductance_W_per_K[0] * inverse[:, None]
    out = own[b.regimes.of]
    if solved.coupled is not None:
        for source in solved.sources:
            if source.along:  # what it does now follows from the past alone
                continue
            into = source.direction[0] * inverse
            for place, slope in source.slopes(solved.coupled.borders, slice(0, out.shape[1])).items():
                out = out + slope[0].mean(axis=1)[..., None, None] * np.outer(into, solved.places.rows[place])
    every = b.inputs.every * thin
    whole = out[:, : out.shape[1] // every * every]
    return np.asarray(whole.reshape(len(out), -1, every, *out.shape[2:]).mean(axis=2))


def _slopes(solved: Solved, rows: Rows) -> tuple[Array, Array]:
    """How readings (B, K, n_sensors, N) and errors (B, K, n_errors, N) change with the cells at the same row.

    Readings as if the change had always been there, so that a lag passes it; errors as if it came behind the first row.
    """
    network, n = solved.balance.network, solved.balance.network.n_cells
    shape = (n, *rows.time_s.shape)
    later = np.ones(shape)
    later[..., 0] = 0.0
    places = np.array(solved.places.rows).reshape(-1, n)
    chain = np.array([e.matrix(solved.balance.values[0]) for e in network.errors]).reshape(-1, n)
    air = np.zeros((n, len(network.surroundings), *rows.time_s.shape))
    out = []
    for seen in (np.ones(shape), later):
        tangents = Tangents(places[:, :, None, None] * seen, chain[:, :, None, None] * later, air, {})
        out.append([np.moveaxis(d, 0, -1) for d in shown(rows, network, tangents)[2:]])
    return out[0][0], out[1][1]


def _lags_s(network: Network, values: Array, used: NDArray[np.int64]) -> dict[int, float]:
    """Time constant by number of the sensors in use that lag."""
    out: dict[int, float] = {}
    for j in used.tolist():
        for law in network.readings[j].effects:
            if law.mechanism.key == "sensor_lag" and j not in out:
                lag_s = float(values[law.parameters["lag"]])
                if lag_s > 0:
                    out[j] = lag_s
            elif law.mechanism.along_time:
                raise InputError(
                    f"machine {network.machine}: sensor {network.readings[j].channel!r} has {law.name}, "
                    f"which remembers more than one lag ({law.mechanism.summary}); filter without this sensor"
                )
    return out


def _white(network: Network, capacity: Array, n: int) -> Array:
    """Spectral density (n, n) of the noise in dT/dt at 1 W, K²/s: each body's own heat, even over its cells."""
    out = np.zeros((n, n))
    for cells in network.bodies.values():
        rate = 1.0 / len(cells) / capacity[cells]
        out[np.ix_(cells, cells)] = np.outer(rate, rate) * _HOUR_S
    return out


def _check(network: Network, inputs: Inputs, readings: Array, doubt: Doubt) -> None:
    n_rows = (inputs.time_s.shape[1] - 1) // inputs.every + 1
    expected = (inputs.n_batches, n_rows, len(network.readings))
    if readings.shape != expected:
        raise InputError(
            f"machine {network.machine}: readings have shape {readings.shape}, expected (batches, rows, sensors) = "
            f"{expected}"
        )
    if doubt.start_K2.shape != (network.n_cells, network.n_cells):
        raise InputError(
            f"machine {network.machine}: the start's covariance has shape {doubt.start_K2.shape}, expected "
            f"({network.n_cells}, {network.n_cells})"
        )
    for name in ("heat_spread", "heat_W"):
        if not getattr(doubt, name) >= 0:
            raise InputError(f"machine {network.machine}: {name} is {getattr(doubt, name):g}, expected 0 or more")
