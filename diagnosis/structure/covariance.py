"""The covariance of all rows under structural discrepancy, and least squares under it.

``Σ = blockdiag_c(σ_c² I + B_c) + Σ_g s_g² R_g R_gᵀ / D_g + E Eᵀ``: white noise of every channel c; misfits R_g (n, D_g)
of refined twins that were recalibrated to the lump, in groups g from stiff to soft machines; per channel what no
combination of the other draws makes of a draw (B_c), so that some draws do not pass for all machines; and E, mild
physics that every machine has and no file states. The scales s_g maximise the marginal likelihood of the recordings.
Everything is solved by the Woodbury identity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from data.arrays import Array
from data.errors import WorkError
from diagnosis.structure.policy import STRUCTURE
from diagnosis.structure.rows import Linear, Rows
from twin.calibration.fit_problem import Unknown

Factor = tuple[Array, bool]
MAD_TO_SD = 1.4826  # of a normal distribution


def white_noise(rows: Rows, residual: Array) -> Array:
    """White noise (C,) of every channel in units of the given noise, at least 1.

    From second differences within each batch, by their median absolute value (Rice 1984, Ann. Stat. 12, 1215): a slow
    misfit hardly counts there, and a few jumps do not either.
    """
    out = np.ones(rows.channels)
    for c, own in enumerate(rows.of_channel):
        pieces = np.split(residual[own], np.flatnonzero(np.diff(np.searchsorted(rows.edges, own, "right"))) + 1)
        second = [np.diff(p, 2) for p in pieces if len(p) > 2]
        if second:
            out[c] = max(1.0, float(MAD_TO_SD * np.median(np.abs(np.concatenate(second))) / np.sqrt(6.0)))
    return out


@dataclass(frozen=True)
class Blocks:
    """The part of the covariance that joins rows of one channel alone, ready for its inverse square root.

    `bases` are orthonormal (n_c, r_c), `power` (r_c,) the variance along them over the noise's.
    """

    rows: Rows
    sd: Array
    bases: tuple[Array, ...]
    power: tuple[Array, ...]

    @classmethod
    def of(cls, rows: Rows, sd: Array, draws: Array) -> Blocks:
        """What each of the draws (n, D) leaves outside the span of the others, channel by channel."""
        n_draws = draws.shape[1]
        if n_draws < 2:
            none = tuple(np.zeros((len(own), 0)) for own in rows.of_channel)
            return cls(rows, sd, none, tuple(np.zeros(0) for _ in none))
        scaled = draws / sd[rows.channel][:, None]
        inverse = np.linalg.inv(scaled.T @ scaled + np.eye(n_draws))
        left = scaled @ (inverse / np.diag(inverse))
        bases, power = [], []
        for own in rows.of_channel:
            basis, singular, _ = np.linalg.svd(left[own], full_matrices=False)
            variance = singular**2 / n_draws
            kept = variance > STRUCTURE.block_min_variance
            bases.append(basis[:, kept])
            power.append(variance[kept])
        return cls(rows, sd, tuple(bases), tuple(power))

    def whitened(self, values: Array) -> Array:
        """Rows (n, …) times the inverse square root of the block-diagonal part."""
        out = np.empty(values.shape)
        for c, own in enumerate(self.rows.of_channel):
            x = values[own] / self.sd[c]
            basis = self.bases[c]
            if basis.shape[1]:
                damped = 1.0 - 1.0 / np.sqrt(1.0 + self.power[c])
                x = x - basis @ (damped * (basis.T @ x).T).T
            out[own] = x
        return out


@dataclass(frozen=True, eq=False)
class Covariance:
    """Σ. Rows that are `whitened` have the block-diagonal part taken out; `projected` does the rest.

    Attributes:
        scales: (G,) s of every group of draws.
        columns: (n, r) whitened columns of the low-rank part.
        factor: Cholesky of ``I + columnsᵀ columns``.
        prior_sd: of every shared unknown, in its prior sd: a lump's value is an effective one, which differs from the
            handbook's by as much as structure makes it; 1 for unknowns that are not named.
    """

    blocks: Blocks
    scales: Array
    columns: Array
    factor: Factor
    prior_sd: dict[str, float]

    @property
    def rows(self) -> Rows:
        return self.blocks.rows

    @property
    def sd(self) -> Array:
        """White noise (C,) in units of the given noise."""
        return self.blocks.sd

    @property
    def log_determinant(self) -> float:
        """log det Σ."""
        every = zip(self.rows.of_channel, self.sd, self.blocks.power, strict=True)
        blocks = sum(2.0 * len(own) * np.log(sd) + np.log1p(power).sum() for own, sd, power in every)
        return float(blocks + 2.0 * np.log(np.diag(self.factor[0])).sum())

    def whitened(self, values: Array) -> Array:
        return self.blocks.whitened(values)

    def projected(self, whitened: Array) -> Array:
        """Whitened rows (n, …) times the rest of Σ⁻¹: ``xᵀ Σ⁻¹ y`` is ``whitened(x)ᵀ projected(whitened(y))``."""
        return np.asarray(whitened - self.columns @ cho_solve(self.factor, self.columns.T @ whitened))

    def prior_of(self, names: Sequence[str]) -> Array:
        """Prior sd (p,) of unknowns by name, in units of their file's."""
        return np.array([self.prior_sd.get(name, 1.0) for name in names])


def recalibrated(linear: Linear, draws: Array, sd: Array, free: Array) -> tuple[Array, Array]:
    """Misfits (n, D) that are left once the lump has been fitted to each, and the shared unknowns' moves (p, D).

    One linearised step; `free` (p,) is how far, in prior sd, a lump's effective value may lie from the handbook's.
    """
    p = linear.jacobian.shape[1]
    columns = np.hstack([linear.jacobian * free, linear.nuisance])
    weight = 1.0 / sd[linear.rows.channel][:, None]
    scaled = columns * weight
    moves = cho_solve(cho_factor(scaled.T @ scaled + np.eye(columns.shape[1])), scaled.T @ (draws * weight))
    return draws - columns @ moves, moves[:p] * free[:, None]


def freedom(unknowns: Sequence[Unknown]) -> Array:
    """How far (p,), in prior sd, structure may move the effective value of each unknown of a lump."""
    log_sd, sd = STRUCTURE.effective_log_sd, STRUCTURE.effective_sd
    return np.array([max(1.0, log_sd / u.spread) if u.scale == "log" else sd for u in unknowns])


def covariance_at(
    linear: Linear,
    unknowns: Sequence[Unknown],
    draws: Sequence[Array],
    films: Array,
    varying: Array,
    sd: Array,
    scales: Array,
) -> Covariance:
    """The covariance about a linearised fit.

    Args:
        unknowns: the shared ones.
        draws: of every group (n, D_g) misfits of refined twins: stiff, soft and very soft machines.
        films, varying: (n, f) and (n, m) columns of physics that every machine has, per prior sd; of a film only what
            no constant film shows.
        scales: (G,) of the groups, from the fit before; the blocks take them, the rest starts from them.
    """
    free, names = freedom(unknowns), [u.name for u in unknowns]
    every, moves = recalibrated(linear, np.hstack(draws), sd, free)
    mild = np.hstack([recalibrated(linear, films, sd, free)[0], varying])
    group = np.repeat(np.arange(len(draws)), [d.shape[1] for d in draws])
    share = 1.0 / np.sqrt(np.maximum(np.bincount(group, minlength=len(draws)), 1))[group]
    moved = np.sum((moves * share * scales[group]) ** 2, axis=1)
    prior_sd = np.minimum(np.sqrt(1.0 + moved), free)
    blocks = Blocks.of(linear.rows, sd, every * scales[group])
    whitened = blocks.whitened(np.hstack([every * share, mild, linear.jacobian * prior_sd, linear.nuisance]))
    target = blocks.whitened(linear.target)
    scales = _likeliest(whitened.T @ whitened, whitened.T @ target, group, scales)
    structural = whitened[:, : len(group) + mild.shape[1]] * np.append(scales[group], np.ones(mild.shape[1]))
    columns = _compressed(structural)
    factor = cho_factor(columns.T @ columns + np.eye(columns.shape[1]))
    return Covariance(blocks, scales, columns, factor, dict(zip(names, prior_sd.tolist(), strict=True)))


def _likeliest(gram: Array, along: Array, group: NDArray[np.int64], scales: Array) -> Array:
    """Scales (G,) of the highest marginal likelihood, one group after the other until none changes."""

    def likelihood(at: Array) -> float:
        times = np.ones(len(gram))
        times[: len(group)] = at[group]
        root = cho_factor(gram * times[:, None] * times + np.eye(len(gram)))
        seen = along * times
        return 0.5 * float(seen @ cho_solve(root, seen)) - float(np.log(np.diag(root[0])).sum())

    best = scales.copy()
    known: dict[tuple[float, ...], float] = {}
    for _ in range(STRUCTURE.scale_rounds):
        before = best.copy()
        for g in range(len(best)):
            for s in STRUCTURE.scales:
                at = best.copy()
                at[g] = s
                if tuple(at) not in known:
                    known[tuple(at)] = likelihood(at)
            best = np.array(max((k for k in known if np.array_equal(np.delete(k, g), np.delete(best, g))),
                                key=lambda k: known[k]))  # fmt: skip
        if np.array_equal(before, best):
            break
    return best


def _compressed(columns: Array) -> Array:
    """Fewer columns with the same C Cᵀ, without directions whose energy in all rows is far below one value's noise."""
    square, turn = np.linalg.eigh(columns.T @ columns)
    return np.asarray(columns @ turn[:, square > STRUCTURE.least_energy])


@dataclass(frozen=True)
class Normal:
    """The normal equations of shared and own unknowns under a covariance, in units of the prior sd.

    Attributes:
        z, own: the point, as in `Linear`; `prior` (p,) the prior sd of the shared unknowns.
        hessian: (p + q, p + q) half of the second derivative of the objective; `downhill` (p + q,) of the first.
    """

    z: Array
    own: Array
    prior: Array
    hessian: Array
    downhill: Array

    def step(self, damping: float) -> tuple[Array, Array]:
        """Where a Gauss-Newton step leads, z and own, damped as by Levenberg (1944) in units of the prior."""
        p = len(self.prior)
        moved = cho_solve(_factor(self.hessian + damping * np.eye(len(self.hessian))), self.downhill)
        return self.z + moved[:p] * self.prior, self.own + moved[p:]

    @property
    def expected_fall(self) -> float:
        """By how much the linear problem expects the objective to fall, undamped."""
        return float(self.downhill @ cho_solve(_factor(self.hessian), self.downhill))

    def covariance(self) -> Array:
        """(p, p) posterior covariance of the shared unknowns z."""
        p = len(self.prior)
        inverse = cho_solve(_factor(self.hessian), np.eye(len(self.hessian))[:, :p])[:p]
        return np.asarray(inverse * np.outer(self.prior, self.prior))

    @property
    def log_volume(self) -> float:
        """Half the log determinant of the posterior precision, nats."""
        return float(np.log(np.diag(_factor(self.hessian)[0])).sum())


def _factor(hessian: Array) -> Factor:
    """Cholesky factor; where rounding has made the smallest eigenvalues negative they are raised by as much.

    Raises:
        WorkError: not even then; a derivative is far out of any range.
    """
    size = float(np.diag(hessian).max(initial=1.0))
    for raised in (0.0, 1e-14, 1e-12, 1e-10):
        try:
            return cho_factor(hessian + raised * size * np.eye(len(hessian)))
        except LinAlgError:
            continue
    raise WorkError("the normal equations are singular: a parameter changes the recordings beyond any range")


def normal_equations(linear: Linear, names: Sequence[str], covariance: Covariance) -> Normal:
    """Of generalised least squares on linearised rows."""
    prior = covariance.prior_of(names)
    columns = covariance.whitened(np.hstack([linear.jacobian * prior, linear.nuisance]))
    residual = covariance.whitened(linear.residual)
    shared = covariance.columns.T @ columns
    hessian = columns.T @ columns - shared.T @ cho_solve(covariance.factor, shared) + np.eye(columns.shape[1])
    along = columns.T @ residual - shared.T @ cho_solve(covariance.factor, covariance.columns.T @ residual)
    return Normal(linear.z, linear.own, prior, hessian, along - np.concatenate([linear.z / prior, linear.own]))


def objective(residual: Array, z: Array, own: Array, prior: Array, covariance: Covariance) -> float:
    """Twice the negative log posterior of a point, up to a constant."""
    white = covariance.whitened(residual)
    misfit = float(white @ covariance.projected(white))
    return misfit + float(np.sum((z / prior) ** 2)) + float(own @ own)


def with_columns(covariance: Covariance, more: Array) -> Covariance:
    """With further columns (n, k) of prior N(0, 1) in the low-rank part."""
    columns = np.hstack([covariance.columns, covariance.whitened(more)])
    return replace(covariance, columns=columns, factor=cho_factor(columns.T @ columns + np.eye(columns.shape[1])))
