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
from reports.twin.figures import mode_shapes, residual_map
from reports.twin.flows import flow_picture, heat_stack
from reports.twin.network_picture import chain_label, heat_lines, network_picture, sensor_lines
from reports.twin.page import write_picture
from reports.twin.tables import rms
from tests.reports.toy_twin import batch, flows
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
        assert (f"→ {t.ends[1]} {g}" if t.ground else g) in said
    assert {"1100 kJ/K", "◆ head_front", "+ motor_loss 149 W", "z +, y +", "SIMULATED"} <= set(said)
    assert "room: recorded as room" in said
    assert any("heat, steady state, spindle_rpm = 4000, surroundings at 20 °C" in s for s in said)
    assert "14 bodies, 16 links, 17 exposures, 9 sensors; 60 free and 81 fixed parameters" in said


def test_a_long_name_of_a_machine_leaves_room_for_the_mark_of_what_is_simulated(view: Overview) -> None:
    figure = network_picture(replace(view, machine="machining_centre_with_a_long_name_" * 3, simulated=True))
    figure.canvas.draw()
    said = {t.get_text(): t.get_window_extent() for t in figure.axes[0].texts}
    title = next(box for text, box in said.items() if text.startswith("Thermal network of"))
    assert title.x1 < said["SIMULATED"].x0


def test_chains_are_told_with_sign_and_closure(view: Overview) -> None:
    z, y, _ = (chain_label(c) for c in view.chains)
    assert z.startswith("z: + ") and "− column_back 0.625 m, closes" in z
    assert z.endswith("; tilt −12.15 µm/K × (column_front − column_back); speed_shift")
    assert y.endswith("bed 0.25 − table 0.2 m, closes; tilt −16.88 µm/K × (column_front − column_back)")
    unknown = replace(view.chains[0], parts=(("bed", float("nan"), 2.5),), tilts=(), also=())
    assert chain_label(unknown) == "z: + bed 2.5 µm/K"


@pytest.mark.parametrize("scaled", [False, True])
def test_cards_and_labels_keep_clear_of_each_other_and_on_the_paper(view: Overview, scaled: bool) -> None:
    """Also where other conductances make another layout."""
    if scaled:
        ties = [
            replace(t, conductance_W_per_K=t.conductance_W_per_K * 1.8 ** (k % 3 - 1)) for k, t in enumerate(view.ties)
        ]
        view = replace(view, ties=tuple(ties))
    figure = network_picture(view)
    ax = figure.axes[0]
    renderer = FigureCanvasAgg(figure).get_renderer()
    cards = [p.get_window_extent(renderer) for p in ax.patches if isinstance(p, FancyBboxPatch)]
    assert len(cards) == len(view.bodies)
    for k, card in enumerate(cards):
        assert figure.bbox.containsx(card.x0) and figure.bbox.containsx(card.x1)
        assert not any(card.overlaps(other) for other in cards[:k])
    labels = [t for t in ax.texts if re.fullmatch(r"[\d.]+", t.get_text())]
    assert len(labels) == sum(not t.ground for t in view.ties)
    for label in labels:
        at = label.get_window_extent(renderer).shrunk(0.9, 0.9)
        assert not any(at.overlaps(card) for card in cards), label.get_text()


def test_every_line_of_a_card_is_inside_it(view: Overview, picture: Figure) -> None:
    ax = picture.axes[0]
    renderer = FigureCanvasAgg(picture).get_renderer()
    cards = [p.get_window_extent(renderer) for p in ax.patches if isinstance(p, FancyBboxPatch)]
    names = {b.name for b in view.bodies}
    for t in ax.texts:
        text, at = t.get_text(), t.get_window_extent(renderer)
        if text in names or text[:2] in ("→ ", "◆ ", "+ "):
            assert any(c.x0 <= at.x0 and at.x1 <= c.x1 and c.y0 <= at.y0 and at.y1 <= c.y1 for c in cards), text


def test_the_picture_is_the_same_every_time(view: Overview, picture: Figure, tmp_path: Path) -> None:
    one = write_picture(tmp_path / "deep" / "one.svg", view).read_bytes()
    assert one == picture_bytes(picture, "svg") and b"<svg" in one[:800]
    with pytest.raises(InputError, match=r"unsupported file extension '.gif'; give .svg, .png or .html"):
        write_picture(tmp_path / "one.gif", view)


def test_many_laws_and_sensors_in_one_body_are_counted(view: Overview) -> None:
    assert [text for text, _ in heat_lines(["a", "b"])] == ["+ a", "+ b"]
    assert [text for text, _ in heat_lines(list("abcdef"))] == ["+ a", "+ b", "+ c", "+ 3 more"]
    more = replace(view, sensors=tuple((f"a_channel_{k}", "bed") for k in range(9)))
    assert [text for text, _ in sensor_lines(more, "bed")] == ["◆ a_channel_0 and 8 more"]


# heat


def test_the_stack_names_what_it_shows_and_both_sides_are_equal(view: Overview) -> None:
    f = flows(view)
    fig = heat_stack(f)
    legend = fig.axes[0].get_legend()
    assert legend is not None and "SIMULATED" in texts(fig)
    said = [t.get_text() for t in legend.get_texts()]
    names = {"heat", "taken by", "stored in", "front_bearings", "room", "floor", "bed", "8 others"}
    assert names <= {text.partition(",")[0] for text in said} and all(t.endswith((" W", ", mean")) for t in said)
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
    ends = [tuple(np.round(p._posA_posB, 2)[:, 0]) for p in arrows]  # type: ignore[attr-defined]
    assert (round(at["table"], 2), round(at["bed"], 2)) in ends  # −8 W from bed to table


# fit


def test_a_residual_map_has_a_row_per_channel_and_colours_about_zero() -> None:
    fig = residual_map(batch())
    images = [ax.images[0] for ax in fig.axes if ax.images and len(ax.get_yticklabels()) and ax.get_xlabel()]
    assert [i.get_array().shape for i in images] == [(2, 25), (1, 25)]  # type: ignore[union-attr]
    for image in images:
        low, high = image.get_clim()
        assert low == -high  # type: ignore[operator]
    assert np.ma.masked_invalid(images[0].get_array()).mask.sum() == 3  # type: ignore[arg-type]


def test_the_table_of_rms_leaves_what_is_missing_empty() -> None:
    given = pd.DataFrame(
        [("b1", "front", "K", 9, 0.123), ("b1", "z", "um", 9, 12.3), ("b2", "front", "K", 9, 0.5)],
        columns=["batch", "channel", "unit", "rows", "rms"],
    )
    table = rms(given, True)
    assert [(c.title, c.unit) for c in table.columns] == [("batch", ""), ("front", "K"), ("z", "µm")]
    assert [r.cells for r in table.rows] == [("b1", "0.12", "12.3"), ("b2", "0.50", "–")] and table.simulated


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
        assert picture_bytes(residual_map(batch()), kind).startswith(head)
