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

from models.promotion import choose
from models.protocols import PromotionRule
from reports.comparison import write_report
from tests.toys.report_training import COMPARISON, Maker, promotion, results, settings, training

CHROMIUM = next((p for n in ("chromium", "chromium-browser", "google-chrome") if (p := shutil.which(n))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium or google-chrome on the path to open the page in")
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
    """What `MEASURE` finds on a copy of the page, without its rule against scripts, in a frame of this width."""
    text = re.sub(r"<meta http-equiv[^>]*>", "", page.read_text(encoding="utf-8")).replace("</body>", MEASURE)
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


def test_the_page_is_shown_without_a_script_and_without_an_error(page: Path, scratch: Path) -> None:
    dom, log = open_page(page, scratch)
    assert console(log) == [] and "<script" not in dom
    assert not re.search(r">[^<]*&amp;(#|lt|gt|amp)", dom), "markup shown as it stands"


@pytest.mark.parametrize("width_px", [390, 1200])
def test_every_picture_is_readable_and_nothing_overflows_the_page(width_px: int, page: Path, scratch: Path) -> None:
    found = measured(page, width_px, scratch)
    assert found["page"] <= width_px
    assert len(found["pictures"]) == 2 * 7 + 1
    for p in found["pictures"]:
        assert p["right"] <= width_px and p["width"] >= 300 and p["texts"] > 8, p
        assert p["cut"] == [] and p["covered"] == [], p
        assert p["width"] <= p["box"] or "left-out" not in p["id"], f"{p['id']}: curves of one batch need no scrolling"


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
