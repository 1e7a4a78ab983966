"""Back-propagation net p–h–1 trained by Levenberg–Marquardt, with tanh or linear transfer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.errors import InputError, closest
from data.registry import check_packages
from features.design import Design, decimated_rows
from features.nets import Nets
from models.base import Family
from models.numerics.batches import too_few_rows
from models.program import Builder

_STACK_VALUES = 4_000_000  # of the Jacobians trained together: what fits a processor's cache and memory
TRANSFERS = ("tanh", "linear")
_LEAST_SPREAD = 0.1  # inputs that hardly move (K, or the driver's unit) are not blown up to unit spread


class BP(Family):
    """Back-propagation net p–`hidden`–1 with linear output; the mean of `starts` nets of seeded starts.

    `transfer` of the hidden layer: "tanh", or "linear" as in the year-round study. With linear transfer the net is a
    linear map x · Σ_j v_j w_j, found iteratively: least squares with the penalty 2 · decay · |β|, not squared, which
    is the least that |w|² + |v|² can be for a slope β (Cauchy and Schwarz).

    Inputs are relative to the batch's start, where they are 0; that start, with an error of 0, is one row more that
    weighs as much as all others (`as_published`: the inputs as they are, without that row). Inputs and target are
    standardised by the training rows of the fold. Batches are decimated evenly to at most
    `max_rows` usable rows each. Every net takes at most `iterations` Levenberg–Marquardt steps with weight `decay`
    (on standardised data), the same for every fold: train-on-one has no batch for early stopping.
    With tanh the decay bounds the extrapolation: |ŷ − mean| ≤ std_y (|c| + Σ|v_j|).

    Source: the year-round study's 2–3–1 net; M. Hagan and M. Menhaj, IEEE Trans. Neural Networks 5 (1994).
    """

    key = "bp"
    summary = "BP neural network, Levenberg–Marquardt"
    source = "Hagan and Menhaj 1994"
    closed_form = False
    packages = ("torch",)
    rank = 70

    def __init__(
        self,
        hidden: int = 3,
        starts: int = 3,
        decay: float = 3e-3,
        iterations: int = 30,
        max_rows: int = 20,
        seed: int = 0,
        transfer: str = "tanh",
    ) -> None:
        super().__init__()
        if transfer not in TRANSFERS:
            raise InputError(f"family {self.key}: unknown transfer {transfer!r}: {closest(transfer, TRANSFERS)}")
        self.hidden, self.starts, self.decay = int(hidden), int(starts), float(decay)
        self.iterations, self.max_rows, self.seed, self.transfer = int(iterations), int(max_rows), int(seed), transfer

    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        """All folds' nets trained as stacks of similar row counts.

        Raises:
            InputError: fewer than 2 usable rows in a fold.
        """
        kept = decimated_rows(design, range(design.n_batches), self.max_rows)
        rows = [np.concatenate([kept[k] for k in fold]) if len(fold) else np.empty(0, np.int64) for fold in folds]
        for f, fold in enumerate(folds):
            if len(rows[f]) < 2:
                raise too_few_rows(self.key, design, fold, len(rows[f]), 2)
        out: dict[int, Self] = {}
        for stack in self._stacks([len(r) for r in rows], len(design.inputs)):
            out |= dict(zip(stack, self._fit_stack(design, [rows[f] for f in stack]), strict=True))
        return [out[f] for f in range(len(folds))]

    def respond(self, design: Design, batches: Sequence[int]) -> list[Array]:
        f, x = self.fitted, self.started(design).x
        nets = Nets(np.atleast_2d(np.asarray(f["nets"], float)), x.shape[1], self.hidden, self.transfer)
        u = (x - np.asarray(f["x_mean"], float)) / np.asarray(f["x_spread"], float)
        return [f["y_mean"] + f["y_spread"] * nets.outputs(u[design.rows(k)].T[None]).mean(axis=0) for k in batches]

    def operations(self, b: Builder) -> Sequence[int]:
        f, h, p = self.fitted, self.hidden, len(self.inputs)
        u = b.scaled(self.started_inputs(b), f["x_spread"], f["x_mean"])
        nets = np.atleast_2d(np.asarray(f["nets"], float))
        w, offset, v, c = np.split(nets, [h * p, h * (p + 1), h * (p + 2)], axis=1)
        hidden = b.affine(u, w.reshape(-1, p), offset.ravel())
        if self.transfer == "tanh":
            hidden = b.add("tanh", [hidden], b.size(hidden))
        share = f["y_spread"] / len(nets)
        return [b.affine(hidden, share * v.reshape(1, -1), f["y_mean"] + f["y_spread"] * float(c.mean()))]

    def n_parameters(self) -> int:
        return int(np.size(self.fitted["nets"]))

    def _stacks(self, counts: Sequence[int], n_inputs: int) -> list[list[int]]:
        """Folds in the order of their rows, cut where the rows double or the stack is full."""
        per_row = self.starts * (self.hidden * (n_inputs + 2) + 1)
        stacks: list[list[int]] = []
        for f in sorted(range(len(counts)), key=lambda i: counts[i]):
            last = stacks[-1] if stacks else []
            full = (len(last) + 1) * counts[f] * per_row > _STACK_VALUES
            if not last or full or counts[f] > 2 * counts[last[0]]:
                stacks.append([])
            stacks[-1].append(f)
        return stacks

    def _fit_stack(self, design: Design, rows: Sequence[NDArray[np.int64]]) -> list[Self]:
        check_packages("family", self)
        from features.levenberg_marquardt import train

        n, p, starts = max(len(r) for r in rows) + self.zero_start, len(design.inputs), self.starts
        all_x = self.started(design).x
        x_t, y, known = np.zeros((len(rows), p, n)), np.zeros((len(rows), n)), np.zeros((len(rows), n))
        scales = []
        for s, r in enumerate(rows):
            x, y_um = all_x[r], design.y_um[r]
            x_mean, x_spread = x.mean(axis=0), np.maximum(x.std(axis=0), _LEAST_SPREAD)
            y_mean, y_spread = float(y_um.mean()), float(y_um.std()) or 1.0
            x_t[s, :, : len(r)] = ((x - x_mean) / x_spread).T
            y[s, : len(r)], known[s, : len(r)] = (y_um - y_mean) / y_spread, 1.0
            if self.zero_start:
                x_t[s, :, len(r)], y[s, len(r)] = -x_mean / x_spread, -y_mean / y_spread
                known[s, len(r)] = np.sqrt(len(r))
            scales.append({"x_mean": x_mean, "x_spread": x_spread, "y_mean": y_mean, "y_spread": y_spread})
        first = Nets.drawn(starts, p, self.hidden, self.seed, self.transfer)
        nets = replace(first, parameters=np.tile(first.parameters, (len(rows), 1)))
        nets, steps = train(nets, np.repeat(x_t, starts, axis=0), np.repeat(y, starts, axis=0),
                            np.repeat(known, starts, axis=0), self.decay, self.iterations)  # fmt: skip
        parts = nets.parameters.reshape(len(rows), starts, -1)
        taken = steps.reshape(len(rows), starts)
        return [
            self._learned(design, {"nets": parts[s], **scales[s], "steps": taken[s], "n_rows": len(rows[s])})
            for s in range(len(rows))
        ]


class BPLinear(BP):
    """`BP` with linear transfer: one start, since every start leads to the same linear map."""

    key = "bp_linear"
    summary = "BP neural network with linear transfer: a linear map found iteratively"
    source = "year-round PCR study; Hagan and Menhaj 1994"
    rank = 20

    def __init__(self, hidden: int = 3, starts: int = 1, decay: float = 3e-4, iterations: int = 30,
                 max_rows: int = 80, seed: int = 0, transfer: str = "linear") -> None:  # fmt: skip
        super().__init__(hidden, starts, decay, iterations, max_rows, seed, transfer)
