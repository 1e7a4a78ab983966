"""The elastic net of many training sets at once against scikit-learn's solvers, medians of one run.

- selection: `active_inputs`, the exact path on 50 halves of the batches, against `lars_path_gram` half by half;
- fit: `sparse_coefficients` on 25 penalties of 3 mixings for each of 30 folds, against `enet_path` on Gram matrices.

Inputs are correlated like the temperatures of one machine. Both sides start from the products of inputs and target, so
that neither pays for the rows. Results agree to 1e-6; run with OMP_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse

import numpy as np
from sklearn.linear_model import enet_path, lars_path_gram

from benchmarks.table import Row, markdown, median_s
from data.arrays import Array
from features.selectors.elastic_net_path import active_inputs
from models.families.elastic_net import sparse_coefficients

INPUTS, ROWS, HALVES, FOLDS = 10, 600, 50, 30
LEVELS, PENALTIES, MIXINGS = np.geomspace(1.0, 1e-3, 50), np.geomspace(1.0, 1e-4, 25), (1.0, 0.5, 0.1)


def problems(n: int, seed: int = 0) -> tuple[Array, Array]:
    """Correlations (n, p, p) of the inputs and (n, p) with the target."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, ROWS, 3)) @ rng.normal(size=(3, INPUTS)) + 0.2 * rng.normal(size=(n, ROWS, INPUTS))
    y = x @ rng.normal(size=INPUTS) + rng.normal(size=(n, ROWS))
    x = (x - x.mean(axis=1, keepdims=True)) / x.std(axis=1, keepdims=True)
    y = (y - y.mean(axis=1, keepdims=True)) / y.std(axis=1, keepdims=True)
    return np.einsum("sri,srj->sij", x, x) / ROWS, np.einsum("sri,sr->si", x, y) / ROWS


def lars_active(xx: Array, xy: Array) -> Array:
    """Coefficients (S, L, p) of scikit-learn's exact path at the levels: it is linear between its steps."""
    out = np.empty((len(xx), len(LEVELS), INPUTS))
    for s, (g, r) in enumerate(zip(xx, xy, strict=True)):
        alphas, _, path = lars_path_gram(Xy=r, Gram=g, n_samples=1, method="lasso")
        out[s] = np.stack([np.interp(LEVELS, alphas[::-1], row[::-1]) for row in path], axis=1)
    return out


def ours(xx: Array, xy: Array) -> Array:
    """Coefficients (S, penalties, mixings, p) by active sets, each penalty from the one before."""
    m = len(MIXINGS)
    xx_m, xy_m, highest = (np.repeat(a, m, axis=0) for a in (xx, xy, np.abs(xy).max(axis=1)))
    beta, out = np.zeros_like(xy_m), []
    for k in PENALTIES:
        absolute = k * highest
        beta = sparse_coefficients(
            xx_m, xy_m, absolute, absolute * np.tile(1.0 / np.array(MIXINGS) - 1.0, len(xy)), beta
        )
        out.append(beta.reshape(len(xy), m, -1))
    return np.stack(out, axis=1)


def descent(xx: Array, xy: Array, tol: float) -> Array:
    """The same by scikit-learn's coordinate descent; rows are a Cholesky factor, as few as there are inputs."""
    out = np.empty((len(xx), len(PENALTIES), len(MIXINGS), INPUTS))
    for s, (g, r) in enumerate(zip(xx, xy, strict=True)):
        rows = np.linalg.cholesky(g + 1e-13 * np.eye(INPUTS)).T * np.sqrt(INPUTS)
        target = np.linalg.solve(rows.T, r * INPUTS)
        for j, mixing in enumerate(MIXINGS):
            alphas = PENALTIES * np.abs(r).max() / mixing
            _, path, _ = enet_path(
                rows, target, l1_ratio=mixing, alphas=alphas, precompute=rows.T @ rows, Xy=r * INPUTS, tol=tol,
                max_iter=100_000, check_input=False,
            )  # fmt: skip
            out[s, :, j] = path.T
    return out


def rows(repeats: int) -> list[Row]:
    """Rows of the table: selection, and the fit at scikit-learn's own tolerance and at an exact one."""
    xx, xy = problems(HALVES)
    a, b = (median_s(f, repeats) for f in (lambda: active_inputs(xx, xy, LEVELS), lambda: lars_active(xx, xy)))
    out = [Row(f"elastic net, selection, {HALVES} halves", a, "scikit-learn, lars_path_gram", b)]
    xx, xy = problems(FOLDS, 1)
    a = median_s(lambda: ours(xx, xy), repeats)
    for tol in (1e-4, 1e-12):
        b = median_s(lambda tol=tol: descent(xx, xy, tol), repeats)  # type: ignore[misc]
        out.append(Row(f"elastic net, fit, {FOLDS} folds", a, f"scikit-learn, enet_path, tol {tol:g}", b))
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=7)
    repeats = parser.parse_args().repeats
    xx, xy = problems(HALVES)
    own, theirs = active_inputs(xx, xy, LEVELS), lars_active(xx, xy)
    print(f"selection: {np.mean(own == (np.abs(theirs) > 1e-9)):.4%} of the active inputs agree")
    xx, xy = problems(FOLDS, 1)
    found = ours(xx, xy)
    for tol in (1e-4, 1e-12):
        print(f"fit, tol {tol:g}: largest difference {np.abs(found - descent(xx, xy, tol)).max():.1e}")
    print(markdown(rows(repeats)))


if __name__ == "__main__":
    main()
