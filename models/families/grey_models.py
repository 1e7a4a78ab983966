"""Grey models as the first layer of a corrected model: out-of-sample outputs for training."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from data.arrays import Array
from features.design import Design
from models.base import inner_groups
from models.families.gm1n import GM1N

_FEW = 3  # batches: with fewer, quarters of them are left out


@dataclass(frozen=True)
class GreyLayer:
    """The G grey models of one training set, and their out-of-sample outputs on it, µm (n, G), NaN on other rows."""

    models: list[GM1N]
    outputs_um: Array


def grey_layers(design: Design, folds: Sequence[Sequence[int]], grey: Sequence[GM1N]) -> list[GreyLayer]:
    """A layer per fold, of one model per unfitted GM(1,N) in `grey`; equal training sets are fitted once.

    Raises:
        InputError: too few usable rows, or training batches of different steps.
    """
    wanted: dict[tuple[int, ...], list[int]] = {}
    for fold in folds:
        wanted.setdefault(tuple(fold), [])
        for k in fold if len(fold) >= _FEW else ():
            wanted.setdefault(tuple(j for j in fold if j != k), []).append(k)
    sets = list(wanted)
    place = {batches: s for s, batches in enumerate(sets)}
    fitted = [family.fit_folds(design, sets) for family in grey]
    predicted = [
        family.predict_folds(design, own, list(wanted.values())) for family, own in zip(grey, fitted, strict=True)
    ]
    out = []
    for fold in folds:
        outputs_um = np.full((len(design.time_s), len(grey)), np.nan)
        if len(fold) < _FEW:
            _fill_by_quarters(outputs_um, design, fold, grey)
        else:
            for k in fold:
                rest = tuple(j for j in fold if j != k)
                s, at = place[rest], wanted[rest].index(k)
                outputs_um[design.rows(k)] = np.column_stack([predicted[g][s][at] for g in range(len(grey))])
        out.append(GreyLayer([fitted[g][place[tuple(fold)]] for g in range(len(grey))], outputs_um))
    return out


def layer_design(design: Design, outputs_um: Array) -> Design:
    """The same batches with the outputs of grey models (n, G) as inputs, and the target on the rows that have them."""
    known = np.isfinite(outputs_um).all(axis=1)
    names = tuple(f"grey{g + 1}" for g in range(outputs_um.shape[1]))
    return Design(names, design.target, design.batch_ids, outputs_um, np.where(known, design.y_um, np.nan),
                  design.time_s, design.offsets, design.step_s, input_units=("um",) * len(names),
                  batches=design.batches)  # fmt: skip


def _fill_by_quarters(outputs_um: Array, design: Design, fold: Sequence[int], grey: Sequence[GM1N]) -> None:
    rows = np.flatnonzero(np.isin(design.group, list(fold)) & design.usable)
    group = inner_groups(design.group[rows])
    for q in np.unique(group):
        hidden = design.y_um.copy()
        hidden[rows[group == q]] = np.nan
        blind = replace(design, y_um=hidden, _parent=None, _columns=None)
        k = int(design.group[rows[group == q][0]])
        inside = rows[group == q] - design.offsets[k]
        for g, family in enumerate(grey):
            outputs_um[rows[group == q], g] = family.fit_design(blind, fold).predict_design(blind, [k])[0][inside]
