"""A Gaussian process on a few rows: a regression that says where it has seen nothing."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from features.design import Design
from models.base import Array, Family
from models.batchwise import too_few_rows

_FEWEST = 4


class GaussianProcess(Family):
    """A straight line and about it a squared exponential with one length per input, plus noise.

    Hyper-parameters by marginal likelihood; far from all rows the prediction follows the line and says so.

    It learns from at most `n_rows` rows, drawn by `seed` and the same number from each batch as far as it has them.
    Inputs and target are scaled by their training spread.
    A part of `twin_residual`, not of the grid. `fitted` holds rows, weights and the triangular factor.
    """

    key = "gaussian_process"
    words = "Gaussian process: linear plus squared exponential"
    source = "Rasmussen and Williams (2006), algorithm 2.1, eqs. 4.9 and 4.27"
    closed_form = False

    def __init__(self, n_rows: int = 400, seed: int = 0) -> None:
        super().__init__()
        self.n_rows, self.seed = int(n_rows), int(seed)

    def fit_design(self, design: Design, train: Sequence[int]) -> Self:
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.gaussian_process import GaussianProcessRegressor
        from sklearn.gaussian_process.kernels import RBF, ConstantKernel, DotProduct, WhiteKernel

        x, y, group = design.stacked(train)
        if len(y) < _FEWEST:
            raise too_few_rows(self.key, design, train, len(y), _FEWEST)
        rows = self._drawn(group)
        x, y = x[rows], y[rows]
        centre, scale = x.mean(axis=0), _spread(x)
        mean, size = float(y.mean()), float(_spread(y[:, None])[0])
        kernel = (
            ConstantKernel(0.3, (1e-3, 1e2)) * RBF(np.full(x.shape[1], 2.0), (0.1, 100.0))
            + ConstantKernel(0.3, (1e-3, 1e2)) * DotProduct(0.0, "fixed")
            + WhiteKernel(0.1, (1e-4, 1.0))
        )
        regression = GaussianProcessRegressor(kernel, random_state=self.seed)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # a length at its bound is an input that says nothing
            regression.fit((x - centre) / scale, (y - mean) / size)
        found = regression.kernel_
        return self._learned(design, {
            "x": regression.X_train_, "weights": np.asarray(regression.alpha_), "factor": np.asarray(regression.L_),
            "centre": centre, "scale": scale, "mean_um": mean, "size_um": size,
            "variance": float(found.k1.k1.k1.constant_value), "length": np.atleast_1d(found.k1.k1.k2.length_scale),
            "slope": float(found.k1.k2.k1.constant_value), "noise": float(found.k2.noise_level),
        })  # fmt: skip

    def predict_design(self, design: Design, batches: Sequence[int]) -> list[Array]:
        f = self.fitted
        out = []
        for k in batches:
            x = design.x[design.rows(k)]
            out.append(f["mean_um"] + f["size_um"] * (self._kernel(x) @ f["weights"]))
        return out

    def sd_um(self, design: Design, batches: Sequence[int]) -> list[Array]:
        """Predictive standard deviation (n_k,) of a recorded value, noise included."""
        f = self.fitted
        out = []
        for k in batches:
            x = design.x[design.rows(k)]
            kernel, own = self._kernel(x), f["variance"] + f["slope"] * (self._scaled(x) ** 2).sum(axis=1)
            known = np.full(kernel.T.shape, np.nan)
            ok = np.isfinite(kernel).all(axis=1)
            known[:, ok] = solve_triangular(f["factor"], kernel[ok].T, lower=True)
            out.append(f["size_um"] * np.sqrt(np.maximum(own - (known**2).sum(axis=0), 0.0) + f["noise"]))
        return out

    def n_parameters(self) -> int:
        """One weight per row, a length per input, variance, slope and noise."""
        return int(self.fitted["weights"].size + self.fitted["length"].size + 3) if self.fitted else 0

    def _kernel(self, x: Array) -> Array:
        f, scaled = self.fitted, self._scaled(x)
        a, b = scaled / f["length"], f["x"] / f["length"]
        square = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2 * a @ b.T
        return np.asarray(f["variance"] * np.exp(-0.5 * np.maximum(square, 0.0)) + f["slope"] * scaled @ f["x"].T)

    def _scaled(self, x: Array) -> Array:
        return np.asarray((x - self.fitted["centre"]) / self.fitted["scale"])

    def _drawn(self, group: NDArray[np.int64]) -> NDArray[np.int64]:
        rng = np.random.default_rng(self.seed)
        ids = np.unique(group)
        each = max(1, self.n_rows // len(ids))
        return np.concatenate([np.sort(rng.permutation(np.flatnonzero(group == g))[:each]) for g in ids])


def _spread(x: Array) -> Array:
    out = x.std(axis=0)
    return np.where(out > 0, out, 1.0)
