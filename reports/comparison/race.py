"""Why the champion won: the expected loss of every family's best cell, and who was dropped from the race when."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from models.protocols import PromotionRule
from models.selection.loss import BASELINES
from models.selection.promotion import Choice, ranked
from models.selection.result import GridResult
from reports.comparison.figures import logarithmic, say_simulated
from reports.drawing import GREY, MUTED, panel
from reports.labels import BLUE, INK, NOTHING, cell_label, family_label, number, plus_minus
from reports.layout import Column, Key, Panel, Plot, Row, Scale, Table

_SHOWN = 9  # families in the figure
_ROUNDS = {"families": "1 families", "points": "2 points", "runs": "3 runs"}  # of `models.selection.race`


def why_panel(name: str, result: GridResult, choice: Choice, rule: PromotionRule, digits: int) -> Panel | None:
    """Expected loss in a future run, the champion's first, and what every other family's best cell would have cost.

    None where none of the rule's protocols was run.
    """
    if not rule.offered(set(result.cells["protocol"])):
        return None
    table = _with_champion(ranked(result, rule, choice.cell), choice).head(_SHOWN)
    own_um = float(table.loc[table["is_own"], "score_um"].iloc[0]) if table["is_own"].any() else choice.score_um
    others = table[~table["is_own"] & ~table["family"].isin(BASELINES)]
    plot = Plot(_losses(table, own_um, result.simulated), f"{name}: expected loss of every family", "full")
    notes = [
        "Mean S over left-out runs with the cost of choosing, pooled with what the family reached on other machines. A "
        "bar is one standard error of the difference to the chosen cell, over runs."
    ]
    if len(others):
        second = others.iloc[0]
        words = cell_label(second["selector"], second["family"], int(second["n_tsp"]))
        cost = number(second["score_um"] - own_um, max(digits, 2), sign=True)
        notes.insert(0, f"The runner-up, {words}, would cost {cost} ± {number(second['se_um'], 2)} µm a run.")
    keys = (Key("chosen", BLUE, "circle"), Key("other families", INK, "circle"), Key("baselines", GREY, "circle"))
    return Panel(f"{name}: why this model", (plot,), result.simulated, keys, tuple(notes))


def race_table(name: str, result: GridResult, digits: int) -> Table | None:
    """Of every family the best cell in the last round that it was in, and why it went no further; None: no race."""
    race = result.race
    if race.empty:
        return None
    race = race[~race["family"].isin(BASELINES)].assign(place=lambda t: t["round"].map(list(_ROUNDS).index))
    last = race["place"] == race.groupby("family")["place"].transform("max")
    order = race[last].sort_values(["place", "S_mean_um"], ascending=[False, True], kind="stable")
    rows = [
        Row.of(
            family_label(r["family"]),
            cell_label(r["selector"], r["family"], int(r["n_tsp"])),
            _ROUNDS[r["round"]],
            str(r["n_runs"]),
            number(r["S_mean_um"], digits),
            plus_minus(r["behind_um"], r["se_um"], digits) if np.isfinite(r["se_um"]) else NOTHING,
            "went on to all folds" if r["kept"] else r["why"],
        )
        for r in order.drop_duplicates("family").to_dict("records")
    ]
    columns = (
        Column("family"),
        Column("its best cell"),
        Column("last round"),
        Column("runs", "", "number"),
        Column("S_mean", "µm", "number"),
        Column("behind the leader", "µm", "number"),
        Column("outcome", "", "wide"),
    )
    counts = [(label, own["kept"]) for r, label in _ROUNDS.items() if len(own := race[race["round"] == r])]
    note = "; ".join(f"round {label}: {len(kept)} cells, {kept.sum()} went on" for label, kept in counts)
    return Table(f"{name}: the race", columns, tuple(rows), result.simulated, None, (f"{note}.",))


def _with_champion(table: pd.DataFrame, choice: Choice) -> pd.DataFrame:
    """The best cell of every family, in the chosen family's row the chosen cell."""
    own = table["family"] == choice.family
    table = table.assign(
        is_own=own,
        selector=table["selector"].mask(own, choice.selector),
        n_tsp=table["n_tsp"].mask(own, choice.n_tsp),
        score_um=table["score_um"].mask(own, choice.score_um),
    )
    return table.sort_values(["is_own", "score_um"], ascending=[False, True], kind="stable").reset_index(drop=True)


def _losses(table: pd.DataFrame, own_um: float, simulated: bool) -> Figure:
    tall_in = 0.3 * len(table)
    fig = Figure(figsize=(7.0, tall_in + 0.8))
    ax = panel(fig, 2.8, 0.3, 4.0, tall_in)
    names = [cell_label(r["selector"], r["family"], int(r["n_tsp"])) for r in table.to_dict("records")]
    for i, r in enumerate(table.to_dict("records")):
        color = BLUE if r["is_own"] else GREY if r["family"] in BASELINES else INK
        error = 0.0 if r["is_own"] or not np.isfinite(r["se_um"]) else r["se_um"]
        ax.errorbar(r["score_um"], i, xerr=error, fmt="o", color=color, ms=5, lw=1)
        ax.annotate(f"{r['score_um'] - own_um:+.2f}" if not r["is_own"] else f"{own_um:.2f} µm", (r["score_um"], i),
                    (0, 5), textcoords="offset points", ha="center", fontsize=7, color=MUTED)  # fmt: skip
    ax.axvline(own_um, color=BLUE, lw=0.8, ls=":")
    values = table["score_um"].to_numpy(float)
    logarithmic(ax, Scale.over([*(values / 1.1), *(values * 1.1)], math.inf), "x")
    ax.set_yticks(range(len(names)), names, fontsize=8)
    ax.set_ylim(len(names) - 0.5, -0.6)
    ax.set_xlabel("expected loss in a future run, µm", fontsize=8, color=MUTED)
    say_simulated(ax, simulated)
    return fig
