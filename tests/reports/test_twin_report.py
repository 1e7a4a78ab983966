"""Tables and report of a twin: numbers in words, everything on the page, and what is simulated is called so."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch
from data.errors import InputError
from reports.drawing import Picture
from reports.twin import tables as twin_tables
from reports.twin.page import TwinData, twin_data, twin_page, worst, write_twin_report
from tests.reports.toy_twin import batch, flows
from tests.toys.pages import blocks, unscripted
from tests.twin.machines import machine as two_bodies
from twin.calibration.identifiability import Interval
from twin.network import Network
from twin.quantity import Parameter
from twin.views.overview import ModeView, Overview

SAMPLE = Path(__file__).parents[2] / "machines" / "sample_vmc.yml"


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
    assert twin_tables.prior_label(p) == "14 W/K ×/÷ 1.65" and twin_tables.quantity(p.value, p.unit) == "20 W/K"
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
    text = unscripted(written.read_text(encoding="utf-8"))
    assert not re.findall(r'(?:src|href)="(?!data:|#)', text) and "default-src 'none'" in text
    assert text.count("data:image/") == 5  # network, residuals, stack, flows, modes
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
    assert 'alt="b1: residual map"' in text  # this recording is real


def test_the_markdown_has_the_tables_and_no_picture(written: Path) -> None:
    text = written.with_suffix(".md").read_text(encoding="utf-8")
    assert text.startswith("# Twin of sample_vmc (SIMULATED)") and "data:image" not in text
    assert "| bed |" in text and "1100 kJ/K" in text and "## Where the watts go" in text


def test_what_is_not_given_is_left_out_and_another_ending_is_told(view: Overview, tmp_path: Path) -> None:
    page = twin_page(TwinData(view, ()), pictures=False)
    assert [s.title for s in page.sections] == ["Network"] and blocks(page, Picture) == []
    with pytest.raises(InputError, match=r"report .*x.pdf: unsupported file extension '.pdf'; give .html or .md"):
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
