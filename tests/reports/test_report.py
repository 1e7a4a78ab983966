"""The report: its numbers against the tables and against hand computation, its sentences, its safety."""

from __future__ import annotations

import base64
import hashlib
import json
import math
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from data import files as atomic_file
from data.errors import InputError
from models.protocols import PromotionRule
from models.selection.crossing import Plan
from models.selection.grid import run_grid
from models.selection.outlook import outlook
from models.selection.promotion import Choice, choose
from models.selection.result import GridResult, Training
from reports.comparison import figure_pngs, write_report
from reports.comparison.channel import Channel, removed
from reports.comparison.figures import logarithmic
from reports.comparison.page import page as page_of
from reports.comparison.pictures import left_out_panels, time_panel, tried_panel
from reports.comparison.story import changed_batches
from reports.comparison.tables import families, left_out_batches
from reports.labels import between, cell_label, count, decimals, listed, number
from reports.layout import Cell, Pairs, Panel, Table, Text
from reports.viewer import Viewer
from tests.toys.pages import blocks, unscripted
from tests.toys.report_training import HOSTILE, Maker, column, promotion, results, settings, table_after, training

RULE = PromotionRule()
LBO = "leave-batch-out"
LOADING = ("src", "href", "srcset", "data", "action", "poster")


class Page(HTMLParser):
    """What a browser would load, and the text outside of style and scripts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.tags: list[str] = []
        self.words: list[str] = []
        self.ids: list[str] = []
        self.feed(unscripted(text))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        given = dict(attrs)
        self.ids += [given["id"] or ""] if "id" in given else []
        self.loads += [v or "" for k, v in attrs if k.split(":")[-1] in LOADING]
        self.loads += re.findall(r"url\(([^)]*)\)", " ".join(v or "" for v in given.values()))

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def cell_words(choice: Choice) -> str:
    return cell_label(choice.selector, choice.family, choice.n_tsp)


def html_of(trainings: list[Training], folder: Path) -> str:
    path = write_report(trainings, folder / "r.html", settings(folder).promotion)
    return path.read_text(encoding="utf-8").replace("\u00a0", " ")


@cache
def of_z(make: Maker) -> str:
    """The page of the channel z, as it is."""
    with TemporaryDirectory() as folder:
        return markdown_of([training(results(make)["z"])], Path(folder))


@cache
def of_both(make: Maker) -> str:
    """The HTML page of both channels."""
    with TemporaryDirectory() as folder:
        return html_of([training(results(make)[t], name=t) for t in "zx"], Path(folder))


@cache
def small(make: Maker) -> GridResult:
    """A result of one family and no left-out prediction."""
    plan = Plan(selectors=("none",), families=("mlr",), protocols=("train-on-one",))
    ((_, result),) = run_grid(make(k=3, n=30, sensors=2), ["z"], plan).values()
    return result


def markdown_of(trainings: list[Training], folder: Path) -> str:
    return write_report(trainings, folder / "r.md", settings(folder).promotion).read_text(encoding="utf-8")


def test_left_out_scores_are_those_of_the_predictions(toy_batches: Maker) -> None:
    result = results(toy_batches)["z"]
    cell = choose(result, RULE)
    text = of_z(toy_batches)
    p = result.predictions
    s = []
    for b in result.batches["batch_id"]:
        rows = p[p["batch_id"] == b]
        e = (rows["recorded_um"] - rows[cell.cell]).to_numpy(float)
        e = e[np.isfinite(e)]
        s.append(np.sqrt((e**2).sum() / (len(e) - 1)))
    rows = table_after(text, "z: best cell of every family")
    mine = next(r for r in rows if r[0].endswith("(chosen)"))
    (own,) = column([rows[0], mine], LBO)
    digits = len(own.split(" ")[0].split(".")[1])
    assert own == f"{np.mean(s):.{digits}f} ± {np.std(s, ddof=1):.{digits}f}"
    batches = table_after(text, f"z: every batch, left out by {cell_words(cell)}")
    assert column(batches, "S, left out") == [f"{v:.{digits}f}" for v in s]


def test_every_family_has_its_least_cell_and_both_baselines_are_there(toy_batches: Maker) -> None:
    result = results(toy_batches)["z"]
    rows = table_after(of_z(toy_batches), "z: best cell of every family")
    names = [n.removesuffix(" (chosen)") for n in column(rows, "cell")]
    assert names.count("no model") == names.count("mean curve") == 1
    cells = result.cells[result.cells["protocol"] == "forward"]
    shown = [float(v.split(" ")[0]) for v in column(rows, "forward")]
    assert len(shown) == cells["family"].nunique() and shown == sorted(shown)
    own = choose(result, RULE)
    least = cells[cells["family"] != own.family].groupby("family")["S_mean_um"].min()
    rounded_um = 10.0 ** -len(column(rows, "forward")[0].split(" ")[0].split(".")[1])
    for value in [*least, own.S_mean_um]:
        assert min(abs(v - value) for v in shown) <= 0.51 * rounded_um


def test_protocols_have_columns_of_their_own_with_their_own_numbers(toy_batches: Maker) -> None:
    result = results(toy_batches)["z"]
    rows = table_after(of_z(toy_batches), "z: best cell of every family")
    i = column(rows, "cell").index("mean curve")
    for protocol in ("train-on-one", "leave-season-out", "leave-speed-out"):
        cells = result.cells[(result.cells["protocol"] == protocol) & (result.cells["family"] == "mean_curve")]
        shown = float(column(rows, protocol)[i].split(" ")[0])
        assert shown == pytest.approx(float(cells["S_mean_um"].iloc[0]), abs=0.051)


def test_families_that_the_race_dropped_are_named_with_the_reason(toy_batches: Maker) -> None:
    result = results(toy_batches)["z"]
    race = pd.DataFrame(
        [("families", "none", "svr", 4, 3, 7.25, 1.0, 0.1, False, "clearly worse than the leader"),
         ("families", "none", "mlr", 4, 3, 1.0, 0.0, 0.0, True, "")],
        columns=["round", "selector", "family", "n_tsp", "n_runs", "S_mean_um", "behind_um", "se_um", "kept", "why"],
    )  # fmt: skip
    table = families("z", replace(result, race=race), choose(result, RULE), 1)
    said = "Dropped in round 1 of the race, clearly worse than the leader (S_mean over 3 runs): svr on all 4 points "
    assert table.notes[-1] == f"{said}7.2 µm."


def test_the_page_loads_nothing_and_is_small(toy_batches: Maker) -> None:
    text = of_both(toy_batches)
    page = Page(text)
    assert page.loads and all(v[1:] in page.ids for v in page.loads if v.startswith("#"))
    assert [v for v in page.loads if not v.startswith("#")] == []
    assert len(page.ids) == len(set(page.ids)), "a name twice: a picture would be clipped by another's frame"
    assert "@import" not in text and len(text) < 420_000


def test_only_the_pages_own_scripts_may_run_and_the_licence_goes_with_them(toy_batches: Maker) -> None:
    text = of_both(toy_batches)
    scripts = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    hashes = [base64.b64encode(hashlib.sha256(s.encode()).digest()).decode() for s in scripts]
    allowed = re.search(r"default-src 'none'; style-src 'unsafe-inline'; img-src data:; script-src([^;]*);", text)
    assert allowed is not None and allowed[1].split() == [f"'sha256-{h}'" for h in hashes] and len(scripts) == 3
    assert "The MIT License" in text and "Leon Sorokin" in text


def test_the_viewer_holds_every_later_run(toy_batches: Maker) -> None:
    result = results(toy_batches)["z"]
    (found,) = blocks(page_of([training(result)], RULE), Viewer)
    curves = result.curves[result.curves["protocol"] == "forward"]
    assert [p.run for p in found.panes] == [b.batch_id for b in left_out_batches(result, choose(result, RULE))]
    assert {p.run for p in found.panes} == set(curves["batch_id"])
    own = curves[curves["batch_id"] == found.panes[0].run]
    plain = json.loads(found.json)["panes"][0]
    for name, line in zip(("recorded_um", "predicted_um"), plain["lines"], strict=True):
        steps = np.array([np.nan if v is None else v for v in line["v"]])
        read = np.where(np.isfinite(steps), np.nancumsum(steps), np.nan) * line["q"]
        span = np.ptp(own[name].dropna())
        assert np.allclose(read, own[name], atol=span / 1000, equal_nan=True)
    (other,) = blocks(page_of([replace(training(result), params={"unit": "mrad"})], RULE), Viewer)
    assert plain["unit"] == "µm" and json.loads(other.json)["panes"][0]["unit"] == "mrad"
    assert other.panes[0].summary.endswith(" mrad")
    assert "<" not in found.json, "a name could end the script element"


def test_the_sentences_and_the_leaders_begin_with_the_largest_error(toy_batches: Maker) -> None:
    both = results(toy_batches)
    page = page_of([training(both[t], name=t) for t in "xz"], RULE)
    z, x = (t for t in page.top if isinstance(t, Text) and t.look == "lead")
    assert [z.strong, x.strong] == ["z:", "x:"]
    choice = choose(both["z"], RULE)
    expected = outlook(both["z"], choice)
    table = next(t for t in blocks(page, Table) if t.caption == "Leaders")
    own, *others = table.rows
    lead = own.cells[0]
    assert isinstance(lead, Cell)
    assert (lead.text, lead.chip[0], own.look) == (f"z: {cell_words(choice)}", "provisional", "marked")
    digits = len(str(own.cells[1]).split(" ")[0].split(".")[1])
    S = f"{expected.S_um:.{digits}f} ± {expected.S_std_um:.{digits}f}"
    assert own.cells[1] == S and expected.S_std_um > 0
    bound = f"4 of 4 stay below the 90 % bound of {expected.bound_um:.{digits}f} µm."
    assert z.text.startswith(f"{cell_words(choice)} removes {own.cells[2]} of the error of later runs: S ")
    assert f" → {S} µm; {bound} " in z.text
    assert ("later runs against the promise", expected.kept) in blocks(page, Pairs)[0].entries and expected.kept
    runners = [str(r.cells[0]) for r in others[: len(table.rows) // 2 - 1]]
    assert runners and all(r.startswith("z: ") and "no model" not in r for r in runners)
    groups = next(t for t in blocks(page, Table) if t.caption == "z: S_mean by season and speed")
    assert [r.cells[0] for r in groups.rows] == [
        "season below 10 °C", "season 10–18 °C", "season 18–25 °C", "season above 25 °C",
        "speed 2000 rpm", "speed 4000 rpm", "speed 6000 rpm",
    ]  # fmt: skip


def test_the_share_that_is_removed_has_its_error_over_the_runs() -> None:
    runs = pd.DataFrame({"S_um": [1.0, 2.0, 3.0], "none_um": [10.0, 20.0, 20.0]})
    share, se = removed(runs)
    without = np.array([1 - 5 / 40, 1 - 4 / 30, 1 - 3 / 30])
    assert share == pytest.approx(1 - 6 / 50)
    assert se == pytest.approx(np.sqrt(2 / 3 * np.sum((without - without.mean()) ** 2)))
    assert removed(runs, cost=2.0)[0] == pytest.approx(1 - 12 / 50)
    assert np.isnan(removed(runs[:1])[1]) and np.isnan(removed(runs[:0])[0])


def test_the_page_is_a_sentence_three_pictures_a_table_the_viewer_and_one_fold(toy_batches: Maker) -> None:
    (section,) = page_of([training(results(toy_batches)["z"])], RULE).sections
    assert [type(b).__name__ for b in section.blocks] == ["Panel", "Table", "Group", "Viewer", "Details"]
    (section,) = page_of([training(r) for r in results(toy_batches).values()], RULE).sections
    assert [type(b).__name__ for b in section.blocks] == ["Panel", "Table", "Panel", "Panel", "Viewer", "Details"]


def test_no_model_never_wears_the_champions_colour(toy_batches: Maker, tmp_path: Path) -> None:
    result = results(toy_batches)["z"]
    reason = "not shown to be better than zero (S 3 against 2 µm over 6 batches)"
    text = html_of(
        [training(result, promotion("none|zero|0", "challenger", caution=reason, champion_version=0))], tmp_path
    )
    assert '<span class="chip untrusted">no trustworthy model</span>' in text and "chip champion" not in text
    assert "No trustworthy model: not shown to be better than no model.</p>" in text
    assert text.count("(S 3 against 2 µm over 6 batches)") == 1 and "z:</b> nothing is compensated" in text


def test_the_curves_are_later_runs_predicted_from_earlier_ones(toy_batches: Maker) -> None:
    result = results(toy_batches)["z"]
    cell = choose(result, RULE)
    every = left_out_batches(result, cell)
    shown = [b for b in every if b.place]
    s = result.scores
    own = s[(s["family"] == cell.family) & (s["selector"] == cell.selector) & (s["n_tsp"] == cell.n_tsp)]
    forward = own[own["protocol"] == "forward"].set_index("batch_id")["S_um"]
    assert [b.place for b in shown] == ["median", "worst"] and {b.protocol for b in shown} == {"forward"}
    assert [b.S_um for b in shown] == [forward.sort_values().iloc[1], forward.max()]
    (panel,) = left_out_panels([Channel.of("z", [training(result)], RULE)])
    assert panel.caption == "Runs left out: recorded and predicted, forward"
    for b, plot in zip(shown, panel.plots, strict=True):
        rows = result.curves[(result.curves["protocol"] == "forward") & (result.curves["batch_id"] == b.batch_id)]
        upper, lower = plot.figure.axes
        recorded, predicted = upper.lines
        assert np.array_equal(recorded.get_ydata(), rows["recorded_um"], equal_nan=True)
        assert np.array_equal(predicted.get_ydata(), rows["predicted_um"], equal_nan=True)
        assert np.allclose(lower.lines[-1].get_ydata(), rows["recorded_um"] - rows["predicted_um"], equal_nan=True)
        assert "SIMULATED" in plot.svg("p")
    assert len({plot.figure.axes[1].get_ylim() for plot in panel.plots}) == 1


def test_without_kept_curves_the_batches_are_those_left_out_one_by_one(toy_batches: Maker) -> None:
    result = replace(results(toy_batches)["z"], curves=pd.DataFrame())
    cell = choose(result, RULE)
    shown = [b for b in left_out_batches(result, cell) if b.place]
    every = result.scores[(result.scores["protocol"] == LBO) & (result.scores["family"] == cell.family)]
    own = every[(every["selector"] == cell.selector) & (every["n_tsp"] == cell.n_tsp)]["S_um"]
    assert {b.protocol for b in shown} == {LBO} and shown[-1].S_um == own.max()
    other = replace(choose(result, RULE.only(LBO)), family="mean_curve", selector="none", n_tsp=0)
    assert {b.protocol for b in left_out_batches(results(toy_batches)["z"], other)} == {LBO}


def test_a_long_curve_is_thinned(toy_batches: Maker) -> None:
    result = results(toy_batches)["z"]
    rows = result.curves.loc[result.curves.index.repeat(50)].reset_index(drop=True)
    shown = left_out_batches(replace(result, curves=rows), choose(result, RULE))
    assert all(len(b.time_h) <= 400 and b.every == 5 for b in shown)


def test_a_mark_stands_at_the_score_of_every_cell(toy_batches: Maker) -> None:
    result = results(toy_batches)["z"]
    own = Channel.of("z", [training(result)], RULE)
    (plot,) = tried_panel([own]).plots
    cells = result.cells[(result.cells["protocol"] == "forward") & ~result.cells["family"].isin(["zero", "mean_curve"])]
    marks = [line for line in plot.figure.axes[0].lines if line.get_marker() in ("o", "s")]
    assert sorted(v for m in marks for v in m.get_xdata()) == pytest.approx(sorted(cells["S_mean_um"]))
    (chosen,) = [line for line in plot.figure.axes[0].lines if line.get_marker() == "D" and len(line.get_xdata())]
    assert chosen.get_xdata()[0] == pytest.approx(own.choice.S_mean_um)


def test_a_race_is_drawn_with_the_cells_that_were_judged_on_the_same_runs(toy_batches: Maker) -> None:
    result = results(toy_batches)["z"]
    rows = [("families", "none", "mlr", 4, 3, 7.0), ("points", "correlation", "mlr", 2, 3, 5.0),
            ("runs", "none", "mlr", 4, 6, 6.0), ("families", "none", "zero", 0, 3, 30.0)]  # fmt: skip
    race = pd.DataFrame(rows, columns=["round", "selector", "family", "n_tsp", "n_runs", "S_mean_um"])
    race = race.assign(behind_um=0.0, se_um=0.0, kept=True, why="")
    panel = tried_panel([Channel.of("z", [training(replace(result, race=race))], RULE)])
    marks = [line for line in panel.plots[0].figure.axes[0].lines if line.get_marker() in ("o", "s")]
    assert sorted(v for m in marks for v in m.get_xdata()) == [5.0, 7.0]
    assert "z 2 cells on 3 runs" in panel.notes[0]


def test_the_runs_stand_in_the_order_of_time_with_the_bound(toy_batches: Maker) -> None:
    own = Channel.of("z", [training(results(toy_batches)["z"])], RULE)
    (plot,) = time_panel([own]).plots
    none, S, bound = plot.figure.axes[0].lines
    assert list(S.get_ydata()) == list(own.runs["S_um"]) and list(none.get_ydata()) == list(own.runs["none_um"])
    assert own.runs["start"].is_monotonic_increasing and set(bound.get_ydata()) == {own.expected.bound_um}


def test_hostile_names_stay_text(toy_batches: Maker, tmp_path: Path) -> None:
    both = results(toy_batches)
    text = html_of([training(replace(both["z"], machine="<img src=http://x>"))], tmp_path)
    page = Page(text)
    assert "img" not in page.tags and "script" not in page.tags and text.count("<script") == 4
    assert any(HOSTILE in w for w in page.words)
    assert "alert('$x$')</script>" not in text
    markdown = of_z(toy_batches)
    rows = table_after(markdown, f"z: every batch, left out by {cell_words(choose(both['z'], RULE))}")
    assert {len(r) for r in rows} == {len(rows[0])} and HOSTILE in [r[0] for r in rows]
    assert "<script" not in markdown.replace("\\<script", "")
    assert figure_pngs(both["z"])


@pytest.mark.parametrize("simulated", [True, False])
def test_simulated_is_said_at_the_top_and_in_every_picture_or_nowhere(
    simulated: bool, toy_batches: Maker, tmp_path: Path
) -> None:
    own = training(results(toy_batches, simulated=simulated)["x"])
    html = html_of([own], tmp_path)
    assert html.count('<span class="badge">SIMULATED</span>') == (1 if simulated else 0)
    assert ("(SIMULATED)" in markdown_of([own], tmp_path).splitlines()[0]) is simulated
    plots = [plot for panel in blocks(page_of([own], RULE), Panel) for plot in panel.plots]
    assert plots and all(("SIMULATED" in plot.svg("p")) is simulated for plot in plots)


def test_of_simulated_and_recorded_channels_the_simulated_ones_are_called_so(toy_batches: Maker) -> None:
    both = results(toy_batches)
    page = page_of([training(both["z"]), training(replace(both["x"], simulated=False))], RULE)
    assert page.mark == "SIMULATED" and [t.strong for t in page.top if t.look == "lead"] == ["z (SIMULATED):", "x:"]


@pytest.mark.slow
def test_findings_say_what_when_and_whether_masked(toy_batches: Maker, tmp_path: Path) -> None:
    both = results(toy_batches, findings=True)
    text = markdown_of([training(both["z"]), training(both["x"])], tmp_path)
    assert "3 findings in 1 of 6 batches: 1 masked for training, 1 noted only, 1 overruled by the machine file." in text
    rows = table_after(text, "Every finding")
    assert ["b01", "t1", "spike", "0:20", "one spike of 3.2 K", "used; overruled: checked & fine"] in rows
    assert ["b01", "t2", "offset", "whole batch", "t2 starts 0.4 K off", "used; noted only"] in rows
    assert ["b01", "t3", "frozen", "0:10 to 0:50", "t3 holds 21.4 °C <b>for 40 min</b>", "masked"] in rows
    assert "<b>for" not in html_of([training(both["z"])], tmp_path)
    clean = markdown_of([training(results(toy_batches)["z"])], tmp_path)
    assert "The checks raised no finding in 6 batches and masked no sample." in clean


def test_exclusions_are_told_once_with_the_channels_they_touch(toy_batches: Maker, tmp_path: Path) -> None:
    both = results(toy_batches)
    lost = both["z"].excluded.iloc[:0].copy()
    lost.loc[0] = ["t4", "t4 is unusable in 66% of b01"]
    z_only = lost.copy()
    z_only.loc[1] = ["family bp", "did not converge"]
    trainings = [training(replace(both["z"], excluded=z_only)), training(replace(both["x"], excluded=lost))]
    rows = table_after(markdown_of(trainings, tmp_path), "Left out: channels, folds and failed families")
    assert rows[1:] == [["t4", "t4 is unusable in 66% of b01", "all"], ["family bp", "did not converge", "z"]]


def test_a_promoted_cell_of_ones_own_choice_is_the_one_shown(toy_batches: Maker, tmp_path: Path) -> None:
    result = results(toy_batches)["z"]
    text = markdown_of([training(result, promotion("correlation|mlr|1"))], tmp_path)
    rows = table_after(text, "z: best cell of every family")
    assert [r[0] for r in rows if r[0].endswith("(champion)")] == ["MLR on 1 point by correlation (champion)"]
    assert "toy-z version 3 is champion" in text


@pytest.mark.slow
def test_two_trainings_are_compared_on_the_batches_they_share(toy_batches: Maker, tmp_path: Path) -> None:
    now, before = results(toy_batches, k=6)["z"], results(toy_batches, k=5)["z"]
    before = replace(before, batches=before.batches.assign(digest=now.batches["digest"].iloc[:5].to_numpy()))
    pair = [training(before, name="old", when="2025-06-01"), training(now, name="new")]
    text = markdown_of(pair, tmp_path)
    assert "New since 2025-06-01 08:00 UTC: b05." in text
    rows = table_after(text, "z: the trainings, each judged on its own batches")
    assert column(rows, "trained") == ["2026-01-10 08:00", "2025-06-01 08:00"]
    assert column(rows, "new batches") == ["+1", "–"] and column(rows, "batches") == ["6", "5"]
    a, b = (choose(r, RULE) for r in (now, before))

    def per_batch(result: GridResult, c: Choice) -> dict[str, float]:
        s = result.scores[result.scores["protocol"] == LBO]
        s = s[(s["selector"] == c.selector) & (s["family"] == c.family) & (s["n_tsp"] == c.n_tsp)]
        return dict(zip(s["batch_id"], s["S_um"], strict=True))

    old, new = per_batch(before, b), per_batch(now, a)
    d = np.array([old[k] - new[k] for k in old])
    better = "better" if d.mean() >= 0 else "worse"
    assert f"On the 5 batches that both know the newest model is {abs(d.mean()):.2f} µm {better} (90 %: " in text
    assert f"better on {(d > 0).sum()}." in text


def test_batches_with_other_content_count_as_new() -> None:
    now = pd.DataFrame({"batch_id": ["a", "b", "c"], "digest": ["1", "2", "3"]})
    earlier = pd.DataFrame({"batch_id": ["a", "b", "d"], "digest": ["1", "9", "4"]})
    assert changed_batches(now, earlier) == (["b", "c"], ["d"])


def test_a_grid_without_leave_batch_out_still_makes_a_report(toy_batches: Maker, tmp_path: Path) -> None:
    result = small(toy_batches)
    text = markdown_of([training(result)], tmp_path)
    assert "z: best cell of every family" in text and "train-on-one" in text
    assert "No left-out prediction of these models was kept." in html_of([training(result)], tmp_path)
    assert set(figure_pngs(result)) == {"families.png", "in_time.png"}


def test_pictures_are_pngs_and_the_same_from_two_threads(toy_batches: Maker) -> None:
    result = results(toy_batches)["z"]
    with ThreadPoolExecutor(2) as pool:
        one, two = pool.map(figure_pngs, [result, result])
    assert set(one) == {"families.png", "in_time.png", "left_out_median.png", "left_out_worst.png"}
    assert all(content.startswith(b"\x89PNG\r\n\x1a\n") and len(content) > 3000 for content in one.values())
    assert one == two


@pytest.mark.parametrize("name", ["r.pdf", "r", "r.HTM"])
def test_another_suffix_is_refused(name: str, toy_batches: Maker, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"unsupported file extension '.*'; give \.html or \.md"):
        write_report([training(results(toy_batches)["z"])], tmp_path / name, settings(tmp_path).promotion)


def test_no_training_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="report: got no training; give at least one tracked training"):
        write_report([], tmp_path / "r.md", settings(tmp_path).promotion)


def test_a_place_that_cannot_be_written_is_told(toy_batches: Maker, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"report .*r\.md: cannot be written \(.+\); give another place"):
        write_report([training(small(toy_batches))], tmp_path / "file" / "r.md", settings(tmp_path).promotion)


def test_a_failure_leaves_the_old_report_whole(
    toy_batches: Maker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "new" / "r.md"
    write_report([training(small(toy_batches))], target, settings(tmp_path).promotion)
    before = target.read_text(encoding="utf-8")

    def broken(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(atomic_file.os, "fsync", broken)
    with pytest.raises(InputError, match="No space left on device"):
        write_report([training(small(toy_batches), name="t1")], target, settings(tmp_path).promotion)
    assert target.read_text(encoding="utf-8") == before
    assert [p.name for p in target.parent.iterdir()] == ["r.md"]


def test_digits_and_words() -> None:
    assert [decimals(0.8, 30), decimals(0.3, 30), decimals(float("nan"), 30), decimals(1.0, 0)] == [1, 2, 1, 1]
    assert number(-2.04, 1) == "−2.0" and number(0.5, 2, sign=True) == "+0.50"
    assert number(float("nan")) == "–" and number(-3.2e7) == "−3.2·10⁷" and number(9999.4, 0) == "9999"
    nan = float("nan")
    assert [between(nan, nan), between(nan, 5400), between(600, nan), between(60, 60), between(0, 4500)] == [
        "whole batch", "start to 1:30", "0:10 to end", "0:01", "0:00 to 1:15",
    ]  # fmt: skip
    assert [count(1, "batch"), count(2, "batch"), count(2, "point")] == ["1 batch", "2 batches", "2 points"]
    assert listed(list("abc")) == "a, b and c" and listed(list("abcd"), most=2) == "a, b and 2 more"
    assert listed([]) == "" and listed(["a"]) == "a"


def test_a_logarithmic_axis_has_a_few_round_ticks() -> None:
    wanted = {
        (1.1, 100.0): ["1", "2", "5", "10", "20", "50", "100"],
        (1.11, 1.52): ["1.2", "1.4", "1.6", "1.8", "2", "2.2"],
    }
    for values_um, labels in wanted.items():
        ax = Figure().add_subplot()
        logarithmic(ax, [*values_um, math.nan, 0.0])
        ends = ax.get_ylim()
        assert [f"{t:g}" for t in ax.yaxis.get_majorticklocs() if ends[0] <= t <= ends[1]] == labels
