"""Family: transfer function, a sum of first-order responses to temperatures, drivers and the start state."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Self

import numpy as np

from data.arrays import Array, Mask
from data.errors import InputError
from features.design import Design
from models.base import Family
from models.linear import Task, left_out_spread, mean_square, stated_sd_um
from models.program import Builder
from models.solvers.batches import fold_masks, only, padded, steps_s, unpadded
from models.solvers.lags import behind
from models.solvers.poles import (
    PENALTIES,
    TAUS_S,
    Candidate,
    Dictionary,
    Source,
    combination,
    drivers_of,
    gaps_of,
    refined,
    searched,
)
from models.solvers.pooled_sums import Blocks, ridge_path

_FEWEST_ROWS = 8
_MOST_INPUTS = 60
_ENOUGH_BATCHES = 3


class TransferFunction(Family):
    """`y = Σ_i [ k_i u_i + Σ_l K_il / (τ_il s + 1) u_i ]`, at most two poles per input, from rest, running free.

    Two poles stand as the sum of their partial fractions, which contains the cascade K / ((τ1 s + 1)(τ2 s + 1)):
    K τ1 / (τ1 − τ2) and K τ2 / (τ2 − τ1). Inputs are the chosen sensors; their direct term is near a lead. With
    `gaps` also how far each of them stands off the room at the start, as a step: castings that have not settled
    overnight relax like that; it takes two training batches per sensor. With `drivers` also (|n| / 1000 rpm)^m, m 1,
    1.5 or 2, other drivers and the ambient rise.

    In every fold leave-batch-out over its training batches chooses on a grid from 2 min to 12 h the poles that all
    inputs start from, whether gaps and drivers take part, and the ridge on the gains. Then each input's poles move by
    themselves. With fewer than three training batches only direct terms of the sensors are fitted. What some batch of
    the design lacks takes no part.

    `fitted`: per input kind, name and exponent, direct_um (µm per unit), gain_um and tau_s (inputs, poles).

    Source: L. Ljung, System Identification (1999), output-error models, eq. 4.25; the gains between steps of the
    poles: G. Golub and V. Pereyra, SIAM J. Numer. Anal. 10 (1973), variable projection.
    """

    key = "transfer_function"
    summary = "first-order responses to the sensors and to what is not settled at the start"
    source = "Ljung 1999, eq. 4.25; Golub and Pereyra 1973"
    closed_form = False
    rowwise = False
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
        """Predictive standard deviation (n_k,) of a recorded value, see `models.linear.stated_sd_um`."""
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
        spread = np.transpose(left_out_spread(task, grows, path, chosen)).tolist()
        names = ("variance_um2", "variance_growth_um2")
        return [
            self._learned(design, {**plain, "direct_um": direct_um[f], "gain_um": gain_um[f],
                                   "tau_s": np.exp(log_tau[f]), "intercept_um": float(intercept[f]),
                                   "k": float(PENALTIES[chosen[f]]),
                                   **(dict(zip(names, spread[f], strict=True)) if np.isfinite(spread[f][0]) else {})})
            for f in range(len(masks))
        ]  # fmt: skip
