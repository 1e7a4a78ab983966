"""What `thermodrift simulate` says: errors after some hours, the hottest body, where the heat comes from."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from rich.box import SIMPLE_HEAD
from rich.table import Table

from data.batch import Batch
from features.iso230_3 import clock
from pipelines import screen
from pipelines.simulating import Simulated, SimulationOutcome
from reports.labels import number

HOURS = (1.0, 2.0, 6.0)
_UNITS = {"um": "µm", "um/m": "µm/m"}


def error_table(batch: Batch) -> pd.DataFrame:
    """Per error channel: unit, range, value after 1, 2 and 6 h (NaN where the plan is shorter) and at the end."""
    rows = []
    for name in batch.names("error"):
        values, unit = batch.values(name), batch.channels[name].unit
        after = np.interp([h * 3600.0 for h in HOURS], batch.time_s, values, right=np.nan)
        at = {f"at_{h:g}h": float(v) for h, v in zip(HOURS, after, strict=True)}
        rows.append({"channel": name, "unit": unit, "range": float(np.ptp(values)), **at, "end": float(values[-1])})
    return pd.DataFrame(rows, columns=["channel", "unit", "range", *(f"at_{h:g}h" for h in HOURS), "end"])


def hottest(one: Simulated) -> tuple[str, float, float]:
    """The cell that gets hottest, how hot (degC) and when (s)."""
    cells = one.simulation.cells_degC
    assert cells is not None
    row, cell = np.unravel_index(int(np.argmax(cells[0, 0])), cells.shape[2:])
    return one.simulation.network.cells[cell], float(cells[0, 0, row, cell]), float(one.simulation.time_s[0, row])


def heat_table(one: Simulated) -> pd.DataFrame:
    """Per heat source: mean and greatest W over the plan, and its energy in Wh, the most first."""
    found, seconds = one.simulation, float(one.job.plan.time_s[-1])
    names = [h.law.name for h in found.network.heats]
    rows = [
        {"source": n, "mean_W": found.heat_J[n][0, 0, -1] / seconds, "most_W": found.heat_W[n][0, 0].max(),
         "energy_Wh": found.heat_J[n][0, 0, -1] / 3600.0}
        for n in names
    ]  # fmt: skip
    table = pd.DataFrame(rows, columns=["source", "mean_W", "most_W", "energy_Wh"])
    return table.sort_values("mean_W", ascending=False, kind="stable", ignore_index=True)


def print_outcome(outcome: SimulationOutcome) -> None:
    """Per plan: errors, hottest body, heat by source; then where everything is."""
    for one in outcome.plans:
        length = clock(float(one.job.plan.time_s[-1]))
        screen.line(f"{one.job.file.stem}: {one.job.plan.name}, {length} h, simulated; {one.simulation.words}")
        if len(one.batch.names("error")):
            screen.out.print(_errors(error_table(one.batch)))
        body, degC, time_s = hottest(one)
        screen.line(f"hottest body: {body}, {degC:.1f} °C at {clock(time_s)} h")
        screen.out.print(_heats(heat_table(one)))
        screen.line(f"recording {one.job.file}")
        if one.report is not None:
            screen.line(f"report    {one.report}")
    screen.line(f"overview  {outcome.overview}")
    screen.line(f"twin      {outcome.twin}")


def outcome_dict(outcome: SimulationOutcome) -> dict[str, Any]:
    """What came of a simulation, for machines."""
    plans = []
    for one in outcome.plans:
        body, degC, time_s = hottest(one)
        plans.append(
            {
                "plan": one.job.plan.name,
                "file": str(one.job.file),
                "report": None if one.report is None else str(one.report),
                "hours": float(one.job.plan.time_s[-1]) / 3600.0,
                "rows": one.batch.n_rows,
                "words": one.simulation.words,
                "errors": screen.records(error_table(one.batch)),
                "hottest": {"body": body, "degC": degC, "time_s": time_s},
                "heat": screen.records(heat_table(one)),
            }
        )
    files = {"overview": str(outcome.overview), "twin": str(outcome.twin)}
    return {"machine": outcome.machine, "simulated": True, "plans": plans, **files}


def _errors(table: pd.DataFrame) -> Table:
    shown = _table("error", "unit", "range", *(f"{h:g} h" for h in HOURS), "end")
    for r in table.to_dict("records"):
        after = [number(float(r[f"at_{h:g}h"])) for h in HOURS]
        shown.add_row(str(r["channel"]), _UNITS.get(str(r["unit"]), str(r["unit"])), number(float(r["range"])), *after,
                      number(float(r["end"])))  # fmt: skip
    return shown


def _heats(table: pd.DataFrame) -> Table:
    shown = _table("heat", "", "mean W", "most W", "Wh")
    for r in table.to_dict("records"):
        watts = [number(float(r[k]), 0) for k in ("mean_W", "most_W", "energy_Wh")]
        shown.add_row(str(r["source"]), "", *watts)
    total = table[["mean_W", "energy_Wh"]].sum()
    shown.add_row("all", "", number(float(total["mean_W"]), 0), "", number(float(total["energy_Wh"]), 0))
    return shown


def _table(*names: str) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for k, name in enumerate(names):
        table.add_column(name, no_wrap=True, justify="left" if k < 2 else "right")
    return table
