"""Criteria of acceptance that need no refit: residuals of random sign, signs of batches, and trust in a gain."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import binom

from data.arrays import Array
from diagnosis.contracts import CandidateKind, Tried
from diagnosis.export.machine_file import deviations
from diagnosis.policy import POLICY, Policy
from diagnosis.screening.evidence import Evidence
from twin.calibration.identifiability import Z90
from twin.mechanisms import MECHANISMS


def flipped_gains(
    evidence: Evidence, after: Evidence, alarm: Sequence[int], seed: int, policy: Policy = POLICY
) -> Array:
    """Gains (T, C) of columns when the residuals of the best candidate take a random sign in every batch, T times.

    What agrees between batches cancels, what varies stays: the wild cluster bootstrap with the effect in the model
    (Cameron, Gelbach and Miller 2008), over the whole family of candidates (Westfall and Young 1993).
    """
    left = after.residuals(left_out=policy.leaves_batches_out)
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], size=(len(left), policy.sign_flips))
    scale = np.sqrt(evidence.weight / after.weight)
    targets = [e * scale[b.channel][:, None] * s for b, e, s in zip(evidence.batches, left, signs, strict=True)]
    return np.asarray(evidence.gains(targets, policy.leaves_batches_out)[0][:, list(alarm)])


def flipped_threshold(gains: Array, batches: int, which: int | None = None) -> float:
    """The gain in nats that flipped signs exceed once in a hundred; the largest where few batches have few patterns.

    gains (T, C); `which` is the candidate's column, None where it has none.
    """
    if not gains.size:
        return 0.0
    return float(gains.max()) if 2**batches <= POLICY.sign_flips else balanced_quantile(gains, which)


def balanced_quantile(gains: Array, which: int | None, share: float = POLICY.chance_quantile) -> float:
    """The gain in nats that candidate `which` reaches by chance, at a family-wise error rate of 1 - `share`.

    Each of C candidates counts in units of its own quantile of the chance gains (T, C), so that one which structure
    imitates in every draw does not raise the threshold of the others. The largest of these ratios, in draws that are
    left out of the quantiles in turn, keeps the error rate of the whole family (balanced as in Westfall and Young 1993,
    §2.3). The result is never above the quantile of the largest gain of all; None as `which` gives that quantile.
    """
    largest = gains.max(axis=1)
    every = max(float(gumbel(largest, share)), float(largest.max()))
    if which is None:
        return every
    beyond = [float((own / _own(np.delete(gains, t, axis=0), share)).max()) for t, own in enumerate(gains)]
    factor = max(1.0, float(gumbel(np.array(beyond), share)))
    return min(every, factor * float(_own(gains[:, which : which + 1], share)[0]))


def _own(gains: Array, share: float) -> Array:
    """Each candidate's quantile (C,) of gains (T, C)."""
    return np.maximum(np.maximum(gumbel(gains, share), gains.max(axis=0)), POLICY.own_quantile_min_nats)


def gumbel(gain: Array, share: float = POLICY.chance_quantile) -> Array:
    """The quantile (…,) of largest values (n, …) by a Gumbel distribution of their mean and spread (Gumbel 1958)."""
    scale = np.std(gain, axis=0, ddof=1) * np.sqrt(6.0) / np.pi
    return np.asarray(np.mean(gain, axis=0) - scale * (np.euler_gamma + np.log(-np.log(share))))


def sign_p(better: int, n: int) -> float:
    """p value of so many improved batches of `n` (sign test)."""
    return float(binom.sf(better - 1, n, 0.5))


def stands_out(t: Tried) -> bool:
    """Whether the 90 % interval of a signed amplitude excludes the value without an effect; of several, of any."""
    if t.fitted is None:
        return True
    change = t.candidate.change
    if change is not None and change.per_batch is not None:
        return deviations(t.fitted).get(change.parameter.name, 1.0) > POLICY.run_to_run_min_sd
    if t.candidate.part is None:
        return True
    sd = np.sqrt(np.diag(t.fitted.state.arrow.covariance))
    fitted = {u.name: (u, z, own) for u, z, own in zip(t.fitted.problem.unknowns, t.fitted.state.z, sd, strict=True)}
    outside = []
    for amplitude, off in t.candidate.amplitudes.items():
        if (found := fitted.get(f"mechanisms.{t.candidate.name}.{amplitude}")) is not None:
            u, z, own = found
            outside.append(u.scale != "linear" or abs(u.prior + u.spread * z - off) >= Z90 * u.spread * own)
    return not outside or any(outside)


def few_worse(t: Tried, batches: int) -> bool:
    """Whether few of the left-out batches get worse."""
    return t.worse <= POLICY.max_worse_share * batches


def trust(t: Tried) -> float:
    """The probability that a claim with the gain of `t` is true, from claims on development plants."""
    odds = POLICY.odds_gain_exponent * np.log(max(t.gain, 1.0) / POLICY.even_odds_gain_nats) - _doubts(t)
    return float(1.0 / (1.0 + np.exp(-odds)))


def least_gain(t: Tried) -> float:
    """The gain in nats below which a candidate is not accepted: there `trust` is one half."""
    if not t.candidate.kind.is_physics:
        return POLICY.coarse_min_gain_nats
    return float(POLICY.even_odds_gain_nats * np.exp(_doubts(t) / POLICY.odds_gain_exponent))


def _doubts(t: Tried) -> float:
    c = t.candidate
    doubts = POLICY.odds_cost_worse_batch * t.worse
    if c.mechanism in MECHANISMS:  # alternatives that need no new physics are in no registry
        law = MECHANISMS[c.mechanism]
        doubts += POLICY.odds_cost_network * law.of_network + POLICY.odds_cost_labels * (
            c.kind is CandidateKind.SENSOR_SWAP
        )
        driven = c.part is not None and bool(c.part.drivers) if law.any_unit else bool(law.drivers)
        doubts += POLICY.odds_cost_lever * (c.where.kind == "error" and not driven and not law.fault)
    return doubts
