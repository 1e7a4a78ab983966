"""The page of a replay: what each retraining was worth, run by run, against a model that is never retrained."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from models.selection.replay import Paired, Replay, Retraining, Run, Score
from reports.drawing import LINES, MUTED, WIDTH_IN, panel
from reports.labels import GREEN, NOTHING, count, number
from reports.layout import Column, Key, Number, Numbers, Page, Panel, Plot, Row, Section, Table, Text
from reports.rendering import write_page

CHAMPION, FROZEN, NONE = LINES[0], LINES[1], "#8a949f"
_TALL_IN = 3.1
_TICKS = 12  # dates below the picture


def write_replay(path: Path, r: Replay) -> None:
    """Write the page. Raises: InputError, another suffix than .html, or no place to write."""
    write_page(path, replay_page(r), (".html",))


def replay_page(r: Replay) -> Page:
    """The page's content."""
    plan = "as recorded" if r.seed is None else f"disturbed by seed {r.seed}"
    runs = len({a.batch_id for a in r.arrivals})
    trainings = len({g.number for g in r.retrainings})
    summary = (
        f"{count(runs, 'run')} arrived {plan}. The first training had {r.start}, each further one "
        f"{count(r.every, 'new run')} more; {count(trainings, 'training')}, effort {r.effort}. Every run was predicted "
        "by the champion in force when it arrived, before any model learned it. Of the recordings: "
        f"{r.account['summary']}."
    )
    sections = [_channel(r, t, f"p{k}") for k, t in enumerate(r.targets, 1)]
    disturbed = _arrivals(r)
    if disturbed.rows or len(disturbed.notes) > 1:
        sections.append(Section("arrivals", "", (disturbed.folded(),), "Arrivals"))
    footer = ("The models are in the replay's own home and in no registry that a machine uses.",)
    title = f"{r.machine}: replay of a year"
    return Page("thermodrift replay", title, (Text(summary),), tuple(sections), footer, r.simulated)


def _channel(r: Replay, target: str, anchor: str) -> Section:
    reasons, runs = _reasons(r, target), _runs(r, target)
    blocks = (Numbers(_facts(r.score(target))), _picture(r, target), _retrainings(r, target))
    return Section(anchor, target, (*blocks, reasons.folded(counted=False), runs.folded()), look="channel")


def _facts(s: Score) -> tuple[Number, ...]:
    if not s.n:
        return (Number("runs with a champion", "0", "no trustworthy model was promoted"),)
    share = f"{100 * s.covered / s.bounded:.0f} %" if s.bounded else NOTHING
    stated = f"{s.covered_stated} of {s.bounded_stated} below the bound that the champion states for any run"
    return (
        Number("champion of the day", f"{s.S_um:.2f} µm", f"mean S of {count(s.n, 'run')}"),
        Number("first champion, frozen", f"{s.frozen_S_um:.2f} µm",
               f"{_paired(s.against_frozen)} µm paired; another champion on {count(s.retrained, 'run')}"),
        Number("no model", f"{s.none_S_um:.2f} µm", f"{_paired(s.against_none)} µm paired"),
        Number("below the run's 90 % bound", share, f"{s.covered} of {count(s.bounded, 'run')}; {stated}"),
    )  # fmt: skip


def _paired(p: Paired) -> str:
    """The difference with its standard error; plus: the champion of the day is better."""
    return f"{number(p.difference_um, 2, sign=True)} ± {number(p.se_um, 2)}"


def _retrainings(r: Replay, target: str) -> Table:
    columns = (
        Column("date"), Column("runs known", kind="number"), Column("before", kind="number"),
        Column("after", kind="number"), Column("expected S", "µm", "number"), Column("90 % below", "µm", "number"),
        Column("runs after", kind="number"), Column("S champion", "µm", "number"),
        Column("S frozen", "µm", "number"), Column("S no model", "µm", "number"),
        Column("frozen − champion", "µm", "number"), Column("below bound", kind="number"),
        Column("outcome"),
    )  # fmt: skip
    rows = [_retraining(g, r.score(target, g.number)) for g in r.retrainings_of(target)]
    notes = (
        "Before and after: version of the champion. Expected S and its bound are those of the champion after. S is the "
        "residual standard deviation of a run; means over the runs that arrived until the next training. "
        "Frozen − champion: paired mean and standard error, plus where retraining was better. Below bound: runs below "
        "the 90 % bound of their own prediction.",
    )
    return Table("Trainings", columns, tuple(rows), r.simulated, notes=notes)


def _retraining(g: Retraining, s: Score) -> Row:
    version = [NOTHING if v is None else str(v) for v in (g.before, g.after)]
    expected = [number(v, 2) for v in (g.expected_S_um, g.bound90_S_um)]
    followed = [number(v, 2) for v in (s.S_um, s.frozen_S_um, s.none_S_um)]
    paired = _paired(s.against_frozen) if s.n and s.retrained else NOTHING
    bound = f"{s.covered} of {s.bounded}" if s.bounded else NOTHING
    runs = f"{s.n}" + (f" (+{s.without})" if s.without else "")
    return Row.of(
        f"{g.number}: {_date(g)}", str(g.n_batches), *version, *expected, runs, *followed,
        paired, bound, g.outcome, mark="promoted" if g.promoted else "",
    )  # fmt: skip


def _date(g: Retraining) -> str:
    """The date with hyphens at which no line breaks."""
    return g.date[:10].replace("-", "\u2011") or f"arrival {g.arrival}"


def _reasons(r: Replay, target: str) -> Table:
    rows = tuple(Row.of(str(g.number), g.why) for g in r.retrainings_of(target))
    columns = (Column("training"), Column("reason", kind="wide"))
    return Table("Why each training was promoted or not", columns, rows, r.simulated)


def _runs(r: Replay, target: str) -> Table:
    columns = (
        Column("run"), Column("recorded"), Column("arrived"), Column("champion", kind="number"),
        Column("S champion", "µm", "number"), Column("S frozen", "µm", "number"), Column("S no model", "µm", "number"),
        Column("expected S", "µm", "number"), Column("90 % below", "µm", "number"), Column("remark", kind="wide"),
    )  # fmt: skip
    rows = []
    for run in r.runs_of(target):
        numbers = (run.S_um, run.frozen_S_um, run.none_S_um, run.expected_S_um, run.bound90_S_um)
        above = "above its bound" if run.S_um > run.bound90_S_um else ""
        rows.append(Row.of(
            run.batch_id, run.date.replace("T", " "), run.how, NOTHING if run.champion is None else str(run.champion),
            *(number(v, 2) for v in numbers), "; ".join(t for t in (above, run.note, run.flagged) if t),
        ))  # fmt: skip
    return Table("Runs in the order of arrival", columns, tuple(rows), r.simulated)


def _arrivals(r: Replay) -> Table:
    columns = (Column("arrival"), Column("run"), Column("how"), Column("fault", kind="wide"))
    rows = tuple(Row.of(str(a.number), a.batch_id, a.how, a.fault) for a in r.arrivals if a.how != "as recorded")
    others = len(r.arrivals) - len(rows)
    notes = (f"The other {count(others, 'arrival')} came as recorded.", *(f"Left out: {t}" for t in r.left_out))
    return Table("Disturbed arrivals", columns, rows, r.simulated, notes=notes)


def _picture(r: Replay, target: str) -> Panel:
    fig = Figure(figsize=(WIDTH_IN, _TALL_IN + 1.0))
    ax = panel(fig, 0.65, 0.5, WIDTH_IN - 0.85, _TALL_IN)
    runs = r.runs_of(target)
    at = np.arange(len(runs))
    kinds = (
        ("none_S_um", NONE, "s", 3.5, 1.0),
        ("frozen_S_um", FROZEN, "^", 5.5, 1.2),
        ("S_um", CHAMPION, "o", 5.0, 1.6),
    )
    for name, color, symbol, size, width in kinds:
        values = np.array([getattr(run, name) for run in runs], float)
        ax.plot(at, values, marker=symbol, color=color, ms=size, lw=width, mec="white", mew=0.6)
    for k, run in enumerate(runs):
        if math.isfinite(run.bound90_S_um):
            ax.plot([k - 0.3, k + 0.3], [run.bound90_S_um] * 2, color=CHAMPION, lw=1.0, alpha=0.55)
    _axis(ax, runs)
    _promotions(ax, r, target, runs)
    keys = (
        Key("champion of the day", CHAMPION, "circle"), Key("first champion, frozen", FROZEN, "triangle-up"),
        Key("no model", NONE, "square"), Key("90 % bound of the run's prediction", CHAMPION, "line"),
        Key("promotion", GREEN, "dash"), Key("training without one", MUTED, "dot"),
    )  # fmt: skip
    title = f"Error of every run of {target} in the order of arrival"
    return Panel(title, (Plot(fig, title),), r.simulated, keys)


def _axis(ax: Axes, runs: Sequence[Run]) -> None:
    """A logarithmic axis where the errors differ by more than ten times; dates below."""
    values = [v for run in runs for v in (run.S_um, run.frozen_S_um, run.none_S_um) if math.isfinite(v) and v > 0]
    if values and max(values) > 10 * min(values):
        ax.set_yscale("log")
        ax.yaxis.set_major_formatter(lambda v, _: f"{v:g}")
        ax.yaxis.set_minor_formatter(lambda v, _: f"{v:g}" if f"{v:e}"[0] in "25" else "")
        ax.tick_params(axis="y", which="minor", labelsize=7.5)
    else:
        ax.set_ylim(bottom=0)
    ax.set_ylabel("S of the run, µm", fontsize=8.5, color=MUTED)
    ax.set_xlim(-0.8, max(0.5, len(runs) - 0.2))
    every = max(1, math.ceil(len(runs) / _TICKS))
    ax.set_xticks(range(0, len(runs), every), [r.date[:10] or r.batch_id for r in runs[::every]], fontsize=7.5)
    ax.set_xlabel("run, in the order of arrival", fontsize=8.5, color=MUTED)


def _promotions(ax: Axes, r: Replay, target: str, runs: Sequence[Run]) -> None:
    """A line before the first run that a training could serve; promotions carry the version."""
    arrivals = [run.arrival for run in runs]
    for g in r.retrainings_of(target):
        x = sum(a <= g.arrival for a in arrivals) - 0.5
        ax.axvline(x, color=GREEN if g.promoted else MUTED, lw=1.2 if g.promoted else 0.8,
                   ls=(0, (6, 3)) if g.promoted else (0, (1.5, 2.5)))  # fmt: skip
        if g.promoted:
            ax.annotate(f"version {g.after}", (x, 1.02), xycoords=("data", "axes fraction"), fontsize=8, color=GREEN,
                        ha="left" if x < 0 else "center")  # fmt: skip
