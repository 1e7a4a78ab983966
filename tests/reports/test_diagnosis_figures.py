"""Figures of a diagnosis: what they show, in which words and units, and what is taken from the tables for them."""

from __future__ import annotations

import io
import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from diagnosis.contracts import COLUMNS
from reports.diagnosis import figures as diagnosis_evidence
from reports.diagnosis import figures as diagnosis_figures
from reports.diagnosis import tables as diagnosis_extracts
from reports.diagnosis.map import Mark, mismatch_picture
from reports.twin.network_picture import PITCH_IN
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


def test_the_most_changed_and_a_typical_run_are_drawn() -> None:
    gains = {"a": 1.0, "b": 9.0, "c": 3.0, "d": 5.0, "e": 2.0}
    rms = pd.DataFrame([(b, "z", "um", 9, 10.0, 10.0 - g, 1.0) for b, g in gains.items()], columns=list(COLUMNS["rms"]))
    assert diagnosis_extracts.telling(rms, True) == [
        ("b", "greatest change"), ("d", "second greatest change"), ("c", "typical, median change"),
    ]  # fmt: skip
    assert diagnosis_extracts.telling(rms[:1], True) == [("a", "greatest change")]
    assert diagnosis_extracts.telling(rms[:0], True) == []


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
    assert "unexplained heat 0 to 48 W" in said and "unexplained displacement 0 to 2.0 µm" in said
    assert "SIMULATED" in said


def test_a_machine_without_mismatch_says_so(view: Overview) -> None:
    found = diagnosis_extracts.mismatch(toy_diagnosis("consistent").tables["map"])
    said = texts(mismatch_picture(replace(view, simulated=False), found, []))
    assert "Nothing above chance: no place holds heat, displacement or a reading that the simulation lacks." in said
    assert "no unexplained heat" in said and "SIMULATED" not in said and not any(" W" in t for t in said)


def test_before_and_after_are_numbers_with_units() -> None:
    d = toy_diagnosis("explained")
    channels = diagnosis_extracts.by_change(diagnosis_extracts.by_channel(d.tables["rms"]))
    said = texts(diagnosis_figures.before_after(channels, True, True))
    z = channels.iloc[0]
    assert z["channel"] == "z" and f"{z['before']:.1f} → {z['after']:.1f}" in said
    assert {"rms, µm", "rms, K", "noise floor", "before", "after", "SIMULATED"} <= set(said)
    alone = texts(diagnosis_figures.before_after(channels, False, False))
    assert "simulation" in alone and "before" not in alone and "SIMULATED" not in alone


def test_left_out_runs_show_three_lines_and_why_they_were_chosen() -> None:
    t = toy_diagnosis("explained").tables
    runs = diagnosis_extracts.telling(t["rms"], True)
    fig = diagnosis_figures.left_out_batches(t["series"], t["rms"], runs, ["z", "bed"], True, True)
    assert len(fig.axes) == 6 and all(len(ax.lines) == 3 for ax in fig.axes)
    said = texts(fig)
    assert {"greatest change", "typical, median change", "z, µm", "bed, °C", "time, h"} <= set(said)
    assert any(re.fullmatch(r"rms \d\.\d\d → \d\.\d\d K", s) for s in said)
    plain = diagnosis_figures.left_out_batches(t["series"], t["rms"], runs, ["z"], False, True)
    assert all(len(ax.lines) == 2 for ax in plain.axes)


def test_where_and_when_is_pale_within_chance() -> None:
    rows = [("heat", place, "batch", label, value, "W", z) for place, label, value, z in (
        ("bed", "b1", 60.0, 9.0), ("bed", "b2", 60.0, 1.0), ("table", "b1", -60.0, -9.0),
    )]  # fmt: skip
    fig = diagnosis_evidence.where_when(pd.DataFrame(rows, columns=list(COLUMNS["map"])), ("regime", "batch"), False)
    cells = fig.axes[0].images[0].get_array()
    assert cells is not None and cells.shape[:2] == (2, 2)
    cells = np.asarray(cells)
    strong, pale, blue, none = cells[0, 0], cells[0, 1], cells[1, 0], cells[1, 1]
    assert strong[0] > 1.5 * strong[2] and pale[:3].min() > 0.8 and blue[2] > 1.5 * blue[0]
    assert none[:3] == pytest.approx([0.91, 0.93, 0.95])
    assert {"by run", "unexplained heat", "bed", "W"} <= set(texts(fig))


def test_a_missing_flux_shows_its_band_on_one_scale() -> None:
    t = toy_diagnosis("unlisted").tables
    fig = diagnosis_evidence.missing_flux(t["flux"], True)
    assert len(fig.axes) == 6 and {"column_back, W", BATCHES[5], "time, h"} <= set(texts(fig))
    band = fig.axes[0].collections[0].get_paths()[0].get_extents()
    assert band.y1 > float(t["flux"]["value"][:73].max()) + 8 and fig.axes[0].get_ylim() == fig.axes[5].get_ylim()


def test_names_with_dollars_and_many_runs_are_drawn() -> None:
    t = toy_diagnosis("explained").tables
    odd = {k: t[k].assign(channel=t[k]["channel"].replace({"z": "z$1$"})) for k in ("rms", "series", "acf")}
    channels = diagnosis_extracts.by_change(diagnosis_extracts.by_channel(odd["rms"]))
    runs = pd.concat([odd["rms"].assign(batch=odd["rms"]["batch"] + f"_{k}") for k in range(4)])
    figures = [
        diagnosis_figures.before_after(channels, True, True),
        diagnosis_figures.by_run(runs, ["z$1$", "bed"], True, True),
        diagnosis_evidence.autocorrelation(odd["acf"], True, True),
    ]
    for figure in figures:
        figure.savefig(io.BytesIO(), format="svg")
        assert any("z\\$1\\$" in s for s in texts(figure))
    assert len(figures[1].axes[0].get_yticks()) == 30


def test_many_sensors_of_a_body_fit_its_box(view: Overview) -> None:
    """Those with a mismatch come first, the rest are counted; no box grows into its neighbour."""
    more = tuple((f"a_channel_{k}", "bed") for k in range(9))
    found = pd.DataFrame(
        [("sensor", "a_channel_7", "K", 0.3, -0.3, True)], columns=["kind", "place", "unit", "size", "mean", "shown"]
    )
    figure = mismatch_picture(replace(view, sensors=(*view.sensors, *more)), found, [])
    said = texts(figure)
    assert "◆ a_channel_7 −0.30 K" in said and "8 more" in said and "◆ a_channel_0" not in said
    boxes = [p for p in figure.axes[0].patches if isinstance(p, FancyBboxPatch) and p.get_height() > 0.25]
    assert max(p.get_width() for p in boxes) + 0.12 < PITCH_IN[0]


def test_a_displacement_is_always_among_the_drawn_channels() -> None:
    rows = [("a", f"t{k}", "K", 9, 5.0, 0.1, 0.1) for k in range(6)] + [("a", "z", "um", 9, 2.0, 1.0, 1.0)]
    channels = diagnosis_extracts.by_channel(pd.DataFrame(rows, columns=list(COLUMNS["rms"])))
    assert diagnosis_extracts.chosen_channels(channels, True) == ["z", "t0", "t1", "t2"]
