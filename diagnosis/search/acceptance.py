"""When a gain counts: more than structure alone makes, more than residuals of random sign make, in most batches."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import binom

from data.arrays import Array
from diagnosis.contracts import Tried
from diagnosis.export.machine_file import deviations
from diagnosis.screening.evidence import Evidence
from twin.calibration.identifiability import Z90
from twin.mechanisms import MECHANISMS

FLIPS = 60
LITTLE = 20.0  # nats of one candidate below which its own scatter says nothing
LEAST_DEVIATION = 0.02  # of a value from run to run: nobody's heat is the same to less


def flipped_gains(evidence: Evidence, after: Evidence, alarm: Sequence[int], seed: int) -> Array:
    """Gains (FLIPS, C) of columns when what the best candidate leaves over takes a random sign in every batch.

    What agrees between batches is gone, what varies stays: the wild cluster bootstrap with the effect in the model
    (Cameron, Gelbach and Miller 2008), over the whole family of candidates (Westfall and Young 1993).
    """
    left = after.left_out()
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], size=(len(left), FLIPS))
    scale = np.sqrt(evidence.weight / after.weight)
    targets = [e * scale[b.channel][:, None] * s for b, e, s in zip(evidence.batches, left, signs, strict=True)]
    return np.asarray(evidence.gains(targets)[0][:, list(alarm)])


def flipped_threshold(gains: Array, batches: int, which: int | None = None) -> float:
    """The gain that flipped signs exceed once in a hundred; of few batches, with few patterns, their largest.

    gains (FLIPS, C); `which` is the candidate's column, None of one that has none.
    """
    if not gains.size:
        return 0.0
    return float(gains.max()) if 2**batches <= FLIPS else balanced(gains, which)


def balanced(gains: Array, which: int | None, share: float = 0.99) -> float:
    """What the gain of one of C candidates may be by chance, all of them considered; gains (T, C) made by chance.

    Structure that looks like a lever of the screw in every draw is no reason to doubt heat to the floor: each
    candidate's gain counts in units of its own quantile, and what the largest of these reaches in draws that the
    quantiles do not know keeps the share for all together (balanced as by Westfall and Young 1993, §2.3, with a draw
    left out in turn). Never more than what the largest gain of all exceeds in 1 - `share` of the draws.
    """
    largest = gains.max(axis=1)
    every = max(float(gumbel(largest, share)), float(largest.max()))
    if which is None:
        return every
    beyond = [float((own / _own(np.delete(gains, t, axis=0), share)).max()) for t, own in enumerate(gains)]
    factor = max(1.0, float(gumbel(np.array(beyond), share)))
    return min(every, factor * float(_own(gains[:, which : which + 1], share)[0]))


def _own(gains: Array, share: float) -> Array:
    """Of gains (T, C) each candidate's quantile (C,)."""
    return np.maximum(np.maximum(gumbel(gains, share), gains.max(axis=0)), LITTLE)


def gumbel(gain: Array, share: float = 0.99) -> Array:
    """The quantile (…,) of largest values (n, …) by a Gumbel distribution of their mean and spread (Gumbel 1958)."""
    scale = np.std(gain, axis=0, ddof=1) * np.sqrt(6.0) / np.pi
    return np.asarray(np.mean(gain, axis=0) - scale * (np.euler_gamma + np.log(-np.log(share))))


def sign_p(better: int, n: int) -> float:
    """Chance of so many improved batches if improving were a coin's toss (Fisher's sign test)."""
    return float(binom.sf(better - 1, n, 0.5))


def stands_out(t: Tried) -> bool:
    """Whether a signed amplitude's 90 % interval leaves out the value without an effect; of several, any one's."""
    if t.fitted is None:
        return True
    change = t.candidate.change
    if change is not None and change.per_batch is not None:
        return deviations(t.fitted).get(change.parameter.name, 1.0) > LEAST_DEVIATION
    if t.candidate.part is None:
        return True
    sd = np.sqrt(np.diag(t.fitted.state.arrow.covariance))
    fitted = {u.name: (u, z, own) for u, z, own in zip(t.fitted.problem.unknowns, t.fitted.state.z, sd, strict=True)}
    told = []
    for amplitude, off in t.candidate.amplitudes.items():
        if (found := fitted.get(f"mechanisms.{t.candidate.name}.{amplitude}")) is not None:
            u, z, own = found
            told.append(u.scale != "linear" or abs(u.prior + u.spread * z - off) >= Z90 * u.spread * own)
    return not told or any(told)


EVEN = 110.0  # nats at which a claim is as often false as true, where all batches improve
GROWTH = 2.4  # by which the log odds grow with the gain's logarithm
WORSE = 1.2  # by which they fall for each batch that does not improve
NETWORK = 1.5  # and for what only says how the network is drawn: castings have no links
# And for displacements by temperatures, as no drawing shows all levers: in 112 cases of development seeds 41 to 43
# eight false ones gained 142 to 253 nats, and the only true one beyond 100 gained 343.
LEVER = 1.4
LABELS = 4.5  # and for exchanged ones: sensors of one casting gave up to 630 nats, ten true exchanges from 1200
LEAST_FINER = 40.0  # nats of a finer network, which claims no physics


def trust(t: Tried, batches: int) -> float:
    """The probability, 0 to 1, that a gain as that of `t`, with all else that is known of it, is no structure's."""
    odds = GROWTH * np.log(max(t.gain, 1.0) / EVEN) - _doubts(t, batches)
    return float(1.0 / (1.0 + np.exp(-odds)))


def least_gain(t: Tried, batches: int) -> float:
    """Nats below which a candidate is not accepted: at which it is as likely to be structure."""
    if t.candidate.mechanism == "coarse_network":
        return LEAST_FINER
    return float(EVEN * np.exp(_doubts(t, batches) / GROWTH))


def _doubts(t: Tried, batches: int) -> float:
    c = t.candidate
    doubts = WORSE * (batches - t.improved)
    if c.mechanism in MECHANISMS:  # and no rival, which no registry has
        law = MECHANISMS[c.mechanism]
        doubts += NETWORK * law.of_network + LABELS * (c.mechanism == "sensor_swap")
        driven = c.part is not None and bool(c.part.drivers) if law.any_unit else bool(law.drivers)
        doubts += LEVER * (c.where.kind == "error" and not driven and not law.fault)
    return doubts
