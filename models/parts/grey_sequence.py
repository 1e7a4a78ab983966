"""The grey model and its corrector inside one batch, as published: early rows teach, later ones correct, the rest test.

Functions over arrays for a study; rows are numbered from 0. The study of a THM6380 machining centre (136 rows of 2 min)
fitted GM(1,6) of the 25, 30, 35 and 40 rows that end with row 55, the LS-SVM on rows 56–65, and tested on 66–116,
counted from 1: `outputs_um = sequence_outputs(x, y, range(15, 55))`, `corrected(outputs_um, y, range(55, 65))`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data.errors import InputError
from features.design import Design
from models.base import Array
from models.gm1n import GM1N, response
from models.lssvm import LSSVM
from models.parts.grey_layer import layer_design


def sequence_outputs(
    x: Array,
    y_um: Array,
    fit: range,
    lengths: Sequence[int] = (25, 30, 35, 40),
    step_s: float = 120.0,
    kind: str = "difference",
    one_step: bool = False,
) -> Array:
    """What GM(1,N) of each sequence length says of every row from its sequence's first on, µm (n, G); NaN before.

    x (n, p) inputs, y_um (n,) error. A sequence is the `lengths[g]` most recent rows of `fit`; its sums begin with its
    first row, whose measured error it starts from; then it runs free. `one_step` gives instead what follows from
    all errors measured up to the row before: such scores look perfect and mean nothing for compensation.

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
        model = GM1N(kind).fit_design(_batch(x[start:end], y_um[start:end], step_s), [0])
        a, drive = model.fitted["a"], x[start:] @ model.fitted["b"]
        if one_step:
            sums, measured = np.cumsum(drive), np.cumsum(y_um[start:])
            out[start, g] = y_um[start]
            out[start + 1 :, g] = (sums[1:] - a * measured[:-1]) / (1.0 + a / 2.0)
        else:
            out[start:, g] = response(drive[None], a, kind, float(y_um[start]))[0]
    return out


def corrected(outputs_um: Array, y_um: Array, fit: range, tuning: str = "particle_swarm", seed: int = 0) -> Array:
    """Error_um (n,) by an LS-SVM that learned on rows `fit` what the outputs (n, G) leave over; NaN where they are.

    γ and σ by leaving out contiguous quarters of those rows.

    Raises:
        InputError: fewer than 2 usable rows, or an unknown tuning.
    """
    known = np.full(len(y_um), np.nan)
    known[list(fit)] = y_um[list(fit)]
    design = layer_design(_batch(outputs_um, known, 1.0), outputs_um)
    return LSSVM(max_rows=len(fit), tuning=tuning, seed=seed).fit_design(design, [0]).predict_design(design, [0])[0]


def _batch(x: Array, y_um: Array, step_s: float) -> Design:
    names = tuple(f"x{j + 2}" for j in range(x.shape[1]))
    time_s = np.arange(len(x), dtype=float) * step_s
    return Design(names, "error", ("sequence",), x, y_um, time_s, np.array([0, len(x)], np.int64), step_s)
