"""Too few batches to leave one out: each is cut into runs of its own, and confidence is capped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pandas as pd

from data.batch import Batch
from data.errors import InputError
from diagnosis.policy import POLICY
from twin.calibration.problem import EVERY_S
from twin.network import Network
from twin.simulation.inputs import acting, inputs_of


def enough_batches(batches: Sequence[Batch]) -> tuple[list[Batch], tuple[str, ...]]:
    """The batches, or, of fewer than four, blocks of them in time; and remarks on that.

    A block starts at its first readings; bodies without a sensor start as the network at rest, within the prior.
    """
    if len(batches) >= POLICY.min_batches:
        return list(batches), ()
    each = int(np.ceil(POLICY.min_batches / max(1, len(batches))))
    out: list[Batch] = []
    for batch in batches:
        n = max(1, min(each, batch.n_rows // POLICY.min_block_rows))
        out += _cut(batch, n)
    few = POLICY.few_runs_max_probability
    remarks = (
        f"{len(batches)} run{'s' if len(batches) != 1 else ''} only: cut into {len(out)} blocks that are left out in "
        "turn; blocks of one run share its weather and its state, so no probability above "
        f"{few[max(1, len(batches)) - 1]:g} is reported",
    )
    return out, remarks


def spacing_s(batches: Sequence[Batch]) -> float:
    """Seconds between the rows that are fitted."""
    lengths = sorted(b.step_s * b.n_rows for b in batches) or [0.0]  # an empty recording is refused where simulated
    return min(EVERY_S, lengths[len(lengths) // 2] / POLICY.min_rows_per_batch) or EVERY_S


def coarse(batches: Sequence[Batch], every_s: float, lead_rows: float = 0.0) -> list[Batch]:
    """The batches with a row every `every_s`, or their own step where that is longer: what a machine does takes
    minutes, however often it is recorded. What holds between two rows is the mean of what held there, so that heat is
    kept; drivers act `lead_rows` before the row that first shows a change (`twin.simulation.inputs.acting`)."""
    own = acting(batches, lead_rows)
    return [_thinned(b, round(every_s / b.step_s)) if b.step_s else b for b in own]


def _thinned(batch: Batch, stride: int) -> Batch:
    if stride < 2:
        return batch
    group = np.arange(batch.n_rows) // stride
    held = {
        n: np.asarray(pd.Series(batch.held.get(n, batch.masked(n))).groupby(group).mean(), np.float64)
        for n in batch.names("driver") if n in batch.table.columns
    }  # fmt: skip
    return replace(batch, table=batch.table.iloc[::stride].reset_index(drop=True), held=held)


def usable_batches(network: Network, batches: Sequence[Batch]) -> tuple[list[Batch], tuple[str, ...]]:
    """Those that the network can be driven with, and of the others why not: a hole in one run spoils no other.

    Holes are longer on the `coarse` rows that are fitted.

    Raises:
        InputError: fewer than four are left, or fewer than half; the first reason.
    """
    kept: list[Batch] = []
    remarks: list[str] = []
    reasons: list[InputError] = []
    every_s = spacing_s(batches)
    for batch in batches:
        try:
            inputs_of(network, [batch])
            inputs_of(network, coarse([batch], every_s))
            kept.append(batch)
        except InputError as error:
            reasons.append(error)
            remarks.append(f"left out: {error}")
    if reasons and len(kept) < max(POLICY.min_batches, POLICY.min_usable_share * len(batches)):
        raise reasons[0]
    return kept, tuple(remarks)


def _cut(batch: Batch, n: int) -> list[Batch]:
    if n == 1:
        return [batch]
    edges = np.linspace(0, batch.n_rows, n + 1).astype(int)
    out = []
    for k, (a, b) in enumerate(pairwise(edges)):
        first_s = float(batch.time_s[a])
        table = batch.table.iloc[a:b].reset_index(drop=True)
        table["time_s"] = table["time_s"] - first_s
        findings = tuple(
            replace(
                f,
                start_s=None if f.start_s is None else f.start_s - first_s,
                end_s=None if f.end_s is None else f.end_s - first_s,
            )
            for f in batch.findings
        )
        start = None if batch.start is None else batch.start + pd.Timedelta(seconds=first_s)
        out.append(replace(batch, batch_id=f"{batch.batch_id}_{k + 1}", table=table, start=start, findings=findings))
    return out
