"""Families: LSTM and GRU nets along whole batches."""

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

    def states(self, xp: Any, weights: Weights, x: Any) -> tuple[Any, tuple[Any, ...]]:
        n = self.hidden
        half = xp.ones_like(weights["bias"])[:, :, None]
        half[:, n:] = 0.5  # σ(q) = ½ + ½ tanh(q/2): one tanh for all gates
        gates = affine(xp, weights, x) * half
        recurrent = weights["recurrent"] * half
        cell, bent, h = (xp.empty_like(gates[:, :, :n]) for _ in range(3))
        for t, q in enumerate(gates):
            if t:
                q += recurrent @ h[t - 1]
            xp.tanh(q, out=q)
            q[:, n:] *= 0.5
            q[:, n:] += 0.5
            g, i, f, o = (q[:, j * n : (j + 1) * n] for j in range(4))
            xp.multiply(i, g, out=cell[t])
            if t:
                cell[t] += f * cell[t - 1]
            xp.tanh(cell[t], out=bent[t])
            xp.multiply(o, bent[t], out=h[t])
        return xp.moveaxis(h, 0, 2), (gates, cell, bent, h)

    def gradient(self, xp: Any, weights: Weights, x: Any, tape: tuple[Any, ...], slope: Any) -> Weights:
        gates, cell, bent, h = tape
        n = self.hidden
        g, i, f, o = (gates[:, :, j * n : (j + 1) * n] for j in range(4))
        by_cell = xp.zeros_like(gates[:, :, : 3 * n])  # ∂c/∂(q_g, q_i, q_f)
        by_cell[:, :, :n] = i * (1.0 - g * g)
        by_cell[:, :, n : 2 * n] = g * i * (1.0 - i)
        by_cell[1:, :, 2 * n :] = (f * (1.0 - f))[1:] * cell[:-1]
        by_gate = bent * o * (1.0 - o)  # ∂h/∂q_o
        through = o * (1.0 - bent * bent)  # ∂h/∂c
        back = xp.swapaxes(weights["recurrent"], 1, 2)
        pull = xp.empty_like(gates)
        on_state = xp.moveaxis(slope, 2, 0)
        on_cell = xp.zeros_like(cell[0])
        by_three = (len(on_cell), 3, n, -1)
        for t in range(len(gates) - 1, -1, -1):
            on_h = on_state[t]
            if t + 1 < len(gates):
                on_h = on_h + back @ pull[t + 1]
                on_cell = on_cell * f[t + 1]
            on_cell = on_cell + on_h * through[t]
            pull[t, :, : 3 * n] = (on_cell[:, None] * by_cell[t].reshape(by_three)).reshape(by_cell[t].shape)
            xp.multiply(on_h, by_gate[t], out=pull[t, :, 3 * n :])
        by_input, by_bias = input_slopes(xp, pull, x)
        by_bias[:, :n] = 0.0
        return {"input": by_input, "recurrent": recurrent_slopes(xp, pull, h), "bias": by_bias}


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

    def states(self, xp: Any, weights: Weights, x: Any) -> tuple[Any, tuple[Any, ...]]:
        n = self.hidden
        half = xp.ones_like(weights["bias"])[:, :, None]
        half[:, : 2 * n] = 0.5  # σ(q) = ½ + ½ tanh(q/2)
        gates = affine(xp, weights, x) * half
        recurrent = weights["recurrent"] * half
        recalled, h = xp.zeros_like(gates[:, :, :n]), xp.empty_like(gates[:, :, :n])
        for t, q in enumerate(gates):
            gate, c = q[:, : 2 * n], q[:, 2 * n :]
            if t:
                fed = recurrent @ h[t - 1]
                gate += fed[:, : 2 * n]
                recalled[t] = fed[:, 2 * n :]
            xp.tanh(gate, out=gate)
            gate *= 0.5
            gate += 0.5
            z, r = gate[:, :n], gate[:, n:]
            c += r * recalled[t]
            xp.tanh(c, out=c)
            xp.multiply(z, c, out=h[t])
            if t:
                h[t] += (1.0 - z) * h[t - 1]
        return xp.moveaxis(h, 0, 2), (gates, recalled, h)

    def gradient(self, xp: Any, weights: Weights, x: Any, tape: tuple[Any, ...], slope: Any) -> Weights:
        gates, recalled, h = tape
        n = self.hidden
        z, r, c = (gates[:, :, j * n : (j + 1) * n] for j in range(3))
        before = xp.zeros_like(h)
        before[1:] = h[:-1]
        bent = z * (1.0 - c * c)  # ∂h/∂(W_c x)
        by_state = xp.empty_like(gates)  # ∂h/∂(q_z, q_r, U_c h)
        by_state[:, :, :n] = (c - before) * z * (1.0 - z)
        by_state[:, :, n : 2 * n] = bent * recalled * r * (1.0 - r)
        by_state[:, :, 2 * n :] = bent * r
        back = xp.swapaxes(weights["recurrent"], 1, 2)
        pull, on_h = xp.empty_like(gates), xp.moveaxis(slope, 2, 0) + 0.0
        by_three = (on_h.shape[1], 3, n, -1)
        for t in range(len(gates) - 1, -1, -1):
            if t + 1 < len(gates):
                on_h[t] += on_h[t + 1] * (1.0 - z[t + 1])
                on_h[t] += back @ pull[t + 1]
            pull[t] = (on_h[t][:, None] * by_state[t].reshape(by_three)).reshape(by_state[t].shape)
        by_recurrent = recurrent_slopes(xp, pull, h)
        pull[:, :, 2 * n :] = on_h * bent
        by_input, by_bias = input_slopes(xp, pull, x)
        by_bias[:, 2 * n :] = 0.0
        return {"input": by_input, "recurrent": by_recurrent, "bias": by_bias}
