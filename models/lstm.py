"""LSTM: long short-term memory along whole batches."""

from __future__ import annotations

from typing import Any

import numpy as np

from models.base import Array
from models.parts.recurrent import RecurrentNet, affine, input_slopes, recurrent_slopes
from models.parts.sequence_net import Weights


class LSTM(RecurrentNet):
    """Long short-term memory of `hidden` cells behind a linear part with memory; see `SequenceNet`.

    `(q_g, q_i, q_f, q_o) = W x(t) + U h(t−1) + b`; `c(t) = σ(q_f) c(t−1) + σ(q_i) tanh(q_g)`;
    `h(t) = σ(q_o) tanh(c(t))`. The candidate has no bias (b_g = 0): at rest the state stays 0.

    Source: S. Hochreiter and J. Schmidhuber, Neural Computation 9 (1997); forget gate: F. Gers, J. Schmidhuber and
    F. Cummins (2000); gates opened by time constants: C. Tallec and Y. Ollivier, ICLR (2018).
    """

    key = "lstm"
    words = "long short-term memory net along whole batches, behind a linear part with memory"
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
