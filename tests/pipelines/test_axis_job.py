"""Errors along an axis through the whole job: files, lake, grid, tracking, promotion, report and prediction."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from data.checks import check_batch, check_machine
from data.errors import InputError
from data.machine import Machine, load_machine
from data.recording import read_batches
from models.axis_coupled import AxisCoupled
from models.crossing import Plan
from models.grid import run_grid
from models.promotion import choose
from models.protocols import PromotionRule
from models.result import GridResult
from models.trust import Region
from pipelines import model_store
from pipelines.commands.predict import predict_file
from pipelines.training import TrainRequest, check_request
from plants.sample.sample_axis import write_sample_axis
from reports.comparison import figure_pngs, write_report
from reports.comparison.figures import fan_panel
from reports.comparison.tables import left_out_batches
from tests.reports.test_report_browser import CHROMIUM, console, open_page
from tests.toys.report_training import settings, training

MACHINE_FILE = Path(__file__).parents[2] / "machines" / "sample_lathe.yml"


@pytest.fixture(scope="module")
def machine() -> Machine:
    return load_machine(MACHINE_FILE)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return write_sample_axis(tmp_path_factory.mktemp("axis"), 1, 5)


@pytest.fixture(scope="module")
def result(recordings: list[Path], machine: Machine) -> GridResult:
    batches = [b.with_findings(check_batch(b, machine)) for p in recordings for b in read_batches(p, machine)]
    plan = Plan(("none", "correlation"), ("zero", "mean_curve", "ridge", "axis_coupled"), n_tsps=(4, 8))
    return run_grid(check_machine(batches, machine), ["x_axis"], plan, machine)["x_axis"][1]


@pytest.fixture(scope="module")
def page(result: GridResult, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("page")
    return write_report([training(result)], folder / "r.html", settings(folder).promotion)


def test_the_fan_shows_every_reading_and_the_lines_of_the_left_out_model(result: GridResult) -> None:
    shown = left_out_batches(result, choose(result.cells, PromotionRule()))
    assert [b.place for b in shown] == ["best", "median", "worst"]
    panel = fan_panel("x_axis", shown, "x_axis", 1, True)
    assert panel is not None and len(panel.plots) == 3
    for batch, plot in zip(shown, panel.plots, strict=True):
        assert batch.position_mm is not None and batch.every == 1
        sweeps = len(batch.time_h) // 12
        lines = [t for t in plot.figure.data if t.mode == "lines"]
        recorded, residual = (t for t in plot.figure.data if t.mode == "markers")
        assert len(lines) == sweeps - 1  # the first sweep is zero
        assert np.array_equal(recorded.y, batch.recorded_um[12:]) and np.array_equal(recorded.x, batch.position_mm[12:])
        assert np.allclose(residual.y, (batch.recorded_um - batch.predicted_um)[12:])
        for k, line in enumerate(lines, 1):
            assert np.array_equal(line.y, batch.predicted_um[12 * k : 12 * k + 12])
            straight = np.polyval(np.polyfit(line.x, line.y, 1), line.x)
            assert np.abs(line.y - straight).max() < 1.5  # one line a sweep, but for what warms meanwhile
    labels = [k.label for k in panel.keys]
    assert labels[:2] == ["recorded", "predicted, batch left out"] and labels[2:4] == ["0 h", "1 h"]


def test_a_channel_without_an_axis_has_no_fan(toy_batches) -> None:
    plain = run_grid(toy_batches(4), ["z"], Plan(("none",), ("zero", "mlr"), ("leave-batch-out",)))["z"][1]
    shown = left_out_batches(plain, choose(plain.cells, PromotionRule()))
    assert shown and shown[0].position_mm is None
    assert fan_panel("z", shown, "z", 1, False) is None


def test_the_page_and_the_small_pictures_are_made(result: GridResult, page: Path, tmp_path: Path) -> None:
    html = page.read_text(encoding="utf-8")
    assert "x_axis: error against position, sweep after sweep" in html and 'id="c1-fan-3"' in html
    specs = dict(re.findall(r'<script type="application/json" id="([\w-]+)-data">(.*?)</script>', html, re.S))
    in_time = json.loads(specs["c1-left-out-1"])
    assert {t["mode"] for t in in_time["data"]} == {"markers"}  # a line through readings would be a zigzag
    assert figure_pngs(result)["left_out.png"].startswith(b"\x89PNG")
    text = write_report([training(result)], tmp_path / "r.md", settings(tmp_path).promotion).read_text(encoding="utf-8")
    assert "axis coupled" in text


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium or google-chrome on the path to open the page in")
def test_every_figure_is_drawn_in_a_browser(page: Path, tmp_path: Path) -> None:
    dom, log = open_page(page, tmp_path)
    assert re.search(r'<html[^>]* data-errors=""', dom) and console(log) == []
    for k in (1, 2, 3):
        part = dom.split(f'id="c1-fan-{k}"', 1)[1].split(f'id="c1-fan-{k}-data"', 1)[0]
        assert len(re.findall(r'class="js-line"[^>]* d="M[^"]+L', part)) >= 8
        assert len(re.findall(r'class="point"', part)) >= 2 * 8 * 12


def test_a_stored_model_predicts_a_raw_recording(recordings: list[Path], machine: Machine, tmp_path: Path) -> None:
    batches = [b for p in recordings[:4] for b in read_batches(p, machine)]
    model = AxisCoupled().fit(batches, ("room", "headstock", "x_nut", "spindle_front"), "x_axis", machine)
    model_store.save(tmp_path / "m", model, MACHINE_FILE.read_text(encoding="utf-8"), Region.of(batches, model.inputs))
    table = predict_file(str(tmp_path / "m"), recordings[4], settings(tmp_path))
    (batch,) = read_batches(recordings[4], machine)
    there = np.isfinite(batch.values("x_position"))
    assert np.array_equal(np.isfinite(table["predicted_um"]), there)
    assert np.array_equal(table["position_mm"], batch.values("x_position"), equal_nan=True)
    stored = model_store.load(tmp_path / "m")
    assert np.array_equal(stored.predict(batch), model.predict(batch), equal_nan=True)
    assert stored.family.options() == model.options() and stored.family.n_parameters() == model.n_parameters()

    bare = pd.read_csv(recordings[4], skiprows=1).drop(columns=["x_position", "x_axis"])
    bare.to_csv(tmp_path / "bare.csv", index=False)
    with pytest.raises(
        InputError, match=r"needs 'x_position' \(column 'x_position'\), which the recording does not have"
    ):
        predict_file(str(tmp_path / "m"), tmp_path / "bare.csv", settings(tmp_path))


def test_a_request_for_a_channel_without_an_axis_is_refused_before_anything_starts(tmp_path: Path) -> None:
    shutil.copy(MACHINE_FILE, tmp_path / "m.yml")
    plan = Plan(families=("zero", "axis_coupled"))
    check_request(TrainRequest(tmp_path / "m.yml", targets=("x_axis", "z_axis"), plan=plan), settings(tmp_path))
    with pytest.raises(
        InputError, match="family axis_coupled needs the position of every reading, and error channel x_sp"
    ):
        check_request(TrainRequest(tmp_path / "m.yml", plan=plan), settings(tmp_path))
