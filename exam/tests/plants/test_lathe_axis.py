"""The axis recordings of the sample lathe: as a measuring system writes them, their physics, and the way to a model."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch
from data.checks import check_batch, check_machine
from data.errors import InputError
from data.machine import Machine, load_machine
from data.recording import read_batches
from models.selection.crossing import Plan
from models.selection.grid import run_grid
from thermodrift_exam.plants.types.lathe import AXES, LATHE, STEEL_UM_PER_M_K, Drive, feed_heat_W
from thermodrift_exam.plants.types.lathe_axis import (
    COLUMNS,
    POSITIONS,
    SENSOR_OFFSET_K,
    axis_runs,
    run_lathe,
    write_sample_axis,
)

MACHINE = Path(__file__).parents[3] / "machines" / "sample_lathe.yml"


@pytest.fixture(scope="module")
def paths(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return write_sample_axis(tmp_path_factory.mktemp("axis"))


@pytest.fixture(scope="module")
def machine() -> Machine:
    return load_machine(MACHINE)


@pytest.fixture(scope="module")
def batches(paths: list[Path], machine: Machine) -> list[Batch]:
    read = [b for p in paths for b in read_batches(p, machine)]
    return check_machine([b.with_findings(check_batch(b, machine)) for b in read], machine)


def test_files_look_like_a_measuring_system_wrote_them(paths: list[Path]) -> None:
    assert len(paths) == 9 and paths == sorted(paths)
    for path in paths:
        first, header = path.read_text("ascii").splitlines()[:2]
        assert first == "# simulated recording, thermodrift sample lathe, seed 0"
        assert header.split(",") == list(COLUMNS)
        table = pd.read_csv(path, skiprows=1, parse_dates=["timestamp"])
        assert (table["timestamp"].diff().dropna() > pd.Timedelta(0)).all()
        for axis, part in AXES.items():
            swept = table.dropna(subset=f"{axis}_axis")
            assert len(swept) % POSITIONS == 0 and len(swept) >= 9 * POSITIONS
            assert swept[f"{axis}_position"].nunique() == POSITIONS
            assert (swept[f"{axis}_position"].min(), swept[f"{axis}_position"].max()) == part.travel_mm
        assert table["spindle_rpm"].max() in (1000, 1500, 2000) and table["feed_mm_min"].max() in (500, 1000, 1500)
    combos = {tuple(p.stem.split("_")[1:]) for p in paths}
    assert len(combos) == 9  # every speed with every feed


def test_the_machine_file_names_every_column_and_says_simulated(machine: Machine) -> None:
    assert machine.simulated
    assert (machine.recording.time.column, *machine.channels) == (
        "timestamp", *SENSOR_OFFSET_K, "spindle_rpm", "feed_mm_min", "x_spindle", "z_spindle", "x_position", "x_axis",
        "z_position", "z_axis",
    )  # fmt: skip
    assert machine.axes() == {"x_position": ("x_axis",), "z_position": ("z_axis",)}
    for axis, part in AXES.items():
        assert machine.channels[f"{axis}_position"].fixed_end == part.fixed_end_mm


def test_nothing_is_lost_on_the_way_in_and_no_check_complains(batches: list[Batch], paths: list[Path]) -> None:
    for batch, path in zip(batches, paths, strict=True):
        assert batch.findings == () and batch.simulated
        assert batch.repairs["rows_dropped"] == 0 == batch.repairs["duplicates"]
        table = pd.read_csv(path, skiprows=1)
        for name in ("x_axis", "z_axis"):
            recorded = table[name].dropna().to_numpy()
            assert batch.values(name)[np.isfinite(batch.values(name))] == pytest.approx(recorded)


def test_same_seed_same_bytes_and_another_seed_another_lathe(tmp_path: Path) -> None:
    first, again, other = (write_sample_axis(tmp_path / n, seed, 2) for n, seed in (("a", 3), ("b", 3), ("c", 4)))
    assert [p.read_bytes() for p in first] == [p.read_bytes() for p in again]
    assert [p.read_bytes() for p in first] != [p.read_bytes() for p in other]


def test_a_uniformly_warm_screw_grows_by_alpha_times_length() -> None:
    for axis in AXES.values():
        rise_K = {body: np.full(3, 5.0) for body in axis.thirds}
        at_mm = np.array([*axis.travel_mm, axis.fixed_end_mm + 100.0])
        away_m = (at_mm - axis.fixed_end_mm) / 1000
        np.testing.assert_allclose(axis.elongation_um(rise_K, at_mm), STEEL_UM_PER_M_K * away_m * 5.0)
    uneven = dict(zip(AXES["x"].thirds, ([3.0], [0.0], [6.0]), strict=True))
    got = AXES["x"].elongation_um({k: np.array(v) for k, v in uneven.items()}, np.array([150.0]))
    assert got == pytest.approx(STEEL_UM_PER_M_K * (0.06 * 3 + 0.03 * 6))  # 60 mm, nothing, and half of the last 60


def test_what_rubs_is_what_warms() -> None:
    """Next to alone in the world, the machine keeps every joule of the drives."""
    lone = replace(LATHE, room_W_per_K={"enclosure": 1e-4}, floor_W_per_K={}, always_W={}, heats=(), bearings=())
    feed = np.full((360, 1), 1500.0)
    drives = {axis: [Drive(friction=1.1)] for axis in AXES}
    heat = feed_heat_W(lone, feed, drives)
    assert np.all(heat >= 0) and heat[0].sum() > 50.0
    start = np.full((1, len(lone.bodies)), 20.0)
    out = lone.simulate(np.zeros((360, 1)), np.full((360, 1), 20.0), np.zeros(1), start, np.ones(1), 10.0, heat)
    kept = float(((out[-1] - out[0]) * lone.capacity).sum())
    assert kept == pytest.approx(3600.0 * heat[0].sum(), rel=1e-6)


def test_the_spindle_warms_the_offset_and_the_feed_the_slope() -> None:
    """One day's run as it was, with a faster feed, and with a faster spindle."""
    slow = next(r for r in axis_runs(0, 9) if (r.speed_rpm, r.feed_mm_per_min) == (1000, 500))
    stages = tuple((seconds, 2.0 * rpm) for seconds, rpm in slow.scatter.stages)
    faster = replace(slow, scatter=replace(slow.scatter, stages=stages))
    truth = run_lathe([slow, replace(slow, feed_mm_per_min=1500), faster])
    end = np.array([int(4.0 * 360)])
    for axis, part in AXES.items():
        low, high = (np.array([v]) for v in part.travel_mm)
        slope_um = [float((truth.axis_um(axis, end, b, high) - truth.axis_um(axis, end, b, low))[0]) for b in range(3)]
        offset_um = truth.spindle_um()[f"{axis}_spindle"][end[0]]
        by_feed, by_speed = slope_um[1] - slope_um[0], slope_um[2] - slope_um[0]
        assert by_feed > 5.0 and abs(by_speed) < 0.3 * by_feed
        by_feed, by_speed = offset_um[1] - offset_um[0], offset_um[2] - offset_um[0]
        assert by_speed > 3.0 and abs(by_feed) < 0.3 * by_speed
        np.testing.assert_allclose(truth.axis_um(axis, end, 1, np.array([part.fixed_end_mm])), offset_um[1])


def test_models_that_know_the_position_beat_those_that_do_not(batches: list[Batch], machine: Machine) -> None:
    plan = Plan(("none",), ("zero", "mean_curve", "ridge", "pcr", "axis_coupled"), ("leave-batch-out",))
    for target in ("x_axis", "z_axis"):
        cells = run_grid(batches, [target], plan, machine)[target][1].cells
        S = cells[cells["protocol"] == "leave-batch-out"].set_index("family")["S_mean_um"]
        others = S.drop("axis_coupled").min()
        assert S["axis_coupled"] < 0.5 * others < S["zero"]


def test_wrong_requests_are_told_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="sample axis: seed: got -1, expected 0 or more; choose another number"):
        axis_runs(-1)
    with pytest.raises(InputError, match="sample axis: batches: got 91, expected 1 to 90"):
        axis_runs(0, 91)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"sample axis: .*file cannot be written .*; give a folder that can be"):
        write_sample_axis(tmp_path / "file", 0, 1)
