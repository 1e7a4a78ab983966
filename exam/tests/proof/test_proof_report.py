"""The report of the proof: what it says, what it leaves out, that simulated is called so, on tables made up for it."""

from __future__ import annotations

import base64
import io
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.image import imread

from data.errors import WorkError
from reports.drawing import Picture
from reports.layout import Text
from tests.proof.toy_proof import ROOT, toy_proof, without
from tests.toys.pages import blocks, section, unscripted
from thermodrift_exam.proof.report import shortfall, tables
from thermodrift_exam.proof.report import tables as extracts
from thermodrift_exam.proof.report.labels import measured, origin
from thermodrift_exam.proof.report.page import headline, proof_page, write_proof_report
from thermodrift_exam.proof.report.tables import TABLES, ProofRun, goal_rows, shortfalls
from thermodrift_exam.proof.scoring.goal_table import GOAL_COLUMNS, RELIABILITY_COLUMNS
from thermodrift_exam.proof.scoring.outcomes import OUTCOMES, TERMS
from thermodrift_exam.proof.scoring.tables import CLAIMS, LITTLE, MISSED
from thermodrift_exam.proof.scoring.tables import COMPARED_COLUMNS as COMPARED
from thermodrift_exam.proof.sealing.leak import COLUMNS as LEAK

ANCHORS = (
    "goals",
    "baselines",
    "confusion",
    "detection",
    "shortfall",
    "improvement",
    "amplitude",
    "reliability",
    "worst",
    "how",
    "terms",
)
SILENT = {
    "compared": "Baselines and ablations were not scored in this run.",
    "terms": "No concealed effect has a known detection limit in this run.",
    "goals": "The goals were not scored in this run.",
    "reliability": "No finding stated a probability in this run.",
    "missed": "No visible effect was missed and no claim is false, or none was scored.",
    "worst": "Every answer was right, or none was judged.",
    "leak": "The leak test was not run.",
    "convergence": "convergence was not studied in this run.",
    "ledger": "The ledger is not part of this page.",
    "outcomes": "No visible case has left-out errors in this run.",
}


@pytest.fixture(scope="module")
def run() -> ProofRun:
    """With cells that do not apply as the scoring gives them: pandas' own missing value."""
    made = toy_proof(60, worst_cases=2)
    typed = dict(made.tables)
    for name, kinds in (("outcomes", OUTCOMES), ("terms", TERMS), ("goals", GOAL_COLUMNS)):
        table = made.tables[name]
        typed[name] = table.astype({c: kinds[c] for c in table.columns if c in kinds})
    typed["outcomes"].loc[0, ["visible", "probability", "error_before", "seconds"]] = pd.NA
    typed["terms"].loc[0, ["visible", "found", "limit_share", "low90"]] = pd.NA
    return replace(made, tables=typed)


@pytest.fixture(scope="module")
def text(run: ProofRun, tmp_path_factory: pytest.TempPathFactory) -> str:
    path = write_proof_report(tmp_path_factory.mktemp("proof"), run)
    assert path.name == "report.html"
    return unscripted(path.read_text(encoding="utf-8"))


# the page


def test_the_page_holds_everything_and_asks_no_network(text: str) -> None:
    assert not re.findall(r'(?:src|href)="(?!data:|#)', text) and not re.findall(r"https?://|<script", text)
    assert re.findall(r'<section class="part" id="(\w+)"', text) == list(ANCHORS)
    assert set(re.findall(r'href="#(\w+)"', text)) == set(ANCHORS)
    assert not re.findall(r"\bnan\b|<NA>|&lt;NA", re.sub(r'src="data:[^"]*"', "", text))
    assert text.count('<span class="chip met">met</span>') == 10
    assert "<h1>10 of 12 goals met on 60 sealed cases. <span" in text
    lead = re.search('<p class="lead">(.*)</p>', text)
    assert lead and "\u00a0%" in lead[1] and " %" not in lead[1]  # no line ends before a unit


def test_every_picture_is_drawn_and_says_what_is_simulated(text: str) -> None:
    shown = re.findall(r'<img alt="([^"]*)" src="data:image/png;base64,([^"]*)"', text)
    assert len(shown) == 9 + 2 and all(alt.endswith("(SIMULATED)") for alt, _ in shown)
    for _, content in shown:
        pixels = imread(io.BytesIO(base64.b64decode(content)))
        assert pixels.shape[1] > 800 and pixels[..., :3].std() > 0.02


def test_the_head_says_root_dates_version_and_what_does_not_count(text: str) -> None:
    said = dict(re.findall(r"<dt>([^<]*)</dt><dd>([^<]*)</dd>", text))
    assert said["Sealed root"] == ROOT[:16] and f"Sealed root: {ROOT}</p>" in text
    assert (said["Sealed"], said["Opened"]) == ("2026-01-05 06:00 UTC", "2026-01-05 19:30 UTC")
    assert (said["thermodrift"], said["Void, left out"], said["Failed, counted as wrong"]) == ("0.1.0", "1", "1")
    assert said["Cases sealed"] == "61" and said["Cases that count"].startswith("60 (plant A ")
    assert "diagnosis: 300 s were not enough" in text and "answered twice" in text
    assert "landlock and audit hook: 60 cases" in text


def test_a_sealed_suite_has_no_warning_and_others_have() -> None:
    run = toy_proof(5, tables={})
    assert top_texts(run, "warning") == []
    (known,) = top_texts(replace(run, suite="development"), "warning")
    assert known.startswith("A development suite: its seed is known")
    (part,) = top_texts(replace(run, partial=True), "warning")
    assert part.startswith("Opened in part")


def top_texts(run: ProofRun, look: str) -> list[str]:
    return [b.text for b in proof_page(run).top if isinstance(b, Text) and b.look == look]


@pytest.mark.parametrize("absent", SILENT)
def test_an_absent_table_leaves_a_sentence_in_its_place(run: ProofRun, absent: str, tmp_path: Path) -> None:
    kept = {"outcomes", "terms", absent} if absent in ("outcomes", "terms") else {"outcomes", absent}
    few = replace(run, tables={k: v for k, v in run.tables.items() if k in kept - {absent}})
    text = write_proof_report(tmp_path, few).read_text(encoding="utf-8")
    assert SILENT[absent] in text.replace("&#39;", "'")
    assert re.findall(r'<section class="part" id="(\w+)"', text) == list(ANCHORS)


def test_a_table_without_rows_is_an_absent_one(run: ProofRun) -> None:
    empty = {name: pd.DataFrame(columns=list(columns)) for name, columns in TABLES.items()}
    page = proof_page(replace(run, tables=empty))
    assert page.headline == "No goal could be evaluated on 0 sealed cases."
    assert blocks(page, Picture) == []


def test_mixed_plants_say_for_each_where_its_recordings_come_from() -> None:
    assert origin(("elements", "volumes")) == "SIMULATED"
    assert origin(("elements", "volumes", "grafted", "withheld")) == "A, B SIMULATED · C partly SIMULATED · D real"
    mixed = toy_proof(40, plants=("elements", "withheld"))
    page = proof_page(replace(mixed, tables=without(mixed, "series", "compared", "confusion_mechanism", "terms")))
    assert page.mark == "A SIMULATED · D real"
    pictures = blocks(page, Picture)
    assert pictures and not any(p.simulated for p in pictures)
    assert all(p.label.endswith("(A SIMULATED · D real)") for p in pictures)
    (_, *worst) = section(page, "worst").blocks
    heads = [w.blocks[:2] for w in worst]
    assert heads and all(head.simulated == ("finite elements" in what.text) for head, what in heads)


def test_a_table_that_lacks_a_column_and_a_strange_one_are_named() -> None:
    short = pd.DataFrame({"time": ["2026-01-05"], "step": ["sealed"]})
    with pytest.raises(WorkError, match="table ledger: got columns time, step, expected also words; score the proof"):
        toy_proof(5, tables={"ledger": short})
    with pytest.raises(WorkError, match="got a table 'diary', expected one of ledger, outcomes"):
        toy_proof(5, tables={"diary": short})


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(WorkError, match=r"gone/report.html: cannot be written \(No such file or directory\); free"):
        write_proof_report(tmp_path / "gone", toy_proof(5, tables={}))


def test_the_scoring_gives_every_column_that_the_page_reads() -> None:
    assert set(TABLES["outcomes"]) <= set(OUTCOMES) and set(TABLES["terms"]) <= set(TERMS)
    assert set(TABLES["goals"]) <= set(GOAL_COLUMNS) and set(TABLES["reliability"]) <= set(RELIABILITY_COLUMNS)
    assert (set(TABLES["missed"]), set(TABLES["claims"])) == (set(TABLES["missed"]) & set(MISSED), set(CLAIMS))
    assert set(TABLES["leak"]) <= set(LEAK) and set(TABLES["compared"]) <= set(COMPARED)


# shortfall


def test_what_was_missed_and_claimed_falsely_is_listed_with_what_limits_it(run: ProofRun, text: str) -> None:
    missed, claims = run.table("missed"), run.table("claims")
    assert len(missed) and (~claims["true"].astype(bool)).any()
    plain = re.sub(r"<[^>]*>", " ", text)
    false = int((~claims["true"].astype(bool)).sum())
    assert f"{false} of {len(claims)} claims are false." in plain
    terms = run.table("terms")
    seen = terms[terms["visible"].eq(True) & ~terms["decoy"].astype(bool)]
    enough = int((seen["gain_nats"] > seen["bar_nats"]).sum())
    assert (
        f"Of {len(seen)} visible effects that the true model contains, {enough} gain more than the threshold" in plain
    )
    little = int((missed["reason"] == LITTLE).sum())
    assert f"{len(missed)} of {len(seen)} visible effects have no claim: {little} are limited by the data" in plain
    table = shortfall.reasons(missed, ("elements", "volumes"))
    assert [row.cells[1] for row in table.rows] == ["data", "data", "search", "search"]
    assert table.rows[0].cells[0] == LITTLE and table.rows[0].cells[-1] == f"{little}"


# goals


def _goal(**changed: object) -> dict[str, object]:
    row = {"measure": "detection", "goal": "≥ 97 %", "wanted": 0.97, "better": "higher", "value": 0.955, "low90": 0.93,
           "high90": 0.972, "n": 200, "met": False, "informed": 0.99, "informed_n": 190, "plant": "all"}  # fmt: skip
    return row | changed


def test_a_goal_is_shown_with_interval_count_and_plants() -> None:
    goals = pd.DataFrame([_goal(), _goal(plant="volumes", value=0.98, met=True, n=90)])
    (row,) = goal_rows(goals, ("elements", "volumes"))
    assert (row.measure, row.goal, row.whole.value) == ("detection", "≥ 97 %", "95.5 %")
    assert row.whole.interval == "93.0 to 97.2 %"
    assert (row.whole.met, row.whole.n) == ("no", "200")
    assert (row.informed.value, row.informed.n, row.informed.met) == ("99.0 %", "190", "")
    assert [(c.value, c.met, c.n) for c in row.plants] == [("–", "", ""), ("98.0 %", "yes", "90")]
    bar = row.whole.bar
    assert bar is not None and (bar.marks, bar.dots) == (
        (("wanted", 75.0),),
        (62.5,),
    )  # the axis runs from 0.97 − 3 · 0.03 to 1
    assert shortfalls(goals) == ["detection: 95.5 %, goal ≥ 97 %"] and shortfalls(goals, "volumes") == []


def test_a_goal_that_no_case_speaks_for_is_neither_met_nor_missed(run: ProofRun) -> None:
    empty = _goal(value=None, low90=None, high90=None, n=0, met=None, informed=None, informed_n=0)
    goals = pd.DataFrame([empty, _goal(measure="time", met=True)], dtype=object)
    assert goal_rows(goals, ())[0].informed.value == "–"
    assert goal_rows(goals, ())[0].whole.value == "–" and goal_rows(goals, ())[0].whole.bar is None
    told = replace(run, tables={"goals": goals, "outcomes": run.table("outcomes")})
    assert headline(told) == "Every goal met on 60 sealed cases."
    assert top_texts(replace(told, tables={"goals": goals}), "lead") == ["Without a case: 1 goal."]


def test_many_missed_goals_are_counted_and_the_first_told() -> None:
    goals = pd.DataFrame([_goal(measure=f"m{k}", met=k == 0) for k in range(8)])
    run = toy_proof(5, tables={"goals": goals})
    (said,) = top_texts(run, "lead")
    assert said.startswith("Missed: m1: 95.5 %, goal ≥ 97 %; m2: ") and said.endswith("; 3 more, in the table.")


def test_a_convergence_study_is_one_row_with_its_orders(run: ProofRun) -> None:
    (first, *rest) = tables.convergence(run.table("convergence")).rows
    assert first.cells == ("A, finite elements", "temperature at the nose, K", "grid", "80 → 40 → 20 mm",
                           "0.04 → 0.01 → 0.0025", "1.97, 1.97")  # fmt: skip
    assert len(rest) == 3


def test_rivals_without_a_case_are_no_empty_picture(run: ProofRun) -> None:
    compared = run.table("compared").assign(value=np.nan, lead=np.nan)
    (only,) = section(proof_page(replace(run, tables={"compared": compared})), "baselines").blocks
    assert only.text == SILENT["compared"]


@pytest.mark.parametrize(
    ("value", "goal", "said"),
    [(0.0061, "≤ 1 %", "0.6 %"), (0.423, "≥ 15 %", "42 %"), (0.9534, "≥ 95 %", "95.3 %"), (21.96, "≤ 30 s", "22.0 s"),
     (0.0412, "≤ 0.05", "0.04"), (1.4, "≤ 2 explanations", "1.40"), (np.nan, "≤ 30 s", "–")],
)  # fmt: skip
def test_a_measured_value_has_its_goals_unit(value: float, goal: str, said: str) -> None:
    assert measured(value, goal, 0.5) == said


# what is drawn


def _terms(**columns: object) -> pd.DataFrame:
    n = len(next(iter(columns.values())))  # type: ignore[arg-type]
    rest = {"decoy": [False] * n, "visible": [True] * n, "found": [True] * n, "effect": ["sun"] * n}
    return pd.DataFrame(rest | columns)


def test_detection_counts_terms_by_size_and_effect() -> None:
    terms = _terms(limit_share=[0.5, 1.0, 3.9, 4.0, np.nan, 2.0], found=[False, True, True, False, True, True],
                   effect=["sun"] * 5 + ["radiation"], decoy=[False] * 5 + [True])  # fmt: skip
    table = extracts.detection_by_size(terms)
    assert [tuple(r) for r in table.loc[table["effect"] == "sun", ["size", "found", "n"]].to_numpy()] == [
        ("below 1×", 0, 1), ("1 to 2×", 1, 1), ("2 to 4×", 1, 1), ("4 to 10×", 0, 1)]  # fmt: skip
    assert list(dict.fromkeys(table["effect"])) == ["all effects", "sun"]


def test_amplitudes_are_compared_in_detection_limits() -> None:
    terms = _terms(limit_share=[2.0, 2.0], amplitude_true=[10.0, -10.0], amplitude_found=[12.0, -5.0],
                   low90=[11.0, -12.0], high90=[13.0, -4.0])  # fmt: skip
    table = extracts.with_amplitude(terms)
    np.testing.assert_allclose(table["found_limits"], [2.4, 1.0])
    np.testing.assert_allclose(table["low_limits"], [2.2, 0.8])
    np.testing.assert_allclose(table["high_limits"], [2.6, 2.4])
    assert list(table["covers"]) == [False, True]


def test_the_matrix_of_mechanisms_follows_the_registrys_groups() -> None:
    counts = pd.DataFrame({"true": ["unlisted", "sun", "sun", "radiation", "sensor_lag"],
                           "named": ["unlisted", "sun", "cabinet_heat", "nothing", "sensor_lag"],
                           "count": [4, 3, 2, 1, 5]})  # fmt: skip
    matrix, bounds = extracts.mechanism_matrix(counts)
    assert list(matrix.index) == ["radiation", "sun", "sensor_lag", "unlisted"]
    assert list(matrix.columns) == ["radiation", "sun", "sensor_lag", "unlisted", "cabinet_heat", "nothing"]
    assert matrix.loc["sun", "cabinet_heat"] == 2 and matrix.to_numpy().sum() == 15 and bounds == [1, 2, 3, 4]


def test_rare_places_stand_together_and_no_count_is_lost() -> None:
    names = [f"body_{k:02d}" for k in range(60)]
    counts = pd.DataFrame({"true": names, "named": [*names[:-1], "nothing"], "count": np.arange(60, 0, -1)})
    matrix, _ = extracts.place_matrix(counts)
    assert len(matrix) == 35 and matrix.index[-1] == "other" and list(matrix.columns)[-2:] == ["other", "nothing"]
    assert matrix.to_numpy().sum() == counts["count"].sum() and matrix.loc["body_00", "body_00"] == 60


def test_the_worst_channel_is_worst_against_its_own_noise() -> None:
    draws = np.random.default_rng(0)
    parts = []
    for channel, noise, left in (("z_um", 1.0, 3.0), ("t_bed", 0.01, 0.2)):
        for batch in ("a", "b"):
            after = left * (batch == "b") + noise * draws.standard_normal(200)
            parts.append(
                pd.DataFrame({"batch": batch, "channel": channel, "recorded": after, "before": 0.0, "after": 0.0})
            )
    shown = extracts.worst_channel(pd.concat(parts, ignore_index=True))
    assert set(shown["channel"]) == {"t_bed"} and list(dict.fromkeys(shown["batch"])) == ["a", "b"]
