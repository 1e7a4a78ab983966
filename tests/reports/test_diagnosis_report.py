"""The report of a diagnosis: what it says for each verdict, what it leaves out, and that simulated is called so."""

from __future__ import annotations

import base64
import re
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest

from data.errors import InputError
from diagnosis.contracts import COLUMNS
from diagnosis.findings.schema import Findings, LeftOutRms
from diagnosis.result import Diagnosis
from reports.diagnosis import tables as diagnosis_tables
from reports.diagnosis.first_screen import claim
from reports.diagnosis.page import diagnosis_page, write_diagnosis_report
from reports.diagnosis.tables import CHIPS, GLOSSARY, METHOD, headline, likelihood, most_left, probability_label
from reports.layout import Heading, Items, Panel, Table, Text
from reports.viewer import Viewer
from tests.snapshots import check_snapshot
from tests.toys.diagnosis import BATCHES, toy_diagnosis
from tests.toys.pages import blocks, unscripted

VERDICTS = ("consistent", "explained", "partly_explained", "unlisted", "undecidable")


def changed(d: Diagnosis, **findings: Any) -> Diagnosis:
    return replace(d, findings=d.findings.model_copy(update=findings))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("diagnosis")


@pytest.fixture(scope="module")
def full(folder: Path) -> str:
    """The page of a diagnosis with every section but a next experiment, pictures and all."""
    path = folder / "deep" / "report.html"
    write_diagnosis_report(path, toy_diagnosis("unlisted"))
    return path.read_text(encoding="utf-8")


# the page


def leads_of(d: Diagnosis) -> list[Text]:
    return [b for b in diagnosis_page(d, False).top if isinstance(b, Text) and b.look == "lead"]


def better_of(d: Diagnosis) -> str:
    """How much better left-out runs are predicted."""
    return next(b.text for b in diagnosis_page(d, False).top if isinstance(b, Text) and not b.look)


@pytest.mark.parametrize("verdict", VERDICTS)
def test_a_page_says_the_verdict_and_every_statement(verdict: str, folder: Path) -> None:
    d = toy_diagnosis(verdict)
    path = folder / f"{verdict}.html"
    write_diagnosis_report(path, d, pictures=False)
    text = path.read_text(encoding="utf-8").replace("\u00a0", " ")
    page = diagnosis_page(d, False)
    assert f'<span class="chip {verdict}">{page.chip[0]}</span>' in text and f"<h1>{page.headline}</h1>" in text
    for f in d.findings.findings:
        assert f.statement.replace("'", "&#39;") in text and f.equation.replace(">", "&gt;") in text
    assert text.count('<p class="lead">') == max(len(d.findings.findings), 1)
    assert all(said in text for said in METHOD) and all(f"<dt>{word}</dt>" in text for word, _ in GLOSSARY)
    said = unscripted(text)
    assert not re.findall(r'(?:src|href)="(?!data:|#)', said) and not re.findall(r"https?://", said)


def test_a_finding_is_told_with_its_probability_and_what_else_it_may_be() -> None:
    d = toy_diagnosis("explained")
    (lead,) = leads_of(d)
    assert (lead.strong, lead.text) == ("1. 97\u202f%, extremely likely:", claim(d.findings.findings[0])[1])
    assert diagnosis_tables.explanations(d.findings.findings[0]) == [
        ("heat to the floor at bed", 0.97), ("radiation to walls or from a hot neighbour at bed", 0.02),
    ]  # fmt: skip
    assert [t.strong[:2] for t in leads_of(toy_diagnosis("partly_explained"))] == ["1.", "2."]
    page = diagnosis_page(toy_diagnosis("unlisted"), False)
    assert "1. missing heat of no listed mechanism at column_back, spindle_rpm > 0" in [
        h.text for h in blocks(page, Heading)
    ]


def test_nothing_and_not_in_the_library_are_among_the_explanations_and_tied_ones_are_called_so() -> None:
    x = toy_diagnosis("undecidable").findings.findings[0]
    tied = tuple(a.model_copy(update={"alike": a.mechanism == "radiation"}) for a in x.alternatives)
    x = x.model_copy(
        update={"alternatives": tied, "evidence": {"probability_nothing": 0.04, "probability_unlisted": 0.02}}
    )
    rows = diagnosis_tables.explanations(x)
    assert rows[1] == ("radiation to walls or from a hot neighbour at bed (not distinguishable)", 0.31)
    assert rows[-2:] == [("nothing is missing", 0.04), ("not in the library", 0.02)]
    many = x.model_copy(update={"alternatives": tied * 3})
    assert len(diagnosis_tables.explanations(many)) == 6 and diagnosis_tables.explanations(many)[-2:] == rows[-2:]


def test_no_headline_or_probability_is_more_certain_than_the_finding() -> None:
    cases = [(v, [x.probability for x in toy_diagnosis(v).findings.findings]) for v in VERDICTS]
    cases += [("explained", [0.97, 0.7]), ("explained", [0.8, 0.7]), ("partly_explained", [0.4])]
    lines = [f"{CHIPS[v]} {probabilities}: {headline(v, probabilities)}\n" for v, probabilities in cases]
    check_snapshot(__file__, "headlines", "".join(lines))
    assert [likelihood(p) for p in (1.0, 0.95, 0.9, 0.66, 0.5, 0.33, 0.1, 0.0)] == [
        "virtually certain", "extremely likely", "very likely", "likely", "more likely than not",
        "about as likely as not", "unlikely", "very unlikely",
    ]  # fmt: skip
    assert [probability_label(p).replace("\u202f", " ") for p in (1.0, 0.994, 0.52, 0.004)] == [
        "> 99 %", "> 99 %", "52 %", "< 1 %",
    ]  # fmt: skip


def test_the_errors_are_before_after_and_noise_with_their_units() -> None:
    d = toy_diagnosis("explained")
    rms = d.findings.fit.left_out_rms
    said = better_of(d)
    assert said.startswith(
        f"11 of 12 left-out runs are predicted better: rms z {rms.before['z_um']:.1f} → {rms.after['z_um']:.1f} µm, "
        "noise 1.2 µm; "
    )
    assert " x " not in said  # it did not change by a tenth of its noise
    quiet = better_of(toy_diagnosis("consistent"))
    assert quiet.startswith("12 left-out runs, each predicted from the others: rms ") and "→" not in quiet
    (lead,) = leads_of(toy_diagnosis("consistent"))
    assert lead.text.startswith(
        "In 12 left-out runs the simulation misses no more than noise and a coarse network leave; an effect"
    )


def test_tied_causes_name_the_run_that_settles_them() -> None:
    page = diagnosis_page(toy_diagnosis("undecidable"), False)
    (settle,) = [b for b in page.top if isinstance(b, Text) and b.look == "settle"]
    assert settle.text.startswith("Night stop: 3 h of spindle") and "; 12 h in all. " in settle.text
    assert settle.text.endswith("It distinguishes floor sink bed from radiation bed room.")
    (remarks,) = [b for b in page.top if isinstance(b, Items)]
    assert "Fewer than 4 batches: no probability above 80 % is stated." in remarks.items
    top = diagnosis_page(toy_diagnosis("explained"), False).top
    assert not [b for b in top if isinstance(b, Text) and b.look == "settle"]


def test_simulated_and_drafted_are_said(full: str, folder: Path) -> None:
    assert "not in the library (SIMULATED)</title>" in full and '<span class="badge">SIMULATED</span></p>' in full
    (machine,) = re.findall(r'<img[^>]* alt="([^"]*)"', full)
    assert machine.endswith("(SIMULATED)") and full.count('<span class="badge">SIMULATED</span>') == 1
    plots = [
        plot.svg("p") for panel in blocks(diagnosis_page(toy_diagnosis("unlisted")), Panel) for plot in panel.plots
    ]
    assert plots and all("SIMULATED" in plot for plot in plots)
    real = replace(toy_diagnosis("explained"), simulated=False, drafted=True)
    write_diagnosis_report(folder / "real.html", real, pictures=False)
    text = (folder / "real.html").read_text(encoding="utf-8")
    assert "SIMULATED</" not in unscripted(text) and "network that was drafted from the recordings" in text
    assert "drafted from the recordings" not in full


def test_the_picture_of_the_machine_can_be_read(full: str) -> None:
    ((kind, content),) = re.findall(r'src="data:image/([^;]+);base64,([^"]+)"', full)
    assert kind == "svg+xml" and ElementTree.fromstring(base64.b64decode(content)).tag.endswith("svg")


def test_the_page_is_three_pictures_a_table_the_viewer_and_one_fold_and_without_data_less() -> None:
    (section,) = diagnosis_page(toy_diagnosis("explained")).sections
    assert [type(b).__name__ for b in section.blocks] == [
        "Picture", "Text", "Panel", "Panel", "Table", "Viewer", "Details",
    ]  # fmt: skip
    d = toy_diagnosis("consistent")
    bare = replace(d, tables={k: pd.DataFrame(columns=list(c)) for k, c in COLUMNS.items()})
    bare = changed(bare, detection_limits=())
    (section,) = diagnosis_page(bare).sections
    assert [type(b).__name__ for b in section.blocks] == ["Details"] and not blocks(section, Table)
    assert better_of(bare) == "12 left-out runs, each predicted from the others."
    (lead,) = leads_of(bare)
    assert lead.text == "In 12 left-out runs the simulation misses no more than noise and a coarse network leave."
    captions = {"rms": "Left-out rms", "limits": "Detection limits", "steps": "Steps of the search"}
    for name, caption in captions.items():
        full = toy_diagnosis("unlisted")
        less = replace(full, tables={**full.tables, name: bare.tables[name]})
        shown = [[t.caption for t in blocks(diagnosis_page(x, False), Table)] for x in (full, less)]
        assert caption in shown[0] and caption not in shown[1]


def test_words_from_the_findings_are_text_and_no_markup(folder: Path) -> None:
    d = toy_diagnosis("explained")
    odd = d.findings.findings[0].model_copy(update={"statement": "a <b>bold</b> & $ claim"})
    d = replace(changed(d, findings=(odd,)), remarks=("<script>alert(1)</script>",))
    write_diagnosis_report(folder / "odd.html", d, pictures=False)
    text = (folder / "odd.html").read_text(encoding="utf-8")
    assert "a &lt;b&gt;bold&lt;/b&gt; &amp; $ claim" in text
    assert "<script>alert(1)" not in text and "&lt;script&gt;alert(1)" in text
    quiet = changed(toy_diagnosis("consistent"), statement="Why <i>so</i>.")
    write_diagnosis_report(folder / "quiet.html", quiet, pictures=False)
    assert "<p>Why &lt;i&gt;so&lt;/i&gt;.</p>" in (folder / "quiet.html").read_text(encoding="utf-8")


def test_a_wrong_place_is_told_in_one_line(folder: Path) -> None:
    with pytest.raises(InputError, match=r"report .*x.pdf: unsupported file extension '.pdf'; give .html"):
        write_diagnosis_report(folder / "x.pdf", toy_diagnosis("explained"), pictures=False)
    (folder / "file").write_text("")
    with pytest.raises(InputError, match=r"report .*x.html: cannot be written \(.+\); give another place"):
        write_diagnosis_report(folder / "file" / "x.html", toy_diagnosis("explained"), pictures=False)


def test_the_viewer_holds_every_left_out_run_and_channel() -> None:
    d = toy_diagnosis("explained")
    (found,) = blocks(diagnosis_page(d), Viewer)
    series = d.tables["series"]
    pairs = {(p.run, p.channel) for p in found.panes}
    assert pairs == set(series[["batch", "channel"]].itertuples(index=False, name=None))
    own = series[(series["batch"] == BATCHES[0]) & (series["channel"] == "z")]
    pane = next(p for p in found.panes if (p.run, p.channel) == (BATCHES[0], "z"))
    assert [t.label for t in pane.traces] == ["recorded", "simulated before", "simulated after"]
    assert np.array_equal(pane.traces[2].values, own["after"]) and np.array_equal(pane.time_h, own["time_s"] / 3600)


def test_heat_of_no_law_is_in_the_viewer_with_its_band() -> None:
    d = toy_diagnosis("unlisted")
    (found,) = blocks(diagnosis_page(d), Viewer)
    panes = [p for p in found.panes if p.channel == "missing heat, column_back"]
    assert [p.run for p in panes] == list(BATCHES[:6]) and {p.unit for p in panes} == {"W"}
    own = d.tables["flux"][d.tables["flux"]["batch"] == BATCHES[0]]
    traces, band = panes[0].traces, 1.645 * own["sd"]
    assert np.array_equal(traces[0].values, own["value"]) and not panes[0].residual
    assert np.allclose(traces[1].values, own["value"] - band) and np.allclose(traces[2].values, own["value"] + band)


# tables


def test_candidates_are_ranked_in_words_and_the_accepted_is_marked() -> None:
    d = toy_diagnosis("explained")
    table = diagnosis_tables.candidates(d.tables["candidates"], {("floor_sink", "bed"): 0.97})
    assert table.rows[0].mark == "found" and [r.mark for r in table.rows[1:]] == [""] * 8
    assert table.rows[0].cells == (
        "heat to the floor, bed", "97\u202f%", "10.2 W/K", "+412", "11 of 12", "63 %",
    )  # fmt: skip
    assert table.rows[-1].cells[0::2] == ("a joint that slips, z", "0.8 µm", "5 of 12")
    many = pd.concat([d.tables["candidates"]] * 3).assign(rank=range(27), probability=np.nan)
    table = diagnosis_tables.candidates(many, {})
    assert len(table.rows) == 12 and table.rows[0].cells[1] == "–"
    assert table.notes[-1] == "Shown: the best 12 of 27 that were refitted."
    gains = [float(str(r.cells[3]).replace("−", "-")) for r in table.rows]
    assert gains == sorted(gains, reverse=True)


def test_the_size_of_a_free_form_is_per_unit_of_its_drivers() -> None:
    row = {
        "rank": 0, "mechanism": "free_shift", "kind": "error", "name": "free_shift_z_square", "cluster": 1,
        "words": "displacement of no listed mechanism: z (spindle_rpm^2)", "gain": -3.0, "improved": 1, "batches": 2,
        "absorbed": 0.5, "amplitude": 1.82e-7, "unit": "um", "probability": 0.02,
    }  # fmt: skip
    per_K = {"words": "displacement of no listed mechanism: z (spindle_rpm θ_bed)", "unit": "um/K", "amplitude": -2e-4}
    bare = {
        "mechanism": "bearing_load",
        "words": "friction of the bearings under load: screw (spindle_rpm)",
        "unit": "1",
    }
    table = diagnosis_tables.candidates(pd.DataFrame([row, row | per_K, row | bare]), {})
    assert [r.cells[2] for r in table.rows] == [
        "1.82e−07 µm per spindle_rpm^2", "−0.0002 µm/K per spindle_rpm", "1.82e−07",
    ]  # fmt: skip
    assert any("dimensionless" in n for n in table.notes)


def test_a_place_is_found_in_a_candidates_unique_name() -> None:
    assert diagnosis_tables.place({"mechanism": "floor_sink", "name": "floor_sink_bed"}) == "bed"
    assert diagnosis_tables.place({"mechanism": "floor_sink", "name": "bed-air"}) == "bed-air"


def test_parameters_have_units_and_intervals_where_they_are_known() -> None:
    findings = Findings.from_json(
        {
            "schema": "thermodrift.findings/1", "machine": "m", "batches": ["a"], "verdict": "explained",
            "seconds": 1.0,
            "fit": {"batches_improved": 1, "batches": 1},
            "findings": [
                {
                    "mechanism": "floor_sink", "where": {"kind": "node", "name": "bed"}, "probability": 0.9,
                    "statement": "s",
                    "parameters": {
                        "conductance": {"value": 1234.5, "unit": "W/K", "interval90": [1100.0, 1400.2]},
                        "start_up": {"value": -0.0456, "unit": "um", "interval90": None},
                        "gain": {"value": None, "unit": "1"},
                    },
                }
            ],
        }
    )  # fmt: skip
    table = diagnosis_tables.parameters(findings.findings)
    assert [r.cells for r in table.rows] == [
        ("1. conductance", "1234 W/K", "1100 to 1400 W/K"), ("1. start up", "−0.0456 µm", "–"), ("1. gain", "–", "–"),
    ]  # fmt: skip


def test_limits_and_steps_have_their_units() -> None:
    t = toy_diagnosis("explained").tables
    limits = diagnosis_tables.limits(t["limits"])
    assert limits.rows[2].cells == (
        "air that moves", "1.1 W/K", "88 %", "exposures.column_front-air",
    )  # fmt: skip
    assert limits.rows[3].cells[1:] == ("0.04 K/h", "20 %", "–")
    assert [r.cells[-1] for r in diagnosis_tables.steps(t["steps"]).rows] == ["accepted", "rejected"]
    assert diagnosis_tables.steps(t["steps"]).rows[0].cells[2:5] == ("+412", "31", "97 %")


def test_every_run_and_channel_is_in_a_table_with_noise_and_all_runs() -> None:
    rms = toy_diagnosis("explained").tables["rms"]
    table = diagnosis_tables.runs(rms, True)
    assert [(c.title, c.unit) for c in table.columns][:2] == [("run", ""), ("z", "µm")]
    noise, every, *runs = (r.cells for r in table.rows)
    z = rms[rms["channel"] == "z"]
    whole = [np.sqrt(np.average(z[k] ** 2, weights=z["rows"])) for k in ("before", "after")]
    assert noise[:2] == ("noise", "1.2") and every[:2] == ("all runs", f"{whole[0]:.1f} → {whole[1]:.1f}")
    first = z[z["batch"] == BATCHES[0]].iloc[0]
    assert runs[0][:2] == (BATCHES[0], f"{first['before']:.1f} → {first['after']:.1f}") and len(runs) == 12
    alone = diagnosis_tables.runs(z[z["batch"] == BATCHES[0]], False)
    assert alone.rows[-1].cells == (BATCHES[0], f"{first['after']:.1f}")


def test_the_page_names_rows_and_values_that_are_not_used() -> None:
    lost = {"batch_id": "b1", "channel": "T_C", "check": "held_values", "state": "masked", "rows": 12, "share": 0.125,
            "start_s": 3600.0, "end_s": 7200.0}  # fmt: skip
    account = {"summary": "rows: 96 read, 3 dropped; 12 values masked: T_C 12 (held_values)", "lost": [lost]}
    page = diagnosis_page(changed(toy_diagnosis("explained"), account=account), pictures=False)
    assert "Rows: 96 read, 3 dropped; 12 values masked: T_C 12 (held_values)." in [b.text for b in blocks(page, Text)]
    (row,) = next(t for t in blocks(page, Table) if t.caption == "Values that are not used").rows
    assert list(row.cells) == ["b1", "T_C", "held values", "masked", "12", "12", "1.00 to 2.00"]


def test_the_headline_says_what_is_left() -> None:
    rms = LeftOutRms(
        before={"z_um": 9.0}, after={"z_um": 6.0, "t_front_K": 0.11}, noise_floor={"z_um": 0.5, "t_front_K": 0.1}
    )
    assert most_left(rms) == "z at 12 times its noise"
    said = headline("partly_explained", [0.95], most_left(rms))
    assert said == "The simulation left out one effect; z at 12 times its noise is left."
    assert headline("consistent", [], most_left(rms)).endswith("by these runs; z at 12 times its noise is left.")
    noise = LeftOutRms(after={"z_um": 0.6, "x_um": None}, noise_floor={"z_um": 0.5, "y_um": None})
    assert most_left(noise) == most_left(LeftOutRms()) == ""
