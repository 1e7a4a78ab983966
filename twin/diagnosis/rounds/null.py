"""The structural null: what the whole search would find where nothing is missing but a finer network."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from data.errors import InputError, WorkError
from twin.calibration.fit_problem import Array
from twin.diagnosis.rounds.acceptance import balanced
from twin.diagnosis.rounds.fitted import Fitted
from twin.diagnosis.rounds.refined import refined
from twin.diagnosis.scoring.evidence import Evidence
from twin.diagnosis.scoring.finite import difference

TWINS = 14  # refined machines
# Bounds of the temperature: on development plants an explanation that was wrong led the true one by up to 28 nats.
HOT = 8.0, 16.0
SCALES = (0.3, 1.0, 3.0, 8.0)  # of the misfit of each: real castings are finer than bars of five cells
AS_IT_IS = 1  # the scale that is their own
MARGIN = 1.25  # on a quantile that so few machines tell
WIDER = 2.0  # an amplitude's scatter in plants of other numerics than in bars of five cells


@dataclass(frozen=True)
class Null:
    """Recordings of T refined machines with the misfit at S scales: largest gain of any candidate (T, S) in nats, the
    log density of batches left out (T, S) before any candidate, their mean squares (T, S, K), and the amplitudes and
    gains (T, S, C) that the candidates `names` would be given where none is there."""

    gain: Array
    density: Array
    mean_squares: Array
    amplitude: Array
    names: tuple[str, ...] = ()
    gains: Array = field(default_factory=lambda: np.zeros((0, 0, 0)))

    def threshold(self, density: float, share: float = 0.99, name: str = "", margin: float = MARGIN) -> float:
        """The gain that structure alone exceeds in 1 - share of the cases, where it leaves no more than `density` says.

        Of each machine counts the largest misfit that predicts left-out batches no worse. As there are few, a Gumbel
        distribution goes through their mean and spread.

        With the `name` of a candidate what structure makes of it counts, and not of others (`balanced`).
        Either is `margin` times that quantile.
        """
        gain = self.typical(density)
        if len(gain) < 3:
            return float("inf")
        if name not in self.names or not self.gains.size:
            return margin * balanced(gain[:, None], None, share)
        return margin * balanced(self.gains[np.arange(len(gain)), self._scale(density)], self.names.index(name), share)

    def typical(self, density: float) -> Array:
        """The largest gain (T,) of each machine at that misfit."""
        return np.asarray(self.gain[np.arange(len(self.gain)), self._scale(density)])

    @property
    def temperature(self) -> float:
        """Nats of score that count as one when explanations are compared: a share of what structure alone gains."""
        typical = self.typical(self.as_it_is)
        return float(np.clip(np.median(typical) / 4.0, *HOT)) if self.gain.size else HOT[0]

    @property
    def as_it_is(self) -> float:
        """The usual log density where the misfit is that of the refined machines themselves."""
        return float(np.median(self.density[:, min(AS_IT_IS, self.density.shape[1] - 1)])) if self.density.size else 0.0

    def scatter(self, name: str, density: float) -> float:
        """By how much structure and noise move a candidate's amplitude in nine of ten machines; 0: that is not known.

        They leave no more than `density` says.

        An amplitude that cannot be negative shows half of that: of it one machine in twenty goes beyond.
        """
        if name not in self.names or len(self.gain) < 2:
            return 0.0
        own = self.amplitude[np.arange(len(self.gain)), self._scale(density), self.names.index(name)]
        return WIDER * float(np.quantile(np.abs(own), 0.9 if (own < 0).any() else 0.95))

    def _scale(self, density: float) -> NDArray[np.int64]:
        """Of each machine (T,) the largest misfit that predicts left-out batches no worse."""
        allowed = self.density >= density
        last = allowed.shape[1] - 1 - np.argmax(allowed[:, ::-1], axis=1)
        return np.where(allowed.any(axis=1), last, 0)


def structural_null(
    fitted: Fitted,
    evidence: Evidence,
    counts: Mapping[str, int],
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Null:
    """Refined machines driven as the recordings were, their left-out gains by the same evidence in one step each.

    Only the target changes: the linearisation, its factors and the folds are the recordings' own. `counts` numbers, by
    candidate, the columns whose gain would be an alarm. A machine's parameters are what the machine file thinks
    possible, not those of the fit: bent by what is missing, they would be what a candidate is rewarded for.
    """
    drawn = recordings(structural_misfits(fitted, seed, progress), evidence, seed)
    gain, amplitude, _ = evidence.gains(drawn)
    columns = list(counts.values())
    squares = evidence.mean_squares(evidence.left_out(drawn))
    shape = (-1, len(SCALES))
    return Null(
        gain[:, columns].max(axis=1, initial=0.0).reshape(shape),
        evidence.base_score(drawn).reshape(shape),
        squares.reshape(*shape, squares.shape[1]),
        amplitude[:, columns].reshape(*shape, len(columns)),
        tuple(counts),
        gain[:, columns].reshape(*shape, len(columns)),
    )


def structural_misfits(
    fitted: Fitted, seed: int = 0, progress: Callable[[int, int], None] | None = None
) -> list[list[Array]]:
    """Of each refined machine what it shows beyond the fit, (n_b,) of every batch in units of the given noise."""
    base = fitted.problem.residuals(fitted.x, fitted.state.nuisance)
    out = []
    for k in range(TWINS):
        try:
            part = refined(fitted.part, fitted.problem.network, fitted.values, seed + k)
            out.append(difference(fitted, part, base))
        except (InputError, WorkError):
            continue  # a draw that no machine has
        if progress:
            progress(k + 1, TWINS)
    return out


def recordings(misfits: Sequence[Sequence[Array]], evidence: Evidence, seed: int = 0) -> list[Array]:
    """Targets (n_b, T S) of every batch: T machines with parameters of their own, each at every scale, and noise."""
    rng = np.random.default_rng(seed)
    targets: list[list[Array]] = [[] for _ in evidence.batches]
    for rows in misfits:
        z = rng.standard_normal(evidence.batches[0].jacobian.shape[1])
        for own, whitened, misfit in zip(targets, evidence.batches, rows, strict=True):
            plain, noise = whitened.jacobian @ z, rng.standard_normal(len(misfit))
            own += [plain + whitened.of(scale * misfit + noise) for scale in SCALES]
    return [np.stack(t, axis=1) for t in targets]
