"""The report: its numbers against the tables and against hand computation, its sentences, its safety."""

from __future__ import annotations

import json
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from plotly.offline import get_plotlyjs

from data import files as atomic_file
from data.errors import InputError
from models.crossing import Plan
from models.grid import run_grid
from models.promotion import Choice, choose
from models.protocols import PromotionRule
from models.result import GridResult, Training
from reports.comparison import figure_pngs, write_report
from reports.comparison.story import changed_batches
from reports.comparison.tables import frequencies, left_out_batches, picked, scored
from reports.labels import between, cell_label, count, decimals, listed, number
from reports.layout import Scale
from tests.toys.report_training import HOSTILE, Maker, column, promotion, results, settings, table_after, training

RULE = PromotionRule()
LBO = "leave-batch-out"


class Page(HTMLParser):
    """What a browser would load, and the words outside of script and style."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.tags: list[str] = []
        self.words: list[str] = []
        self.ids: list[str] = []
        self.scripts: dict[str, str] = {}
        self._in = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        given = dict(attrs)
        self._in = (given.get("id") or tag) if tag in ("script", "style") else ""
        self.ids.append(given.get("id") or "")
        self.loads += [v or "" for k, v in attrs if k in ("src", "href", "srcset", "data", "action", "poster")]

    def handle_endtag(self, tag: str) -> None:
        self._in = ""

    def handle_data(self, data: str) -> None:
        if self._in:
            self.scripts[self._in] = data
        else:
            self.words.append(data)


def cell_words(choice: Choice) -> str:
    return cell_label(choice.selector, choice.family, choice.n_tsp)


def html_of(trainings: list[Training], folder: Path) -> str:
    return write_report(trainings, folder / "r.html", settings(folder).promotion).read_text(encoding="utf-8")


def markdown_of(trainings: list[Training], folder: Path) -> str:
    return write_report(trainings, folder / "r.md", settings(folder).promotion).read_text(encoding="utf-8")


def test_left_out_scores_are_those_of_the_predictions(toy_batches: Maker, tmp_path: Path) -> None:
    result = results(toy_batches)["z"]
    cell = choose(result.cells, RULE)
    text = markdown_of([training(result)], tmp_path)
    p = result.predictions
    s = []
    for b in result.batches["batch_id"]:
        rows = p[p["batch_id"] == b]
        e = (rows["recorded_um"] - rows[cell.cell]).to_numpy(float)
        e = e[np.isfinite(e)]
        s.append(np.sqrt((e**2).sum() / (len(e) - 1)))
    rows = table_after(text, f"z: best cell of every family, {LBO}")
    mine = next(r for r in rows if r[0].endswith("(chosen)"))
    at = {h.split(" (")[0]: v for h, v in zip(rows[0], mine, strict=True)}
    digits = len(at["S_mean"].split(".")[1])
    assert at["S_mean"] == f"{np.mean(s):.{digits}f}"
    assert at["S_std"] == f"{np.std(s, ddof=1):.{digits}f}"
    assert at["S per batch"] == f"{min(s):.{digits}f} to {max(s):.{digits}f}, median {np.median(s):.{digits}f}"
    batches = table_after(text, f"Every batch, left out by {cell_words(cell)}")
    assert column(batches, "S, left out") == [f"{v:.{digits}f}" for v in s]


@pytest.mark.parametrize("key", ["family", "selector"])
def test_a_leaderboard_holds_the_least_cell_of_each_and_both_baselines(
    key: str, toy_batches: Maker, tmp_path: Path
) -> None:
    result = results(toy_batches)["z"]
    rows = table_after(markdown_of([training(result)], tmp_path), f"z: best cell of every {key}, {LBO}")
    families = column(rows, "family")
    assert sum(f.startswith("no model") for f in families) == sum(f.startswith("mean curve") for f in families) == 1
    cells = result.cells[(result.cells["protocol"] == LBO) & ~result.cells["family"].isin(["zero", "mean_curve"])]
    score = (cells["S_mean_um"] + cells["S_std_um"]).groupby(cells[key]).min()
    shown = [float(a) + float(b) for a, b in zip(column(rows, "S_mean"), column(rows, "S_std"), strict=True)]
    assert shown == sorted(shown) or np.all(np.diff(shown) > -0.02)  # rounded to two decimals each
    for least in score:
        assert min(abs(v - least) for v in shown) <= 0.011


def test_protocols_have_tables_of_their_own_with_their_own_numbers(toy_batches: Maker, tmp_path: Path) -> None:
    result = results(toy_batches)["z"]
    text = markdown_of([training(result)], tmp_path)
    for protocol in ("train-on-one", "leave-season-out", "leave-speed-out"):
        cells = result.cells[(result.cells["protocol"] == protocol) & (result.cells["family"] == "mean_curve")]
        rows = table_after(text, f"z: best cell of every family, {protocol}")
        i = column(rows, "family").index("mean curve")
        assert float(column(rows, "S_mean")[i]) == pytest.approx(float(cells["S_mean_um"].iloc[0]), abs=0.051)
    rows = table_after(text, "z: best cell of every family, leave-speed-out")
    speeds = [h.split(" (")[0] for h in rows[0] if "rpm" in h]
    assert speeds == ["2000 rpm", "4000 rpm", "6000 rpm"]
    s = result.scores
    zero = s[(s["protocol"] == "leave-speed-out") & (s["family"] == "zero") & (s["fold"] == "4000 rpm")]
    i = column(rows, "family").index("no model")
    assert float(column(rows, "4000 rpm")[i]) == pytest.approx(zero["S_um"].mean(), abs=0.051)


def test_the_page_loads_nothing_and_holds_only_what_it_shows(toy_batches: Maker, tmp_path: Path) -> None:
    both = results(toy_batches)
    text = html_of([training(both["z"]), training(both["x"], name="t1")], tmp_path)
    page = Page(text)
    assert [v for v in page.loads if not v.startswith("#")] == []
    assert "@import" not in text.replace(get_plotlyjs(), "") and "url(" not in page.scripts["style"]
    assert "default-src 'none'" in text
    own = len(text) - len(get_plotlyjs())
    assert own < 300_000, f"{own} characters beside plotly.js"
    anchors = {v[1:] for v in page.loads}
    assert anchors <= set(page.ids)


def test_figures_hold_the_three_batches_and_no_other(toy_batches: Maker, tmp_path: Path) -> None:
    result = results(toy_batches)["z"]
    scripts = Page(html_of([training(result)], tmp_path)).scripts
    figures = {k: json.loads(v) for k, v in scripts.items() if k.endswith("-data")}
    assert sorted(figures) == [
        "c1-frequency-1-data", "c1-heat-1-data", "c1-left-out-1-data", "c1-left-out-2-data", "c1-left-out-3-data",
        "c1-points-1-data", "c1-points-2-data",
    ]  # fmt: skip
    shown = left_out_batches(result, picked(result, RULE, LBO))
    s = [b.S_um for b in shown]
    assert [b.place for b in shown] == ["best", "median", "worst"] and s == sorted(s)
    every = result.scores[(result.scores["protocol"] == LBO)]
    cell = picked(result, RULE, LBO)
    own = every[
        (every["family"] == cell.family) & (every["selector"] == cell.selector) & (every["n_tsp"] == cell.n_tsp)
    ]
    assert s[0] == own["S_um"].min() and s[2] == own["S_um"].max()
    for figure in figures.values():
        assert figure["data"], "a figure without a trace"
        assert any(a["text"] == "SIMULATED" for a in figure["layout"]["annotations"])


def test_hostile_names_stay_text(toy_batches: Maker, tmp_path: Path) -> None:
    both = results(toy_batches)
    text = html_of([training(replace(both["z"], machine="<img src=http://x>"))], tmp_path)
    page = Page(text)
    assert "img" not in page.tags and page.tags.count("script") == 3 + 7  # note, plotly, drawing; seven figures
    assert any(HOSTILE in w for w in page.words)
    assert "alert('$x$')</script>" not in text
    markdown = markdown_of([training(both["z"])], tmp_path)
    rows = table_after(markdown, f"Every batch, left out by {cell_words(choose(both['z'].cells, RULE))}")
    assert {len(r) for r in rows} == {len(rows[0])} and HOSTILE in [r[0] for r in rows]
    assert "<script" not in markdown.replace("\\<script", "")
    assert figure_pngs(both["z"])


@pytest.mark.parametrize("simulated", [True, False])
def test_simulated_is_said_everywhere_or_nowhere(simulated: bool, toy_batches: Maker, tmp_path: Path) -> None:
    page = training(results(toy_batches, simulated=simulated)["x"])
    for text in (html_of([page], tmp_path), markdown_of([page], tmp_path)):
        assert ("SIMULATED" in text) is simulated
    if simulated:
        markdown = markdown_of([page], tmp_path)
        captions = [line for line in markdown.splitlines() if re.match(r"\*\*.*\*\*", line)]
        assert captions and all("(SIMULATED)" in line for line in captions)


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
    assert "The checks raised no finding in 6 batches; every recorded sample was used." in clean


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
    rows = table_after(text, f"z: best cell of every family, {LBO}")
    mine = [r for r in rows if r[0].endswith("(champion)")]
    assert [r[:3] for r in mine] == [["MLR (champion)", "correlation", "1"]]
    assert "Version 3, MLR on 1 point by correlation, is champion" in text


def test_two_trainings_are_compared_on_the_batches_they_share(toy_batches: Maker, tmp_path: Path) -> None:
    now, before = results(toy_batches, k=6)["z"], results(toy_batches, k=5)["z"]
    before = replace(before, batches=before.batches.assign(digest=now.batches["digest"].iloc[:5].to_numpy()))
    pair = [training(before, name="old", when="2025-06-01"), training(now, name="new")]
    text = markdown_of(pair, tmp_path)
    assert "New since 2025-06-01 08:00 UTC: b05." in text
    rows = table_after(text, "The trainings, each judged on its own batches")
    assert column(rows, "trained") == ["2026-01-10 08:00", "2025-06-01 08:00"]
    assert column(rows, "new batches") == ["+1", "–"] and column(rows, "batches") == ["6", "5"]
    a, b = (choose(r.cells, RULE) for r in (now, before))

    def per_batch(result: GridResult, c: Choice) -> dict[str, float]:
        s = result.scores[result.scores["protocol"] == LBO]
        s = s[(s["selector"] == c.selector) & (s["family"] == c.family) & (s["n_tsp"] == c.n_tsp)]
        return dict(zip(s["batch_id"], s["S_um"], strict=True))

    old, new = per_batch(before, b), per_batch(now, a)
    d = np.array([old[k] - new[k] for k in old])
    better = "better" if d.mean() >= 0 else "worse"
    assert f"On the 5 batches that both know the newest model is {abs(d.mean()):.2f} µm {better} (90 %: " in text
    assert f"better on {(d > 0).sum()}." in text
    assert "c1-change-1-data" in Page(html_of(pair, tmp_path)).scripts


def test_batches_with_other_content_count_as_new() -> None:
    now = pd.DataFrame({"batch_id": ["a", "b", "c"], "digest": ["1", "2", "3"]})
    earlier = pd.DataFrame({"batch_id": ["a", "b", "d"], "digest": ["1", "9", "4"]})
    assert changed_batches(now, earlier) == (["b", "c"], ["d"])


def test_a_grid_without_leave_batch_out_still_makes_a_report(toy_batches: Maker, tmp_path: Path) -> None:
    plan = Plan(selectors=("none",), families=("mlr",), protocols=("train-on-one",))
    ((_, result),) = run_grid(toy_batches(k=3, n=30, sensors=2), ["z"], plan).values()
    text = markdown_of([training(result)], tmp_path)
    assert "z: best cell of every family, train-on-one" in text
    assert "No left-out prediction of this model was kept." in html_of([training(result)], tmp_path)
    assert set(figure_pngs(result)) == {"families.png", "points.png"}


def test_pictures_are_pngs_and_the_same_from_two_threads(toy_batches: Maker) -> None:
    result = results(toy_batches)["z"]
    with ThreadPoolExecutor(2) as pool:
        one, two = pool.map(figure_pngs, [result, result])
    assert set(one) == {"families.png", "points.png", "left_out.png"}
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
        write_report([training(results(toy_batches)["z"])], tmp_path / "file" / "r.md", settings(tmp_path).promotion)


def test_a_failure_leaves_the_old_report_whole(
    toy_batches: Maker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "new" / "r.md"
    write_report([training(results(toy_batches)["z"])], target, settings(tmp_path).promotion)
    before = target.read_text(encoding="utf-8")

    def broken(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(atomic_file.os, "fsync", broken)
    with pytest.raises(InputError, match="No space left on device"):
        write_report([training(results(toy_batches)["x"])], target, settings(tmp_path).promotion)
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


def test_the_strips_axis_is_logarithmic_and_keeps_what_leaves_it() -> None:
    scale = Scale(1.0, 100.0)
    assert [scale.at(v) for v in (1.0, 10.0, 100.0, 5000.0, 0.1)] == [0.0, 50.0, 100.0, 100.0, 0.0]
    assert (50.0, "10") in scale.ticks and len(scale.ticks) <= 7
    narrow = Scale(1.11, 1.52).ticks
    assert [label for _, label in narrow] == ["1.2", "1.3", "1.4", "1.5"]
    wide = Scale.over([0.5, 3.0, 1e9], cap_um=30.0)
    assert wide.high_um == pytest.approx(33.0) and wide.low_um == pytest.approx(0.5 / 1.1)
    assert Scale.over([], 1.0).ticks


def test_the_choice_of_points_is_shown_where_there_is_a_choice(toy_batches: Maker) -> None:
    result = results(toy_batches)["z"]
    shown = frequencies(result, scored(result, "leave-batch-out", RULE), "leave-batch-out")
    everything = int(result.cells["n_inputs"].max())
    assert {f.selector for f in shown} == {"correlation", "pca_elimination"}
    assert all(f.n_tsp < everything and sum(f.share.values()) == pytest.approx(f.n_tsp) for f in shown)
