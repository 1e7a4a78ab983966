"""The linear algebra of a calibration's step: batches joined by shared parameters, each with nuisances of its own.

The normal matrix has the shape of an arrow: a block per batch and a border for the parameters. A triangular
factor per batch eliminates its nuisances (Golub & Plemmons 1980), so one batch lives in memory at a time.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack
from scipy.optimize import lsq_linear

from data.arrays import Array
from data.errors import WorkError
from twin.calibration.fit_problem import Block, Unknown

# Above this squared column norm the Gram matrix loses the prior's 1 to rounding: Householder QR instead.
GRAM_LIMIT = 1e9


@dataclass(frozen=True)
class Corner:
    """What is kept of one batch: its nuisances' optimum is ``corner⁻¹ (target − coupling dz)``."""

    corner: Array  # (q, q) upper triangular
    coupling: Array  # (q, p)
    target: Array  # (q,)

    def step(self, dz: Array, share: float = 1.0) -> Array:
        """The nuisances' step (q,): all that a parameter step dz (p,) requires, and `share` of their own.

        Without the step that dz requires, dz would not lead downhill: it is the step of the cost at their optimum.
        """
        return _solve(self.corner, share * self.target - self.coupling @ dz)


@dataclass(frozen=True)
class Arrow:
    """The linearised cost in z = (x − prior) / spread, nuisances at their optimum: ``|target − root dz|² + const``.

    `root` (p, p) is upper triangular and holds the prior too: ``rootᵀ root = data information + 1``.
    """

    root: Array
    target: Array
    corners: tuple[Corner, ...]

    @property
    def information(self) -> Array:
        """The data's information (p, p) in z, nuisances marginalised, without the parameters' prior."""
        return self.root.T @ self.root - np.eye(len(self.root))

    @property
    def covariance(self) -> Array:
        """The posterior covariance (p, p) in z."""
        inverse = _solve(self.root, np.eye(len(self.root)))
        return inverse @ inverse.T

    def effective_parameters(self) -> float:
        """How many parameters and nuisances the data determine rather than the prior: ``trace(H (H + prior)⁻¹)``."""
        covariance = self.covariance
        total = len(covariance) - float(np.trace(covariance))
        for c in self.corners:
            inverse = _solve(c.corner, np.eye(len(c.corner)))
            shift = inverse @ c.coupling
            total += len(inverse) - float(np.sum(inverse**2) + np.sum((shift @ covariance) * shift))
        return total

    def step(self, damping: float, low: Array, high: Array) -> Array:
        """The minimum dz (p,) of the linearised cost plus ``damping |dz|²`` within low ≤ dz ≤ high, all (p,)."""
        p = len(self.root)
        rows = np.vstack([self.root, np.sqrt(damping) * np.eye(p)]) if damping > 0 else self.root
        aim = np.concatenate([self.target, np.zeros(len(rows) - p)])
        system = np.column_stack([rows, aim])
        root, target = triangle(system, system.T @ system)
        dz = _solve(root, target)
        if np.all((dz >= low) & (dz <= high)):
            return dz
        bounded = lsq_linear(root, target, bounds=(low, high), method="bvls", tol=1e-14, max_iter=20 * p)
        return np.clip(bounded.x, low, high)

    def gain(self, dz: Array, share: float = 1.0) -> float:
        """Decrease of the linearised cost with dz (p,) and `share` of the nuisances' own step."""
        before = self.target @ self.target
        rest = self.target - self.root @ dz
        after = rest @ rest
        for c in self.corners:
            before += c.target @ c.target
            after += (1 - share) ** 2 * (c.target @ c.target)
        return float(before - after)


def assemble(
    blocks: Iterable[Block], nuisance: Sequence[Array], z: Array, unknowns: Sequence[Unknown], weight: Array
) -> Arrow:
    """The arrow system of the blocks at z (p,) and the nuisances (B arrays (q_b,)); `weight` (channels,) of the rows.

    Every batch takes an equal share of the prior, so that each factor is regular on its own.

    Raises:
        WorkError: a block is not finite; names the batch and the channel or the parameter.
    """
    p = len(z)
    spread = np.array([u.spread for u in unknowns])
    prior = 1.0 / np.sqrt(max(1, len(nuisance)))
    total = np.zeros((p, p + 1))  # sum of the Gram matrices of all batches
    large = np.zeros((0, p + 1))  # and as a triangle, of those whose Gram matrices would lose the prior
    corners = []
    for block, current in zip(blocks, nuisance, strict=True):
        n, q = block.nuisance.shape
        row = np.sqrt(weight[block.channel])[:, None]
        system = np.empty((n, q + p + 1))
        np.multiply(row, block.nuisance, out=system[:, :q])
        np.multiply(block.jacobian, spread, out=system[:, q:-1])
        system[:, q:-1] *= row
        np.multiply(row[:, 0], block.residual, out=system[:, -1])
        own = np.concatenate([np.ones(q), np.full(p, prior)])
        aim = -np.concatenate([current, prior * z])
        gram = system.T @ system
        gram[np.arange(q + p), np.arange(q + p)] += own**2
        gram[:-1, -1] += own * aim
        if not np.isfinite(gram.trace()):
            raise WorkError(_not_finite(block, unknowns))
        kept = _without_nuisances(gram, q)
        if kept is None:
            both = np.vstack([system, np.column_stack([np.diag(own), aim])])
            root, target = triangle(both, both.T @ both)
            corner = Corner(root[:q, :q].copy(), root[:q, q:].copy(), target[:q].copy())
            large = np.vstack([large, np.column_stack([root[q:, q:], target[q:]])])
            large = np.column_stack(triangle(large, large.T @ large))
        else:
            corner, left = kept
            total += left
        corners.append(corner)
    if total.any():  # regular: every batch brings its share of the prior
        root = lapack.dpotrf(total[:, :p], lower=0, clean=1)[0]
        rows = np.column_stack([root, _solve(root, total[:, p], transposed=True)])
        if not len(large):
            return Arrow(root, rows[:, p], tuple(corners))
        large = np.vstack([large, rows])
    return Arrow(*triangle(large, large.T @ large), tuple(corners))


def _without_nuisances(gram: Array, q: int) -> tuple[Corner, Array] | None:
    """The corner of a Gram matrix (q + p + 1 square) and its Schur complement (p, p + 1); None where rounding forbids
    it."""
    if gram.diagonal()[:-1].max(initial=0.0) >= GRAM_LIMIT:
        return None
    corner, failed = lapack.dpotrf(gram[:q, :q], lower=0, clean=1) if q else (np.zeros((0, 0)), 0)
    if failed:
        return None
    coupling = _solve(corner, gram[:q, q:], transposed=True)
    left = gram[q:-1, q:] - coupling[:, :-1].T @ coupling
    return Corner(corner, coupling[:, :-1], coupling[:, -1]), left


def triangle(system: Array, gram: Array) -> tuple[Array, Array]:
    """The upper triangular R (m, m) and c (m,) with ``|A y − b|² = |R y − c|² + const`` for a system [A b] (n, m + 1).

    Cholesky of its Gram matrix where rounding allows it (several times faster), Householder QR where it does not.
    """
    m = len(gram) - 1
    if gram.diagonal()[:m].max(initial=0.0) < GRAM_LIMIT:
        root, failed = lapack.dpotrf(gram[:m, :m], lower=0, clean=1)
        if not failed:
            return root, _solve(root, gram[:m, m], transposed=True)
    factor = lapack.dgeqrf(np.asfortranarray(system), lwork=32 * (m + 1))[0][:m]
    return np.triu(factor[:, :m]), np.ascontiguousarray(factor[:, m])


def _not_finite(block: Block, unknowns: Sequence[Unknown]) -> str:
    """What of a block is not finite: its rows, or the derivative by which parameter."""
    bad = int(np.count_nonzero(~np.isfinite(block.residual)))
    if bad:
        return f"batch {block.batch_id!r}: {bad} of {len(block.residual)} modelled rows are not finite"
    columns = np.flatnonzero(~np.isfinite(block.jacobian).all(axis=0))
    if len(columns):
        return f"batch {block.batch_id!r}: the derivative by {unknowns[columns[0]].name!r} is not finite"
    if not np.isfinite(block.nuisance).all():
        return f"batch {block.batch_id!r}: the derivative by its initial state or an offset is not finite"
    return f"batch {block.batch_id!r}: residuals or derivatives are too large to square"


def _solve(root: Array, right: Array, transposed: bool = False) -> Array:
    """``root⁻¹ right`` for an upper triangular root, which may be empty."""
    if root.size == 0 or right.size == 0:
        return np.zeros(right.shape)
    return np.asarray(lapack.dtrtrs(root, right, lower=0, trans=int(transposed))[0])
