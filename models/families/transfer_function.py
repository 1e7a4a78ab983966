"""Family: transfer function, a sum of first-order responses to temperatures, drivers and the start state.

Poles come from a grid search by leave-batch-out, then each pole is refined, all of it on sums per batch. The search is
one coordinate after the other: poles that all sources share, which sources take part, the penalty. Folds share
candidates, so each is solved once for all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Self

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array, Mask
from data.checks.base import THERMAL
from data.errors import InputError
from features.design import Design
from features.rises import hold_last
from models.base import Family
from models.families.linear import EPS, Task, left_out_spread, mean_square, stated_sd_um
from models.numerics.batches import bridged, fold_masks, only, padded, steps_s, unpadded
from models.numerics.lags import behind, lag_responses, with_columns
from models.numerics.pooled_sums import Blocks, Pool, left_out_mean_S_um, mean_diagonal, ridge_path
from models.program import Builder

_FEWEST_ROWS = 8
_MOST_INPUTS = 60
_ENOUGH_BATCHES = 3
TAUS_S = np.geomspace(120.0, 43200.0, 15)
EXPONENTS = (1.0, 1.5, 2.0)
DRIVERS = ("speed", "load", "room")  # kinds of sources that come with the drivers
_LOG_TAUS = np.log(TAUS_S)
_PITCH = float(_LOG_TAUS[1] - _LOG_TAUS[0])
_NODES = 6
_LIKE_1_K = {"rpm": 1000.0, "mm/min": 1000.0}  # drivers in other units count as they are
PENALTIES = np.geomspace(1e1, 1e-7, 9)
_COARSE = (1, 4, 7, 10, 13)  # of the grid: 3 min to 8 h
_FEW_PATH = partial(ridge_path, penalties=PENALTIES[2::2])  # while poles are sought
_BATCHES_PER_GAP = 2  # a gap is one number a batch
_STEPS, _LONGEST_STEP = 8, 0.7  # in log τ
_LOOSENESS = 0.5  # prior standard deviation of a pole's log τ about the shared one


class TransferFunction(Family):
    """`y = Σ_i [ k_i u_i + Σ_l K_il / (τ_il s + 1) u_i ]`, at most two poles per input, from rest, running free.

    Two poles are stated as the sum of their partial fractions, which contains the cascade K / ((τ1 s + 1)(τ2 s + 1)):
    K τ1 / (τ1 − τ2) and K τ2 / (τ2 − τ1). Inputs are the chosen sensors; their direct term is near a lead. With
    `gaps` also the difference of each of them from the room at the start, as a step: castings that are not in steady
    state overnight relax like that; it takes two training batches per sensor. With `drivers` also (|n| / 1000 rpm)^m, m
    1, 1.5 or 2, other drivers and the ambient rise.

    In every fold leave-batch-out over its training batches chooses on a grid from 2 min to 12 h the poles that all
    inputs start from, whether gaps and drivers take part, and the ridge on the gains. Then each input's poles move by
    themselves. With fewer than three training batches only direct terms of the sensors are fitted. What some batch of
    the design lacks takes no part.

    `fitted`: per input kind, name and exponent, direct_um (µm per unit), gain_um and tau_s (inputs, poles).

    Source: L. Ljung, System Identification (1999), output-error models, eq. 4.25; the gains between steps of the
    poles: G. Golub and V. Pereyra, SIAM J. Numer. Anal. 10 (1973), variable projection.
    """

    key = "transfer_function"
    summary = "first-order responses to the sensors and to what is not steady at the start"
    source = "Ljung 1999, eq. 4.25; Golub and Pereyra 1973"
    closed_form = False
    has_sd = True
    rank = 30

    def __init__(self, poles: int = 2, gaps: bool = True, drivers: bool = False) -> None:
        super().__init__()
        if poles not in (0, 1, 2):
            raise InputError(f"family {self.key}: poles is {poles!r}, expected 0, 1 or 2; choose one of them")
        self.poles, self.gaps, self.drivers = int(poles), bool(gaps), bool(drivers)

    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        """All folds from the sums of one dictionary of responses.

        Raises:
            InputError: no inputs or more than 60, or fewer than 8 usable rows in a fold.
        """
        if not 0 < len(design.inputs) <= _MOST_INPUTS:
            raise InputError(
                f"family {self.key}: got {len(design.inputs)} inputs for {design.target or 'the error'}, expected 1 to "
                f"{_MOST_INPUTS}; let a selector choose"
            )
        counts = np.bincount(design.group[design.usable], minlength=design.n_batches)
        masks = fold_masks(self.key, design, folds, counts, _FEWEST_ROWS)
        drivers = drivers_of(design) if self.drivers else []
        gaps = gaps_of(design) if self.gaps else []
        sources = (*(Source("input", i) for i in design.inputs), *drivers, *gaps)
        dictionary = Dictionary(design, sources, about_start=self.zero_start)
        best, many = [Candidate()] * len(masks), np.flatnonzero(masks.sum(axis=1) >= _ENOUGH_BATCHES)
        if len(many):
            for f, candidate in zip(many, searched(dictionary, masks[many], self.poles), strict=True):
                best[f] = candidate
        out: dict[int, Self] = {}
        for candidate in dict.fromkeys(best):
            some = [f for f, own in enumerate(best) if own == candidate]
            out |= zip(some, self._fitted(dictionary, masks[some], candidate), strict=True)
        return [out[f] for f in range(len(folds))]

    def respond(self, design: Design, batches: Sequence[int]) -> list[Array]:
        """NaN at a row where an input is missing, and throughout a batch that lacks a driver the model needs."""
        f, some = self.fitted, only(design, batches)
        parts = zip(f["kinds"], f["names"], f["exponents"], strict=True)
        signals = np.column_stack([Source(kind, name, float(m)).signal(some) for kind, name, m in parts])
        laid, step_s = padded(some, signals), steps_s(some)
        total_um = f["intercept_um"] + laid @ f["direct_um"]
        for signal, gains_um, taus_s in zip(np.moveaxis(laid, 2, 0), f["gain_um"], f["tau_s"], strict=True):
            for gain_um, tau_s in zip(gains_um, taus_s, strict=True):
                total_um += gain_um * behind(signal, tau_s, step_s)
        error_um = unpadded(some, total_um)
        error_um = np.where(np.isfinite(some.x).all(axis=1), error_um, np.nan)
        return [error_um[some.rows(k)] for k in range(some.n_batches)]

    def operations(self, b: Builder) -> Sequence[int]:
        f = self.fitted
        parts = zip(f["kinds"], f["names"], f["exponents"], strict=True)
        b.features(self.inputs)
        signals = b.join(*(Source(kind, name, float(m)).operation(b) for kind, name, m in parts))
        tau_s, gain_um = np.asarray(f["tau_s"]), np.asarray(f["gain_um"])
        lagged = [b.lag(signals, tau_s[:, pole], 0.0) for pole in range(tau_s.shape[1])]
        weights = np.concatenate([f["direct_um"], *gain_um.T])
        return [b.affine(b.join(signals, *lagged), weights[None], f["intercept_um"])]

    def sd_um(self, design: Design, batches: Sequence[int]) -> list[Array]:
        """Predictive standard deviation (n_k,) of a recorded value, see `models.families.linear.stated_sd_um`."""
        return stated_sd_um(self, design, batches)

    def n_parameters(self) -> int:
        """Gains, time constants, and the intercept where the level is free."""
        if not self.fitted:
            return 0
        return len(self.fitted["names"]) + 2 * int(np.size(self.fitted["tau_s"])) + (not self.zero_start)

    def _fitted(self, dictionary: Dictionary, masks: Mask, candidate: Candidate) -> list[Self]:
        """The folds that chose one candidate: its penalty, then its poles moved."""
        design, moments = dictionary.design, dictionary.table.moments
        which = candidate.sources(dictionary)
        own = map(str, dictionary.places(which, candidate.poles))
        task = Task.of(dictionary.table.subset(tuple(own)), masks, False)
        path = partial(ridge_path, penalties=PENALTIES)
        chosen = task.chosen(path, "leave_batch_out")
        sources, columns = [dictionary.sources[i] for i in which], dictionary.block(which)
        direct = np.array([s.direct for s in sources])
        blocks = Blocks.of(moments.subset(columns))
        pool = blocks.pool(masks, False)
        square = masks @ (blocks.yy + blocks.count * blocks.mean_y**2) - pool.count * pool.mean_y**2
        shared = np.tile(np.log(TAUS_S[list(candidate.poles)]), (len(masks), 1))
        log_tau, gain = refined(pool, square, direct, shared, PENALTIES[chosen], pool.count / masks.sum(axis=1))
        weight, _ = combination(log_tau, direct)
        away = ((pool.mean_x + moments.shift_x[columns])[:, None, :] @ weight @ gain[:, :, None])[:, 0, 0]
        intercept = pool.mean_y + moments.shift_y - away
        n_direct = int(direct.sum())
        direct_um = np.zeros((len(masks), len(sources)))
        direct_um[:, direct] = gain[:, :n_direct]
        gain_um = gain[:, n_direct:].reshape(len(masks), -1, len(sources)).transpose(0, 2, 1)
        plain = {"kinds": [s.kind for s in sources], "names": [s.name for s in sources],
                 "exponents": np.array([s.exponent for s in sources])}  # fmt: skip
        # For `sd_um`: left-out residuals with the poles where the candidate has them.
        grows = mean_square(self.started(design).x, design)
        used, at = np.unique(chosen, return_inverse=True)
        path = partial(ridge_path, penalties=PENALTIES[used])
        spread = np.transpose(left_out_spread(task, grows, path, at)).tolist()
        names = ("variance_um2", "variance_growth_um2")
        return [
            self._learned(design, {**plain, "direct_um": direct_um[f], "gain_um": gain_um[f],
                                   "tau_s": np.exp(log_tau[f]), "intercept_um": float(intercept[f]),
                                   "k": float(PENALTIES[chosen[f]]),
                                   **(dict(zip(names, spread[f], strict=True)) if np.isfinite(spread[f][0]) else {})})
            for f in range(len(masks))
        ]  # fmt: skip


@dataclass(frozen=True)
class Source:
    """What acts: `kind` is how the channel or input `name` acts.

    input: a chosen input as the design has it. speed: (|n| / 1000 rpm)^exponent. load: |another driver|. room: the
    ambient rise. gap: T − T_ambient of a sensor at the batch's start, held; a machine that does not start in
    equilibrium relaxes as if this step acted on it.
    """

    kind: str
    name: str
    exponent: float = 1.0

    @property
    def direct(self) -> bool:
        """Whether it may also act without a lag: a step at the start would only shift the error's zero."""
        return self.kind != "gap"

    def signal(self, design: Design) -> Array:
        """Its values (n,), holes held; NaN throughout a batch that has none of it."""
        if self.kind == "input":
            return bridged(design, design.x[:, [design.inputs.index(self.name)]])[:, 0]
        if self.kind in ("speed", "load"):
            column = design.driver_names.index(self.name) if self.name in design.driver_names else None
            if column is None:
                return np.full(len(design.time_s), np.nan)
            scale = _LIKE_1_K.get(design.driver_units[column], 1.0)
            return np.asarray((np.abs(bridged(design, design.drivers[:, [column]])[:, 0]) / scale) ** self.exponent)
        if self.kind == "room":
            return _temperature(design, self.name) - _first(design, self.name)
        return _first(design, self.name) - _first(design, ambient_of(design))

    def operation(self, b: Builder) -> int:
        """The same as a node of a program."""
        if self.kind == "input":
            return b.features([self.name])
        raw = b.channels([self.name], required=False)
        if self.kind in ("speed", "load"):
            scaled = b.scaled(raw, np.array(_LIKE_1_K.get(b.known[self.name].unit, 1.0)))
            return b.add("power", [scaled], 1, exponents=self.exponent)
        if self.kind == "room":
            return b.since_first(raw)
        room = next(c for c, spec in b.known.items() if spec.role == "ambient")
        return b.add("first", [b.sub(raw, b.channels([room], required=False))], 1)


def drivers_of(design: Design) -> list[Source]:
    """What every batch of a design has of speed (one source per exponent), other drivers and ambient rise."""
    found = []
    for name, unit in zip(design.driver_names, design.driver_units, strict=True):
        if name not in design.inputs:
            found += [Source("speed", name, m) for m in EXPONENTS] if unit == "rpm" else [Source("load", name)]
    room = ambient_of(design)
    found += [Source("room", room)] if room and room not in design.inputs else []
    return [s for s in found if np.isfinite(s.signal(design)).all()]


def gaps_of(design: Design) -> list[Source]:
    """The gaps of those inputs that are plain rises of temperatures, where every batch has them."""
    room = ambient_of(design)
    channels = design.batches[0].channels if room else {}
    names = [n for n in design.inputs if n != room and n in channels and channels[n].role in THERMAL]
    found = [Source("gap", n) for n in names]
    return [s for s in found if np.isfinite(s.signal(design)).all()]


@dataclass(frozen=True)
class Dictionary:
    """The columns of S sources on a design: first the signals themselves, then their responses to every τ.

    Column `(t + 1) S + s` is source s behind `TAUS_S[t]`; with `about_start` relative to its value at the start.
    """

    design: Design
    sources: tuple[Source, ...]
    about_start: bool = False

    @cached_property
    def table(self) -> Design:
        """All columns as a design on the same usable rows."""
        signals = np.column_stack([s.signal(self.design) for s in self.sources])
        columns = lag_responses(self.design, signals, [(0.0, 0.0), *((0.0, tau_s) for tau_s in TAUS_S)])
        table = with_columns(self.design, np.nan_to_num(columns.reshape(len(signals), -1)))
        return table.started if self.about_start else table

    def places(self, which: Sequence[int], poles: Sequence[int]) -> list[int]:
        """Columns of some sources: the direct ones, then all behind each pole of the grid."""
        direct = [s for s in which if self.sources[s].direct]
        return [*direct, *((t + 1) * len(self.sources) + s for t in poles for s in which)]

    def block(self, which: Sequence[int]) -> list[int]:
        """All columns of some sources, in the order that `combination` counts them."""
        return [t * len(self.sources) + s for t in range(len(TAUS_S) + 1) for s in which]


def combination(log_tau: Array, direct: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Weights over a dictionary's columns that give poles of any place, and their slopes by log τ.

    Args:
        log_tau: (F, S, L), the L poles of each of S sources in F fits. direct: which sources act directly, (S,).

    Returns:
        (F, (T + 1) S, D + L S): D direct columns, then pole by pole; and (F, (T + 1) S, L S).
    """
    n_fits, n_sources, n_poles = log_tau.shape
    weight, slope = _interpolated(log_tau)
    own, at = np.arange(n_sources), np.flatnonzero(direct)
    lagged = np.zeros((n_fits, len(TAUS_S) + 1, n_sources, n_poles, n_sources))
    moved = np.zeros_like(lagged)
    for pole in range(n_poles):
        lagged[:, 1:, own, pole, own] = weight[:, :, pole].transpose(0, 2, 1)
        moved[:, 1:, own, pole, own] = slope[:, :, pole].transpose(0, 2, 1)
    head = np.zeros((n_fits, (len(TAUS_S) + 1) * n_sources, len(at)))
    head[:, at, np.arange(len(at))] = 1.0
    shape = (n_fits, head.shape[1], n_poles * n_sources)
    return np.concatenate([head, lagged.reshape(shape)], axis=2), moved.reshape(shape)


def _interpolated(log_tau: Array) -> tuple[Array, Array]:
    """Lagrange weights over the grid and their derivatives, (…, T)."""
    place = (log_tau - _LOG_TAUS[0]) / _PITCH
    first = np.clip(np.floor(place).astype(int) - _NODES // 2 + 1, 0, len(TAUS_S) - _NODES)
    away = (place - first)[..., None] - np.arange(_NODES)
    weight, slope = np.zeros((*log_tau.shape, len(TAUS_S))), np.zeros((*log_tau.shape, len(TAUS_S)))
    for a in range(_NODES):
        others = [b for b in range(_NODES) if b != a]
        scale = float(np.prod([a - b for b in others]))
        product = away[..., others].prod(axis=-1) / scale
        change = sum(away[..., [b for b in others if b != c]].prod(axis=-1) for c in others) / (scale * _PITCH)
        np.put_along_axis(weight, first[..., None] + a, product[..., None], axis=-1)
        np.put_along_axis(slope, first[..., None] + a, np.asarray(change)[..., None], axis=-1)
    return weight, slope


def ambient_of(design: Design) -> str:
    """The first ambient channel; "" where the design has no batches or they have none."""
    names = design.batches[0].names("ambient") if design.batches else ()
    return names[0] if names else ""


def _temperature(design: Design, name: str) -> Array:
    """A channel's temperature (n,), holes held; NaN throughout a batch that has none."""
    out = np.full(len(design.time_s), np.nan)
    for k, batch in enumerate(design.batches):
        if name in batch.channels:
            out[design.rows(k)] = hold_last(batch.masked(name))
    return out


def _first(design: Design, name: str) -> Array:
    """Its value at each batch's start, held, (n,)."""
    values = _temperature(design, name)
    return values[design.offsets[design.group]] if len(values) else values


@dataclass(frozen=True)
class Candidate:
    """Poles of the grid that all sources share, the speed's exponent (0: no drivers), and whether gaps take part."""

    poles: tuple[int, ...] = ()
    exponent: float = 0.0
    gaps: bool = False

    def sources(self, dictionary: Dictionary) -> list[int]:
        """Which sources of a dictionary take part."""
        takes = {"input": True, "gap": self.gaps and bool(self.poles), **dict.fromkeys(DRIVERS, self.exponent > 0)}
        return [
            i
            for i, s in enumerate(dictionary.sources)
            if takes[s.kind] and (s.kind != "speed" or s.exponent == self.exponent)
        ]


def searched(dictionary: Dictionary, masks: Mask, n_poles: int) -> list[Candidate]:
    """The best candidate of every training set, masks (F, K)."""
    scores: dict[Candidate, Array] = {}

    def better(best: Sequence[Candidate], others: Callable[[Candidate], list[Candidate]]) -> list[Candidate]:
        """The alternative of least score for every set, next to its best; equal scores keep the first."""
        tried = [list(dict.fromkeys(others(candidate))) for candidate in best]
        for candidate in dict.fromkeys(one for candidates in tried for one in candidates):
            score = scores.setdefault(candidate, np.full(len(best), np.nan))
            if new := [f for f, candidates in enumerate(tried) if candidate in candidates and np.isnan(score[f])]:
                columns = dictionary.places(candidate.sources(dictionary), candidate.poles)
                blocks = Blocks.of(dictionary.table.moments.subset(columns))
                score[new] = left_out_mean_S_um(blocks, masks[new], False, _FEW_PATH).min(axis=1)
        return [c[int(np.argmin([scores[one][f] for one in c]))] for f, c in enumerate(tried)]

    exponents = tuple(dict.fromkeys(s.exponent for s in dictionary.sources if s.kind in DRIVERS))
    least = _BATCHES_PER_GAP * sum(s.kind == "gap" for s in dictionary.sources)
    start = Candidate((), exponents[0] if exponents else 0.0)
    best = [replace(start, gaps=0 < least <= n) for n in masks.sum(axis=1)]
    if n_poles > 0:
        best = better(best, lambda c: [c, *(replace(c, poles=(a,)) for a in _COARSE)])
    if n_poles > 1:
        best = better(best, _second_pole)
    best = better(best, lambda c: [c, replace(c, gaps=False)])
    if exponents:
        best = better(best, lambda c: [c, *(replace(c, exponent=m) for m in (0.0, *exponents))])
    return best


def _second_pole(c: Candidate) -> list[Candidate]:
    """A second pole in addition to the first, on the coarse grid."""
    if len(c.poles) != 1:
        return [c]
    return [c, *(replace(c, poles=tuple(sorted((c.poles[0], b)))) for b in _COARSE if b != c.poles[0])]


@dataclass(frozen=True)
class _Solved:
    """Gains at given poles: weight and slope of `combination`, the pool's xx times the weight, ridge alpha (F,), gain
    (F, p), sum of squares (F,)."""

    log_tau: Array
    weight: Array
    slope: Array
    xx_weight: Array
    alpha: Array
    gain: Array
    sse: Array

    @classmethod
    def at(cls, log_tau: Array, pool: Pool, yy: Array, direct: NDArray[np.bool_], penalty: Array) -> Self:
        weight, slope = combination(log_tau, direct)
        across, xx_weight = weight.transpose(0, 2, 1), pool.xx @ weight
        matrix, right = across @ xx_weight, (across @ pool.xy[:, :, None])[:, :, 0]
        alpha = penalty * mean_diagonal(matrix)
        ridge = alpha[:, None, None] * np.eye(matrix.shape[1])
        gain = np.asarray(np.linalg.solve(matrix + ridge, right[:, :, None])[:, :, 0], float)
        square = np.einsum("fj,fj->f", gain, (matrix @ gain[:, :, None])[:, :, 0])
        sse = np.maximum(yy - 2.0 * np.einsum("fj,fj->f", gain, right) + square, 0.0)
        return cls(log_tau, weight, slope, xx_weight, alpha, gain, sse)

    def cost(self, shared: Array, hold: Array) -> Array:
        away = ((self.log_tau - shared[:, None, :]) ** 2).sum(axis=(1, 2))
        return np.asarray(self.sse + self.alpha * (self.gain**2).sum(axis=1) + hold * away)

    def step(self, pool: Pool, shared: Array, hold: Array) -> Array:
        """The Gauss–Newton step in log τ, (F, S, L), gains moving along."""
        n_fits, n_sources, n_poles = self.log_tau.shape
        p, n_lags = self.gain.shape[1], n_sources * n_poles
        moved = self.slope * self.gain[:, None, p - n_lags :]
        across = np.concatenate([self.weight, moved], axis=2).transpose(0, 2, 1)
        rest = pool.xy - (self.xx_weight @ self.gain[:, :, None])[:, :, 0]
        right = (across @ rest[:, :, None])[:, :, 0]
        away = (self.log_tau - shared[:, None, :]).transpose(0, 2, 1).reshape(n_fits, -1)
        right -= np.concatenate([self.alpha[:, None] * self.gain, hold[:, None] * away], axis=1)
        matrix = across @ np.concatenate([self.xx_weight, pool.xx @ moved], axis=2)
        ridge = [np.repeat(self.alpha[:, None], p, axis=1), np.repeat(hold[:, None], n_lags, axis=1)]
        np.einsum("fjj->fj", matrix)[:] += np.concatenate(ridge, axis=1)
        step = np.linalg.solve(matrix, right[:, :, None])[:, p:, 0]
        return np.clip(step, -_LONGEST_STEP, _LONGEST_STEP).reshape(n_fits, n_poles, -1).transpose(0, 2, 1)

    def where(self, better: NDArray[np.bool_], other: Self) -> Self:
        """`other` in the fits where it is better."""
        parts = {
            name: np.where(better.reshape(-1, *[1] * (old.ndim - 1)), getattr(other, name), old)
            for name, old in vars(self).items()
        }
        return replace(self, **parts)


def refined(
    pool: Pool, yy: Array, direct: NDArray[np.bool_], shared: Array, penalty: Array, rows: Array
) -> tuple[Array, Array]:
    """Each source's poles by itself: penalised Gauss–Newton on log τ, shortened until it helps (variable projection).

    Minimises `|y − Σ g v|² + α |g|² + σ² m |log τ − log τ_shared|² / looseness²`: α is the ridge of `ridge_path`, σ²
    the residual variance, and the m rows of a batch count as one observation, because they are not independent.

    Args:
        pool: sums over the dictionary's columns of the S sources in the order of `Dictionary.block`, F sets.
        yy: the target's centred sum of squares, (F,). shared: log τ of the poles that all sources start from, (F, L).
        penalty: k of `ridge_path`, (F,). rows: mean rows per batch, (F,).

    Returns:
        log τ (F, S, L) and gains (F, D + L S) of the columns of `combination`.
    """
    now = _Solved.at(np.repeat(shared[:, None, :], len(direct), axis=1), pool, yy, direct, penalty)
    share = np.ones(len(shared))
    for _ in range(_STEPS if shared.shape[1] else 0):
        hold = rows * now.sse / np.maximum(pool.count, 1.0) / _LOOSENESS**2 + EPS * (yy + 1.0)
        moved = now.log_tau + share[:, None, None] * now.step(pool, shared, hold)
        trial = _Solved.at(np.clip(moved, *np.log(TAUS_S[[0, -1]])), pool, yy, direct, penalty)
        better = trial.cost(shared, hold) < now.cost(shared, hold)
        now, share = now.where(better, trial), np.where(better, np.minimum(2.0 * share, 1.0), 0.3 * share)
    return now.log_tau, now.gain
