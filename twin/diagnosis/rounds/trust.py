"""How far a gain on batches left out is to be trusted: the share of claims with such a gain that were true.

Real castings and levers leave more than refined networks do, so a gain beyond the structural null may still be theirs.
On 64 claims about development plants (seeds 2 to 8 and 20 to 22 of the proof's generator), 16 of them false, a logistic
regression of "is true" on the gain's logarithm and on the batches that do not improve gave the first three numbers: 4
wrong calls, of the gain alone 10. The doubts of kinds rest on few claims each, and are less than their regression says.
"""

from __future__ import annotations

import numpy as np

from twin.diagnosis.rounds.refits import Tried
from twin.mechanisms import MECHANISMS

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
