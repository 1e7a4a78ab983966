"""Figures of a twin: what they show, in which words, and that simulated data are called so."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from data.errors import InputError
from reports.drawing import picture_bytes
from reports.twin.figures import fit_figure, mode_shapes, residual_map, rms_map
from reports.twin.flows import flow_picture, heat_stack
from reports.twin.glyphs import Rect
from reports.twin.network_picture import PITCH_IN, by_length, network_picture, shortened
from reports.twin.page import write_picture
from tests.reports.toy_twin import batch, flows
from twin.views.compared import rms_table
from twin.views.overview import ModeView, Overview

SAMPLE = Path(__file__).parents[2] / "machines" / "sample_vmc.yml"


@pytest.fixture(scope="module")
def picture(view: Overview) -> Figure:
    return network_picture(view)


def texts(figure: Figure) -> list[str]:
    found = [t.get_text() for t in figure.texts]
    for ax in figure.axes:
        titles = [ax.get_title(), ax.get_title("left"), ax.get_title("right")]
        found += [t.get_text() for t in ax.texts] + titles + [ax.get_xlabel(), ax.get_ylabel()]
        found += [t.get_text() for t in (*ax.get_xticklabels(), *ax.get_yticklabels())]
    return [t for t in found if t]


# the network


def test_every_body_link_surrounding_sensor_and_law_is_in_the_picture(view: Overview, picture: Figure) -> None:
    said = texts(picture)
    for b in view.bodies:
        assert b.name in said
    for t in view.ties:
        g = f"{t.conductance_W_per_K:.3g}"
        assert (f"{t.ends[1]} {g}" if t.ground else g) in said
    assert "bed" in said and "1100 kJ/K" in said and "◆ head_front" in said and "motor_loss  149 W" in said
    assert "room: recorded as room" in said and "air: enclosure air with its sheet metal" in said
    assert "heat, steady state, spindle_rpm = 4000, surroundings at 20 °C" in said
    assert "14 bodies, 16 links, 17 exposures, 9 sensors; 60 free and 81 fixed parameters" in said
    assert "SIMULATED" in said


def test_chains_are_told_with_sign_and_closure(view: Overview, picture: Figure) -> None:
    said = texts(picture)
    assert said.count("closes: both sides are equal") == 3
    assert "tilt −12.15 µm/K × (column_front − column_back)" in said and "and speed_shift" in said
    assert "column_back 0.625" in said and "Error chains, lengths in m" in said
    assert {"z +", "z −", "y +", "y −", "x +", "x −"} <= set(said)
    assert by_length(view.chains)


def test_boxes_neither_overlap_nor_leave_the_paper_and_grow_with_capacity(view: Overview, picture: Figure) -> None:
    ax = picture.axes[0]
    boxes = [p for p in ax.patches if isinstance(p, FancyBboxPatch) and p.get_height() > 0.25]
    rects = [
        Rect(p.get_x() + p.get_width() / 2, p.get_y() + p.get_height() / 2, p.get_width() + 0.12, p.get_height() + 0.12)
        for p in boxes
    ]
    assert len(rects) == len(view.bodies)
    for i, one in enumerate(rects):
        assert one.x - one.w / 2 > 0 and one.x + one.w / 2 < ax.get_xlim()[1]
        assert all(one.overlap(other) == 0 for other in rects[:i])
    by_capacity = sorted(zip([b.capacity_J_per_K for b in view.bodies], [r.w * r.h for r in rects], strict=True))
    sizes = [size for _, size in by_capacity]
    assert sizes == sorted(sizes) and sizes[-1] > 1.5 * sizes[0]


@pytest.mark.parametrize("scaled", [False, True])
def test_words_keep_clear_of_boxes_and_of_each_other(view: Overview, picture: Figure, scaled: bool) -> None:
    """Also where other conductances make another layout."""
    if scaled:
        ties = [
            replace(t, conductance_W_per_K=t.conductance_W_per_K * 1.8 ** (k % 3 - 1)) for k, t in enumerate(view.ties)
        ]
        picture = network_picture(replace(view, ties=tuple(ties)))
    ax = picture.axes[0]
    renderer = FigureCanvasAgg(picture).get_renderer()
    boxes = [
        p.get_window_extent(renderer) for p in ax.patches if isinstance(p, FancyBboxPatch) and p.get_height() > 0.25
    ]
    outside = [t for t in ax.texts if re.fullmatch(r"(room|air|floor) [\d.]+|\w+  [\d.]+ W", t.get_text())]
    assert len(outside) == 17 + 11
    places = [(t.get_text(), t.get_window_extent(renderer)) for t in outside]
    for k, (text, at) in enumerate(places):
        assert not any(at.overlaps(b) for b in boxes), text
        assert not [other for other, there in places[:k] if at.shrunk(0.9, 0.9).overlaps(there)], text


def test_the_picture_is_the_same_every_time(view: Overview, picture: Figure, tmp_path: Path) -> None:
    one = write_picture(tmp_path / "deep" / "one.svg", view).read_bytes()
    assert one == picture_bytes(picture, "svg") and b"<svg" in one[:800]
    with pytest.raises(InputError, match=r"unsupported file extension '.gif'; give .svg, .png or .html"):
        write_picture(tmp_path / "one.gif", view)


def test_many_laws_in_one_body_are_counted() -> None:
    assert shortened(["a", "b"]) == ("a", "b")
    assert shortened(["a", "b", "c", "d", "e", "f"]) == ("a", "b", "c", "and 3 more")


def test_a_line_in_a_rectangle_is_measured() -> None:
    r = Rect(1.0, 1.0, 2.0, 1.0)
    assert r.inside((-5.0, 1.0), (5.0, 1.0)) == pytest.approx(2.0)
    assert r.inside((-5.0, 3.0), (5.0, 3.0)) == 0.0 and r.inside((1.0, 1.2), (1.0, 1.4)) == pytest.approx(0.2)
    assert r.border((11.0, 1.0)) == pytest.approx((2.0, 1.0)) and PITCH_IN[0] > 2


# heat


def test_the_stack_names_what_it_shows_and_both_sides_are_equal(view: Overview) -> None:
    f = flows(view)
    fig = heat_stack(f)
    said = texts(fig)
    assert {"heat", "taken by", "stored in", "front_bearings", "room", "floor", "bed", "8 others", "SIMULATED"} <= set(
        said
    )
    heights = [path.get_paths()[0].get_extents() for path in fig.axes[0].collections]
    assert max(h.y1 for h in heights) == pytest.approx(70 + 5)
    assert min(h.y0 for h in heights) == pytest.approx(-(70 - 3.2 + 3 + 13 * 0.4))


def test_flows_have_direction_watts_and_rises(view: Overview) -> None:
    fig = flow_picture(view, flows(view), 3700.0)
    said = texts(fig)
    assert "b1 at 2:00 h: heat through sample_vmc" in said
    assert "70 W put in, 8 W stored, 62 W to the surroundings" in said
    assert said.count("+3.0 K") == 14 and "stores 3.0 W" in said and "8.0 W" in said
    arrows = [p for p in fig.axes[0].patches if isinstance(p, FancyArrowPatch)]
    assert len(arrows) >= 16
    at = {t.get_text(): t.get_position()[0] for t in fig.axes[0].texts}
    ends = {tuple(np.round(p._posA_posB, 2).ravel()) for p in arrows}  # type: ignore[attr-defined]
    # -8 W from bed to table: the arrow runs from the table's side to the bed's
    between = [e for e in ends if min(at["bed"], at["table"]) - 1 < e[0] < max(at["bed"], at["table"]) + 1]
    assert any((e[2] - e[0]) * (at["bed"] - at["table"]) > 0 for e in between)


# fit


def test_a_fit_shows_both_lines_the_residual_and_its_rms() -> None:
    fig = fit_figure(batch())
    assert len(fig.axes) == 6
    said = texts(fig)
    assert {"front, °C", "room<1>, °C", "z, µm", "rms 0.50 K", "rms 2.00 µm", "recorded − simulated"[:8]} & set(said)
    assert "rms 2.00 µm" in said and "rms 0.50 K" in said and "SIMULATED" not in said
    upper, lower = fig.axes[0], fig.axes[1]
    assert [line.get_label() for line in upper.lines] == ["recorded", "simulated"]
    np.testing.assert_allclose(np.asarray(lower.lines[0].get_ydata()), 0.5)
    assert "SIMULATED" in texts(fit_figure(batch(simulated=True)))


def test_a_residual_map_has_a_row_per_channel_and_colours_about_zero() -> None:
    fig = residual_map(batch())
    images = [ax.images[0] for ax in fig.axes if ax.images and len(ax.get_yticklabels()) and ax.get_xlabel()]
    assert [i.get_array().shape for i in images] == [(2, 25), (1, 25)]  # type: ignore[union-attr]
    for image in images:
        low, high = image.get_clim()
        assert low == -high  # type: ignore[operator]
    assert np.ma.masked_invalid(images[0].get_array()).mask.sum() == 3  # type: ignore[arg-type]


def test_the_rms_map_prints_its_numbers_and_leaves_what_is_missing_empty() -> None:
    table = pd.DataFrame(
        [("b1", "front", "K", 9, 0.123), ("b1", "z", "um", 9, 12.3), ("b2", "front", "K", 9, 0.5)],
        columns=["batch", "channel", "unit", "rows", "rms"],
    )
    said = texts(rms_map(table, True))
    assert {"0.12", "12.3", "0.50", "front\nK", "z\nµm", "b1", "b2", "SIMULATED"} <= set(said)
    assert sum(bool(re.fullmatch(r"[\d.]+", t)) for t in said) == 3


def test_mode_shapes_have_a_bar_per_body() -> None:
    views = [
        ModeView(27864.0, "bed against the room", {"bed": 1.0, "air": -0.2}, {"bed": 0.9, "air": 0.1}, {}, {}),
        ModeView(240.0, "air against the room", {"bed": 0.0, "air": 1.0}, {"bed": 0.1, "air": 0.9}, {}, {}),
    ]
    fig = mode_shapes(views, simulated=False)
    said = texts(fig)
    assert {"7.7 h", "4.0 min", "bed against the room", "bed", "air"} <= set(said) and "SIMULATED" not in said
    widths = [p.get_width() for p in fig.axes[0].patches]  # type: ignore[attr-defined]
    assert widths == [1.0, -0.2]


def test_figures_become_png_and_svg() -> None:
    for kind, head in (("png", b"\x89PNG"), ("svg", b"<?xml")):
        assert picture_bytes(rms_map(rms_table([batch()]), False), kind).startswith(head)
