"""Family: temporal convolutional net (TCN) along whole batches."""

from __future__ import annotations

from typing import Any

import numpy as np

from models.families.sequence_net import SequenceNet
from models.numerics.sequences import Weights

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

    def states(self, xp: Any, weights: Weights, x: Any) -> tuple[Any, tuple[Any, ...]]:
        n_nets, p, n_steps, n_batches = x.shape
        layers = [weights["input"] @ x.reshape(n_nets, p, -1)]
        bent = []
        for layer in range(LAYERS):
            z, late = layers[-1], _late(xp, layers[-1], n_batches << layer)
            bias = weights["bias"][:, layer, :, None]
            bent.append(xp.tanh(weights["now"][:, layer] @ z + weights["past"][:, layer] @ late + bias))
            layers.append(bent[-1] - xp.tanh(bias))
        return xp.concatenate(layers[1:], 1).reshape(n_nets, -1, n_steps, n_batches), (layers, bent)

    def gradient(self, xp: Any, weights: Weights, x: Any, tape: tuple[Any, ...], slope: Any) -> Weights:
        layers, bent = tape
        n_nets, p, _, n_batches = x.shape
        slope = slope.reshape(n_nets, LAYERS, self.hidden, -1)
        out = {name: xp.empty_like(weights[name]) for name in ("now", "past", "bias")}
        on_z = xp.zeros_like(layers[0])
        for layer in range(LAYERS - 1, -1, -1):
            on_z = on_z + slope[:, layer]
            pull = on_z * (1.0 - bent[layer] ** 2)
            shift = n_batches << layer
            out["now"][:, layer] = pull @ xp.swapaxes(layers[layer], 1, 2)
            out["past"][:, layer] = pull @ xp.swapaxes(_late(xp, layers[layer], shift), 1, 2)
            at_rest = 1.0 - xp.tanh(weights["bias"][:, layer]) ** 2
            out["bias"][:, layer] = pull.sum(2) - on_z.sum(2) * at_rest
            back = xp.swapaxes(weights["past"][:, layer], 1, 2) @ pull
            on_z = xp.swapaxes(weights["now"][:, layer], 1, 2) @ pull
            if shift < on_z.shape[2]:
                on_z[:, :, :-shift] += back[:, :, shift:]
        out["input"] = on_z @ xp.swapaxes(x.reshape(n_nets, p, -1), 1, 2)
        return out


def _late(xp: Any, z: Any, shift: int) -> Any:
    """z (S, h, T B) of `shift` places before, 0 before the start."""
    out = xp.zeros_like(z)
    if shift < z.shape[2]:
        out[:, :, shift:] = z[:, :, :-shift]
    return out
