"""What a training's model is expected to leave in the next season, as a number with a bound and one sentence."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pandas as pd

from models.selection.conformal import expected_next
from models.selection.promotion import Choice
from models.selection.result import GridResult

_MUCH_WORSE = 1.5  # later runs against the same runs left out one by one; a factor that a user would call another model


@dataclass(frozen=True)
class Outlook:
    """Expected S of a run in the next season, µm.

    `S_um` is the mean left-out S under `protocol`, the one nearest to the next season that the recordings allow. Where
    choosing among the cells costs, it is the nested score: every run by the cell that the other runs chose; `cell_S_um`
    is that of the chosen cell itself, which the choice flatters. `S_std_um` is over the runs of the one that leads.
    `bound_um` covers the S of the next run with 90 % (`models.selection.conformal.expected_next`); `n_runs` under
    `protocol`. `leave_batch_out_um`, `leave_batch_out_std_um`: S_mean and S_std by leave-batch-out; NaN where it was
    not run. `warning`: the failing season, speed or block, where later runs are much worse than runs left out one by
    one. `note`: why the number is optimistic, where the order in time is not known. `kept`: what the blocks before each
    later one promised, and what was held.
    """

    protocol: str
    S_um: float
    bound_um: float
    n_runs: int
    leave_batch_out_um: float
    leave_batch_out_std_um: float
    warning: str = ""
    note: str = ""
    cell_S_um: float = float("nan")
    S_std_um: float = float("nan")
    kept: str = ""

    @property
    def summary(self) -> str:
        """The warning, the number with its bound, leave-batch-out, and the note."""
        nested = ", each by the cell that the others chose" if self.nested else ""
        parts = [self.warning, f"{self._number} ({self.protocol}, {self.n_runs} runs{nested})"]
        if self.nested:
            parts.append(f"the chosen cell itself, flattered by the choice, {self.cell_S_um:.2f} µm")
        if self.protocol != "leave-batch-out" and np.isfinite(self.leave_batch_out_um):
            parts.append(f"leave-batch-out {self.leave_batch_out_um:.2f} ± {self.leave_batch_out_std_um:.2f} µm")
        return "; ".join(p for p in [*parts, self.kept, self.note] if p)

    @property
    def headline(self) -> str:
        """The warning, and the number with its bound; what the model itself left, where the number is more."""
        choosing = f"with the cost of choosing a model, {self.cell_S_um:.2f} µm by this one alone" * self.nested
        return "; ".join(p for p in (self.warning, self._number, choosing) if p)

    @property
    def _number(self) -> str:
        where = "next season" if self.protocol == "forward" else f"by {self.protocol}"
        spread = f" ± {self.S_std_um:.2f}" if np.isfinite(self.S_std_um) else ""
        return f"expected error {where}: S {self.S_um:.2f}{spread} µm, 90 % of runs below {self.bound_um:.2f} µm"

    @property
    def nested(self) -> bool:
        """Whether `S_um` is the nested score."""
        return self.S_um > self.cell_S_um

    def as_dict(self) -> dict[str, Any]:
        return {**asdict(self), "summary": self.summary}


def outlook(result: GridResult, choice: Choice) -> Outlook:
    """The outlook of a chosen cell, from left-out scores; its bound grows as much as the nested score is larger."""
    s = result.scores
    own = s[(s["selector"] == choice.selector) & (s["family"] == choice.family) & (s["n_tsp"] == choice.n_tsp)]
    own = own[np.isfinite(own["S_um"])]
    led = expected_next(own)
    later, near = (own[own["protocol"] == p] for p in ("forward", "leave-batch-out"))
    mean, std = float(near["S_um"].mean()), float(near["S_um"].std())
    warning = _warning(result, later, near) if len(later) and len(near) else ""
    nested_um = choice.nested_S_mean_um if choice.protocol == led.protocol else led.S_um
    cost = max(nested_um / led.S_um, 1.0) if led.S_um > 0 and np.isfinite(nested_um) else 1.0
    spread_um = choice.nested_S_std_um if cost > 1.0 else float(own.loc[own["protocol"] == led.protocol, "S_um"].std())
    return Outlook(
        led.protocol, cost * led.S_um, cost * led.bound_um, led.n_runs, mean, std, warning,
        _note(result, led.protocol), led.S_um, spread_um, _kept(later),
    )  # fmt: skip


def _kept(later: pd.DataFrame) -> str:
    """What the blocks before each later one promised, and what was held; empty for fewer than two blocks."""
    blocks = [g for _, g in later.groupby("fold", sort=False)]
    promised = [expected_next(pd.concat(blocks[:k])) for k in range(1, len(blocks))]
    if not promised:
        return ""
    sizes, held = [len(g) for g in blocks[1:]], pd.concat(blocks[1:])["S_um"]
    below = sum(int((g["S_um"] <= p.bound_um).sum()) for g, p in zip(blocks[1:], promised, strict=True))
    mean_um = np.average([p.S_um for p in promised], weights=sizes)
    return (
        f"promised from earlier runs S {mean_um:.2f} µm, held {held.mean():.2f} ± {held.std():.2f} µm; {below} of "
        f"{len(held)} later runs below the promised bound"
    )


def _note(result: GridResult, protocol: str) -> str:
    """Why no later run was predicted from earlier ones; a single batch left out has its neighbours in the training."""
    if protocol == "forward":
        return ""
    reasons = result.excluded.loc[result.excluded["channel"] == "forward", "reason"]
    why = f" ({reasons.iloc[0]})" if len(reasons) else ""
    return f"optimistic: no later run was predicted from earlier ones{why}"


def _warning(result: GridResult, later: pd.DataFrame, near: pd.DataFrame) -> str:
    """Names the season, speed or block that fails, where forward is much worse than leave-batch-out on its runs."""
    later = later.set_index("batch_id")
    near_um = near.set_index("batch_id")["S_um"].reindex(later.index)
    if not later["S_um"].mean() > _MUCH_WORSE * near_um.mean():
        return ""
    labels = result.batches.assign(batch_id=result.batches["batch_id"].astype(str)).set_index("batch_id")
    groups = {c: labels[c].reindex(later.index) for c in ("season", "speed") if c in labels}
    several = {c: label for c, label in groups.items() if label.nunique() > 1} or {"block": later["fold"]}
    means = pd.concat([
        later["S_um"].groupby(c + " " + label.astype(str)).agg(["mean", "size"]) for c, label in several.items()
    ])  # fmt: skip
    worst = means.nlargest(1, "mean").iloc[0]
    return (
        f"later runs fail: S {later['S_um'].mean():.1f} µm forward in time, {near_um.mean():.1f} µm where only the run "
        f"itself is left out; worst in {worst.name} ({worst['mean']:.1f} µm, runs: {worst['size']:.0f})"
    )
