"""The linear part of the nets: a ridge on the inputs and on how far their lagged selves are behind them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.base import Array
from models.linear import Pool
from models.parts.sequences import Sequences
from models.ridge import Ridge

LAG_STEPS = (1.0, 2.5, 6.3, 16.0)  # time constants, in steps of the sequence
_SHARES = (0.3, 0.03)  # of the lags: how much weaker their columns are before the common penalty
_SHARE_OF_FEW = (0.01,)  # of one or two batches, which cannot tell memory from drift
_DIRECTIONS = 6  # leading principal directions of the inputs that have a memory


def memory_columns(x: Array) -> Array:
    """Sequences x (…, T, p) beside lag_l x − x of every lag, (…, T, (L + 1) p).

    lag is the first-order lag τ dv/dt + v = x, exact for x held over the step before, at rest (0) before the start.
    """
    keep = np.exp(-1.0 / np.array(LAG_STEPS))[:, None]
    out = np.empty((*x.shape[:-1], len(LAG_STEPS) + 1, x.shape[-1]))
    state = np.zeros_like(out[..., 0, 1:, :])
    for t in range(x.shape[-2]):
        now = x[..., t, None, :]
        state = keep * state + (1.0 - keep) * now
        out[..., t, :1, :], out[..., t, 1:, :] = now, state - now
    return out.reshape(*x.shape[:-1], -1)


def fit_memories(sequences: Sequences, columns: Array, folds: Sequence[Sequence[int]]) -> tuple[Array, Array]:
    """Ridge on the columns of the sequences' x: coefficients (F, (L + 1) p), µm per unit of x, and intercepts (F,).

    The lags act on the 6 leading principal directions of the inputs. The penalty, and how much stronger it is on the
    lags, are chosen by leave-batch-out inside each fold; a fold of one or two batches has the lags' share fixed.
    """
    design = sequences.as_design(columns)
    coef, intercept_um = np.empty((len(folds), columns.shape[-1])), np.empty(len(folds))
    for few, shares in ((False, _SHARES), (True, _SHARE_OF_FEW)):
        which = [f for f, fold in enumerate(folds) if (len(fold) < 3) == few]
        for f, fitted in zip(which, _MemoryRidge(shares).fit_folds(design, [folds[f] for f in which]), strict=True):
            coef[f], intercept_um[f] = fitted.fitted["coef_um_per_K"], fitted.fitted["intercept_um"]
    return coef, intercept_um


class _MemoryRidge(Ridge):
    tells_sd = False  # the nets do not, and it costs

    def __init__(self, shares: tuple[float, ...]) -> None:
        super().__init__()
        self.shares = shares

    def _path(self, pool: Pool) -> Array:
        p = pool.xx.shape[1] // (len(LAG_STEPS) + 1)
        leading = np.linalg.eigh(pool.xx[:, :p, :p])[1][:, :, : -_DIRECTIONS - 1 : -1]
        some = leading.shape[2]
        onto = np.zeros((len(pool.xx), pool.xx.shape[1], p + some * len(LAG_STEPS)))
        onto[:, :p, :p] = np.eye(p)
        for lag in range(len(LAG_STEPS)):
            onto[:, p * (lag + 1) : p * (lag + 2), p + some * lag : p + some * (lag + 1)] = leading
        paths = []
        for share in self.shares:
            onto[:, p:, p:] *= share
            back = np.swapaxes(onto, 1, 2)
            narrow = replace(pool, xx=back @ pool.xx @ onto, xy=(back @ pool.xy[:, :, None])[..., 0],
                             scale=np.ones(onto.shape[::2]))  # fmt: skip
            paths.append(onto @ super()._path(narrow) / pool.scale[:, :, None])
            onto[:, p:, p:] /= share
        return np.concatenate(paths, axis=2)

    def _setting(self, pool: Pool, chosen: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        return {}
