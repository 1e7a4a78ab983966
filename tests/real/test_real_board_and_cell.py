"""The laboratory board and the cell: their machine files read every recording, column by column, sign by sign."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from data.batch import Batch
from data.checks import check_batch, check_machine
from data.machine import load_machine
from data.recording import read_batches, recording_files

ROOT = Path(__file__).parents[2]
DATA = ROOT.parent / "shared" / "data"
BOARD, CELL = DATA / "tclab", DATA / "cell_30q"
NAMES = {  # what the four recordings call the five columns that are read by position; one has no header
    "energy_balance_mimo": ["Time (sec)", "Heater 1 (%)", "Heater 2 (%)", "Temperature 1 (degC)",
                            "Temperature 2 (degC)"],
    "hybrid_mimo": ["Time", "Q1", "Q2", "TC1", "TC2"],
    "mhe2nl": [],
    "mimo2_data": ["Time (sec)", "Heater 1", "Heater 2", "Temperature 1", "Temperature 2"],
}  # fmt: skip
RATES = ["1C", "2C", "3C", "4C"]


def read(folder: Path, name: str) -> dict[str, Batch]:
    if not folder.is_dir():
        pytest.skip(f"no ../shared/data/{folder.name}")
    machine = load_machine(ROOT / "machines" / f"{name}.yml")
    files, _ = recording_files(folder, machine)
    batches = [b for f in files for b in read_batches(f, machine, need_error=False)]
    return {b.batch_id: b for b in check_machine([b.with_findings(check_batch(b, machine)) for b in batches], machine)}


def raw(path: Path) -> np.ndarray:
    """The recording's own numbers; a header line is skipped."""
    header = not path.read_text("utf-8-sig")[0].isdigit()
    return np.loadtxt(path, delimiter=",", encoding="utf-8-sig", skiprows=int(header))


@pytest.fixture(scope="module")
def board() -> dict[str, Batch]:
    return read(BOARD, "tclab_board")


@pytest.fixture(scope="module")
def cell() -> dict[str, Batch]:
    return read(CELL, "cell_30q")


def same_as_raw(batch: Batch, path: Path, channels: tuple[str, ...], factors: tuple[float, ...], noise: float) -> None:
    """Every channel is its own column: drivers held, the others no further from the straight line than `noise`."""
    rows = raw(path)
    t = rows[:, 0] - rows[0, 0]
    held = np.searchsorted(t, batch.time_s + 1e-6, side="right") - 1
    for k, (name, factor) in enumerate(zip(channels, factors, strict=True), start=1):
        got = batch.values(name)
        if batch.channels[name].role == "driver":
            assert got == pytest.approx(rows[held, k] * factor), name
        else:
            line = np.interp(batch.time_s, t, rows[:, k] * factor)
            assert np.abs(got - line).max() < noise, name
        assert np.isfinite(batch.masked(name)).all(), name


def test_the_board_reads_whatever_its_headers_say(board: dict[str, Batch]) -> None:
    assert list(board) == sorted(NAMES)
    for name, batch in board.items():
        (path,) = BOARD.glob(f"{name}.*")
        if NAMES[name]:
            header = path.read_text().splitlines()[0].split(",")
            assert [c.strip() for c in header[:5]] == NAMES[name]
        assert batch.repairs.get("preamble_rows", 0) == bool(NAMES[name])
        assert "unknown_columns" not in batch.repairs and "missing_channels" not in batch.repairs
        assert batch.repairs["rows_used"] == batch.repairs["rows_in"] == len(raw(path))
        channels = ("heater1", "heater2", "temperature1", "temperature2")
        same_as_raw(batch, path, channels, (1.0,) * 4, noise=1e-6)
        assert batch.step_s == 1.0 and 595 <= batch.time_s[-1] <= 600


def test_each_heater_of_the_board_warms_its_own_sensor(board: dict[str, Batch]) -> None:
    """While one heater alone is on, its own temperature rises at least three times as much as the other."""
    for name, begin_s, end_s in (("energy_balance_mimo", 10, 95), ("mhe2nl", 6, 70), ("mimo2_data", 0, 145)):
        batch = board[name]
        assert batch.values("heater1")[begin_s + 3] >= 70 and not batch.values("heater2")[: end_s + 1].any()
        rise = [batch.values(t)[end_s] - batch.values(t)[begin_s] for t in ("temperature1", "temperature2")]
        assert rise[0] > 12 and rise[0] > 3 * abs(rise[1]), name


def test_the_board_has_no_fault_without_any_overrule(board: dict[str, Batch]) -> None:
    assert load_machine(ROOT / "machines" / "tclab_board.yml").overrule == []
    assert [f.message for batch in board.values() for f in batch.findings] == []


def test_the_cell_reads_its_columns_in_their_units(cell: dict[str, Batch]) -> None:
    assert list(cell) == [f"Q30_S001_{rate}" for rate in RATES]
    channels = ("current", "voltage", "power", "can", "hoop_strain", "room")
    for name, batch in cell.items():
        path = CELL / f"{name}.csv"
        assert path.read_bytes().startswith(b"\xef\xbb\xbf")  # its first cell is still a number
        assert batch.repairs["rows_used"] == batch.repairs["rows_in"] == len(raw(path))
        same_as_raw(batch, path, channels, (1, 1, 1, 1, 1e6, 1), noise=1e-6)
        assert batch.channels["hoop_strain"].unit == "um/m" and batch.names("error") == ("hoop_strain",)
        assert batch.findings == ()


def test_the_cell_discharges_with_a_negative_current(cell: dict[str, Batch]) -> None:
    for rate, batch in enumerate(cell.values(), start=1):
        current, voltage, power = (batch.values(n) for n in ("current", "voltage", "power"))
        assert current[5:].mean() == pytest.approx(-3.0 * rate, rel=0.002)
        assert -current.sum() * batch.step_s / 3600 == pytest.approx(2.93, abs=0.04)  # Ah
        assert voltage[0] > 4.14 and voltage[-1] < 2.55
        assert power[5:].mean() == pytest.approx((current * voltage)[5:].mean(), rel=1e-3)  # kept with its sign
        assert batch.values("can")[-1] - batch.values("room")[-1] > 10.0
    assert [round(b.values("hoop_strain")[0]) for b in cell.values()] == [44, 58, 76, 110]
