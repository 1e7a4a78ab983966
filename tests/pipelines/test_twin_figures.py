"""Figures and report of a twin: what they show, in which words, and that simulated data are called so."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from data.batch import Batch
from data.errors import InputError
from data.machine import load_machine
from pipelines.report import twin_tables
from pipelines.report.chain_strip import by_length
from pipelines.report.flow_figures import heat_stack
from pipelines.report.flow_picture import flow_picture
from pipelines.report.network_boxes import PITCH_IN, shortened
from pipelines.report.network_glyphs import Rect
from pipelines.report.network_picture import network_picture, picture_bytes
from pipelines.report.twin_data import twin_data
from pipelines.report.twin_figures import fit_figure, mode_shapes, residual_map, rms_map
from pipelines.report.twin_report import TwinData, twin_page, worst, write_picture, write_twin_report
from tests.twin.machines import machine as two_bodies
from twin.compared import Compared, rms_table
from twin.compile import compile_network, expanded
from twin.heat_flows import HeatFlows
from twin.identifiability import Interval
from twin.mode_words import ModeView
from twin.network import Network
from twin.overview import Overview, overview
from twin.quantity import Parameter
from twin.schema import twin_part
from twin.steady import steady_state

SAMPLE = Path(__file__).parents[2] / "machines" / "sample_vmc.yml"


@pytest.fixture(scope="module")
def network() -> Network:
    return compile_network(load_machine(SAMPLE))


@pytest.fixture(scope="module")
def view(network: Network) -> Overview:
    machine = load_machine(SAMPLE)
    drivers = {"spindle_rpm": 4000.0}
    steady = steady_state(network, drivers, 20.0)
    return overview(network, expanded(twin_part(machine)), machine.description, machine.simulated, steady, drivers)


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


def batch(name: str = "b$1", offset: float = 0.5, simulated: bool = False) -> Compared:
    time_s = 300.0 * np.arange(25)
    computed = np.stack([20 + time_s / 3600, np.full(25, 20.0), time_s / 1000])
    recorded = computed + np.array([[offset], [-offset], [4 * offset]])
    recorded[1, 5:8] = np.nan
    return Compared(name, simulated, time_s, ("front", "room<1>", "z"), ("K", "K", "um"), recorded, computed)


def flows(view: Overview) -> HeatFlows:
    time_s = np.array([0.0, 1800.0, 3600.0, 7200.0])
    one = np.ones(3)
    return HeatFlows(
        "b1", True, time_s,
        {law: 10.0 * one for law in dict.fromkeys(h.law for h in view.heats)},
        {b.name: (3.0 if b.name == "bed" else 0.4) * one for b in view.bodies},
        {"room": 70.0 * one - 3.2, "floor": -5.0 * one},
        {t.name: (-8.0 if t.name == "bed-table" else 6.0) * one for t in view.ties},
        {b.name: np.array([0.0, 1.0, 2.0, 3.0]) for b in view.bodies},
    )  # fmt: skip


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


def test_words_keep_clear_of_foreign_boxes(picture: Figure) -> None:
    ax = picture.axes[0]
    renderer = FigureCanvasAgg(picture).get_renderer()
    boxes = [
        p.get_window_extent(renderer) for p in ax.patches if isinstance(p, FancyBboxPatch) and p.get_height() > 0.25
    ]
    outside = [t for t in ax.texts if t.get_text().startswith(("room ", "air ", "floor ")) or " W" in t.get_text()]
    outside = [t for t in outside if not t.get_text().endswith("W/K") and ":" not in t.get_text()]
    assert len(outside) > 20
    for t in outside:
        assert not any(t.get_window_extent(renderer).overlaps(b) for b in boxes), t.get_text()


def test_the_picture_is_the_same_every_time(view: Overview, picture: Figure, tmp_path: Path) -> None:
    one = write_picture(tmp_path / "deep" / "one.svg", view).read_bytes()
    assert one == picture_bytes(picture, "svg") and b"<svg" in one[:800]
    with pytest.raises(InputError, match=r"got suffix '.gif', expected .svg, .png or .html"):
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


# tables and report


def test_a_parameter_is_told_with_prior_interval_and_what_it_rests_on(network: Network) -> None:
    known = Interval("bodies.shaft.capacity", "J/K", 6.4e3, 6.2e3, 6.6e3, 0.1)
    loose = Interval("links.shaft-front.conductance", "W/K", 14.0, 6.0, 31.0, 0.95)
    table = twin_tables.parameters(network.parameters, {i.name: i for i in (known, loose)}, True, True)
    assert [c.title for c in table.columns][:6] == [
        "parameter", "what it is", "value", "prior", "90 % interval", "rests on",
    ]  # fmt: skip
    rows = {str(r.cells[0]): r.cells[2:6] for r in table.rows}
    assert rows["bodies.shaft.capacity"] == ("6.6 kJ/K", "6.6 kJ/K ×/÷ 1.22", "6.2 to 6.6 kJ/K", "recordings")
    assert rows["links.shaft-front.conductance"] == ("14 W/K", "14 W/K ×/÷ 1.65", "6 to 31 W/K", "prior")
    assert rows["sensors.bed.offset"][:2] == ("0 K", "0 ± 0.2 K")
    assert rows["mechanisms.front_bearings.into.shaft"][1] == "0.38 to 0.62"
    assert len(table.rows) == 60
    plain = twin_tables.parameters(network.parameters, {}, False, True)
    assert len(plain.rows) == 81 and "90 % interval" not in [c.title for c in plain.columns]


def test_a_calibrated_value_keeps_the_prior_that_it_had() -> None:
    p = Parameter("links.a-b.conductance", "W/K", "", 20.0, 0.5, 0.0, 1e9, "log", True, prior=14.0)
    assert twin_tables.prior_words(p) == "14 W/K ×/÷ 1.65" and twin_tables.quantity(p.value, p.unit) == "20 W/K"
    assert twin_tables.quantity(-1.1e6, "J/K") == "−1100 kJ/K" and twin_tables.quantity(0.58, "um/K") == "0.58 µm/K"


def test_energies_add_up_in_words(view: Overview) -> None:
    table = twin_tables.heat(flows(view))
    assert table.simulated and table.rows[0].cells[:4] == ("put in", "front_bearings", "72", "10.0")
    assert ("taken by", "floor", "−36", "−5.0", "−7 %") in [r.cells for r in table.rows]
    assert not any(r.cells[0] == "through" for r in table.rows)


def test_the_worst_batches_are_drawn() -> None:
    parts = [batch(f"b{k}", offset) for k, offset in enumerate((0.1, 2.0, 0.3, 1.0))]
    assert [c.batch_id for c in worst(parts, 2)] == ["b1", "b3"]


@pytest.fixture(scope="module")
def written(view: Overview, network: Network, tmp_path_factory: pytest.TempPathFactory) -> Path:
    row = {"channel": "z", "unit": "um", "batches": 3, "left_out": 1.4, "left_out_sd": 0.2, "before": 9.1, "zero": 30.0}
    left_out = pd.DataFrame([row])
    modes = [ModeView(27864.0, "bed against the room", {b.name: 0.5 for b in view.bodies},
                      {b.name: 0.1 for b in view.bodies}, {"z": -1.5}, {"z": 1.0})]  # fmt: skip
    data = TwinData(
        view, network.parameters, "calibrated on 3 batches", {}, ("Shaft <and> front: only their ratio.",), left_out,
        [batch("b1"), batch("b2", 0.1)], [flows(view)], modes,
    )  # fmt: skip
    path = tmp_path_factory.mktemp("twin") / "report.html"
    write_twin_report(path, data, most_batches=1)
    write_twin_report(path.with_suffix(".md"), data)
    return path


def test_the_page_holds_everything_it_needs(written: Path) -> None:
    text = written.read_text(encoding="utf-8")
    assert not re.findall(r'(?:src|href)="(?!data:|#)', text) and "default-src 'none'" in text
    assert text.count("data:image/") == 7  # network, map, fit, residuals, stack, flows, modes
    for part in (
        "Network",
        "Parameters",
        "Simulated against recorded",
        "Where the watts go",
        "Time constants and modes",
    ):
        assert f"<h2>{part}</h2>" in text
    assert "Shaft &lt;and&gt; front: only their ratio." in text and "calibrated on 3 batches" in text
    assert "Drawn: the 1 of 2 batches with the greatest residual." in text and "Fixed parameters (81)" in text


def test_simulated_is_said_on_the_page_and_in_the_pictures(written: Path) -> None:
    text = written.read_text(encoding="utf-8")
    assert "Twin of sample_vmc (SIMULATED)</title>" in text and '<span class="badge">SIMULATED</span></h1>' in text
    assert 'alt="b1: where the watts go (SIMULATED)"' in text
    assert 'alt="b1: recorded and simulated"' in text  # this recording is real


def test_the_markdown_has_the_tables_and_no_picture(written: Path) -> None:
    text = written.with_suffix(".md").read_text(encoding="utf-8")
    assert text.startswith("# Twin of sample_vmc (SIMULATED)") and "data:image" not in text
    assert "| bed |" in text and "1100 kJ/K" in text and "## Where the watts go" in text


def test_what_is_not_given_is_left_out_and_another_ending_is_told(view: Overview, tmp_path: Path) -> None:
    page = twin_page(TwinData(view, ()), pictures=False)
    assert [p.title for p in page.parts] == ["Network"] and page.parts[0].pictures == ()
    with pytest.raises(InputError, match=r"report .*x.pdf: got suffix '.pdf', expected .html or .md"):
        write_twin_report(tmp_path / "x.pdf", TwinData(view, ()))


def test_recordings_and_simulation_become_a_report(tmp_path: Path) -> None:
    machine = two_bodies()
    time_s = 60.0 * np.arange(90)
    columns = {"t_shaft": 20.2, "t_head": 20.0, "room": 20.0, "rpm": np.where(time_s < 2400, 6000.0, 0.0), "z": 0.0}
    batches = [
        Batch(machine.machine, name, pd.DataFrame({"time_s": time_s} | columns), machine.batch_channels())
        for name in ("b1", "b2")
    ]
    data = twin_data(machine, batches, most_flows=1)
    assert data.view.stated.startswith("steady state, rpm = 6000") and data.origin == "as the machine file states them"
    assert [f.batch_id for f in data.flows] == ["b1"] and [c.batch_id for c in data.compared] == ["b1", "b2"]
    assert data.flows[0].heat_W["belt"].max() == pytest.approx(120.0) and len(data.modes) == 2
    text = write_twin_report(tmp_path / "two.html", data, 1).read_text(encoding="utf-8")
    assert "<h2>Simulated against recorded</h2>" in text


def test_a_machine_without_recordings_has_network_and_modes_alone() -> None:
    data = twin_data(two_bodies())
    assert data.view.stated == "" and not data.compared and not data.flows and len(data.modes) == 2
