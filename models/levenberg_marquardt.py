"""Many small tanh nets trained at once by Levenberg–Marquardt with weight decay."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_DAMPING_START, _DAMPING_MOST = 1e-2, 1e8


@dataclass(frozen=True)
class Nets:
    """S nets `c + Σ_j v_j tanh(Σ_i w_ji x_i + b_j)`: parameters (S, P), P = h (p + 2) + 1, in the order w, b, v, c."""

    parameters: Array
    n_inputs: int
    n_hidden: int

    @classmethod
    def drawn(cls, n_nets: int, n_inputs: int, n_hidden: int, seed: int) -> Nets:
        """Random starts that give hidden sums of about unit variance, the same for every fold of a seed."""
        rng = np.random.default_rng(seed)
        w = rng.normal(size=(n_nets, n_hidden, n_inputs)) / np.sqrt(n_inputs)
        b = rng.uniform(-1.0, 1.0, size=(n_nets, n_hidden))
        v = rng.normal(size=(n_nets, n_hidden)) / np.sqrt(n_hidden)
        parts = [w.reshape(n_nets, -1), b, v, np.zeros((n_nets, 1))]
        return cls(np.concatenate(parts, axis=1), n_inputs, n_hidden)

    def split(self, parameters: Array) -> tuple[Array, Array, Array, Array]:
        """w (S, h, p), b (S, h, 1), v (S, 1, h), c (S, 1)."""
        h, p = self.n_hidden, self.n_inputs
        w, b, v, c = np.split(parameters, [h * p, h * (p + 1), h * (p + 2)], axis=1)
        return w.reshape(-1, h, p), b[:, :, None], v[:, None, :], c

    def outputs(self, x_t: Array, parameters: Array | None = None) -> tuple[Array, Array]:
        """Outputs (S, n) and hidden activations (S, h, n) for inputs (S or 1, p, n)."""
        w, b, v, c = self.split(self.parameters if parameters is None else parameters)
        hidden = np.tanh(w @ x_t + b)
        return (v @ hidden)[:, 0] + c, hidden

    def jacobian(self, x_t: Array, hidden: Array, parameters: Array) -> Array:
        """d output / d parameter, (S, P, n)."""
        h, p = self.n_hidden, self.n_inputs
        s, _, n = hidden.shape
        slope = parameters[:, h * (p + 1) : h * (p + 2), None] * (1.0 - hidden**2)
        out = np.empty((s, h * (p + 2) + 1, n))
        np.multiply(slope[:, :, None], x_t[:, None], out=out[:, : h * p].reshape(s, h, p, n))
        out[:, h * p : h * (p + 1)] = slope
        out[:, h * (p + 1) : h * (p + 2)] = hidden
        out[:, -1] = 1.0
        return out


def train(
    nets: Nets, x_t: Array, y: Array, known: Array, decay: float, iterations: int
) -> tuple[Nets, NDArray[np.int64]]:
    """Every net's parameters after at most `iterations` damped Gauss–Newton steps, and the steps each took.

    Net s minimises `mean_n known·(y − ŷ)² + decay · |w, b, v|²` over its rows: x_t (S, p, n), y and known (S, n);
    known is 0 on padding, else 1. Each net has its own damping (÷ 10 after a step that helps, × 10 after one that
    does not) and stops by itself, so a net's result does not depend on its neighbours.

    Source: M. Hagan and M. Menhaj, Training feedforward networks with the Marquardt algorithm (1994).
    """
    theta = nets.parameters.copy()
    count = np.maximum(known.sum(axis=1), 1.0)
    penalty = np.full(theta.shape[1], decay)
    penalty[-1] = 0.0
    damping = np.full(len(theta), _DAMPING_START)
    steps = np.zeros(len(theta), np.int64)
    active = np.arange(len(theta))
    output, hidden = nets.outputs(x_t, theta)
    error = (y - output) * known
    loss = (error**2).sum(axis=1) / count + theta**2 @ penalty
    for _ in range(iterations):
        xa, ka, ta, na = x_t[active], known[active], theta[active], count[active, None]
        jacobian = nets.jacobian(xa, hidden[active], ta)
        if not ka.all():
            jacobian *= ka[:, None]
        gradient = (jacobian @ error[active][:, :, None])[..., 0] / na - penalty * ta
        curvature = jacobian @ jacobian.transpose(0, 2, 1) / na[:, :, None]
        diagonal = penalty + damping[active, None]
        curvature[:, np.arange(ta.shape[1]), np.arange(ta.shape[1])] += diagonal
        trial = ta + np.linalg.solve(curvature, gradient[..., None])[..., 0]
        out_t, hidden_t = nets.outputs(xa, trial)
        error_t = (y[active] - out_t) * ka
        loss_t = (error_t**2).sum(axis=1) / na[:, 0] + trial**2 @ penalty
        fall = loss[active] - loss_t
        better = fall > 0
        steps[active] += 1
        won = active[better]
        theta[won], hidden[won], error[won], loss[won] = (
            trial[better],
            hidden_t[better],
            error_t[better],
            loss_t[better],
        )
        damping[active] = np.clip(damping[active] * np.where(better, 0.1, 10.0), 1e-12, 10 * _DAMPING_MOST)
        done = (better & (fall < 1e-6 * loss_t)) | (damping[active] > _DAMPING_MOST)
        active = active[~done]
        if not len(active):
            break
    return Nets(theta, nets.n_inputs, nets.n_hidden), steps
