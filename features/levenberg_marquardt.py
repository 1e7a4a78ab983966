"""Levenberg–Marquardt training of many small nets at once, with weight decay, in torch."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController
from torch import Tensor

from data.arrays import Array
from features.nets import Nets

_DAMPING_START, _DAMPING_MOST = 1e-2, 1e8
_LEAST_KEPT = 0.25  # of the decrease that the quadratic model predicts, for less damping


def train(
    nets: Nets, x_t: Array, y: Array, known: Array, decay: float, iterations: int
) -> tuple[Nets, NDArray[np.int64]]:
    """Every net's parameters after at most `iterations` damped Gauss–Newton steps, and the steps each took.

    Net s minimises `Σ_n (known·(y − ŷ))² / Σ_n known + decay · |w, b, v|²` over its rows: x_t (S, p, n), y and known
    (S, n); known is 0 on padding, else 1, or the square root of a row's weight. Each net has its own damping (÷ 10
    after a step with a quarter of the decrease that the quadratic model predicts, else × 10; a step that raises the
    loss is taken back) and stops by itself, so a net's result does not depend on its neighbours. Float64 in one
    thread, whatever torch is set to: the matrices are small, and callers train in parallel.

    Source: M. Hagan and M. Menhaj, Training feedforward networks with the Marquardt algorithm (1994).
    """
    torch.get_num_threads()  # torch sets a thread's count at its first use there, which would undo the limit
    with openmp().limit(limits=1), torch.inference_mode():
        tensors = [torch.tensor(a, dtype=torch.float64) for a in (nets.parameters, x_t, y, known)]
        theta, steps = _trained(tensors, nets, decay, iterations)
        return replace(nets, parameters=theta.numpy()), steps.numpy()


def outputs(theta: Tensor, x_t: Tensor, n_hidden: int, transfer: str = "tanh") -> tuple[Tensor, Tensor]:
    """Outputs (S, n) and hidden activations (S, h, n) of nets theta (S, P) for inputs (S, p, n)."""
    h, p = n_hidden, x_t.shape[1]
    w, b, v, c = theta.split([h * p, h, h, 1], dim=1)
    hidden = torch.baddbmm(b[:, :, None], w.reshape(-1, h, p), x_t)
    hidden = hidden.tanh_() if transfer == "tanh" else hidden
    return torch.baddbmm(c[:, :, None], v[:, None], hidden)[:, 0], hidden


def jacobian(theta: Tensor, x_t: Tensor, hidden: Tensor, out: Tensor, transfer: str = "tanh") -> Tensor:
    """d output / d parameter, written to out (S, P, n)."""
    (s, h, n), p = hidden.shape, x_t.shape[1]
    slope = out[:, h * p : h * (p + 1)]
    bend = 1.0 - hidden**2 if transfer == "tanh" else torch.ones_like(hidden)
    torch.mul(theta[:, h * (p + 1) : h * (p + 2), None], bend, out=slope)
    torch.mul(slope[:, :, None], x_t[:, None], out=out[:, : h * p].view(s, h, p, n))
    out[:, h * (p + 1) : h * (p + 2)] = hidden
    out[:, -1] = 1.0
    return out


def _trained(tensors: list[Tensor], nets: Nets, decay: float, iterations: int) -> tuple[Tensor, Tensor]:
    theta, x_t, y, known = tensors
    n_hidden, transfer = nets.n_hidden, nets.transfer
    out = theta.clone()
    steps = torch.full((len(theta),), iterations, device=theta.device)
    place = torch.arange(len(theta), device=theta.device)
    count = known.sum(dim=1).clamp_(min=1.0)
    penalty = torch.full_like(theta[0], decay)
    penalty[-1] = 0.0
    damping = torch.full_like(count, _DAMPING_START)
    weighted = not bool((known == 1.0).all())
    output, hidden = outputs(theta, x_t, n_hidden, transfer)
    error = (y - output).mul_(known)
    loss = error.square().sum(dim=1) / count + theta.square() @ penalty
    # Fresh memory at each step would cost as much as the algebra.
    room = x_t.new_empty((len(theta), theta.shape[1] + 1, x_t.shape[2]))
    for step in range(1, iterations + 1):
        both = room[: len(theta)]
        slopes = jacobian(theta, x_t, hidden, both[:, :-1], transfer)
        if weighted:
            slopes *= known[:, None]
        both[:, -1] = error  # below the slopes, so that one product gives curvature and gradient
        product = torch.bmm(both, both.mT).div_(count[:, None, None])
        gradient = product[:, :-1, -1:] - (penalty * theta)[:, :, None]
        curvature = product[:, :-1, :-1]
        curvature.diagonal(dim1=1, dim2=2).add_(penalty + damping[:, None])
        factor, failed = torch.linalg.cholesky_ex(curvature)
        move = torch.cholesky_solve(gradient, factor)
        trial = theta + move[..., 0]
        promised = (gradient + damping[:, None, None] * move).mul_(move).sum(dim=(1, 2))
        output, hidden_t = outputs(trial, x_t, n_hidden, transfer)
        error_t = (y - output).mul_(known)
        loss_t = error_t.square().sum(dim=1) / count + trial.square() @ penalty
        decrease = loss - loss_t
        better = (decrease > 0) & (failed == 0)
        each, row = better[:, None, None], better[:, None]
        theta, error = torch.where(row, trial, theta), torch.where(row, error_t, error)
        hidden, loss = torch.where(each, hidden_t, hidden), torch.where(better, loss_t, loss)
        kept = better & (decrease > _LEAST_KEPT * promised)
        damping = torch.where(kept, 0.1 * damping, 10.0 * damping).clamp_(min=1e-12)
        done = (kept & (decrease < 1e-6 * loss_t)) | (damping > _DAMPING_MOST)
        if bool(done.any()):
            out[place[done]], steps[place[done]] = theta[done], step
            some = ~done
            theta, x_t, y, known, count = (a[some] for a in (theta, x_t, y, known, count))
            damping, hidden, error, loss, place = (a[some] for a in (damping, hidden, error, loss, place))
            if not len(place):
                break
    out[place] = theta
    return out, steps


@cache
def openmp() -> Any:
    """OpenMP's thread counts. They belong to the calling thread: a limit here reaches no other thread."""
    return ThreadpoolController().select(user_api="openmp")
