"""The panel of an opened demonstration: it says how it came out, and fits the first screen."""

from __future__ import annotations

import json
import re
from html import unescape
from pathlib import Path
from typing import get_args

import pytest

from reports.diagnosis import tables
from reports.diagnosis.page import write_diagnosis_report
from tests.reports.test_report_browser import CHROMIUM, FRAME, open_page
from tests.toys.diagnosis import toy_diagnosis
from thermodrift_exam.proof.unsealed import Outcome, Unsealed

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
    d = toy_diagnosis(VERDICTS[outcome])
    changed = bool(d.findings.findings)
    panel = unsealed(outcome).panel(tables.error_lines(d.tables["rms"], changed), changed)
    write_diagnosis_report(path, d, pictures=False, above=panel)
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
