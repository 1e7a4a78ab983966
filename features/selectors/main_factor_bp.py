"""Selector: largest products of the weights of small neural nets (main factor strategy)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array, Mask
from data.registry import check_packages
from features.design import Design, decimated_rows
from features.nets import Nets
from features.rises import zeroed_error_um
from features.selectors.base import Diagnostic, Selector
from features.selectors.statistics import check_n_tsps, chosen_of_varying, ranking, training_statistics

Columns = NDArray[np.int64]
_COLLINEAR = 0.95  # |corr| from which two inputs count as one group for the diagnostics
_SPREAD, _CHANGES = 0.5, 0.2  # more than this over the starts and the order inside a group is chance
_HELD_OUT_EVERY, _STARTS_PER_SIZE = 4, 2


@dataclass(frozen=True)
class Sensitivity:
    """|Σ_j w_ij v_j| of the inputs `columns` (q,) that passed the gate: `of_start` (seeds, q), summed over channels.

    `hidden` is the number of hidden nodes that the validation chose for every error channel.
    """

    columns: Columns
    of_start: Array
    hidden: tuple[int, ...]

    @property
    def mean(self) -> Array:
        """Over the starts, (q,)."""
        out: Array = self.of_start.mean(axis=0)
        return out


class MainFactorBP(Selector):
    """Inputs of largest sensitivity Sens_i = |Σ_j w_ij v_j| in p–h–1 tanh nets, summed over the error channels.

    Only inputs whose |corr| with one of the error channels exceeds `gate` enter the nets. Per channel the number of
    hidden nodes h = √(p + 1) + a, a = 1 … `most_extra`, is the one of least squared error on batches held out
    from the training set (every fourth by the energy of their error; of fewer than 3 batches, quarters of them). Nets
    of that size then learn from all training rows, thinned evenly to about `rows`; Sens is averaged over `seeds`
    starts. Inputs and errors are standardised, and inputs turned to run with the error, so neither unit nor sign nor
    order matters. Where n exceeds the inputs that pass, the largest |corr| of the others follow.

    The error channels are all of the design's batches, as published for X and Z together; of a design without batches
    the target alone. Inside a group of collinear inputs the weights are chance: the starts disagree (`diagnostics`),
    and only the group's share has a meaning. Inputs that are equal but for their unit get their mean.

    Source: main factor strategy with BP weight products on a lathe; nets by Levenberg–Marquardt with weight decay.
    """

    key = "main_factor_bp"
    packages = ("torch",)
    summary = "largest product of weights in small neural networks, behind a correlation gate"
    source = "main factor strategy: correlation gate and BP weight product, lathe study"

    def __init__(
        self,
        gate: float = 0.8,
        most_extra: int = 10,
        seeds: int = 20,
        rows: int = 90,
        iterations: int = 12,
        decay: float = 3e-3,
        seed: int = 0,
    ) -> None:
        self.gate, self.most_extra, self.seeds, self.rows = float(gate), int(most_extra), int(seeds), int(rows)
        self.iterations, self.decay, self.seed = int(iterations), float(decay), int(seed)

    def select_design(self, design: Design, train: Sequence[int], n_tsps: Sequence[int]) -> dict[int, tuple[str, ...]]:
        check_n_tsps(design, n_tsps, self.key)
        statistics = training_statistics(design, train, self.key)
        relevance = self._relevance(design, train)
        found = self.sensitivity(design, train)
        same = np.abs(statistics.between[np.ix_(found.columns, found.columns)]) > 1.0 - 1e-9
        score = relevance - 2.0  # of those behind the gate: below all that passed
        score[found.columns] = same @ found.mean / np.maximum(same.sum(axis=1), 1)
        order = ranking(score, statistics.varying)
        varying = np.flatnonzero(statistics.varying)
        return chosen_of_varying(design, varying, n_tsps, lambda n: np.searchsorted(varying, order[:n]))

    def diagnostics(self, design: Design, train: Sequence[int], n_tsp: int) -> tuple[Diagnostic, ...]:
        found = self.sensitivity(design, train)
        statistics = training_statistics(design, train, self.key)
        near = np.abs(statistics.between[np.ix_(found.columns, found.columns)]) > _COLLINEAR
        grouped = near.sum(axis=1) > 1
        if not grouped.any():
            return ()
        spread = float((found.of_start.std(axis=0, ddof=1) / np.maximum(found.mean, 1e-12))[grouped].max())
        leader = np.array([np.flatnonzero(row)[np.argmax(found.mean[row])] for row in near])
        leads = np.array([s[leader] >= np.where(near, s, -np.inf).max(axis=1) for s in found.of_start])
        changes = float(1.0 - leads[:, grouped].mean(axis=0).min())
        names = ", ".join(design.inputs[c] for c in np.sort(found.columns[grouped]))
        return (
            Diagnostic("spread of the sensitivity over starts", spread, _SPREAD, spread <= _SPREAD,
                       f"largest standard deviation over mean among the collinear inputs {names}"),
            Diagnostic("first of a group changes", changes, _CHANGES, changes <= _CHANGES,
                       "share of starts in which another input of a collinear group is ahead"),
        )  # fmt: skip

    def sensitivity(self, design: Design, train: Sequence[int]) -> Sensitivity:
        """Gate, choice of the size and weight products, from the batches `train` alone."""
        statistics = training_statistics(design, train, self.key)
        relevance = self._relevance(design, train)
        passed = ranking(relevance, statistics.varying)
        passed = passed[statistics.varying[passed] & (relevance[passed] > self.gate)]
        parts = decimated_rows(design, train, max(1, -(-self.rows // max(1, len(train)))))
        rows = np.concatenate(parts)
        side = np.where(statistics.with_target[passed] < 0, -1.0, 1.0)
        x_t = _standardised(design.x[np.ix_(rows, passed)] * side).T
        recorded = error_channels(design)[:, rows]
        usable = [np.count_nonzero(np.isfinite(y)) > 2 and np.nanstd(y) > 0 for y in recorded]
        known = np.isfinite(recorded[usable])
        y = np.where(known, _standardised(recorded[usable].T).T, 0.0)
        total, hidden = np.zeros((self.seeds, len(passed))), []
        if len(passed) and len(y):
            hidden = self._sizes(x_t, y, known, held_out(parts, design.y_um))
            for c, h in enumerate(hidden):
                total += weight_products(self._trained(h, self.seeds, x_t, y[c : c + 1], known[c : c + 1]))
        return Sensitivity(passed, total, tuple(hidden))

    def _sizes(self, x_t: Array, y: Array, known: Mask, held: Mask) -> list[int]:
        """Per error channel, y and known (C, n), the hidden nodes of least squared error on the rows held out."""
        sizes = [int(np.sqrt(len(x_t) + 1.0) + a) for a in range(1, self.most_extra + 1)]
        test = known[:, held].repeat(_STARTS_PER_SIZE, axis=0)
        error = np.empty((len(sizes), len(y)))
        for i, h in enumerate(sizes):
            nets = self._trained(h, _STARTS_PER_SIZE, x_t[:, ~held], y[:, ~held], known[:, ~held])
            missed = test * (y[:, held].repeat(_STARTS_PER_SIZE, axis=0) - nets.outputs(x_t[None][..., held])) ** 2
            error[i] = missed.reshape(len(y), -1).sum(axis=1)
        return [sizes[i] for i in np.argmin(error, axis=0)]

    def _trained(self, hidden: int, starts: int, x_t: Array, y: Array, known: Mask) -> Nets:
        """Nets (C · starts) of all error channels, y and known (C, n), channel after channel."""
        check_packages("selector", self)
        from features.levenberg_marquardt import train

        drawn = Nets.drawn(starts, len(x_t), hidden, self.seed)
        nets = Nets(np.tile(drawn.parameters, (len(y), 1)), len(x_t), hidden)
        inputs = np.tile(x_t, (len(y) * starts, 1, 1))
        targets, rows = (np.repeat(a, starts, axis=0) for a in (y, known.astype(float)))
        return train(nets, inputs, targets, rows, self.decay, self.iterations)[0]

    def _relevance(self, design: Design, train: Sequence[int]) -> Array:
        """Largest |corr| of every input with an error channel over the usable training rows, (p,)."""
        rows = np.concatenate([np.arange(design.offsets[k], design.offsets[k + 1]) for k in sorted(train)])
        rows = rows[design.usable[rows]]
        relevance = np.zeros(len(design.inputs))
        for y in error_channels(design)[:, rows]:
            known = np.isfinite(y)
            if np.count_nonzero(known) > 2:
                x = _standardised(design.x[rows][known])
                relevance = np.maximum(relevance, np.abs(x.T @ _standardised(y[known])) / np.count_nonzero(known))
        return relevance


def error_channels(design: Design) -> Array:
    """The design's target and, where it knows its batches, all their other error channels, zeroed, (C, n) in µm."""
    others = [c for c in design.batches[0].names("error") if c != design.target] if design.batches else []
    found = [
        np.concatenate([
            zeroed_error_um(b, c) if c in b.channels else np.full(b.n_rows, np.nan) for b in design.batches
        ])
        for c in others
    ]  # fmt: skip
    return np.array([design.y_um, *found])


def held_out(parts: Sequence[Columns], y_um: Array) -> Mask:
    """Validation rows (n,) of the concatenated parts: whole batches; of fewer than 3 batches, whole quarters of them.

    `parts` are indices into y_um of the rows of each batch.
    """
    if sum(len(r) > 0 for r in parts) < 3:
        parts = [quarter for r in parts for quarter in np.array_split(r, 4)]
    energy = [float(np.square(y_um[r] - y_um[r].mean()).sum()) if len(r) else 0.0 for r in parts]
    rank = np.argsort(np.argsort(energy, kind="stable"), kind="stable")
    return np.concatenate([np.full(len(r), place % _HELD_OUT_EVERY == 2) for r, place in zip(parts, rank, strict=True)])


def weight_products(nets: Nets) -> Array:
    """|Σ_j w_ij v_j| of every net and input, (S, p)."""
    h, p = nets.n_hidden, nets.n_inputs
    w = nets.parameters[:, : h * p].reshape(-1, h, p)
    v = nets.parameters[:, h * (p + 1) : h * (p + 2)]
    products: Array = np.abs((v[:, None] @ w)[:, 0])
    return products


def _standardised(values: Array) -> Array:
    """Columns less their mean over their standard deviation, of the known values; a constant becomes 0."""
    mean, std = np.nanmean(values, axis=0), np.nanstd(values, axis=0)
    out: Array = (values - mean) / np.where(std > 1e-9 * (np.abs(mean) + std), std, np.inf)
    return out
