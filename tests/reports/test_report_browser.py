"""The report in a real browser: every picture is shown, no label is cut or covered, nothing overflows a phone."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from html import unescape
from pathlib import Path
from typing import Any

import pytest

from models.protocols import PromotionRule
from models.selection.promotion import choose
from reports.comparison import write_report
from reports.layout import Column, Page, Row, Table
from reports.rendering import write_page
from tests.toys.pages import unscripted
from tests.toys.report_training import COMPARISON, Maker, promotion, results, settings, training

CHROMIUM = next((p for n in ("chromium", "chromium-browser", "google-chrome") if (p := shutil.which(n))), None)
pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium or google-chrome on the path to open the page in"),
]
FLAGS = [
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--hide-scrollbars",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--virtual-time-budget=8000",
    "--enable-logging=stderr", "--dump-dom", "--window-size=1400,900",
]  # fmt: skip
FRAME = """<!doctype html><body><iframe src="%s" width="%d" height="844" style="border:0"></iframe><script>
addEventListener("message", e => { document.body.dataset.found = JSON.stringify(e.data) })</script></body>"""
# Of every picture its id, width, the right end and the width of its box, its texts outside of it, pairs that overlap.
MEASURE = """<script>addEventListener("load", () => setTimeout(() => {
  const over = (a, b) => a >= b - 1
  const across = (a, b) => over(a.left, b.left) && over(b.right, a.right)
  const inside = (a, b) => across(a, b) && over(a.top, b.top) && over(b.bottom, a.bottom)
  const apart = (a, b) => a.right <= b.left || b.right <= a.left || a.bottom <= b.top + 1 || b.bottom <= a.top + 1
  const pictures = [...document.querySelectorAll(".plot")].map(box => {
    const svg = box.querySelector("svg").getBoundingClientRect()
    const texts = [...box.querySelectorAll("text")].map(t => [t.textContent, t.getBoundingClientRect()])
    const others = i => texts.slice(i + 1)
    return {id: box.id, width: svg.width, right: box.getBoundingClientRect().right, box: box.clientWidth,
            texts: texts.length, cut: texts.filter(([, r]) => !inside(r, svg)).map(([t]) => t),
            covered: texts.flatMap(([t, r], i) => others(i).filter(([, s]) => !apart(r, s)).map(([u]) => [t, u]))}
  })
  const curves = document.querySelector(".plot").getBoundingClientRect().top
  parent.postMessage({page: document.documentElement.scrollWidth, curves: curves, pictures: pictures}, "*")
}, 1000))</script></body>"""


def open_page(page: Path, scratch: Path) -> tuple[str, str]:
    """The page's DOM, and what the browser logged."""
    profile = scratch / "profile"
    done = subprocess.run(
        [str(CHROMIUM), *FLAGS, f"--user-data-dir={profile}", page.resolve().as_uri()],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    return done.stdout, done.stderr


def console(log: str) -> list[str]:
    return [line for line in log.splitlines() if "CONSOLE" in line]


def measured(page: Path, width_px: int, scratch: Path, opened: bool = True) -> dict[str, Any]:
    """What `MEASURE` finds on the page in a frame of this width."""
    return in_frame(page, MEASURE, width_px, scratch, opened)


def in_frame(page: Path, script: str, width_px: int, scratch: Path, opened: bool = False) -> dict[str, Any]:
    """What a script posts from a copy of the page, without its rule against other scripts, in a frame."""
    text = re.sub(r"<meta http-equiv[^>]*>", "", page.read_text(encoding="utf-8")).replace("</body>", script)
    copy = page.with_name(f"copy_{page.name}")
    copy.write_text(text.replace("<details>", "<details open>") if opened else text, encoding="utf-8")
    frame = page.with_name(f"frame_{page.name}")
    frame.write_text(FRAME % (copy.name, width_px), encoding="utf-8")
    dom, _ = open_page(frame, scratch)
    found = re.search(r'data-found="([^"]*)"', dom)
    assert found, "the page did not load in the frame"
    out: dict[str, Any] = json.loads(unescape(found[1]))
    return out


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("browser")


@pytest.fixture(scope="module")
def page(toy_batches: Maker, scratch: Path) -> Path:
    both = results(toy_batches, findings=True)
    before = results(toy_batches, k=5)["z"]
    cell = choose(both["z"], PromotionRule()).cell
    trainings = [
        training(both["z"], promotion(cell, comparison=COMPARISON), name="new"),
        training(before, name="old", when="2025-06-01"),
        training(both["x"], name="x"),
    ]
    return write_report(trainings, scratch / "r.html", settings(scratch).promotion)


def test_the_page_is_shown_without_an_error_and_its_viewers_are_drawn(page: Path, scratch: Path) -> None:
    dom, log = open_page(page, scratch)
    assert console(log) == []
    assert not re.search(r">[^<]*&amp;(#|lt|gt|amp)", unscripted(dom)), "markup shown as it stands"
    assert dom.count("<canvas") == 2, "the run and its residual"
    assert len(re.findall(r"<option value=", dom)) == 4 + 2, "every later run and both channels can be chosen"
    assert len(re.findall(r"0.0 to 3.3 h. residual: rms \d", dom)) == 1


USE = """<script>addEventListener("load", () => setTimeout(() => {
  const figure = document.querySelector("figure.viewer")
  const charts = figure.querySelector(".charts")
  const said = () => figure.querySelector("[aria-live]").textContent
  const out = {whole: said()}
  figure.querySelector("button[aria-label='next run']").click()
  out.run = figure.querySelector("select").selectedIndex
  out.next = said()
  const press = key => charts.dispatchEvent(new KeyboardEvent("keydown", {key, bubbles: true}))
  const steps = [
    () => { press("ArrowRight"); press("ArrowRight"); out.cursor = said() },
    () => press("+"),
    () => { out.zoomed = said(); parent.postMessage(out, "*") },
  ]
  steps.forEach((step, k) => setTimeout(step, 200 * (k + 1)))
}, 600))</script></body>"""
ORDER = """<script>addEventListener("load", () => {
  const body = document.querySelector("tbody")
  const head = document.querySelector("thead th:nth-child(2) button")
  const column = () => [...body.rows].map(r => r.cells[1].textContent)
  const out = {}
  head.click(); out.up = column()
  head.click(); out.down = column()
  const field = document.querySelector(".filter input")
  field.value = "b1 RPM"
  field.dispatchEvent(new Event("input"))
  out.kept = [...body.rows].filter(r => !r.hidden).map(r => r.cells[0].textContent)
  out.counted = document.querySelector(".filter span").textContent
  parent.postMessage(out, "*")
})</script></body>"""


def test_runs_are_chosen_read_and_zoomed_with_the_keyboard(page: Path, scratch: Path) -> None:
    found = in_frame(page, USE, 1200, scratch)
    assert found["run"] == 1 and found["next"] != found["whole"]
    assert re.match(r"0\.17 h: recorded [\d.−]+, predicted [\d.−]+, residual [\d.−]+ µm", found["cursor"])
    assert re.match(r"0\.[01] to 1\.\d h\. residual: rms", found["zoomed"])


def test_tables_sort_by_value_and_long_ones_filter(scratch: Path) -> None:
    values = ["−2.5", "10.0", "9.5", "1.2·10⁴", "–", "< 1", "3", "4", "5", "6", "7", "8"]
    rows = tuple(Row.of(f"b{k}", v, "4000 rpm") for k, v in enumerate(values))
    table = Table("t", (Column("batch"), Column("S", "µm", "number"), Column("speed")), rows)
    page = scratch / "table.html"
    write_page(page, Page("", "t", (table,)))
    found = in_frame(page, ORDER, 1200, scratch)
    assert found["up"] == ["−2.5", "< 1", "3", "4", "5", "6", "7", "8", "9.5", "10.0", "1.2·10⁴", "–"]
    assert found["down"] == found["up"][::-1]
    assert found["kept"] and set(found["kept"]) == {"b1", "b10", "b11"} and found["counted"] == "3 of 12 rows"


@pytest.mark.parametrize("width_px", [390, 1200])
def test_every_picture_is_readable_and_nothing_overflows_the_page(width_px: int, page: Path, scratch: Path) -> None:
    found = measured(page, width_px, scratch)
    assert found["page"] <= width_px
    assert len(found["pictures"]) == 2 * 4
    for p in found["pictures"]:
        assert p["right"] <= width_px and p["width"] >= 300 and p["texts"] > 8, p
        assert p["cut"] == [] and p["covered"] == [], p
        assert p["width"] <= p["box"], f"{p['id']}: a plot needs no scrolling"


@pytest.mark.slow
@pytest.mark.parametrize(("width_px", "height_px"), [(390, 844), (1200, 900)])
def test_the_first_screen_reaches_the_curves(width_px: int, height_px: int, page: Path, scratch: Path) -> None:
    assert measured(page, width_px, scratch, opened=False)["curves"] < height_px


def test_an_error_would_be_seen(page: Path, scratch: Path) -> None:
    """The page's own rule blocks what is loaded from elsewhere, and the browser says so."""
    broken = scratch / "broken.html"
    text = page.read_text(encoding="utf-8").replace("<footer>", '<footer><img src="https://example.org/a.png">')
    broken.write_text(text, encoding="utf-8")
    _, log = open_page(broken, scratch)
    assert any("example.org" in line for line in console(log))
