"""The report in a real browser: every figure is drawn, nothing is logged as an error, nothing overflows a phone."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from html import unescape
from pathlib import Path

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
    "--enable-logging=stderr", "--dump-dom",
]  # fmt: skip


def open_page(page: Path, scratch: Path) -> tuple[str, str]:
    """The page's DOM after its scripts have run, and what the browser logged."""
    profile = scratch / "profile"
    done = subprocess.run(
        [str(CHROMIUM), *FLAGS, f"--user-data-dir={profile}", page.resolve().as_uri()],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    return done.stdout, done.stderr


def console(log: str) -> list[str]:
    return [line for line in log.splitlines() if "CONSOLE" in line]


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("browser")


def test_every_figure_is_drawn_and_no_error_is_logged(toy_batches: Maker, scratch: Path) -> None:
    both = results(toy_batches, findings=True)
    before = results(toy_batches, k=5)["z"]
    cell = choose(both["z"].cells, PromotionRule()).cell
    trainings = [
        training(both["z"], promotion(cell, comparison=COMPARISON), name="new"),
        training(before, name="old", when="2025-06-01"),
        training(both["x"], name="x"),
    ]
    page = write_report(trainings, scratch / "r.html", settings(scratch).promotion)
    dom, log = open_page(page, scratch)
    assert re.search(r'<html[^>]* data-errors=""', dom), re.search(r"<html[^>]*>", dom)
    assert console(log) == []
    specs = dict(re.findall(r'<script type="application/json" id="([\w-]+)-data">(.*?)</script>', dom, re.S))
    assert len(specs) == 2 * 7 + 1
    assert re.search(rf'<html[^>]* data-drawn="{len(specs)}"', dom)
    for name, text in specs.items():
        part = dom.split(f'id="{name}"', 1)[1].split(f'id="{name}-data"', 1)[0]
        figure = json.loads(text)
        assert 'class="main-svg"' in part, f"{name} is not drawn"
        assert float(re.search(r'class="main-svg"[^>]* width="([\d.]+)"', part)[1]) > 200  # type: ignore[index]
        heat = sum(t["type"] == "heatmap" for t in figure["data"])
        assert len(re.findall(r'class="hm"', part)) == heat, f"{name}: heat map missing"
        assert len(re.findall(r'class="trace scatter', part)) == len(figure["data"]) - heat, f"{name}: trace missing"
        lines = [t for t in figure["data"] if "lines" in t.get("mode", "")]
        assert len(re.findall(r'class="js-line"[^>]* d="M[^"]+L', part)) >= len(lines), f"{name}: empty line"
        assert part.count('class="xtick"') > 1 and part.count('class="ytick"') > 1, f"{name}: empty axes"
        assert not re.search(r">[^<]*&amp;(#|lt|gt|amp)", part), f"{name}: markup shown as it stands"
        if figure["layout"]["annotations"]:
            assert "SIMULATED" in unescape(part)
    assert "cloud" not in "".join(re.findall(r'data-title="([^"]*)"', dom)).lower()


def test_a_script_error_is_caught_by_the_page(toy_batches: Maker, scratch: Path) -> None:
    page = write_report([training(results(toy_batches)["x"])], scratch / "broken.html", settings(scratch).promotion)
    text = page.read_text(encoding="utf-8").replace("Plotly.newPlot(", "Plotly.noPlot(")
    page.write_text(text.replace("<footer>", '<footer><img src="https://example.org/a.png">'), encoding="utf-8")
    dom, log = open_page(page, scratch)
    errors = re.search(r'<html[^>]* data-errors="([^"]*)"', dom)
    assert errors and "noPlot is not a function" in errors[1]
    assert "blocked https://example.org/a.png" in errors[1]
    assert console(log)


def test_a_phone_needs_no_sideways_scrolling(toy_batches: Maker, scratch: Path) -> None:
    write_report([training(results(toy_batches)["z"])], scratch / "phone.html", settings(scratch).promotion)
    inner = (scratch / "phone.html").read_text(encoding="utf-8")
    measure = (
        "<script>addEventListener('load',function(){setTimeout(function(){parent.postMessage("
        "[document.documentElement.scrollWidth,Math.max.apply(null,Array.from(document.querySelectorAll('.main-svg'))"
        ".map(function(s){return s.getBoundingClientRect().right}))],'*')},2000)})</script></body>"
    )
    (scratch / "phone.html").write_text(inner.replace("</body>", measure), encoding="utf-8")
    frame = scratch / "frame.html"
    frame.write_text(
        '<!doctype html><body><iframe src="phone.html" width="390" height="800" style="border:0"></iframe><script>'
        "addEventListener('message',function(e){document.body.dataset.widths=e.data.join(' ')})</script></body>",
        encoding="utf-8",
    )
    dom, _ = open_page(frame, scratch)
    widths = re.search(r'data-widths="([\d.]+) ([\d.]+)"', dom)
    assert widths, "the page did not load in the frame"
    assert float(widths[1]) <= 390 and float(widths[2]) <= 390
