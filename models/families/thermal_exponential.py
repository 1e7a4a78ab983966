"""Thermal exponential: one or two first-order lags behind the spindle speed, without any temperature."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from features.design import Design
from models.base import Family
from models.numerics.batches import bridged, padded, steps_s, too_few_rows, unpadded
from models.numerics.lags import behind
from models.program import Builder

EXPONENTS = (1.0, 0.5, 0.75, 1.25, 1.5, 1.75, 2.0)  # 1 first: it is kept where there is one speed
_TAU_GRID_S = np.geomspace(120.0, 43200.0, 25)
_LEAST_RATIO = 2.0  # of two time constants: closer ones give huge amplitudes of opposite sign
_MOST_STEPS = 12
_EXACT = 1e-9  # share of the sum of squares below which the residual of one lag is rounding
_WORTH = 0.01  # a second lag must lower the sum of squares by this share


class ThermalExponential(Family):
    """Baseline `y = Σ_j A_j · lag_τj[(n/1000)^m]`; at constant speed `Σ_j A_j (n/1000)^m (1 − exp(−t/τ_j))`.

    n is the first driver in rpm; a standstill cools down. Without such a driver in every training batch the load is 1
    from the start: time alone. m is chosen from `EXPONENTS`, τ from 2 min to 12 h and not above twice the
    longest training batch, amplitudes by least squares (variable projection), all batches pooled.
    A batch to predict that lacks the speed gets the training batches' mean load.

    Source: G. Golub and V. Pereyra, The differentiation of pseudo-inverses and nonlinear least squares problems
    whose variables separate, SIAM J. Numer. Anal. 10 (1973); the law is Newton's warm-up of one or two bodies.
    """

    key = "thermal_exponential"
    summary = "exponential warm-up driven by spindle speed or time alone"
    source = "Newton's law of cooling; Golub and Pereyra 1973"
    uses_inputs = False
    rank = 5

    def __init__(self, lags: int = 2) -> None:
        super().__init__()
        self.lags = int(lags)

    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        """A grid over (m, τ) whose sums all folds share, then τ refined fold by fold.

        Raises:
            InputError: too few usable rows.
        """
        need = 2 * self.lags + 1
        known = np.isfinite(design.y_um)
        counts = np.bincount(design.group[known], minlength=design.n_batches)
        for fold in folds:
            if counts[list(fold)].sum() < need:
                raise too_few_rows(self.key, design, fold, int(counts[list(fold)].sum()), need)
        y_um, use = padded(design, np.where(known, design.y_um, 0.0)), padded(design, known.astype(float)) > 0
        inside, steps = padded(design, np.ones(len(known))) > 0, steps_s(design)
        channel, speed = _speed_rpm(design)
        has_speed = ~np.isnan(speed.sum(axis=1))
        by_law: dict[bool, list[int]] = {}
        for f, fold in enumerate(folds):
            by_law.setdefault(bool(channel) and bool(has_speed[list(fold)].all()), []).append(f)
        out: dict[int, Self] = {}
        for follows, members in by_law.items():
            loads = [_load(speed, m) for m in EXPONENTS] if follows else [np.ones_like(speed)]
            gram, with_y = _sums(loads, y_um, use, steps)
            for f in members:
                fold = list(folds[f])
                longest_s = np.nan_to_num((inside[fold].sum(axis=1) - 1) * steps[fold]).max()
                m, one_s, two_s = _best(gram[fold].sum(axis=0), with_y[fold].sum(axis=0), longest_s, self.lags)
                own = loads[m][fold], y_um[fold], use[fold], steps[fold]
                sse, tau_s, amplitude_um = _refined(*own, one_s)
                if two_s is not None and sse > _EXACT * (y_um[fold] ** 2).sum():
                    sse_two, *both = _refined(*own, two_s)
                    tau_s, amplitude_um = both if sse - sse_two > _WORTH * sse else (tau_s, amplitude_um)
                plain = {"tau_s": tau_s, "amplitude_um": amplitude_um,
                         "mean_load": float(loads[m][fold][inside[fold]].mean()), "exponent": EXPONENTS[m],
                         "speed_channel": channel if follows else ""}  # fmt: skip
                out[f] = self._learned(design, plain)
        return [out[f] for f in range(len(folds))]

    def respond(self, design: Design, batches: Sequence[int]) -> list[Array]:
        """Error_um (n_k,) per batch: 0 at its start, from time and speed alone."""
        taus_s, amplitudes = np.atleast_1d(self.fitted["tau_s"]), np.atleast_1d(self.fitted["amplitude_um"])
        name = self.fitted["speed_channel"]
        load = np.ones((design.n_batches, int(np.diff(design.offsets).max(initial=0))))
        if name:
            speed = _held(design, name)
            missing = np.isnan(speed.sum(axis=1))
            load = _load(np.where(missing[:, None], 0.0, speed), self.fitted["exponent"])
            load[missing] = self.fitted["mean_load"]
        steps = steps_s(design)
        total = np.zeros_like(load)
        for tau_s, amplitude in zip(taus_s, amplitudes, strict=True):
            total += amplitude * behind(load, tau_s, steps)
        rows = unpadded(design, total)
        return [rows[design.rows(k)] for k in batches]

    def operations(self, b: Builder) -> Sequence[int]:
        taus_s, amplitudes = np.atleast_1d(self.fitted["tau_s"]), np.atleast_1d(self.fitted["amplitude_um"])
        name, load = self.fitted["speed_channel"], b.constant(1.0)
        if name:
            kilo_rpm = b.scaled(b.channels([name], required=False), np.array(1000.0))
            load = b.add("power", [kilo_rpm], 1, exponents=self.fitted["exponent"])
        return [b.affine(b.join(*(b.lag(load, tau_s, 0.0) for tau_s in taus_s)), amplitudes[None])]

    def n_parameters(self) -> int:
        return 2 * int(np.size(self.fitted["tau_s"])) + (1 if self.fitted["speed_channel"] else 0)


def _sums(loads: Sequence[Array], y_um: Array, use: NDArray[np.bool_], step_s: Array) -> tuple[Array, Array]:
    """Per batch the products of M loads behind every τ with one another (K, M, T, T) and with the error (K, M, T)."""
    gram = np.empty((len(y_um), len(loads), len(_TAU_GRID_S), len(_TAU_GRID_S)))
    with_y = np.empty(gram.shape[:3])
    for m, load in enumerate(loads):
        lags = np.stack([behind(load, tau, step_s) for tau in _TAU_GRID_S], axis=1) * use[:, None]
        gram[:, m] = lags @ lags.transpose(0, 2, 1)
        with_y[:, m] = np.einsum("ktn,kn->kt", lags, y_um)
    return gram, with_y


def _best(gram: Array, h: Array, longest_s: float, lags: int) -> tuple[int, Array, Array | None]:
    """Exponent's index with the least sum of squares over a fold, its best τ alone and best pair of τ, s.

    gram (M, T, T) and h (M, T) are the fold's sums; its longest batch bounds τ.
    """
    allowed = np.less_equal(_TAU_GRID_S, max(2.0 * longest_s, float(_TAU_GRID_S[1])))
    power = np.einsum("mtt->mt", gram)
    with np.errstate(divide="ignore", invalid="ignore"):
        one = np.where(allowed & (power > 0), h**2 / power, 0.0)
        det = power[:, :, None] * power[:, None, :] - gram**2
        cross = h[:, :, None] * h[:, None, :]
        two = h[:, :, None] ** 2 * power[:, None, :] - 2 * cross * gram + h[:, None, :] ** 2 * power[:, :, None]
        apart = _TAU_GRID_S[None, :] >= _LEAST_RATIO * _TAU_GRID_S[:, None]
        fine = apart & allowed[None, :] & (det > 1e-9 * power[:, :, None] * power[:, None, :])
        two = np.where(fine, two / det, 0.0)
    gain = two.max(axis=(1, 2)) if lags > 1 else one.max(axis=1)
    # A tie within rounding goes to the first exponent: a single speed does not distinguish them.
    m = int(np.argmax(gain >= gain.max() * (1.0 - 1e-9)))
    alone = _TAU_GRID_S[[int(one[m].argmax())]]
    if lags < 2 or two[m].max() <= one[m].max():
        return m, alone, None
    i, j = np.unravel_index(int(two[m].argmax()), two[m].shape)
    return m, alone, _TAU_GRID_S[[i, j]]


def _refined(
    load: Array, y_um: Array, use: NDArray[np.bool_], steps: Array, taus_s: Array
) -> tuple[float, Array, Array]:
    """Sum of squares, τ polished by Gauss–Newton steps on log τ, shortened until they help, and amplitudes solved anew.

    All of the batches of a fold, as `padded` lays them out.
    """
    y = y_um[use]

    def solve(log_tau: Array) -> tuple[float, Array, list[Array], Array]:
        lags = [behind(load, float(np.exp(v)), steps) for v in log_tau]
        basis = np.stack([lag[use] for lag in lags])
        amplitude: Array = np.linalg.lstsq(basis @ basis.T, basis @ y, rcond=1e-12)[0].astype(float)
        residual = y - amplitude @ basis
        return float(residual @ residual), amplitude, lags, basis

    log_tau = np.log(taus_s)
    sse, amplitude, lags, basis = solve(log_tau)
    for _ in range(_MOST_STEPS):
        slopes = [_lag_slope(load, float(np.exp(v)), steps, lag)[use] for v, lag in zip(log_tau, lags, strict=True)]
        rows = np.vstack([basis, amplitude[:, None] * np.stack(slopes)])
        step = np.linalg.lstsq(rows @ rows.T, rows @ (y - amplitude @ basis), rcond=1e-12)[0][len(taus_s) :]
        for share in (1.0, 0.3, 0.1):
            trial = _allowed(log_tau + np.clip(share * step, -1.0, 1.0))
            found = solve(trial)
            if found[0] < sse:
                break
        else:
            break
        moved = float(np.abs(trial - log_tau).max())
        log_tau, (sse, amplitude, lags, basis) = trial, found
        if moved < 1e-5:
            break
    return sse, np.exp(log_tau), amplitude


def _allowed(log_tau: Array) -> Array:
    """Inside the range of τ and, for two, at least `_LEAST_RATIO` apart."""
    low, high, apart = np.log(_TAU_GRID_S[0] / 2), np.log(_TAU_GRID_S[-1]), np.log(_LEAST_RATIO)
    if len(log_tau) == 1:
        return np.clip(log_tau, low, high)
    middle, half = log_tau.mean(), max((log_tau[1] - log_tau[0]) / 2, apart / 2)
    first = np.clip(middle - half, low, high - apart)
    return np.array([first, np.clip(middle + half, first + apart, high)])


def _lag_slope(load: Array, tau_s: float, step_s: Array, lag: Array) -> Array:
    """d lag / d log τ, (K, n), from the recursion's own derivative."""
    ratio = step_s / tau_s
    driven = np.zeros_like(load)
    driven[:, 1:] = (ratio * np.exp(-ratio) / -np.expm1(-ratio))[:, None] * (lag[:, :-1] - load[:, 1:])
    return behind(driven, tau_s, step_s)


def _load(speed_rpm: Array, exponent: float) -> Array:
    return np.asarray((np.abs(speed_rpm) / 1000.0) ** exponent, float)


def _speed_rpm(design: Design) -> tuple[str, Array]:
    """Name of the spindle speed's driver and the speed per batch (K, longest); "" and zeros without one."""
    names = [n for n, u in zip(design.driver_names, design.driver_units, strict=False) if u == "rpm"]
    names += [n for n in design.driver_names if "rpm" in n.lower()]
    if not names:
        return "", np.zeros((design.n_batches, int(np.diff(design.offsets).max(initial=0))))
    return names[0], _held(design, names[0])


def _held(design: Design, name: str) -> Array:
    """A driver with holes held, (K, longest); NaN throughout where a batch has none of it."""
    if name not in design.driver_names:
        return np.full((design.n_batches, int(np.diff(design.offsets).max(initial=0))), np.nan)
    return padded(design, bridged(design, design.drivers[:, [design.driver_names.index(name)]])[:, 0])
