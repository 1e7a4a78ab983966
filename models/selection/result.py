"""Result of a grid: tables of scores, cells and left-out predictions, saved as Parquet files."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from data.files import from_json

CELL_KEYS = ["protocol", "selector", "family", "n_tsp"]
SCORES = ["S_um", "max_abs_um", "bias_um", "p95_abs_um", "rmse_um", "compensation_effect", "eta", "grey_degree"]

CERTAINTY = ["coverage90", "sd_um"]


@dataclass(frozen=True)
class GridResult:
    """Everything one training found out about one error channel of one machine.

    - `batches`: batch_id, start, digest, version, source, simulated, n_rows, rows_read, rows_dropped, speed_rpm,
      start_ambient_degC, season.
    - `scores`: one row per protocol, selector, family, n_tsp, fold and tested batch_id with the columns `SCORES`
      (µm, or a ratio), fit_S_um (the fold's training batches) and n_rows. For train-on-one a row is a fold
      (fold = the training batch), batch_id "*", S_um the mean and S_std_um the std over the other batches. `CERTAINTY`:
      coverage90, the share of rows inside the stated 90 % interval, and sd_um, the mean stated standard deviation in
      µm; NaN for families that state none.
    - `cells`: one row per protocol, selector, family, n_tsp: S_mean_um, S_std_um, the means of the other scores
      (max_abs_um: the largest), `CERTAINTY`, fit_S_um, n_batches, n_parameters, rank (smaller is simpler),
      tsp_stability (mean Jaccard similarity of the chosen sets over folds, 1 = always the same), inputs (the set
      chosen from all batches, joined by "|"), n_inputs, simulated.
    - `subsets`: protocol, selector, n_tsp, fold, inputs ("|"-joined): which points every fold chose.
    - `predictions`: leave-batch-out, wide: batch_id, time_s, recorded_um, for a channel along an axis position_mm, and
      one float32 column per "selector|family|n_tsp" with the left-out prediction in µm.
    - `findings`: batch_id, check, channel, start_s, end_s, words, masks, overruled.
    - `distances`: of the chosen cell's left-out batches what was known before their error, and S, see
      `models.selection.trust.left_out_runs`; empty without a chosen cell.
    - `curves`: the chosen cell's left-out predictions, see `models.selection.trust.LeftOut`; empty without one.
    - `readings`: S of the chosen cell's later runs with readings of a touch probe, see `models.selection.updating`;
      empty without forward or a chosen cell.
    - `excluded`: channel, reason: channels that no cell may use.
    - `selector_diagnostics`: selector, n_tsp, statistic, value, threshold, ok, comment: known weaknesses of
      each selector, measured on all batches at the n_tsp of its best cell (S_mean + S_std) short of all inputs; empty
      in older files.
    - `race`: which cells were dropped in which round and why, see `models.selection.race.rounds`; empty without a race.
      A cell of the last rounds is in `scores` by the leading protocol alone, a finalist by all of them.
    - `stack`: selector, family, n_tsp and inputs of the best cells of up to five families, whose disagreement about a
      run shows of its error; weight: in the cell stack, whose members they are. Empty for fewer than two.
    """

    machine: str
    target: str
    simulated: bool
    batches: pd.DataFrame
    scores: pd.DataFrame
    cells: pd.DataFrame
    subsets: pd.DataFrame
    predictions: pd.DataFrame
    findings: pd.DataFrame
    excluded: pd.DataFrame
    distances: pd.DataFrame = field(default_factory=pd.DataFrame)
    curves: pd.DataFrame = field(default_factory=pd.DataFrame)
    readings: pd.DataFrame = field(default_factory=pd.DataFrame)
    selector_diagnostics: pd.DataFrame = field(default_factory=pd.DataFrame)
    race: pd.DataFrame = field(default_factory=pd.DataFrame)
    stack: pd.DataFrame = field(default_factory=pd.DataFrame)

    def none_um(self, protocol: str) -> float:
        """Mean S of a protocol without a model, in the error's unit; NaN where it was not measured."""
        of_none = (self.cells["family"] == "zero") & (self.cells["protocol"] == protocol)
        return float(next(iter(self.cells.loc[of_none, "S_mean_um"]), np.nan))

    def save(self, folder: Path) -> None:
        """One Parquet file per table and `result.json`."""
        folder.mkdir(parents=True, exist_ok=True)
        meta: dict[str, Any] = {"schema": "thermodrift.grid/1"}
        for f in fields(self):
            value = getattr(self, f.name)
            if isinstance(value, pd.DataFrame):
                value.to_parquet(folder / f"{f.name}.parquet", index=False, compression="zstd")
            else:
                meta[f.name] = value
        (folder / "result.json").write_text(json.dumps(meta, indent=1), encoding="utf-8")

    @classmethod
    def load(cls, folder: Path) -> GridResult:
        """The inverse of `save`."""
        meta: dict[str, Any] = from_json((folder / "result.json").read_text(encoding="utf-8"))
        tables = [f.name for f in fields(cls) if (folder / f"{f.name}.parquet").exists()]
        values = {k: v for k, v in meta.items() if k != "schema"}
        values |= {name: pd.read_parquet(folder / f"{name}.parquet") for name in tables}
        return cls(**values)


@dataclass(frozen=True)
class Training:
    """One tracked training of one error channel.

    `promotion` is what `registry.promote` recorded, with the champion_version of now; empty if nothing. `code_version`
    is the program's, see `tracking.code_version`; empty where none is recorded.
    """

    training_id: str
    started: pd.Timestamp
    simulated: bool
    result: GridResult
    params: dict[str, str] = field(default_factory=dict)
    promotion: dict[str, Any] = field(default_factory=dict)
    code_version: str = ""
