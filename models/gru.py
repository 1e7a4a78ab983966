"""GRU: gated recurrent units along whole batches."""

from __future__ import annotations

from typing import Any

import numpy as np

from models.base import Array
from models.parts.recurrent import RecurrentNet, affine, input_slopes, recurrent_slopes
from models.parts.sequence_net import Weights


class GRU(RecurrentNet):
    """`hidden` gated recurrent units behind a linear part with memory; see `SequenceNet`.

    `z = σ(W_z x + U_z h + b_z)`, `r = σ(W_r x + U_r h + b_r)`, `c = tanh(W_c x + r ⊙ U_c h)`,
    `h(t) = h(t−1) + z ⊙ (c − h(t−1))`: every unit is a first-order lag whose time constant its gate z sets. The
    candidate has no bias: at rest the state stays 0.

    Source: K. Cho et al., EMNLP (2014), with the reset gate behind the product U_c h, as in cuDNN; gates opened by
    time constants: C. Tallec and Y. Ollivier, ICLR (2018).
    """

    key = "gru"
    words = "gated recurrent units along whole batches, behind a linear part with memory"
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
