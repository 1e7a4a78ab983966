"""Text and codes for no value become missing before the grid, with a finding; real readings stay as they are."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch
from data.checks import check_machine, checked, usable_channels
from data.checks.invalid import sentinels
from data.errors import InputError
from data.machine import ChannelPart, Machine, parse_machine
from data.recording import read_batches
from data.units import check_canonical

MACHINE = """
machine: toy
recording: {{step_s: {step_s}, max_gap_s: 300, time: {{column: time, unit: {unit}}}}}
channels:
  front: {{role: temperature, unit: degC, column: T1, range: [-20, 90]}}
  rear: {{role: temperature, unit: degC, column: T2}}
  rpm: {{role: driver, unit: rpm}}
  z: {{role: error, unit: um}}
"""


def toy(step_s: float = 10, unit: str = "s", more: str = "") -> Machine:
    return parse_machine(MACHINE.format(step_s=step_s, unit=unit) + more, "toy")


def recording(n: int = 120, interval: float = 10.0) -> pd.DataFrame:
    t = np.arange(n) * interval
    share = np.arange(n) / n
    table = {"T1": 20 + 8 * share, "T2": 21 + 3 * share, "rpm": 9999.0 * (share > 0.5), "z": 40 * share}
    return pd.DataFrame({"time": t, **pd.DataFrame(table).round(3)})


def read(tmp_path: Path, table: pd.DataFrame, machine: Machine) -> Batch:
    table.to_csv(tmp_path / "run.csv", index=False)
    (batch,) = read_batches(tmp_path / "run.csv", machine)
    return batch


def test_a_clean_recording_has_none(tmp_path: Path) -> None:
    assert read(tmp_path, recording(), toy()).findings == ()


@pytest.mark.parametrize("step_s", [5, 10, 60])
@pytest.mark.parametrize(
    ("cell", "check", "shown"),
    [
        ("ERR", "text_cells", "'ERR'"), ("#N/A", "text_cells", "'#N/A'"),
        ("-999", "sentinel", "'-999'"), ("9999", "sentinel", "'9999'"),
        ("3.4e38", "sentinel", "'3.4e+38'"), ("65535", "sentinel", "'65535'"),
        ("3276.7", "sentinel", "'3276.7'"), ("850", "sentinel", "'850'"),
    ],
)  # fmt: skip
def test_a_cell_without_a_value_is_found_and_leaves_its_neighbours(
    tmp_path: Path, cell: str, check: str, shown: str, step_s: float
) -> None:
    table, machine = recording().astype({"T1": object}), toy(step_s)
    table.loc[[50, 71], "T1"] = cell
    batch = read(tmp_path, table, machine)
    (found,) = batch.findings
    assert (found.check, found.channel, found.masks) == (check, "front", False)
    assert f"{shown} in 2 rows, first in data row 51, column 'T1' of run.csv; treated as missing" in found.message
    truth = 20 + 8 / 1200 * batch.time_s
    got = batch.values("front")
    empty = np.flatnonzero(np.isnan(got)) * step_s
    assert np.nanmax(np.abs(got - truth)) < 0.07  # a mean that lacks a sample moves by 0.03
    assert empty.tolist() == {5: [500, 710], 10: [500, 710], 60: []}[step_s]
    assert [f.check for f in checked(batch, machine).findings] == [check]
    known = check_machine([checked(batch, machine)], machine)
    assert [f.check for f in known[0].findings] == [check]


def test_a_sensor_that_only_sends_codes_is_no_input(tmp_path: Path) -> None:
    machine = toy()
    batch = checked(read(tmp_path, recording().assign(T1=-999.0), machine), machine)
    assert np.isnan(batch.values("front")).all()
    usable, excluded = usable_channels([batch], ("front", "rear"))
    assert usable == ("rear",)
    assert excluded[0][1] == (
        "front has no value in 100% of run (sentinel); if the values are right, add to overrule: "
        "- {channel: front, check: sentinel, reason: ...}"
    )


def test_an_overrule_keeps_the_readings(tmp_path: Path) -> None:
    table = recording()
    table.loc[50, "z"] = 999.0
    assert [f.check for f in read(tmp_path, table, toy()).findings] == ["sentinel"]
    kept = read(tmp_path, table, toy(more="overrule: [{channel: z, check: sentinel, reason: a crash}]\n"))
    assert kept.findings == () and kept.values("z")[50] == 999.0


CODES: list[tuple[str, list[float], list[float]]] = [
    ("temperature", [20, 21, 22, -999, 9999, 9999], [-999, 9999]),
    ("temperature", [850, 851, 900, 950, 998.5, 999, 999.5], []),  # a furnace that passes a code
    ("temperature", [20.0, 60, 110, 110, 110, 110, 110.1], []),  # a bed, far out of its stated range
    ("temperature", [5000, 5010, 5020, 5030], []),  # a wrong unit: the checks of level and range report it
    ("temperature", [20, 20.1, -300, 20.2, 20.3], [-300]),
    ("error", [0, 4e4, 7e4, 9.9e4, 1.01e5, 1.02e5], []),  # nm declared as um
    ("error", [1, 2, 3, 99.9998, 99.9998, 99.9998], []),  # full scale of a probe: the check "saturated"
    ("error", [1, 2, 3, -32768, 4], [-32768]),
    ("driver", [0, 0, 9999, 9999, 0], []),
    ("driver", [0, 0, 3.4e38, 6000], [3.4e38]),
]


@pytest.mark.parametrize(("role", "values", "codes"), CODES)
def test_what_is_a_code_and_what_a_reading(role: str, values: list[float], codes: list[float]) -> None:
    unit = {"temperature": "degC", "error": "um", "driver": "rpm"}[role]
    reach = (-20.0, 90.0) if role == "temperature" else None
    part = ChannelPart.model_validate({"role": role, "unit": unit, "range": reach})
    counts = Counter(values)
    assert sentinels(np.array(values, float), part, "toy") == {c: counts[c] for c in codes}


def test_codes_are_judged_in_the_channels_unit() -> None:
    part = ChannelPart.model_validate({"role": "temperature", "unit": "degC", "unit_in_file": "K"})
    assert sentinels(np.array([293.0, 294.0, 293.5, -1.0]), part, "toy") == {-1.0: 1}


@pytest.mark.parametrize(("unit", "interval", "likely"), [("min", 1 / 60, "h"), ("s", 1.0, "min")])
def test_a_time_unit_that_squeezes_the_run_is_refused(tmp_path: Path, unit: str, interval: float, likely: str) -> None:
    with pytest.raises(InputError) as caught:
        read(tmp_path, recording(206, interval), toy(60, unit))
    message = str(caught.value)
    assert "206 rows, 1 s apart, span 205 s and leave only 4 grid rows of 60 s" in message
    assert (
        f"if the time column is in {likely} (samples 60 s apart), set recording.time.unit: {likely} in place" in message
    )
    assert "\n" not in message


def test_an_error_channel_in_degC_is_refused() -> None:
    with pytest.raises(InputError, match=r"channel 'z' \(error\) has unit 'degC'; expected that of a difference"):
        check_canonical({"z": ("error", "degC")}, "machine file toy")
