"""One error channel's part of the page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from models.protocols import PromotionRule
from models.selection.promotion import Choice, compare_paired, left_out
from models.selection.result import GridResult, Training
from reports.comparison import figures, tables
from reports.comparison import story as records
from reports.comparison.certainty import bound_panel, bound_table, certainty_table, diagnostics_table
from reports.comparison.headline import groups_table, headline
from reports.comparison.race import race_table, why_panel
from reports.comparison.readings import readings_panel, readings_table
from reports.comparison.story import Verdict, comparison_rows, mark_of
from reports.comparison.tables import (
    LeftOut,
    Promoted,
    best_per,
    left_out_batches,
    paths,
    protocols_of,
    scored,
)
from reports.drawing import MUTED
from reports.labels import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    count,
    decimals,
    family_label,
    listed,
    number,
    selector_label,
    styles,
)
from reports.layout import Details, Key, Pairs, Panel, Plot, Section, Table, Text, given
from reports.viewer import Pane, Trace, Viewer, viewer


def channel_part(
    anchor: str,
    name: str,
    group: Sequence[Training],
    choices: Sequence[Choice],
    outcome: Verdict,
    rule: PromotionRule,
) -> Section:
    """A channel's part from its trainings, newest first, and their promoted cells."""
    result, choice = group[0].result, choices[0]
    protocol = protocols_of(result)[0]
    cells = scored(result, protocol)
    digits = decimals(choice.S_std_um, choice.n_batches)
    promoted = Promoted(choice, digits, mark_of(group[0]))
    shown = left_out_batches(result, choice)
    left_out = left_out_panel(name, result, [b for b in shown if b.place], digits)
    blocks = (
        *headline(name, group[0], choice, outcome, digits),
        Text(f"Points: {', '.join(choice.inputs)}.", "note") if choice.inputs else None,
        left_out or Text("No left-out prediction of this model was kept.", "soft"),
        runs_viewer(name, group[0], shown, digits),
        groups_table(name, result, choice, digits),
        why_panel(name, result, choice, rule, digits),
        Details("Promotion, and what changed since the last training", _promotion(name, group, choices, outcome, rule)),
        Details("The race, and leaderboards by protocol", _boards(name, result, promoted, digits)),
        _folded(
            "Selectors, families and number of points",
            tables.heat_map(name, result, cells, digits),
            _points(name, result, cells, choice),
            tables.point_frequency(name, result, cells, protocol),
            diagnostics_table(name, result),
        ),
        _folded(
            "Certainty, and the error outside the trained region",
            certainty_table(name, result, cells, choice, digits, promoted.mark),
            bound_panel(name, result.distances, result.simulated),
            bound_table(name, result.distances, digits, result.simulated),
        ),
        _folded("What a touch probe is worth", readings_table(name, result, digits), readings_panel(name, result)),
        Details("Every batch", (tables.batches(result, choice, digits),)),
    )
    chip = (outcome.chip, outcome.outcome)
    return Section(anchor, name, given(*blocks), chip=chip, simulated=result.simulated, look="channel")


def _folded(summary: str, *blocks: Any) -> Details | None:
    """Details of what there is; None of nothing."""
    inside = given(*blocks)
    return Details(summary, inside) if inside else None


def _promotion(
    name: str, group: Sequence[Training], choices: Sequence[Choice], outcome: Verdict, rule: PromotionRule
) -> tuple[Any, ...]:
    changes, change = _changes(name, group, choices, rule)
    compared = tuple(comparison_rows(group[0].promotion))
    return given(
        Text(outcome.summary),
        Pairs(compared, "pairs") if compared else Text("No comparison with a champion belongs to this training."),
        *map(Text, changes),
        _trainings(group, choices) if len(group) > 1 else None,
        change,
    )


def _boards(name: str, result: GridResult, promoted: Promoted, digits: int) -> tuple[Any, ...]:
    """The race, the best cell of every family and selector by the first protocol, and by family under the others."""
    first, *others = protocols_of(result)
    wanted = [(first, "family"), (first, "selector"), *((p, "family") for p in others)]
    boards = []
    for protocol, key in wanted:
        cells = scored(result, protocol)
        if len(cells):
            caption = f"{name}: best cell of every {key}, {protocol}"
            boards.append(tables.leaderboard(result, cells, key, promoted, caption))
    apart = Text("Numbers of different protocols are not comparable.", "soft")
    return given(race_table(name, result, digits), apart, *boards)


def runs_viewer(name: str, training: Training, shown: Sequence[LeftOut], digits: int) -> Viewer | None:
    """Every left-out run, recorded and predicted; None along an axis, where a run is no line over the time."""
    result, unit = training.result, training.params.get("unit", "um")
    panes = [
        Pane(
            b.batch_id, result.target, unit, b.time_h,
            (Trace("recorded", b.recorded_um, "recorded"), Trace("predicted", b.predicted_um, "computed")),
            f"S = {number(b.S_um, digits)} µm",
        )
        for b in shown
        if b.position_mm is None
    ]  # fmt: skip
    how = f", {shown[0].protocol}" if shown else ""
    return viewer(f"{name}: every left-out run{how}", panes, result.simulated)


def _points(name: str, result: GridResult, cells: pd.DataFrame, choice: Choice) -> Panel | None:
    tried = paths(cells)
    best = best_per(tried, "family")
    if tried["n_tsp"].nunique() < 2:
        return None
    at = dict(zip(best["family"], best["selector"], strict=True))
    if ((tried["family"] == choice.family) & (tried["selector"] == choice.selector)).any():
        at[choice.family] = choice.selector  # the promoted model's own line, where another selector is as good
    lines = tried[tried["selector"] == tried["family"].map(at)]
    flat, looks = best_per(cells[cells["n_tsp"] == 0], "family"), styles(lines["family"].tolist())
    plots = tuple(
        Plot(
            figures.against_points(lines, flat, column, f"{short}, µm", choice.family, result.simulated),
            f"{name}: {short.lower().replace('s_', 'S_')}",
            "half",
        )
        for column, short in (("S_mean_um", "Accuracy S_mean"), ("S_std_um", "Robustness S_std"))
    )
    keys = [Key(f"{family_label(f)}, {selector_label(s)}", *looks[f]) for f, s in at.items()]
    keys += [Key(family_label(f), MUTED, figures.flat_dash(f)) for f in flat["family"]]
    return Panel(
        f"{name}: accuracy and robustness against the number of points",
        plots,
        result.simulated,
        tuple(keys),
        ("Each family with its best selector; both axes are smaller-is-better, log scale. What runs out of the top is "
         "worse than no model. The chosen family is drawn stronger.",),
    )  # fmt: skip


_TRAINED_ON = {"forward": "the runs before its block", "leave-batch-out": "all others"}
_NICE_H = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 24.0)
_MOST_KEYS = 6


def left_out_panel(name: str, result: GridResult, shown: Sequence[LeftOut], digits: int) -> Panel | None:
    """The curves of the batches that are shown, or along an axis their fans; None where no prediction was kept."""
    if not shown:
        return None
    along_axis = shown[0].position_mm is not None
    draw = figures.fan if along_axis else figures.curves
    plots = tuple(
        Plot(draw([b], shown, result.target, digits, result.simulated), figures.place(b, digits, most=200), "third")
        for b in shown
    )
    protocol = shown[0].protocol
    which = "later runs" if protocol == "forward" else "batches"
    trained_on = _TRAINED_ON[protocol]
    notes = [f"Best, median and worst of the {which} by S, each by a model of {trained_on}. Residual axes are equal."]
    if along_axis:
        keys, more = _fan_legend(shown)
        notes += more
    else:
        keys = [Key("recorded", INK), Key("predicted", BLUE), Key("residual", ORANGE)]
        notes.append("The recording stops where it is masked.")
    if (every := max(b.every for b in shown)) > 1:
        notes.append(f"Drawn: up to every {every}th sample.")
    caption = f"{name}: recorded and predicted{' along the axis' if along_axis else ''}, {protocol}"
    return Panel(caption, plots, result.simulated, tuple(keys), (" ".join(notes),))


def _fan_legend(shown: Sequence[LeftOut]) -> tuple[list[Key], list[str]]:
    """The colours of the time, and what a fan's zero is."""
    last_h = figures.longest_h(shown)
    step_h = next((h for h in _NICE_H if last_h / h <= _MOST_KEYS), _NICE_H[-1])
    keys = [Key("recorded", INK, "circle", alone=True), Key("predicted", INK)]
    keys += [
        Key(f"{h:g} h", figures.time_colour(h / last_h), "circle", alone=True)
        for h in np.arange(0.0, last_h + 1e-9, step_h)
    ]
    notes = ["The error less that of the batch's first sweep, which is the line at zero. Colours: time since start."]
    most, drawn = (max(len(of(b)) for b in shown) for of in (figures.sweeps, figures.drawn_sweeps))
    return keys, notes + ([f"Drawn: {drawn} of up to {most} sweeps."] if most > drawn else [])


def _trainings(group: Sequence[Training], choices: Sequence[Choice]) -> Table:
    return records.trainings([(t, c, decimals(c.S_std_um, c.n_batches)) for t, c in zip(group, choices, strict=True)])


def _changes(
    name: str, group: Sequence[Training], choices: Sequence[Choice], rule: PromotionRule
) -> tuple[tuple[str, ...], Panel | None]:
    """What the newest training has that the one before it had not, and both on the batches they share."""
    if len(group) < 2:
        return (), None
    now, before = group[0].result, group[1].result
    new, gone = records.changed_batches(now.batches, before.batches)
    remarks = [f"New since {group[1].started:%Y-%m-%d %H:%M} UTC: {listed(new)}." if new else "No new batch."]
    if gone:
        remarks.append(f"No longer in the training: {listed(gone)}.")
    c, d = choices[0], choices[1]
    run = [set(r.cells["protocol"]) for r in (now, before)]
    shared = [p for p in (tables.MAIN_PROTOCOL, *rule.protocols) if p in run[0] & run[1]]
    if not shared:
        return (*remarks, "The trainings were judged by different protocols and are not compared."), None
    rule = rule.only(shared[0]).model_copy(update={"min_batches": 2})
    a = left_out(now, rule, c.selector, c.family, c.n_tsp)
    b = left_out(before, rule, d.selector, d.family, d.n_tsp)
    both = a.merge(b, on=["batch_id", "digest"], suffixes=("_new", "_old"))
    if len(both) < 2:
        return (*remarks, f"{count(len(both), 'batch')} in common: nothing to compare."), None
    paired = compare_paired(a, b, rule)
    remarks.append(
        f"On the {count(len(both), 'batch')} that both know the newest model is "
        f"{records.interval_label(paired.as_dict())} on average, better on {paired.n_better}."
    )
    cloud = figures.Cloud(
        both["S_um_old"].to_numpy(float),
        both["S_um_new"].to_numpy(float),
        Key("a shared batch", BLUE, "circle", alone=True),
    )
    figure = figures.S_against_S([cloud], [(1.0, GREEN)], "S, earlier training", "S, newest training", now.simulated)
    keys = (cloud.key, Key("no change", GREEN))
    plot = Plot(figure, f"{name} before and after", "half")
    return tuple(remarks), Panel(f"{name}: S of the shared batches, before and after", (plot,), now.simulated, keys)
