"""Thermal tests in the style of ISO 230-3: known series give known numbers, the drivers tell the kind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch, Channel, Finding
from data.errors import InputError
from features.iso230_3 import ProbePair, thermal_test

CHANNELS = {
    "room": Channel("room", "ambient", "degC", 0.1),
    "disp_z": Channel("disp_z", "error", "um", 0.1),
    "x1": Channel("x1", "error", "um", 0.1),
    "x2": Channel("x2", "error", "um", 0.1),
    "rpm": Channel("rpm", "driver", "rpm", 1.0),
    "feed": Channel("feed", "driver", "mm/min", 1.0),
    "pos": Channel("pos", "position", "mm", 0.01),
}
MINUTES = np.arange(306.0)  # 5 min at rest, 4 h running, 1 h stopped, a reading a minute
RUNNING = (MINUTES >= 5) & (MINUTES < 245)


def batch(n: int = 306, **columns: np.ndarray | float) -> Batch:
    """A record of n minutes; channels not given are 0."""
    table = {"time_s": 60.0 * np.arange(n)} | {c: np.zeros(n) + columns.get(c, 0.0) for c in CHANNELS}
    return Batch("m1", "b1", pd.DataFrame(table), CHANNELS)


def spindle_batch() -> Batch:
    """Z grows 0.1 µm a minute while running and falls 0.2 µm a minute after; X2 moves half as much as X1 = Z."""
    z = np.where(RUNNING, 0.1 * (MINUTES - 5), 0.0)
    z = np.where(MINUTES >= 245, 24 - 0.2 * (MINUTES - 245), z) + 7.0
    return batch(rpm=4000.0 * RUNNING, disp_z=z, x1=z, x2=z / 2, room=20 + MINUTES / 306)


def test_a_spindle_test_gives_exactly_its_numbers() -> None:
    t = thermal_test(spindle_batch(), [ProbePair("B", "X1", "x2", 200.0)])
    assert t.kind == "spindle" and t.title == "Rotating-spindle test" and t.notes == ()
    assert (
        t.explanation
        == "The spindle (rpm) stood still for 0:05 h, then ran at 4000 rpm for 4:00 h, then stood still for 1:00 h."
    )
    assert [(p.name, p.length_s) for p in t.periods] == [("warm-up", 14400), ("after the stop", 3600)]
    warm = {q: t.value("Z", q) for q in ("range", "range in 60 min", "d(60 min)", "d(t)")}
    assert warm == pytest.approx({"range": 23.9, "range in 60 min": 6.0, "d(60 min)": 6.0, "d(t)": 23.9}, abs=1e-9)
    # after the stop changes count from the last running reading, 23.9, through 24.0 to 12.0
    after = [t.value("Z", q, "after the stop") for q in ("range", "d(60 min)", "d(t)")]
    assert after == pytest.approx([12.0, -11.9, -11.9], abs=1e-9)
    assert t.value("B", "d(60 min)") == pytest.approx(1000 * 3.0 / 200)
    units = t.quantities.set_index("channel")["unit"].to_dict()
    assert units == {"Z": "um", "X1": "um", "X2": "um", "B": "um/m"}
    z = next(trace for trace in t.traces if trace.name == "Z")
    assert z.value[0] == 0 and z.value[65] == pytest.approx(6.0) and z.digits == 1
    room = t.temperatures.iloc[0]
    assert room.channel == "room" and room.start_degC == 20 and room.end_degC == pytest.approx(20 + 305 / 306)


def test_the_jump_at_the_start_belongs_to_the_warm_up() -> None:
    """An elastic shift with the speed shows in the first running reading; it counts from the last one at rest."""
    t = thermal_test(batch(rpm=6000.0 * RUNNING, disp_z=4.0 * RUNNING))
    assert t.value("Z", "range") == t.value("Z", "d(60 min)") == t.value("Z", "d(t)") == 4.0
    assert t.value("Z", "d(t)", "after the stop") == -4.0


def test_environment_is_the_range_over_the_stated_period() -> None:
    drift = 0.05 * MINUTES
    t = thermal_test(batch(disp_z=drift))
    assert t.kind == "environment" and t.explanation == "The spindle stood still all the time."
    assert t.value("Z", "range") == pytest.approx(0.05 * 305) and t.value("Z", "d(60 min)") == pytest.approx(3.0)
    part = thermal_test(batch(disp_z=drift), start_s=3600, end_s=3 * 3600)
    assert part.value("Z", "range") == part.value("Z", "d(t)") == pytest.approx(6.0)
    assert part.periods[0].length_s == 7200


def test_a_linear_axis_gives_shift_and_change_of_span() -> None:
    n = 241
    minutes = np.arange(float(n))
    far = (np.arange(n) // 3) % 2 == 1
    t = thermal_test(batch(n, disp_z=np.where(far, 0.03, 0.01) * minutes + 5.0 * far, pos=400.0 * far))
    assert (
        t.kind == "linear_axis" and t.explanation == "The axis pos went 40 times between 0 and 400 mm, spindle stopped."
    )
    assert t.position == "pos" and [x.name for x in t.traces][:3] == ["Z at 0 mm", "Z at 400 mm", "Z span"]
    # stays at 0 mm are centred on 1, 7, … 235 and 240 min, those at 400 mm on 4, 10, … 238 min
    assert t.value("Z at 0 mm", "d(t)") == pytest.approx(0.01 * 239) == t.value("Z at 0 mm", "range")
    assert t.value("Z at 400 mm", "d(t)") == pytest.approx(0.03 * 234)
    assert t.value("Z span", "d(t)") == pytest.approx(0.02 * 234)
    assert t.value("Z at 400 mm", "d(60 min)") == pytest.approx(0.03 * 56)


def test_what_is_neither_is_said_in_words() -> None:
    far = (np.arange(306) // 3) % 2 == 1
    both = thermal_test(batch(rpm=1000.0, pos=400.0 * far))
    assert both.kind == "other" and both.explanation.startswith("The spindle ran while pos went")
    fed = thermal_test(batch(feed=2000.0))
    assert (
        fed.explanation
        == "The spindle stood still while the axes moved (feed up to 2000 mm/min), and no position was recorded."
    )
    blind = thermal_test(replace(batch(), table=batch(rpm=np.nan).table))
    assert blind.kind == "other" and "the kind of test is unknown" in blind.explanation
    assert thermal_test(replace(batch(), table=batch(rpm=np.nan).table), kind="environment").kind == "environment"
    spectrum = thermal_test(batch(rpm=np.where(MINUTES % 30 < 10, 2000.0, np.where(MINUTES % 30 < 20, 0.0, 5000.0))))
    assert (
        "ran at 2000 to 5000 rpm (speed spectrum) for 5:05 h, 1:40 h of it at rest, to the end." in spectrum.explanation
    )


def test_holes_are_bridged_up_to_five_minutes_and_counted() -> None:
    b = spindle_batch()
    table = b.table.copy()
    table.loc[63:66, "disp_z"] = np.nan  # around 60 min after the start, at row 65
    t = thermal_test(replace(b, table=table))
    assert t.value("Z", "d(60 min)") == pytest.approx(6.0) and t.notes == (
        "Z: 4 of 306 readings are missing or masked.",
    )
    table.loc[62:68, "disp_z"] = np.nan
    assert np.isnan(thermal_test(replace(b, table=table)).value("Z", "d(60 min)"))
    spike = b.table.copy()
    spike.loc[100, "disp_z"] = 999.0
    assert thermal_test(replace(b, table=spike)).value("Z", "range") > 900
    masked = replace(b, table=spike, findings=(Finding("spike", "disp_z", "999 um", 6000.0, 6000.0),))
    assert thermal_test(masked).value("Z", "range") == pytest.approx(23.9)
    empty = replace(b, table=b.table.assign(x1=np.nan))
    assert "x1: no reading, left out." in thermal_test(empty).notes


def test_short_records_have_no_d_60_min() -> None:
    t = thermal_test(batch(41, disp_z=0.1 * np.arange(41)))
    assert np.isnan(t.value("Z", "d(60 min)")) and np.isnan(t.value("Z", "range in 60 min"))
    assert t.value("Z", "d(t)") == pytest.approx(4.0)
    assert "Whole period: 0:40 h, shorter than 60 min, so there is no d(60 min)." in t.notes
    assert thermal_test(batch(2)).value("Z", "range") == 0


def test_a_probe_that_stands_still_is_doubted() -> None:
    z = np.where(RUNNING, 0.1 * MINUTES, 3.0)
    assert (
        "Z did not change at all after the stop; was it read?"
        in thermal_test(batch(rpm=4000.0 * RUNNING, disp_z=z)).notes
    )


def test_a_simulation_says_so() -> None:
    t = thermal_test(replace(spindle_batch(), simulated=True))
    assert t.simulated and t.title == "Rotating-spindle test (SIMULATED)" and t.quantities["simulated"].all()
    assert not thermal_test(spindle_batch()).quantities["simulated"].any()


def test_axes_choose_and_name_the_channels() -> None:
    t = thermal_test(spindle_batch(), axes={"nose": "disp_z"})
    assert [x.name for x in t.traces] == ["nose"] and t.value("nose", "d(60 min)") == pytest.approx(6.0)


@pytest.mark.parametrize(
    ("b", "given", "words"),
    [
        (
            batch(),
            {"axes": {"Z": "disp_y"}},
            "no error channel 'disp_y'; did you mean 'disp_z'? Allowed: disp_z, x1, x2",
        ),
        (batch(), {"pairs": [ProbePair("A", "x1", "x9", 100)]}, "tilt A: no error channel 'x9'; did you mean"),
        (batch(), {"pairs": [ProbePair("A", "x1", "x2", 0)]}, "tilt A: distance 0 mm, expected more than 0"),
        (batch(), {"kind": "spindel"}, "unknown kind of test 'spindel'; did you mean 'spindle'?"),
        (batch(), {"kind": "spindle"}, "kind 'spindle' was requested, but the spindle stood still all the time"),
        (batch(), {"kind": "linear_axis"}, "but no position channel cycles between two targets"),
        (batch(), {"end_s": 1e6}, "the period 0 to 1e+06 s does not lie in the record, 0 to 18300 s; correct it"),
        (batch(), {"start_s": 70, "end_s": 100}, "the period 70 to 100 s holds 0 readings, expected at least 2"),
        (batch(1), {}, "1 rows, expected at least 2; record longer"),
        (batch(disp_z=np.nan, x1=np.nan, x2=np.nan), {}, "disp_z, x1, x2 hold no reading; record the displacement"),
        (batch(disp_z=np.where(MINUTES < 9, 1, np.nan)), {"start_s": 3600}, "Z has 0 readings from 1:00 to 5:05 h,"),
        (replace(batch(), channels={"rpm": CHANNELS["rpm"]}), {}, "no channel of role error, so no displacement"),
    ],
)
def test_mistakes(b: Batch, given: dict, words: str) -> None:
    with pytest.raises(InputError) as caught:
        thermal_test(b, **given)
    said = str(caught.value)
    assert said.startswith("batch b1 of m1: ") and words in said and "\n" not in said


def test_asking_for_a_number_that_is_not_there() -> None:
    with pytest.raises(InputError, match=r"no channel 'Y'; .*Allowed: X1, X2, Z"):
        thermal_test(spindle_batch()).value("Y", "range")
    with pytest.raises(InputError, match=r"no quantity 'rnge'; did you mean 'range'"):
        thermal_test(spindle_batch()).value("Z", "rnge")
