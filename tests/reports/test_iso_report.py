"""The report in the style of ISO 230-3: its header, its numbers, its stamp, its files."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch, Channel
from data.errors import InputError
from data.yaml_file import parse_yaml
from features.iso230_3 import thermal_test
from reports.twin.iso230_3 import FILES, TestSheet, Tilt, iso_figure, write_iso_report
from tests.toys.pages import unscripted

CHANNELS = {
    "front": Channel("front", "temperature", "degC", 0.1),
    "<room>": Channel("<room>", "ambient", "degC", 0.1),
    "x": Channel("x", "error", "um", 0.1),
    "z": Channel("z", "error", "um", 1.0),
    "spindle_rpm": Channel("spindle_rpm", "driver", "rpm", 1.0),
    "feed": Channel("feed", "driver", "mm/min", 1.0),
}
SHEET = TestSheet(
    position="x 200, y 100 mm", probes="3 capacitive", tilts={"B": Tilt(first="X", second="z", distance_mm=50)}
)


def spindle_batch(simulated: bool = False) -> Batch:
    time_s = 60.0 * np.arange(306)
    running = (time_s >= 300) & (time_s < 14700)
    z = np.where(running, (time_s - 300) / 600, 0.0)
    table = pd.DataFrame({
        "time_s": time_s, "front": 20 + z, "<room>": 20.0, "x": -z / 4, "z": z,
        "spindle_rpm": 4000.0 * running, "feed": 0.0,
    })  # fmt: skip
    return Batch("vmc$1", "b|1", table, CHANNELS, start=pd.Timestamp("2025-03-01 07:30"), simulated=simulated)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> dict[bool, Path]:
    folders = {s: tmp_path_factory.mktemp("iso") / "deep" / str(s) for s in (False, True)}
    for simulated, folder in folders.items():
        assert write_iso_report(spindle_batch(simulated), folder, SHEET) == folder / "report.html"
    return folders


def test_the_folder_holds_whole_files_and_nothing_else(written: dict[bool, Path]) -> None:
    folder = written[False]
    assert sorted(p.name for p in folder.iterdir()) == sorted(FILES)
    assert (folder / "thermal_test.png").read_bytes().startswith(b"\x89PNG")
    table = pd.read_csv(folder / "quantities.csv")
    row = table[(table.channel == "Z") & (table.quantity == "d(60 min)") & (table.period == "warm-up")].iloc[0]
    assert row.value == pytest.approx(6.0) and row.unit == "um" and not row.simulated


def test_the_page_holds_everything_it_needs(written: dict[bool, Path]) -> None:
    text = unscripted((written[False] / "report.html").read_text(encoding="utf-8"))
    assert not re.findall(r'(?:src|href)="(?!data:|#)', text) and text.count("data:image/png;base64,") == 1
    assert "default-src 'none'" in text and "&lt;room&gt;" in text and "<room>" not in text


@pytest.mark.parametrize("name", ["report.html", "report.md"])
def test_what_is_not_known_is_not_stated(written: dict[bool, Path], name: str) -> None:
    text = (written[False] / name).read_text(encoding="utf-8")
    plain = re.sub(r"<[^>]+>", " ", text)
    assert "in the style of ISO 230-3" in plain and "complian" not in text.lower()
    for label in ("Tool stick-out", "Warm-up history", "Compensation", "Uncertainty"):
        assert re.search(rf"{label}\W+not stated", plain), label
    for label, value in {
        "Machine": r"vmc\$1", "Position": "x 200, y 100 mm", "Start": "2025-03-01 07:30",
        "Stated period": "5:05 h, a reading every 60 s", "Probes": r"3 capacitive; B = \(X − z\) / 50 mm",
    }.items():  # fmt: skip
        assert re.search(rf"{label}\W+{value}", plain), label
    assert "then ran at 4000 rpm for 4:00 h, then stood still for 1:00 h." in plain


def test_the_table_has_the_numbers_with_the_instruments_digits(written: dict[bool, Path]) -> None:
    text = (written[False] / "report.md").read_text(encoding="utf-8")
    assert "| warm-up | X | µm | 6.0 | 1.5 | −1.5 | −6.0 | 4:00 |" in text
    assert "| warm-up | Z | µm | 24 | 6 | +6 | +24 | 4:00 |" in text
    assert "| warm-up | B | µm/m | 597.5 | 150.0 | −150.0 | −597.5 | 4:00 |" in text
    assert "| after the stop | Z | µm | 24 |" in text and "| front | temperature | 20.0 |" in text


def test_a_simulation_is_stamped_on_title_table_and_figure(written: dict[bool, Path]) -> None:
    page, plain = (written[True] / n for n in ("report.html", "report.md"))
    html = page.read_text(encoding="utf-8")
    badge = r' <span class="badge">SIMULATED</span>'
    assert "<title>Rotating-spindle test (SIMULATED)</title>" in html
    assert re.search(rf"<h1>[^<]*{badge}</h1>", html) and re.search(rf"<figcaption>[^<]*{badge}", html)
    captions = re.findall(r'<p class="caption">(.*?)</p>', html)
    assert len(captions) == 2 and all("SIMULATED" in c for c in captions)
    text = plain.read_text(encoding="utf-8")
    assert text.startswith("# Rotating-spindle test (SIMULATED)") and text.count("(SIMULATED)") == 4
    assert pd.read_csv(written[True] / "quantities.csv").simulated.all()
    for name in FILES[:2]:
        assert "SIMULATED" not in (written[False] / name).read_text(encoding="utf-8")


@pytest.mark.parametrize("simulated", [False, True])
def test_the_figure_has_one_time_axis_and_its_stamp(simulated: bool) -> None:
    b = spindle_batch(simulated)
    figure = iso_figure(b, thermal_test(b, SHEET.pairs))
    labels = [ax.get_ylabel().replace("\n", " ") for ax in figure.axes]
    assert labels == ["displacement (µm)", "tilt (µm/m)", "temperature (°C)", "spindle_rpm (rpm)", "feed (mm/min)"]
    assert {ax.get_xlim() for ax in figure.axes} == {(0.0, 18300 / 3600)}
    stamps = [t.get_text() for t in [*figure.texts, *figure.axes[0].texts] if "SIMULATED" in t.get_text()]
    assert len(stamps) == (2 if simulated else 0)
    z = next(line for line in figure.axes[0].lines if line.get_label() == "Z")
    assert z.get_ydata()[65] == pytest.approx(6.0)


def test_a_machine_without_temperatures_and_speed_still_has_a_report(tmp_path: Path) -> None:
    b = spindle_batch()
    bare = replace(b, channels={"z": CHANNELS["z"]}, start=None, table=b.table[["time_s", "z"]])
    text = write_iso_report(bare, tmp_path).read_text(encoding="utf-8")
    assert "Thermal drift" in text and "No channel gives the spindle speed" in text and "Temperatures over" not in text


def test_a_test_sheet_is_read_and_its_mistakes_are_told() -> None:
    text = "tool_stick_out: 120 mm\ntilts: {A: {first: Y1, second: Y2, distance_mm: 120}}\n"
    sheet = parse_yaml(text, TestSheet, "test sheet t.yml")
    assert sheet.tool_stick_out == "120 mm" and sheet.pairs[0].distance_mm == 120
    with pytest.raises(
        InputError, match=r"test sheet t\.yml line 1: unknown key 'tool_stickout'; did you mean 'tool_stick_out'"
    ):
        parse_yaml("tool_stickout: 120 mm", TestSheet, "test sheet t.yml")
    with pytest.raises(InputError, match=r"key 'tilts\.A\.distance_mm': got 0; Input should be greater than 0"):
        parse_yaml(text.replace("mm: 120", "mm: 0"), TestSheet, "test sheet t.yml")


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match=r"report .*file: cannot be written .*; give another folder"):
        write_iso_report(spindle_batch(), tmp_path / "file")
