"""Training of many small sequence nets at once in torch: Adam on the weights, readout in closed form."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import torch
from torch import Tensor

from data.arrays import Array
from features.levenberg_marquardt import openmp
from models.numerics.sequences import Stack, Weights

_MOMENTUM, _SECOND, _FLOOR = 0.9, 0.99, 1e-8  # Adam's


class Trainable(Protocol):
    """What training needs of a net (`models.families.sequence_net.SequenceNet` is one)."""

    key: ClassVar[str]
    weights: ClassVar[tuple[str, ...]]
    device: str
    epochs: int
    rate: float
    decay: float
    readout_decay: float

    def states(self, xp: Any, weights: Weights, x: Any) -> Any: ...


def train(net: Trainable, stack: Stack, start: Weights) -> tuple[Weights, Array]:
    """Weights (S, …) and readouts (S, U) of S nets after `net.epochs` passes, each over one phase of the batches.

    Net s minimises `mean_n (rest − v·h)² + (decay |w − w_start|² + readout_decay |v|²) / n_batches` over its known
    rows. For given weights the best v is a ridge; at it the slope of the loss by the weights is the partial one
    (variable projection). Every operation runs along the stack net by net, so that no net's result depends on its
    neighbours. Float64 on any device; on the processor one thread, whatever torch is set to: callers train in
    parallel. Adam's rate falls to 0 as a half cosine.

    Source: G. Golub and V. Pereyra (1973); D. Kingma and J. Ba, Adam, ICLR (2015).
    """
    device = _device(net)
    torch.get_num_threads()  # torch sets a thread's count at its first use there, which would undo the limit
    with openmp().limit(limits=1):
        share = 1.0 / stack.n_batches
        rows = Rows(*(torch.tensor(part, device=device) for part in (stack.x, stack.rest, stack.known, share)))
        weights = _descend(net, rows, {name: torch.tensor(start[name], device=device) for name in net.weights})
        sums = [rows.sums(phase, net.states(torch, weights, rows.x[phase])) for phase in range(len(rows.x))]
        readout = rows.readout([sum(part) for part in zip(*sums, strict=True)], net.readout_decay)
        return {name: w.cpu().numpy() for name, w in weights.items()}, readout.cpu().numpy()


@dataclass(frozen=True)
class Rows:
    """A stack's tensors: x (R, S, p, T, B), rest and known (R, S, T, B), share (S,) = 1 / number of batches."""

    x: Tensor
    rest: Tensor
    known: Tensor
    share: Tensor

    def sums(self, phase: int, states: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Σ h hᵀ (S, U, U), Σ h rest (S, U, 1) and the number (S,) of a phase's known rows."""
        h = (states * self.known[phase][:, None]).flatten(2)
        return h @ h.mT, h @ self.rest[phase].flatten(1)[:, :, None], self.known[phase].sum(dim=(1, 2))

    def readout(self, sums: Sequence[Tensor], decay: float) -> Tensor:
        """The ridge v (S, U)."""
        square, cross, count = sums
        count = count.clamp(min=1.0)[:, None, None]
        square = square / count
        square.diagonal(dim1=1, dim2=2).add_(decay * self.share[:, None])
        return torch.linalg.solve(square, cross / count)[..., 0]


def losses(net: Trainable, rows: Rows, phase: int, weights: Weights) -> Tensor:
    """Mean square residual (S,) of the best readout of a phase, with its penalty, as a function of the weights."""
    states = net.states(torch, weights, rows.x[phase])
    sums = rows.sums(phase, states.detach())  # at the best readout the partial slope is the whole one
    v = rows.readout(sums, net.readout_decay)
    left = ((states * v[:, :, None, None]).sum(dim=1) - rows.rest[phase]) * rows.known[phase]
    return left.square().sum(dim=(1, 2)) / sums[2].clamp(min=1.0) + net.readout_decay * rows.share * v.square().sum(1)


def _descend(net: Trainable, rows: Rows, weights: Weights) -> Weights:
    """The weights after `net.epochs` steps of Adam."""
    start = torch.cat([weights[name].flatten(1) for name in net.weights], dim=1)
    sizes, shapes = zip(*((w[0].numel(), w.shape) for w in map(weights.__getitem__, net.weights)), strict=True)

    def named(theta: Tensor) -> Weights:
        parts = zip(net.weights, theta.split(sizes, dim=1), shapes, strict=True)
        return {name: part.reshape(shape) for name, part, shape in parts}

    theta, mean, square = start.clone(), torch.zeros_like(start), torch.zeros_like(start)
    pull = 2.0 * net.decay * rows.share[:, None]
    for step in range(net.epochs):
        theta.requires_grad_()
        (slope,) = torch.autograd.grad(losses(net, rows, step % len(rows.x), named(theta)).sum(), theta)
        theta = theta.detach()
        slope = slope + pull * (theta - start)
        mean.lerp_(slope, 1.0 - _MOMENTUM)
        square.lerp_(slope.square(), 1.0 - _SECOND)
        rate = 0.5 * net.rate * (1.0 + math.cos(math.pi * step / net.epochs)) / (1.0 - _MOMENTUM ** (step + 1))
        theta = theta - rate * mean / ((square / (1.0 - _SECOND ** (step + 1))).sqrt() + _FLOOR)
    return named(theta)


def _device(net: Trainable) -> str:
    """Device to train on; warns and falls back to the processor if a requested GPU is missing."""
    if net.device == "cpu":
        return "cpu"
    if torch.cuda.is_available():
        return "cuda"
    if net.device == "cuda":
        message = f"family {net.key}: device 'cuda' was requested, but torch sees no GPU; trained on the processor"
        warnings.warn(message, stacklevel=2)
    return "cpu"
