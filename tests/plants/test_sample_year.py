"""The sample year as files: what a reader meets, the scatter behind it, and that models score on it as in print."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from data.errors import InputError
from data.machine import load_machine
from plants.sample.sample_year import COLUMNS, SENSOR_OFFSET_K, plan_year, run_plans, sensor_degC, write_sample_year

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def year(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return write_sample_year(tmp_path_factory.mktemp("year"))


@pytest.fixture(scope="module")
def tables(year: list[Path]) -> list[pd.DataFrame]:
    return [pd.read_csv(p, skiprows=1, parse_dates=["timestamp"]) for p in year]


def digest(paths: list[Path]) -> str:
    return hashlib.sha256(b"".join(p.name.encode() + p.read_bytes() for p in paths)).hexdigest()


def test_files_look_like_a_measuring_system_wrote_them(year: list[Path]) -> None:
    assert len(year) == len({p.name for p in year}) == 30
    for path in year:
        first, header, row = path.read_text("ascii").splitlines()[:3]
        assert first == "# simulated recording, thermodrift sample year, seed 0"
        assert header.split(",") == list(COLUMNS)
        day, kind = path.stem.split("_")
        assert row.startswith(f"{day[:4]}-{day[4:6]}-{day[6:]} ")
        assert kind in {"2000rpm", "4000rpm", "6000rpm", "spectrum"}
        cells = row.split(",")[1:]
        assert all(len(c.split(".")[1]) == 1 for c in cells[:10]) and not any("." in c for c in cells[10:])
        assert "-0.0" not in cells and "nan" not in row


def test_the_machine_file_names_every_column_and_says_simulated() -> None:
    machine = load_machine(ROOT / "machines" / "sample_vmc.yml")
    assert machine.simulated
    assert (machine.recording.time.column, *machine.channels) == COLUMNS
    assert machine.names("error") == ("x", "y", "z")
    assert (*machine.names("temperature"), *machine.names("ambient")) == tuple(SENSOR_OFFSET_K)


def test_values_fit_the_machine_files_ranges_with_room_to_spare(tables: list[pd.DataFrame]) -> None:
    machine = load_machine(ROOT / "machines" / "sample_vmc.yml")
    everything = pd.concat(tables)
    for name, channel in machine.batch_channels().items():
        assert channel.low is not None and channel.high is not None
        assert channel.low <= everything[name].min() and everything[name].max() <= channel.high


@pytest.mark.integration
def test_same_seed_same_bytes_on_any_number_of_threads(tmp_path: Path) -> None:
    paths = write_sample_year(tmp_path / "a", 3, 4)
    code = (
        "import sys; from pathlib import Path; from plants.sample.sample_year import write_sample_year; "
        "write_sample_year(Path(sys.argv[1]), 3, 4)"
    )
    threads = {"OMP_NUM_THREADS": "3", "OPENBLAS_NUM_THREADS": "3"}
    subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "b")], check=True, cwd=ROOT, env={**os.environ, **threads}
    )
    assert digest(paths) == digest(sorted((tmp_path / "b").iterdir()))
    assert digest(paths) != digest(write_sample_year(tmp_path / "c", 4, 4))


def test_the_year_of_seed_0_stays_the_same_to_the_byte(year: list[Path]) -> None:
    content = hashlib.sha256(b"".join(p.read_bytes() for p in year)).hexdigest()
    assert content == "e93baac5646da2dcdfe127b03571b7818edcc0fbc4f621c88c077af837269566"


def test_one_start_ambient_per_season_and_speed() -> None:
    plans = plan_year(0)
    ambient = np.array([p.start_degC for p in plans])
    assert ambient.min() == pytest.approx(2.9) and ambient.max() == pytest.approx(32.4)
    assert np.histogram(ambient, 10, (2.9, 32.4))[0].min() >= 1
    constant = [p.speed_rpm for p in plans if not p.spectrum]
    assert [constant.count(n) for n in (2000, 4000, 6000)] == [9, 9, 9]
    assert sum(p.spectrum for p in plans) == 3 and sum(p.cool_down_s > 0 for p in plans) == 10
    assert all(p.duration_s >= 6 * 3600 for p in plans)
    assert [p.start for p in plans] == sorted(p.start for p in plans)
    for p in plans:
        assert p.start.year == 2025 and p.start.weekday() < 5 and 6 <= p.start.hour < 10
        month = p.start.month
        assert (p.start_degC < 10) <= (month in {11, 12, 1, 2, 3, 4}), "cold days lie in the cold half"
        assert (p.start_degC > 26) <= (month in {5, 6, 7, 8, 9}), "hot days lie in the hot half"


@pytest.mark.parametrize("seed", range(5))
def test_scatter_stays_inside_its_stated_ranges(seed: int) -> None:
    plans = plan_year(seed)
    assert len({p.start.date() for p in plans}) == 30
    for p in plans:
        assert -1 <= p.drift_K <= 5 and 0.85 <= p.friction <= 1.15
        assert all(-2 <= v <= 4 for v in p.slow_start_K.values())
        assert set(p.slow_start_K) == {"bed", "table", "column_front", "column_back"}
        assert p.floor_degC - 17.65 == pytest.approx((p.start_degC - 17.65) / 2)
        time_s = np.arange(0, p.duration_s, 60.0)
        ripple = p.room_at(time_s) - p.start_degC - p.drift_K * time_s / p.duration_s
        assert 0.15 < np.abs(ripple).max() <= 0.3


def test_grid_and_commanded_speeds(tables: list[pd.DataFrame], year: list[Path]) -> None:
    for path, table in zip(year, tables, strict=True):
        assert (table["timestamp"].diff().dropna() == pd.Timedelta(60, "s")).all()
        speeds = table["spindle_rpm"]
        assert (speeds[:5] == 0).all(), "the first five minutes show the machine at rest"
        running = speeds[5:365]
        if path.stem.endswith("spectrum"):
            assert running.tolist() == ([1500] * 15 + [3000] * 15 + [4500] * 15 + [6000] * 15) * 6
        else:
            assert set(running) == {int(path.stem.split("_")[1].removesuffix("rpm"))}
        stopped = speeds[365:]
        if len(stopped) == 1:
            assert stopped.item() > 0, "a run without cool-down ends running"
        else:
            assert len(stopped) > 90 and (stopped == 0).all()


def test_a_sensor_lags_by_a_minute_and_reads_the_air_a_little() -> None:
    step = np.r_[np.full(10, 20.0), np.full(200, 30.0)]
    shown = sensor_degC(step, np.full(210, 20.0), 0.95)
    assert shown[0] == 20.0
    assert shown[-1] == pytest.approx(20 + 0.95 * 10, abs=1e-6)
    assert shown[9 + 6] == pytest.approx(20 + 9.5 * (1 - np.exp(-1)), abs=1e-9)  # 60 s after the step


def test_recordings_follow_the_truth_within_the_instruments(tables: list[pd.DataFrame]) -> None:
    """Probe noise 0.7 µm with rounding to 1 µm: 0.76 µm together, and nothing else."""
    plans = plan_year(0)
    truth = run_plans(plans)
    left = np.concatenate(
        [t[c].to_numpy() - truth.error_um[c][::6, b][: len(t)] for b, t in enumerate(tables) for c in "xyz"]
    )
    assert left.std() == pytest.approx(np.hypot(0.7, 1 / np.sqrt(12)), rel=0.03)
    assert abs(left.mean()) < 0.02 and np.abs(left).max() < 5


def test_no_spike_no_jump_no_frozen_channel(tables: list[pd.DataFrame]) -> None:
    sensors = list(SENSOR_OFFSET_K)
    for table in tables:
        assert table[sensors].diff().abs().max().max() < 2.0
        steady = table["spindle_rpm"].diff().abs().rolling(15, min_periods=1).max() == 0
        assert table[["x", "y", "z"]].diff().abs()[steady].max().max() <= 7
        assert (table[sensors].nunique() >= 3).all() and (table[["x", "y", "z"]].nunique() >= 5).all()


def test_least_squares_scores_as_on_real_years(tables: list[pd.DataFrame]) -> None:
    """Leave-batch-out on 10 sensors at 5 min: a year without scatter would give under 1.6 µm, useless as a test bed."""
    sensors = list(SENSOR_OFFSET_K)
    rises = [(t[sensors] - t[sensors].iloc[0]).to_numpy()[::5] for t in tables]
    z_um = [(t["z"] - t["z"].iloc[0]).to_numpy(float)[::5] for t in tables]

    def left_out_um(columns: list[int]) -> float:
        scores = []
        for k in range(len(tables)):
            x = np.vstack([r[:, columns] for j, r in enumerate(rises) if j != k])
            y = np.concatenate([v for j, v in enumerate(z_um) if j != k])
            beta = np.linalg.lstsq(np.c_[np.ones(len(x)), x], y, rcond=None)[0]
            e = z_um[k] - np.c_[np.ones(len(rises[k])), rises[k][:, columns]] @ beta
            scores.append(np.sqrt((e**2).sum() / (len(e) - 1)))
        return float(np.mean(scores))

    assert 2.0 < left_out_um(list(range(10))) < 3.5
    assert 4.0 < left_out_um([sensors.index("front"), sensors.index("column_back")]) < 9.0
    assert 10.0 < left_out_um([sensors.index("front")]) < 18.0


@pytest.mark.parametrize(
    ("seed", "batches", "words"), [(0, 0, "got 0, expected 1 to 120"), (-1, 3, "got -1, expected 0")]
)
def test_numbers_out_of_range_are_told_in_one_line(seed: int, batches: int, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        plan_year(seed, batches)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("batches", [1, 120])
def test_other_sizes(batches: int) -> None:
    assert len({p.name for p in plan_year(1, batches)}) == batches


def test_a_folder_that_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    with pytest.raises(InputError, match=r"taken cannot be written \(.*\); give a folder"):
        write_sample_year(tmp_path / "taken", 0, 1)
