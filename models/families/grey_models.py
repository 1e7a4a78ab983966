"""Grey models as the first layer of a corrected model: out-of-sample outputs for training, and the published one-batch
form.

The one-batch function works on arrays, rows numbered from 0: early rows train, later ones correct, the rest test. The
study of a THM6380 machining centre (136 rows of 2 min) fitted GM(1,6) of the 25, 30, 35 and 40 rows that end with row
55, `sequence_outputs(x, y, range(15, 55))`, then an LS-SVM on rows 56–65, and tested on 66–116, counted from 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from data.arrays import Array
from data.errors import InputError
from features.design import Design
from models.base import inner_groups
from models.families.gm1n import GM1N, response

_FEW = 3  # batches: with fewer, quarters of them are left out
_STEP_S = 120.0  # nominal step of a sequence; its length does not enter the results


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


def sequence_outputs(
    x: Array,
    y_um: Array,
    fit: range,
    lengths: Sequence[int] = (25, 30, 35, 40),
    kind: str = "difference",
    one_step: bool = False,
) -> Array:
    """Output of GM(1,N) for each sequence length on every row from its sequence's first on, µm (n, G); NaN before.

    x (n, p) inputs, y_um (n,) error. A sequence is the `lengths[g]` most recent rows of `fit`; its sums begin with its
    first row, whose measured error it starts from; then it runs free. `one_step` gives instead what follows from
    all errors measured up to the row before: such scores do not apply to compensation.

    Raises:
        InputError: a sequence longer than `fit`, or shorter than the model has unknowns, or values not finite in it.
    """
    out = np.full((len(x), len(lengths)), np.nan)
    for g, length in enumerate(lengths):
        if not x.shape[1] + 2 <= length <= len(fit):
            raise InputError(
                f"grey sequence: length {length} with {len(fit)} rows to fit and {x.shape[1]} inputs; expected from "
                f"{x.shape[1] + 2} to {len(fit)} rows"
            )
        start, end = fit[-1] + 1 - length, fit[-1] + 1
        model = GM1N(kind).fit_design(_batch(x[start:end], y_um[start:end]), [0])
        a, drive = model.fitted["a"], x[start:] @ model.fitted["b"]
        if one_step:
            sums, measured = np.cumsum(drive), np.cumsum(y_um[start:])
            out[start, g] = y_um[start]
            out[start + 1 :, g] = (sums[1:] - a * measured[:-1]) / (1.0 + a / 2.0)
        else:
            out[start:, g] = response(drive[None], a, kind, float(y_um[start]))[0]
    return out


def _batch(x: Array, y_um: Array) -> Design:
    names = tuple(f"x{j + 2}" for j in range(x.shape[1]))
    time_s = np.arange(len(x), dtype=float) * _STEP_S
    return Design(names, "error", ("sequence",), x, y_um, time_s, np.array([0, len(x)], np.int64), _STEP_S)
