"""What LSTM and GRU share: the arrays of a gated net, where its training starts, and the slopes of its weights."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar

import numpy as np

from models.base import Array
from models.parts.sequence_net import SequenceNet, Weights

_SHORTEST, _LONGEST = 1.0, 16.0  # time constants that the cells start with, in steps
_AMPLITUDE = 1.0  # rms of a candidate's sum at the start: where the tanh begins to bend


class RecurrentNet(SequenceNet):
    """A gated net: input (S, g h, p), recurrent (S, g h, h) and bias (S, g h) of its g gates, the candidate among them.

    At the start no state feeds a gate, and cell j is a first-order lag of its direction whose τ_j is one of 1 to 16
    steps, spread evenly in the logarithm.
    """

    weights = ("input", "recurrent", "bias")
    gates: ClassVar[int]
    candidate: ClassVar[int]  # place of the candidate among the gates

    @abstractmethod
    def gate_bias(self, keep: Array) -> Array:
        """Biases (g, h) with which cell j keeps the share `keep`[j] of its state from one step to the next."""

    def start(self, directions: Array) -> Weights:
        n_nets, h, p = directions.shape
        keep = np.exp(-1.0 / np.geomspace(_SHORTEST, _LONGEST, h))
        into = np.zeros((n_nets, self.gates, h, p))
        into[:, self.candidate] = _AMPLITUDE * directions
        return {
            "input": into.reshape(n_nets, -1, p),
            "recurrent": np.zeros((n_nets, self.gates * h, h)),
            "bias": np.tile(self.gate_bias(keep).ravel(), (n_nets, 1)),
        }


def affine(xp: Any, weights: Weights, x: Any) -> Any:
    """W x + b of all gates at all steps, (T, S, g h, B) for x (S, p, T, B)."""
    n_nets, p, n_steps, n_batches = x.shape
    sums = weights["input"] @ x.reshape(n_nets, p, -1) + weights["bias"][:, :, None]
    sums = sums.reshape(n_nets, -1, n_steps, n_batches)
    return xp.stack([sums[:, :, t] for t in range(n_steps)])


def input_slopes(xp: Any, pull: Any, x: Any) -> tuple[Any, Any]:
    """Slopes by W (S, g h, p) and b (S, g h) from those by the gates' sums, pull (T, S, g h, B)."""
    flat = xp.moveaxis(pull, 0, 2)
    flat = flat.reshape(*flat.shape[:2], -1)
    return flat @ xp.swapaxes(x.reshape(*x.shape[:2], -1), 1, 2), flat.sum(2)


def recurrent_slopes(xp: Any, pull: Any, h: Any) -> Any:
    """Slopes by U (S, g h, h) from those by U h, pull (T, S, g h, B), and the states h (T, S, h, B)."""
    return (pull[1:] @ xp.swapaxes(h[:-1], 2, 3)).sum(0)
