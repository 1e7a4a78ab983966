"""Progress: an estimate of the time left from what is finished, and few lines where there is no terminal."""

from __future__ import annotations

import io
import threading

import numpy as np
import pandas as pd
import pytest
from rich.console import Console

from models.selection.promotion import Choice
from pipelines import console
from pipelines.caller import DirectCaller


def test_the_time_left_is_that_of_the_later_half() -> None:
    pace = console.Pace(0.0)
    said = [pace.left(n, 10, t) for n, t in enumerate([600.0, 1200.0, 1230.0, 1260.0, 1290.0, 1320.0], 1)]
    # two slow ones first, then 30 s each: 8 · 600 s after two, 5 · 30 s after five
    assert said == [
        "", "about 80 min left", "about 37 min left", "about 3 min left", "about 3 min left", "about 2 min left",
    ]  # fmt: skip
    assert pace.left(10, 10, 1500.0) == ""


def test_an_estimate_begins_anew_with_each_step_and_stands_a_repeated_count() -> None:
    pace = console.Pace(0.0)
    for n in (1, 2, 2, 3):
        pace.left(n, 4, 100.0 * n)
    assert pace.left(0, 0, 400.0) == "" and pace.left(1, 50, 410.0) == ""
    assert pace.left(2, 50, 420.0) == "about 8 min left"


@pytest.mark.parametrize(
    ("time_s", "shown"), [(0.0, "10 s"), (11, "20 s"), (90, "90 s"), (91, "2 min"), (5399, "90 min"), (5401, "2 h")]
)
def test_durations_are_rounded_up(time_s: float, shown: str) -> None:
    assert console._duration(time_s) == shown


@pytest.fixture
def log(monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    """Standard error that is no terminal, and a clock that goes on by 20 s at every look."""
    written = io.StringIO()
    monkeypatch.setattr(console, "err", Console(file=written, soft_wrap=True))
    clock = iter(range(0, 10_000, 20))
    monkeypatch.setattr(console.time, "monotonic", lambda: float(next(clock)))
    return written


def test_a_log_gets_a_line_now_and_then(log: io.StringIO) -> None:
    with console.progress(False) as (say, done):
        say("grid")
        for n in range(1, 9):
            done(f"grid z f{n}", n, 8)
    lines = log.getvalue().splitlines()
    assert lines[0] == "grid" and len(lines) == 5
    assert lines[1:3] == ["grid z f2: 2 of 8, about 2 min left", "grid z f4: 4 of 8, about 80 s left"]
    assert lines[4] == "grid z f8: 8 of 8"


def test_quiet_is_quiet(log: io.StringIO) -> None:
    with console.progress(True) as (say, done):
        say("grid")
        for n in range(1, 9):
            done("grid", n, 8)
    assert log.getvalue() == ""


def test_progress_follows_the_order_of_finishing() -> None:
    heard: list[tuple[str, int, int]] = []
    others = threading.Event()

    def work(job: tuple[str, str]) -> str:
        if job[1] == "slow":
            assert others.wait(30)
        return job[1]

    def done(step: str, n: int, of: int) -> None:
        heard.append((step, n, of))
        if n == 2:
            others.set()

    jobs = [("z", "slow"), ("z", "a"), ("z", "b")]
    assert DirectCaller(done).map("grid", work, jobs) == ["slow", "a", "b"]
    assert heard[2] == ("grid z slow", 3, 3) and {h[0] for h in heard[:2]} == {"grid z a", "grid z b"}


def test_a_line_steers_no_terminal_and_says_what_it_was_given(capsys: pytest.CaptureFixture[str]) -> None:
    console.line("root:x:0 \x1b[2J\u202egnp.exe [bold]")
    assert capsys.readouterr().out == "root:x:0 \\x1b[2J\\u202egnp.exe [bold]\n"


def test_a_family_has_its_cost_and_what_it_would_have_had_to_gain(monkeypatch: pytest.MonkeyPatch) -> None:
    from pipelines.commands.train import _print_race

    out = io.StringIO()
    monkeypatch.setattr(console, "out", Console(file=out, width=80, soft_wrap=True))
    rows = [("families", "svr", 2.0, 0.9, 0.2, 0.5), ("families", "ridge", 1.5, 0.4, 0.1, 0.25),
            ("runs", "ridge", 1.6, 0.6, 0.3, 1.0), ("runs", "ridge", 1.4, 0.4, 0.2, 1.0),
            ("families", "mlr", 1.1, 0.0, 0.0, 0.1), ("runs", "mlr", 1.0, 0.0, 0.0, 0.2)]  # fmt: skip
    names = ["round", "family", "S_mean_um", "behind_um", "se_um", "cpu_s"]
    _print_race("m z", pd.DataFrame(rows, columns=names), "um")
    found = {line.split()[0]: line.split()[1:] for line in out.getvalue().splitlines()[3:] if line.strip()}
    assert list(found) == ["ridge", "svr", "mlr"], "the dearest first"
    assert found["ridge"] == ["runs", "1.25", "0.40±0.20"] and found["svr"] == ["families", "0.50", "0.90±0.20"]
    assert found["mlr"] == ["runs", "0.30", "leads"]


def test_the_main_table_shows_whole_names_in_80_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    from pipelines.commands.train import _print_leaderboard

    out = io.StringIO()
    monkeypatch.setattr(console, "out", Console(file=out, width=80, soft_wrap=True))
    cell = {"selector": "sequential_forward", "family": "hist_gradient_boosting", "n_tsp": 10, "n_inputs": 10,
            "S_mean_um": 24.74, "S_std_um": 14.81}  # fmt: skip
    protocols = ("forward", "leave-season-out", "leave-batch-out")
    _print_leaderboard("m z", pd.DataFrame([{**cell, "protocol": p} for p in protocols]), "um")
    lines = out.getvalue().splitlines()
    assert max(map(len, lines)) <= 80 and "hist_gradient_boosting" in lines[3] and "sequential_forward" in lines[3]
    assert lines[3].count("24.7±14.8") == 3


def test_the_chosen_cell_has_its_row_beside_the_best_of_its_family(monkeypatch: pytest.MonkeyPatch) -> None:
    from pipelines.commands.train import SHOWN, _print_leaderboard

    out = io.StringIO()
    monkeypatch.setattr(console, "out", Console(file=out, width=80, soft_wrap=True))
    families = [*(f"f{k}" for k in range(SHOWN)), "ridge", "ridge"]
    cells = pd.DataFrame({"selector": "none", "family": families, "n_tsp": range(SHOWN + 2), "n_inputs": 1,
                          "protocol": "forward", "S_mean_um": np.arange(SHOWN + 2.0), "S_std_um": 0.5})  # fmt: skip
    chosen = Choice("forward", "none", "ridge", SHOWN + 1, ("a",), 9.0, 9.0, 0.5, 1.0, 6, "", "")
    _print_leaderboard("m z", cells, "um", chosen)
    rows = out.getvalue().splitlines()[3:]
    assert len(rows) == SHOWN + 1 and [r for r in rows if "ridge" in r] == [rows[-1]] and "* ridge" in rows[-1]
