"""What stands above a diagnosis: a demonstration in plain words, short sentences, limits in the unit of the error."""

from __future__ import annotations

import json
import re
from html import unescape
from pathlib import Path
from typing import Any, get_args

import pytest

from diagnosis.findings.schema import DetectionLimit, Finding, Place
from reports.diagnosis.first_screen import Outcome, Unsealed, limits_sentence, shortened, values_label
from reports.diagnosis.page import diagnosis_page, write_diagnosis_report
from reports.diagnosis.tables import effect_label
from reports.layout import Text
from tests.reports.test_report_browser import CHROMIUM, FRAME, open_page
from tests.toys.diagnosis import toy_diagnosis

VERDICTS: dict[Outcome, str] = {
    "found": "explained", "found_and_more": "partly_explained", "other_place": "explained", "in_set": "undecidable",
    "missed": "consistent", "wrong": "explained", "false_alarm": "unlisted", "nothing_right": "consistent",
}  # fmt: skip


def unsealed(outcome: Outcome) -> Unsealed:
    first, *others = toy_diagnosis(VERDICTS[outcome]).findings.findings or (None,)
    return Unsealed(
        outcome, "the foundation <cools> the bed", first, tuple(x for x in others if x is not None), VERDICTS[outcome],
        "5e" * 32, "2026-11-25T15:21:14Z", 7, "landlock and audit hook",
    )  # fmt: skip


def write(outcome: Outcome, folder: Path) -> Path:
    path = folder / f"{outcome}.html"
    write_diagnosis_report(path, toy_diagnosis(VERDICTS[outcome]), pictures=False, unsealed=unsealed(outcome))
    return path


@pytest.mark.parametrize("outcome", get_args(Outcome))
def test_the_panel_says_how_it_came_out(outcome: Outcome, tmp_path: Path) -> None:
    text = write(outcome, tmp_path).read_text(encoding="utf-8")
    panel = text[text.index('<div class="unsealed') : text.index("<header")]
    right = outcome in ("found", "nothing_right")
    assert panel.startswith(f'<div class="unsealed {"right" if right else "off"}"')
    heading = re.search(r"<h2>(.*?) <span class=\"badge\"", panel)
    assert heading is not None and heading[1] == unsealed(outcome).headline
    assert heading[1].startswith(("Found:", "Right:")) == right
    assert "SIMULATED" in panel and "The foundation &lt;cools&gt; the bed" in panel and "5e" * 32 in panel
    assert "2026-11-25 15:21:14 UTC" in panel and "landlock and audit hook" in panel
    assert ("not true: poorly bonded sensor: column_front" in panel) == (outcome == "found_and_more")
    assert ("probability" in panel) == (VERDICTS[outcome] != "consistent")
    if VERDICTS[outcome] == "consistent":
        assert "Nothing; verdict: consistent" in panel and "nothing corrected" in panel and "→" not in panel


def test_without_a_demonstration_there_is_no_panel(tmp_path: Path) -> None:
    write_diagnosis_report(tmp_path / "plain.html", toy_diagnosis("explained"), pictures=False)
    text = (tmp_path / "plain.html").read_text(encoding="utf-8")
    assert '<div class="unsealed' not in text and '<div class="changed">' not in text
    assert "machine.yml" in text


def test_a_sentence_names_three_values_and_the_rest_is_counted() -> None:
    values = [f"links.a{k}-b.conductance (14 W/K → {k} W/K (90 %: {k}–{k + 1}))" for k in range(5)]
    text = f"The values of {', '.join(values[:-1])} and {values[-1]} in the machine file are wrong (noise 0.80)."
    cut = f"The values of {', '.join(values[:3])} and 2 more in the machine file are wrong (noise 0.80)."
    assert shortened(text) == cut
    left = "Nothing is missing: the rest is the noise (z 0.4 µm (noise 0.8), y 1 µm, x 2 µm, bed 1 K, room 1 K)."
    assert (
        shortened(left)
        == "Nothing is missing: the rest is the noise (z 0.4 µm (noise 0.8), y 1 µm, x 2 µm and 2 more)."
    )
    for same in (
        "The bed loses heat, 10.2 W/K (90 %: 8.9–11.6): with it z falls from 6 to 1 µm (noise 1.2).",
        "An odd ) statement ( with no (end", "", "Wrong: bodies.bed.capacity (1 → 2) and bodies.air.capacity (3).",
    ):  # fmt: skip
        assert shortened(same) == same


def test_values_have_units_and_intervals_three_at_most() -> None:
    raw: dict[str, Any] = {
        "mechanism": "motor_loss", "where": {"kind": "node", "name": "motor"}, "probability": 0.9, "statement": "s",
        "parameters": {
            "rated": {"value": 6000.0, "unit": "rpm"},
            **{n: {"value": 40.0, "unit": "W", "interval90": [30.0, 51.0]} for n in ("idle", "linear", "quadratic")},
        },
    }  # fmt: skip
    finding = Finding(**raw)
    each = "40 W (90 %: 30 to 51)"
    assert values_label(finding) == f"idle {each}, linear {each}, quadratic {each}; 1 more in the table"
    assert effect_label(finding).endswith(" at motor")
    at = {"sensor": ": z", "error": " in the z error", "link": " at the link z"}
    for kind, words in at.items():
        assert effect_label(finding.model_copy(update={"where": Place(kind=kind, name="z")})).endswith(words)  # type: ignore[arg-type]


def test_consistent_states_what_would_have_been_seen_in_the_errors_unit() -> None:
    def limit(mechanism: str, kind: str, name: str, value: float | None, unit: str) -> DetectionLimit:
        return DetectionLimit(mechanism=mechanism, where=Place(kind=kind, name=name), limit=value, unit=unit)  # type: ignore[arg-type]

    limits = [
        limit("speed_shift", "error", "z", 7.22, "um"), limit("speed_shift", "error", "z", 9.0, "um"),
        limit("joint_slip", "error", "z", 0.81, "um"), limit("joint_slip", "error", "x", 0.7953, "um"),
        limit("joint_slip", "error", "y", None, "um"), limit("column_bending", "error", "y", 5.0, "um/K"),
        limit("floor_sink", "node", "bed", 3.0, "W/K"),
    ]  # fmt: skip
    said = limits_sentence(limits)
    assert said == (
        "Would be claimed: on x slip in a bolted or guided joint from 0.795 µm and on z axial shift of the shaft "
        "with the speed from 7.22 µm."
    )
    assert limits_sentence(limits[-2:]) == ""
    d = toy_diagnosis("consistent")
    d = type(d)(**{**d.__dict__, "findings": d.findings.model_copy(update={"detection_limits": tuple(limits)})})
    (lead,) = [b for b in diagnosis_page(d, False).top if isinstance(b, Text) and b.look == "lead"]
    assert lead.text.endswith(said)


MEASURE = """<script>addEventListener("load", () => {
  const panel = document.querySelector(".unsealed").getBoundingClientRect()
  const wide = [...document.querySelectorAll(".unsealed *, header.top *")].filter(
    e => e.getBoundingClientRect().right > innerWidth).map(e => e.textContent)
  const errors = document.querySelector(".three").getBoundingClientRect().bottom
  const badge = document.querySelector(".unsealed .badge").getBoundingClientRect().width
  parent.postMessage({page: document.documentElement.scrollWidth, right: panel.right, errors, badge, wide}, "*")
})</script></body>"""


@pytest.mark.integration
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium or google-chrome on the path to open the page in")
@pytest.mark.parametrize(("width_px", "height_px"), [(390, 844), (1400, 900)])
def test_the_panel_fits_the_first_screen(width_px: int, height_px: int, tmp_path: Path) -> None:
    page = write("found_and_more", tmp_path)
    text = re.sub(r"<meta http-equiv[^>]*>", "", page.read_text(encoding="utf-8")).replace("</body>", MEASURE)
    page.write_text(text, encoding="utf-8")
    frame = tmp_path / "frame.html"
    frame.write_text(FRAME % (page.name, width_px), encoding="utf-8")
    dom, _ = open_page(frame, tmp_path)
    found = re.search(r'data-found="([^"]*)"', dom)
    assert found, "the page did not load in the frame"
    got = json.loads(unescape(found[1]))
    assert got["page"] <= width_px and got["right"] <= width_px and got["wide"] == []
    assert got["errors"] < height_px and got["badge"] > 20
