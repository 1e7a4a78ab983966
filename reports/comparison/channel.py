"""One error channel's part of the page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd

from models.promotion import Choice, compare_paired, left_out
from models.protocols import PromotionRule
from models.result import GridResult, Training
from reports.comparison import figures, tables
from reports.comparison import story as records
from reports.comparison.certainty import certainty_table, diagnostics_table, rise_panel, rise_table
from reports.comparison.figures import fan_panel
from reports.comparison.story import Verdict, comparison_rows, mark_of
from reports.comparison.tables import (
    LeftOut,
    Promoted,
    best_per,
    frequencies,
    is_baseline,
    left_out_batches,
    paths,
    protocols_of,
    scored,
    zero_um,
)
from reports.labels import (
    BLUE,
    INK,
    ORANGE,
    cell_label,
    count,
    decimals,
    family_label,
    family_style,
    listed,
    number,
    selector_label,
)
from reports.layout import Key, Panel, Plot, Table

_MOST_POINTS_SHOWN = 24


@dataclass(frozen=True)
class Channel:
    """Everything the templates show of one error channel."""

    anchor: str
    name: str
    simulated: bool
    protocol: str
    verdict: Verdict
    inputs: str
    boards: tuple[Table, ...]
    certainty: Table | None
    heat: Panel | None
    points: Panel | None
    frequency: Panel | None
    weaknesses: Table | None
    left_out: Panel | None
    fan: Panel | None
    protocols: tuple[Table, ...]
    batches: Table
    rise: Panel | None
    rises: Table | None
    comparison: tuple[tuple[str, str], ...]
    trainings: Table | None
    changes: tuple[str, ...]
    change: Panel | None


def channel_part(
    anchor: str,
    name: str,
    group: Sequence[Training],
    choices: Sequence[Choice],
    outcome: Verdict,
    rule: PromotionRule,
) -> Channel:
    """A channel's part from its trainings, newest first, and their promoted cells."""
    result, choice = group[0].result, choices[0]
    protocol = protocols_of(result)[0]
    cells = scored(result, protocol, rule)
    digits = decimals(choice.S_std_um, choice.n_batches)
    mark = mark_of(group[0])
    shown = left_out_batches(result, choice)
    promoted = Promoted(choice, rule, digits, mark)
    boards = tuple(
        tables.leaderboard(result, cells, key, promoted, f"{name}: best cell of every {key}, {protocol}")
        for key in ("family", "selector")
    )
    others = []
    for other in protocols_of(result)[1:]:
        own = scored(result, other, rule)
        if len(own):
            caption = f"{name}: best cell of every family, {other}"
            others.append(tables.leaderboard(result, own, "family", promoted, caption))
    changes, change = _changes(name, group, choices)
    return Channel(
        anchor=anchor,
        name=name,
        simulated=result.simulated,
        protocol=protocol,
        verdict=outcome,
        inputs=", ".join(choice.inputs),
        boards=boards,
        certainty=certainty_table(name, result, cells, choice, digits, mark),
        heat=_heat(name, result, cells, digits),
        points=_points(name, result, cells, choice),
        frequency=_frequency(name, result, cells, protocol),
        weaknesses=diagnostics_table(name, result),
        left_out=_left_out(name, result, choice, shown, digits),
        fan=fan_panel(name, shown, result.target, digits, result.simulated),
        protocols=tuple(others),
        batches=tables.batches(result, choice, digits),
        rise=rise_panel(name, result.distances, result.simulated),
        rises=rise_table(name, result.distances, digits, result.simulated),
        comparison=tuple(comparison_rows(group[0].promotion)),
        trainings=_trainings(group, choices) if len(group) > 1 else None,
        changes=changes,
        change=change,
    )


def _heat(name: str, result: GridResult, cells: pd.DataFrame, digits: int) -> Panel | None:
    best = best_per(cells[~is_baseline(cells) & (cells["n_tsp"] > 0)], "selector", "family")
    if best.empty:
        return None
    nothing = zero_um(cells)
    figure = figures.heat_map(best, nothing if math.isfinite(nothing) else math.inf, digits, result.simulated)
    levels = [
        f"{family_label(r['family'])} {number(r['S_mean_um'], digits)} µm"
        for r in best_per(cells[cells["n_tsp"] == 0], "family").to_dict("records")
    ]
    note = "For each pair the number of points n with the least score. The darker, the smaller the error left."
    notes = (note, f"Without temperature points: {listed(levels)}.") if levels else (note,)
    title = f"{name} selectors and families"
    return Panel(
        f"{name}: S_mean of every selector and family, µm", (Plot(figure, title),), result.simulated, (), notes
    )


def _points(name: str, result: GridResult, cells: pd.DataFrame, choice: Choice) -> Panel | None:
    tried = paths(cells)
    best = best_per(tried, "family")
    if best.empty:
        return None
    at = dict(zip(best["family"], best["selector"], strict=True))
    if ((tried["family"] == choice.family) & (tried["selector"] == choice.selector)).any():
        at[choice.family] = choice.selector  # the promoted model's own line, where another selector is as good
    lines = tried[tried["selector"] == tried["family"].map(at)]
    flat = best_per(cells[cells["n_tsp"] == 0], "family")
    plots = tuple(
        Plot(
            figures.against_points(lines, flat, column, f"{short}, µm", choice.family, result.simulated),
            f"{name}: {short.lower().replace('s_', 'S_')}",
            "half",
        )
        for column, short in (("S_mean_um", "Accuracy S_mean"), ("S_std_um", "Robustness S_std"))
    )
    keys = [Key(f"{family_label(f)}, {selector_label(s)}", *family_style(f)) for f, s in at.items()]
    keys += [Key(family_label(f), "#5a6572", figures.flat_dash(f)) for f in flat["family"]]
    return Panel(
        f"{name}: accuracy and robustness against the number of points",
        plots,
        result.simulated,
        tuple(keys),
        ("Each family with its best selector; both axes are smaller-is-better, log scale. What runs out of the top is "
         "worse than no model. The chosen family is drawn stronger.",),
    )  # fmt: skip


def _frequency(name: str, result: GridResult, cells: pd.DataFrame, protocol: str) -> Panel | None:
    found = frequencies(result, cells, protocol)
    if not found:
        return None
    figure = figures.point_frequency(found, _MOST_POINTS_SHOWN, result.simulated)
    total = len({p for f in found for p in f.share})
    stable = [f"{selector_label(f.selector)} {number(f.stability, 2)} ({f.n_tsp} points)" for f in found]
    notes = [
        f"Share of the folds that chose a point, at each selector's best n short of all. Mean Jaccard similarity: "
        f"{listed(stable)}."
    ]
    if total > _MOST_POINTS_SHOWN:
        notes.append(f"The {_MOST_POINTS_SHOWN} most often chosen of {total} points.")
    title = f"{name} chosen points"
    return Panel(f"{name}: how often each point is chosen", (Plot(figure, title),), result.simulated, (), tuple(notes))


def _left_out(name: str, result: GridResult, choice: Choice, shown: Sequence[LeftOut], digits: int) -> Panel | None:
    if not shown:
        return None
    limits = figures.residual_range_um(shown)
    plots = tuple(
        Plot(
            figures.left_out(b, result.target, limits, result.simulated),
            f"{b.place}: {b.batch_id}, S = {number(b.S_um, digits)} µm",
            "third",
        )
        for b in shown
    )
    every = max(b.every for b in shown)
    symbol = "disc" if shown[0].position_mm is not None else "line"
    entries = (("recorded", INK), ("predicted, batch left out", BLUE), ("residual", ORANGE))
    keys = tuple(Key(text, color, symbol) for text, color in entries)
    notes = [
        "Batches by S; every prediction comes from a model that never saw the batch. "
        "Residual axes are equal; the recording stops where it is masked."
    ]
    if every > 1:
        notes.append(f"Drawn: up to every {every}th sample.")
    label = cell_label(choice.selector, choice.family, choice.n_tsp)
    return Panel(f"{name}: recording and left-out prediction, {label}", plots, result.simulated, keys, tuple(notes))


def _trainings(group: Sequence[Training], choices: Sequence[Choice]) -> Table:
    return records.trainings([(t, c, decimals(c.S_std_um, c.n_batches)) for t, c in zip(group, choices, strict=True)])


def _changes(name: str, group: Sequence[Training], choices: Sequence[Choice]) -> tuple[tuple[str, ...], Panel | None]:
    """What the newest training has that the one before it had not, and both on the batches they share."""
    if len(group) < 2:
        return (), None
    now, before = group[0].result, group[1].result
    new, gone = records.changed_batches(now.batches, before.batches)
    remarks = [f"New since {group[1].started:%Y-%m-%d %H:%M} UTC: {listed(new)}." if new else "No new batch."]
    if gone:
        remarks.append(f"No longer in the training: {listed(gone)}.")
    c, d = choices[0], choices[1]
    a = left_out(now, c.protocol, c.selector, c.family, c.n_tsp)
    b = left_out(before, d.protocol, d.selector, d.family, d.n_tsp)
    if c.protocol != d.protocol:
        return (*remarks, "The trainings were judged by different protocols and are not compared."), None
    both = a.merge(b, on=["batch_id", "digest"], suffixes=("_new", "_old"))
    if len(both) < 2:
        return (*remarks, f"{count(len(both), 'batch')} in common: nothing to compare."), None
    paired = compare_paired(a, b, PromotionRule(min_batches=2))
    remarks.append(
        f"On the {count(len(both), 'batch')} that both know the newest model is "
        f"{records.interval_label(paired.as_dict())} on average, better on {paired.n_better}."
    )
    order = {b: i for i, b in enumerate(now.batches["batch_id"])}
    both = both.sort_values("batch_id", key=lambda ids: ids.map(order), kind="stable")
    plot = Plot(figures.before_and_after(both, now.simulated), f"{name} before and after")
    keys = (Key("earlier training", "#5a6572", "ring"), Key("newest training", BLUE, "disc"))
    return tuple(remarks), Panel(f"{name}: S of the shared batches, before and after", (plot,), now.simulated, keys)
