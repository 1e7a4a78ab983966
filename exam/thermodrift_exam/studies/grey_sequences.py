"""Grey models of one batch as the study of a THM6380 machining centre ran them, rows numbered from 0.

Early rows train, later ones correct, the rest test: GM(1,6) of the 25, 30, 35 and 40 rows that end with row 55 of 136
rows of 2 min, then an LS-SVM on rows 56–65, and a test on 66–116, counted from 1.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data.arrays import Array
from data.errors import InputError
from features.design import Design
from models.families.gm1n import GM1N, response

_STEP_S = 120.0  # nominal step of a sequence; its length does not enter the results


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
