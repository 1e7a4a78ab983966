"""Families: LSTM, GRU and temporal convolutional nets (TCN) along whole batches."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar

import numpy as np

from data.arrays import Array
from models.families.sequence_net import SequenceNet
from models.numerics.sequences import Weights

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


def from_inputs(xp: Any, weights: Weights, x: Any, free: slice) -> Any:
    """W x of all gates step by step, with b on those that are `free` to have one: (T, S, g h, B) for x (S, p, T, B)."""
    n_nets, p, n_steps, n_batches = x.shape
    sums = weights["input"] @ x.reshape(n_nets, p, -1)
    sums[:, free] += weights["bias"][:, free, None]
    return xp.moveaxis(sums.reshape(n_nets, -1, n_steps, n_batches), 2, 0)


def opened(xp: Any, q: Any) -> Any:
    """σ(q)."""
    return 0.5 + 0.5 * xp.tanh(0.5 * q)


class LSTM(RecurrentNet):
    """Long short-term memory of `hidden` cells behind a linear part with memory; see `SequenceNet`.

    `(q_g, q_i, q_f, q_o) = W x(t) + U h(t−1) + b`; `c(t) = σ(q_f) c(t−1) + σ(q_i) tanh(q_g)`;
    `h(t) = σ(q_o) tanh(c(t))`. The candidate has no bias (b_g = 0): at rest the state stays 0.

    Source: S. Hochreiter and J. Schmidhuber, Neural Computation 9 (1997); forget gate: F. Gers, J. Schmidhuber and
    F. Cummins (2000); gates opened by time constants: C. Tallec and Y. Ollivier, ICLR (2018).
    """

    key = "lstm"
    summary = "long short-term memory net along whole batches, behind a linear part with memory"
    source = "Hochreiter and Schmidhuber 1997"
    gates, candidate = 4, 0

    def gate_bias(self, keep: Array) -> Array:
        forget = np.log(keep / (1.0 - keep))
        return np.stack([np.zeros_like(keep), -forget, forget, np.ones_like(keep)])

    def states(self, xp: Any, weights: Weights, x: Any) -> Any:
        n, found = self.hidden, []
        sums = from_inputs(xp, weights, x, slice(n, None))
        h = cell = xp.zeros_like(sums[0, :, :n])
        for q in sums:
            q = q + weights["recurrent"] @ h
            gates = opened(xp, q[:, n:])
            cell = gates[:, n : 2 * n] * cell + gates[:, :n] * xp.tanh(q[:, :n])
            h = gates[:, 2 * n :] * xp.tanh(cell)
            found.append(h)
        return xp.stack(found, 2)


class GRU(RecurrentNet):
    """`hidden` gated recurrent units behind a linear part with memory; see `SequenceNet`.

    `z = σ(W_z x + U_z h + b_z)`, `r = σ(W_r x + U_r h + b_r)`, `c = tanh(W_c x + r ⊙ U_c h)`,
    `h(t) = h(t−1) + z ⊙ (c − h(t−1))`: every unit is a first-order lag whose time constant its gate z sets. The
    candidate has no bias: at rest the state stays 0.

    Source: K. Cho et al., EMNLP (2014), with the reset gate behind the product U_c h, as in cuDNN; gates opened by
    time constants: C. Tallec and Y. Ollivier, ICLR (2018).
    """

    key = "gru"
    summary = "gated recurrent units along whole batches, behind a linear part with memory"
    source = "Cho et al. 2014"
    gates, candidate = 3, 2

    def gate_bias(self, keep: Array) -> Array:
        return np.stack([np.log((1.0 - keep) / keep), np.ones_like(keep), np.zeros_like(keep)])

    def states(self, xp: Any, weights: Weights, x: Any) -> Any:
        n, found = self.hidden, []
        sums = from_inputs(xp, weights, x, slice(2 * n))
        h = xp.zeros_like(sums[0, :, :n])
        for now in sums:
            fed = weights["recurrent"] @ h
            gates = opened(xp, now[:, : 2 * n] + fed[:, : 2 * n])
            z, r = gates[:, :n], gates[:, n:]
            h = (1.0 - z) * h + z * xp.tanh(now[:, 2 * n :] + r * fed[:, 2 * n :])
            found.append(h)
        return xp.stack(found, 2)


LAYERS = 4  # receptive field 2⁴ = 16 steps: 5 h 20 min at steps of 20 min


class TCN(SequenceNet):
    """Temporal convolutional net of `hidden` channels behind a linear part with memory; see `SequenceNet`.

    `z_0 = W x`; `z_{l+1}(t) = tanh(N_l z_l(t) + P_l z_l(t − 2^l) + b_l) − tanh(b_l)`, l = 0 … 3: kernels of two taps,
    dilations 1, 2, 4, 8, so that a state depends on 16 steps (5 h 20 min at the default spacing). All layers are read
    out. Before the start everything is 0 and stays so. At the start of the training N = P = ½: layer l is a moving mean
    over 2^l steps.

    Source: A. van den Oord et al., WaveNet (2016); S. Bai, J. Kolter and V. Koltun (2018).
    """

    key = "tcn"
    summary = "temporal convolutional net along whole batches, behind a linear part with memory"
    source = "Bai, Kolter and Koltun 2018"
    weights = ("input", "now", "past", "bias")

    def n_states(self) -> int:
        return LAYERS * self.hidden

    def start(self, directions: Any) -> Weights:
        n_nets, h, _ = directions.shape
        mean = np.tile(0.5 * np.eye(h), (n_nets, LAYERS, 1, 1))
        bias = np.random.default_rng(self.seed + 1).uniform(-1.0, 1.0, (LAYERS, h))
        return {"input": directions, "now": mean, "past": mean.copy(), "bias": np.tile(bias, (n_nets, 1, 1))}

    def states(self, xp: Any, weights: Weights, x: Any) -> Any:
        n_nets, p, n_steps, n_batches = x.shape
        z, layers = weights["input"] @ x.reshape(n_nets, p, -1), []
        for layer in range(LAYERS):
            shift = min(n_batches << layer, z.shape[2])  # of a state at the steps before it, 0 before the start
            late = xp.concatenate([xp.zeros_like(z[:, :, :shift]), z[:, :, : z.shape[2] - shift]], 2)
            bias = weights["bias"][:, layer, :, None]
            z = xp.tanh(weights["now"][:, layer] @ z + weights["past"][:, layer] @ late + bias) - xp.tanh(bias)
            layers.append(z)
        return xp.concatenate(layers, 1).reshape(n_nets, -1, n_steps, n_batches)
