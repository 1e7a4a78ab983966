"""Small neural nets with one hidden layer as plain arrays, evaluated without torch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data.arrays import Array


@dataclass(frozen=True)
class Nets:
    """S nets `c + Σ_j v_j f(Σ_i w_ji x_i + b_j)`: parameters (S, P), P = h (p + 2) + 1, in the order w, b, v, c.

    The transfer f is tanh, or linear: f(u) = u.
    """

    parameters: Array
    n_inputs: int
    n_hidden: int
    transfer: str = "tanh"

    @classmethod
    def drawn(cls, n_nets: int, n_inputs: int, n_hidden: int, seed: int, transfer: str = "tanh") -> Nets:
        """Random starts that give hidden sums of about unit variance, the same for every fold of a seed."""
        rng = np.random.default_rng(seed)
        w = rng.normal(size=(n_nets, n_hidden, n_inputs)) / np.sqrt(n_inputs)
        b = rng.uniform(-1.0, 1.0, size=(n_nets, n_hidden))
        v = rng.normal(size=(n_nets, n_hidden)) / np.sqrt(n_hidden)
        parts = [w.reshape(n_nets, -1), b, v, np.zeros((n_nets, 1))]
        return cls(np.concatenate(parts, axis=1), n_inputs, n_hidden, transfer)

    def outputs(self, x_t: Array) -> Array:
        """Outputs (S, n) for inputs (S or 1, p, n)."""
        h, p = self.n_hidden, self.n_inputs
        w, b, v, c = np.split(self.parameters, [h * p, h * (p + 1), h * (p + 2)], axis=1)
        sums = w.reshape(-1, h, p) @ x_t + b[:, :, None]
        hidden = np.tanh(sums) if self.transfer == "tanh" else sums
        out: Array = (v[:, None] @ hidden)[:, 0] + c
        return out
