"""2. A family of your own: one class in one file, one line in the registry.

In the project the class would be `models/families/nearest_batch.py` and the line
`"nearest_batch": "models.families.nearest_batch:NearestBatch"` in `models/families/__init__.py`; here both are made on
the spot. From then on the grid crosses it, the report ranks it and `pytest tests/contracts -k nearest_batch` checks it.
"""

from collections.abc import Sequence
from typing import Self

import numpy as np

from data.arrays import Array
from features.design import Design
from models.base import Family
from models.numerics.batches import too_few_rows


class NearestBatch(Family):
    """The error of the training batch whose rises were most similar at the same time since start."""

    key = "nearest_batch"
    summary = "the most similar training batch's own error"
    source = "an example"

    def fit_design(self, design: Design, train: Sequence[int]) -> Self:
        usable = int(np.isfinite(design.y_um[np.isin(design.group, list(train))]).sum())
        if usable < 2:
            raise too_few_rows(self.key, design, train, usable, 2)
        n = min(design.rows(k).stop - design.rows(k).start for k in train)
        x = np.stack([design.x[design.rows(k)][:n] for k in train])
        y = np.stack([design.y_um[design.rows(k)][:n] for k in train])
        return self._learned(design, {"x_K": x, "y_um": np.nan_to_num(y)})

    def respond(self, design: Design, batches: Sequence[int]) -> list[Array]:
        out = []
        for k in batches:
            x = design.x[design.rows(k)]
            n = min(len(x), self.fitted["x_K"].shape[1])
            # Only the past counts: the distance up to each row, so the prediction can run at the machine.
            distance = np.cumsum(np.square(self.fitted["x_K"][:, :n] - x[:n]).sum(axis=2), axis=1)
            nearest = distance.argmin(axis=0)
            predicted = self.fitted["y_um"][nearest, np.arange(n)]
            out.append(np.concatenate([predicted, np.full(len(x) - n, predicted[-1])]))
        return out


if __name__ == "__main__":
    import tempfile
    from pathlib import Path

    from data.machine import load_machine
    from data.recording import read_batches
    from models.families import FAMILIES
    from models.selection.crossing import Plan
    from models.selection.grid import run_grid
    from plants.sample.sample_year import write_sample_year

    FAMILIES.add("nearest_batch", f"{__name__}:NearestBatch")

    machine = load_machine(Path(__file__).parent.parent / "machines" / "sample_vmc.yml")
    with tempfile.TemporaryDirectory() as folder:
        batches = [b for f in write_sample_year(Path(folder)) for b in read_batches(f, machine)]
    plan = Plan(("fuzzy_correlation",), ("zero", "mlr", "nearest_batch"), ("leave-batch-out",), (4,))
    cells = run_grid(batches, ["z"], plan)["z"][1].cells.set_index("family")
    print(cells[["S_mean_um", "S_std_um"]].round(2).to_string())
    assert cells.loc["nearest_batch", "S_mean_um"] < cells.loc["zero", "S_mean_um"]
