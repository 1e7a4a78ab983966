"""Errors along an axis through the whole job: files, lake, grid, tracking, promotion, report and prediction."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from data.checks import check_batch, check_machine
from data.errors import InputError
from data.machine import Machine, load_machine
from data.recording import read_batches
from models.families.axis_coupled import AxisCoupled
from models.protocols import PromotionRule
from models.selection.crossing import Plan
from models.selection.grid import run_grid
from models.selection.promotion import choose
from models.selection.result import GridResult
from models.selection.trust import Region
from pipelines.commands.predict import predict_file
from pipelines.jobs.request import TrainRequest, check_request
from pipelines.store import model_store
from reports.comparison import figure_pngs, write_report
from reports.comparison.channel import Channel
from reports.comparison.pictures import left_out_panels
from reports.comparison.tables import left_out_batches
from tests.data.test_describe import draft_of, sweeps_of
from tests.reports.test_report_browser import CHROMIUM, console, measured, open_page
from tests.toys.report_training import settings, training
from thermodrift_exam.plants.types.lathe_axis import write_sample_axis

MACHINE_FILE = Path(__file__).parents[3] / "machines" / "sample_lathe.yml"


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
    shown = [b for b in left_out_batches(result, choose(result, PromotionRule())) if b.place]
    assert [b.place for b in shown] == ["median", "worst"]
    (panel,) = left_out_panels([Channel.of("x_axis", [training(result)], PromotionRule())])
    assert len(panel.plots) == 2
    assert panel.caption == f"Runs left out: recorded and predicted along the axis, {shown[0].protocol}"
    for batch, plot in zip(shown, panel.plots, strict=True):
        assert batch.position_mm is not None and batch.every == 1
        upper, lower = plot.figure.axes
        sweeps = [line for line in upper.lines if len(line.get_xdata()) == 12]
        lines, recorded = sweeps[::2], sweeps[1::2]
        residual = [line for line in lower.lines if len(line.get_xdata()) == 12]
        assert len(lines) == len(residual) == len(batch.time_h) // 12 - 1  # the first sweep is zero
        for k, (line, dots, rest) in enumerate(zip(lines, recorded, residual, strict=True), 1):
            rows = slice(12 * k, 12 * k + 12)
            order = np.argsort(batch.position_mm[rows], kind="stable")
            assert np.array_equal(dots.get_xdata(), batch.position_mm[rows][order])
            assert np.array_equal(dots.get_ydata(), batch.recorded_um[rows][order])
            assert np.array_equal(line.get_ydata(), batch.predicted_um[rows][order])
            assert np.allclose(rest.get_ydata(), (batch.recorded_um - batch.predicted_um)[rows][order])
            straight = np.polyval(np.polyfit(line.get_xdata(), line.get_ydata(), 1), line.get_xdata())
            assert np.abs(line.get_ydata() - straight).max() < 1.5  # one line a sweep, but for what warms meanwhile
    assert [k.label for k in panel.keys][:4] == ["recorded", "predicted", "0 h", "1 h"]


def test_the_page_and_the_small_pictures_are_made(result: GridResult, page: Path, tmp_path: Path) -> None:
    html = page.read_text(encoding="utf-8")
    assert "recorded and predicted along the axis" in html and 'class="viewer"' not in html
    assert figure_pngs(result)["left_out_median.png"].startswith(b"\x89PNG")
    text = write_report([training(result)], tmp_path / "r.md", settings(tmp_path).promotion).read_text(encoding="utf-8")
    assert "axis coupled" in text


@pytest.mark.integration
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium or google-chrome on the path to open the page in")
def test_no_label_of_a_fan_is_cut_or_covered_in_a_browser(page: Path, tmp_path: Path) -> None:
    _, log = open_page(page, tmp_path)
    assert console(log) == []
    plots = measured(page, 390, tmp_path)["pictures"]
    assert len(plots) == 2 + 2 and all(p["cut"] == p["covered"] == [] and p["width"] > 300 for p in plots)


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


def test_readings_with_stamps_of_their_own_in_a_log(tmp_path: Path) -> None:
    (path,) = write_sample_axis(tmp_path, 0, 1)
    table = pd.read_csv(path, skiprows=1)
    table = table.rename(columns={"x_axis": "x_error", "z_axis": "z_error", "x_spindle": "dx", "z_spindle": "dz"})
    text, machine, _ = draft_of(tmp_path, table)
    assert machine.channels["x_error"].position == "x_position" and machine.channels["z_error"].position == "z_position"
    assert machine.channels["dx"].position is None
    assert "position: x_position  # guessed: error and position stand in the same rows" in text
    assert machine.recording.step_s == 10
    at, _ = sweeps_of(tmp_path / "a.csv", machine, "z_error")
    assert (at == at[0]).all()
