"""Figures of a diagnosis: what they show, in which words and units, and what is taken from the tables for them."""

from __future__ import annotations

import io
import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from diagnosis.contracts import COLUMNS
from reports.diagnosis import figures as diagnosis_figures
from reports.diagnosis import tables as diagnosis_extracts
from reports.diagnosis.map import Mark, mismatch_picture
from tests.toys.diagnosis import BATCHES, toy_diagnosis
from twin.views.overview import Overview


def texts(figure: Figure) -> list[str]:
    found = [t.get_text() for t in figure.texts]
    for ax in figure.axes:
        found += [t.get_text() for t in ax.texts] + [ax.get_title(side) for side in ("left", "center", "right")]
        found += [ax.get_xlabel(), ax.get_ylabel(), *(t.get_text() for t in ax.get_yticklabels())]
    return [t for t in found if t]


# what is taken from the tables


def test_channels_are_summed_over_all_rows() -> None:
    rows = [
        ("a", "z", "um", 30, 4.0, 1.0, 1.0),
        ("b", "z", "um", 10, 8.0, 2.0, 1.0),
        ("b", "t", "K", 0, np.nan, np.nan, 0.1),
    ]
    found = diagnosis_extracts.by_channel(pd.DataFrame(rows, columns=list(COLUMNS["rms"])))
    z, t = found.to_dict("records")
    assert z["before"] == pytest.approx(np.sqrt((30 * 16 + 10 * 64) / 40))
    assert (z["rows"], z["batches"], z["improved"]) == (40, 2, 2)
    assert np.isnan(t["before"]) and t["improved"] == 0


def test_the_most_changed_run_is_drawn() -> None:
    gains = {"a": 1.0, "b": 9.0, "c": 3.0}
    rms = pd.DataFrame([(b, "z", "um", 9, 10.0, 10.0 - g, 1.0) for b, g in gains.items()], columns=list(COLUMNS["rms"]))
    assert diagnosis_extracts.most_changed(rms, True) == "b"
    rms.loc[2, "before"] = 12.0
    assert diagnosis_extracts.most_changed(rms, False) == "c"


def test_a_place_is_shown_only_beyond_chance() -> None:
    rows = [("heat", "bed", "batch", f"b{k}", v, "W", z) for k, (v, z) in enumerate(((3.0, 4.0), (-5.0, -4.0)))]
    rows += [("heat", "table", "batch", "b0", 9.0, "W", 2.5), ("heat", "bed", "regime", "off", 99.0, "W", 99.0)]
    found = diagnosis_extracts.mismatch(pd.DataFrame(rows, columns=list(COLUMNS["map"]))).set_index("place")
    assert found.loc["bed", "size"] == pytest.approx(np.sqrt(17.0)) and found.loc["bed", "mean"] == -1.0
    assert found["shown"].tolist() == [True, False]


# pictures


def test_the_machine_shows_size_sign_and_what_was_found(view: Overview) -> None:
    found = pd.DataFrame(
        [("heat", "bed", "W", 48.0, -47.0, True), ("heat", "table", "W", 8.4, 1.0, True),
         ("heat", "motor", "W", 40.0, 40.0, False), ("displacement", "z", "um", 2.04, 2.0, True),
         ("sensor", "column_front", "K", 0.15, 0.15, True)],
        columns=["kind", "place", "unit", "size", "mean", "shown"],
    )  # fmt: skip
    marks = [
        Mark("1 floor sink", "node", "bed"),
        Mark("2 joint slip", "error", "z"),
        Mark("3 bonding", "sensor", "motor"),
        Mark("4 joint", "link", "bed-table"),
        Mark("5 draught", "link", "bed-air"),
        Mark("6 sun", "node", "hall"),
    ]
    said = texts(mismatch_picture(view, found, marks))
    assert {"−48 W", "±8.4 W", "+2.0 µm", "◆ column_front +0.15 K"} <= set(said) and "+40 W" not in said
    assert {m.label for m in marks[:5]} <= set(said) and "6 sun: hall" in said  # the picture has no such place
    assert any("unexplained heat 0 to 48 W; unexplained displacement 0 to 2.0 µm" in s for s in said)
    assert "SIMULATED" in said


def test_a_machine_without_mismatch_says_so(view: Overview) -> None:
    found = diagnosis_extracts.mismatch(toy_diagnosis("consistent").tables["map"])
    said = texts(mismatch_picture(replace(view, simulated=False), found, []))
    assert "Nothing above chance: no place holds heat, displacement or a reading that the simulation lacks." in said
    assert (
        any("no unexplained heat" in s for s in said) and "SIMULATED" not in said and not any(" W" in t for t in said)
    )


def test_a_left_out_run_shows_three_lines_and_the_rms_of_both_simulations() -> None:
    t = toy_diagnosis("explained").tables
    own, scores = (x[(x["batch"] == BATCHES[0]) & (x["channel"] == "bed")] for x in (t["series"], t["rms"]))
    fig = diagnosis_figures.left_out_run(own, scores, "bed", True, True)
    before, after, recorded = fig.axes[0].lines
    assert np.array_equal(before.get_ydata(), own["before"]) and np.array_equal(after.get_ydata(), own["after"])
    assert np.array_equal(recorded.get_ydata(), own["recorded"], equal_nan=True)
    said = texts(fig)
    assert {"bed, °C", "SIMULATED"} <= set(said) and any(re.fullmatch(r"rms \d\.\d\d → \d\.\d\d K", s) for s in said)
    plain = diagnosis_figures.left_out_run(own, scores, "bed", False, False)
    assert len(plain.axes[0].lines) == 2 and "SIMULATED" not in texts(plain) and not any("→" in s for s in texts(plain))


def test_a_bar_is_as_long_as_its_probability() -> None:
    fig = diagnosis_figures.probabilities([("heat $1$", 0.7, "70 %"), ("nothing is missing", 0.2, "20 %")], "f", True)
    (ax,) = fig.axes
    assert [p.get_width() for p in ax.patches] == [1, 0.7, 1, 0.2]
    assert {"heat \\$1\\$", "70 %", "nothing is missing", "20 %", "SIMULATED"} <= set(texts(fig))


def test_names_with_dollars_are_drawn() -> None:
    t = toy_diagnosis("explained").tables
    own, scores = (x[(x["batch"] == BATCHES[0]) & (x["channel"] == "z")] for x in (t["series"], t["rms"]))
    figure = diagnosis_figures.left_out_run(own, scores, "z$1$", True, True)
    figure.savefig(io.BytesIO(), format="svg")
    assert any("z\\$1\\$" in s for s in texts(figure))


def test_many_sensors_of_a_body_are_counted_those_with_a_mismatch_first(view: Overview) -> None:
    more = tuple((f"a_channel_{k}", "bed") for k in range(9))
    found = pd.DataFrame(
        [("sensor", "a_channel_7", "K", 0.3, -0.3, True)], columns=["kind", "place", "unit", "size", "mean", "shown"]
    )
    said = texts(mismatch_picture(replace(view, sensors=(*view.sensors, *more)), found, []))
    assert {"◆ a_channel_7 −0.30 K", "8 more"} <= set(said) and "◆ a_channel_0" not in said


def test_marks_of_one_place_stand_over_each_other(view: Overview) -> None:
    found = diagnosis_extracts.mismatch(toy_diagnosis("explained").tables["map"])
    figure = mismatch_picture(view, found, [Mark("1 sink", "node", "bed"), Mark("2 bonding", "sensor", "bed")])
    at = {t.get_text(): t.get_position() for t in figure.axes[0].texts}
    assert at["2 bonding"][0] == at["1 sink"][0] and at["2 bonding"][1] > at["1 sink"][1] + 0.2


def test_a_displacement_is_always_among_the_drawn_channels() -> None:
    rows = [("a", f"t{k}", "K", 9, 5.0, 0.1, 0.1) for k in range(6)] + [("a", "z", "um", 9, 2.0, 1.0, 1.0)]
    channels = diagnosis_extracts.by_channel(pd.DataFrame(rows, columns=list(COLUMNS["rms"])))
    assert diagnosis_extracts.chosen_channels(channels, True) == ["z", "t0", "t1"]
