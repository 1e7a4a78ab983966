"""Every study of the registry on two seeds: complete, repeatable, labelled; and the counting behind a verdict."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scipy.stats import beta

from data.errors import InputError
from thermodrift_exam.studies import STUDIES
from thermodrift_exam.studies.base import Figure, Ordering, Study, StudyResult, run_studies

BRIEF = ("coupled_lathe", "grey_distributed_lag")  # the others take longer, and are made of the same pieces


@pytest.fixture(scope="module", params=[pytest.param(k, marks=[] if k in BRIEF else pytest.mark.slow) for k in STUDIES])
def result(request: pytest.FixtureRequest) -> StudyResult:
    return run_studies([request.param], 2)[request.param]


@pytest.mark.slow
def test_every_figure_of_every_seed_is_a_number(result: StudyResult) -> None:
    names = [f.key for f in result.study.figures]
    assert len(set(names)) == len(names)
    assert list(result.wide.columns) == names and len(result.table) == 2 * len(names)
    assert np.isfinite(result.wide.to_numpy(float)).all()


def test_seeds_are_different_machines(result: StudyResult) -> None:
    one, other = result.wide.to_numpy(float)
    assert np.mean(one != other) > 0.5


def test_what_a_study_says_of_itself(result: StudyResult) -> None:
    study = result.study
    assert STUDIES[study.key] is study
    assert study.title and study.summary and study.source and study.machine and study.assumed
    assert "±20 %" in study.machine
    known = {f.key for f in study.figures}
    orderings = {o.key: o for o in study.orderings}
    assert len(orderings) == len(study.orderings)
    for o in study.orderings:
        assert o.less and {n for pair in o.less for n in pair} <= known
        assert not o.evidence_for or not orderings[o.evidence_for].evidence_for
    published = [o for o in study.orderings if not o.evidence_for]
    assert published, "a study repeats at least one published ordering"


def test_the_tables_follow_the_seeds(result: StudyResult) -> None:
    figures, wide = result.figures(), result.wide
    np.testing.assert_allclose(figures["mean"], wide.mean().to_numpy())
    np.testing.assert_allclose(figures["sd"], wide.std(ddof=1).to_numpy())
    assert (figures["p5"] <= figures["p95"] + 1e-12).all()
    orderings = result.orderings()
    assert sorted(orderings["ordering"]) == sorted(o.key for o in result.study.orderings)
    for o in result.study.orderings:
        by_hand = sum(all(wide.loc[s, a] < wide.loc[s, b] for a, b in o.less) for s in result.seeds)
        (row,) = orderings[orderings["ordering"] == o.key].to_dict("records")
        assert row["held"] == by_hand and row["seeds"] == 2
        assert "{" not in row["why"]


# The numbers to know: what each source printed must stand in its study.
PRINTED = {
    "year_round_pcr": {6.8, 2.4, 6.12, 3.43, 99.88, -1.0, 5.0, 0.234, 0.577},
    "grey_lssvm": {1.81, 1.72, 1.76, 86.0},
    "coupled_lathe": {0.9, 3.2, 88.4, 90.7, 1.4, 3.4, 82.9, 71.3, 18.6, 7.4, 24.3, 10.5},
}


@pytest.mark.parametrize("key", PRINTED)
def test_the_printed_numbers_are_there(key: str) -> None:
    study = STUDIES[key]
    said = {f.published for f in study.figures} | {o.published_gain for o in study.orderings}
    assert PRINTED[key] <= said


class Toy(Study):
    """Two figures per seed: a = seed, b = 2."""

    key = "toy"
    title = summary = source = machine = "toy"
    assumed = ("nothing",)
    figures = (Figure("a", "a", published=1.0, digits=1), Figure("b", "b"))
    orderings = (
        Ordering("a_less", "a is less", (("a", "b"),), 0.5, why="a has {a}, b has {b}"),
        Ordering("other", "b is less", (("b", "a"),)),
        Ordering("because", "evidence", (("a", "b"),), evidence_for="a_less"),
    )

    def run(self, seed: int) -> dict[str, float]:
        return {"a": float(seed), "b": 2.0}


def toy(values: list[float]) -> pd.DataFrame:
    rows = [("toy", s, f, v) for s, a in enumerate(values) for f, v in (("a", a), ("b", 2.0))]
    result = StudyResult(
        Toy, tuple(range(len(values))), pd.DataFrame(rows, columns=["study", "seed", "figure", "value"])
    )
    return result.orderings().set_index("ordering")


def test_orderings_are_counted_with_the_interval_of_clopper_and_pearson() -> None:
    table = toy([1.0] * 9 + [3.0])
    row = table.loc["a_less"]
    assert (row["held"], row["seeds"]) == (9, 10)
    assert row["low"] == pytest.approx(beta.ppf(0.025, 9, 2)) and row["high"] == pytest.approx(beta.ppf(0.975, 10, 1))
    assert row["verdict"] == "holds" and table.loc["other", "verdict"] == "fails"
    assert row["gain"] == 0.5 and row["gain_p95"] == 0.5
    assert row["gain_p5"] == pytest.approx(-0.5 + 0.45 * 1.0), "linear between the last value and the one before"
    assert row["why"] == "a has 1.2, b has 2.00"
    assert list(table.index) == ["a_less", "because", "other"], "evidence stands behind its claim"


def test_a_tie_is_not_less_and_what_is_no_number_is_not_counted() -> None:
    assert toy([2.0, 1.0]).loc["a_less", "held"] == 1
    row = toy([np.nan, 1.0, 1.0]).loc["a_less"]
    assert (row["held"], row["seeds"]) == (2, 2)


def test_few_seeds_leave_it_undecided() -> None:
    assert toy([1.0] * 5).loc["a_less", "verdict"] == "undecided", "5 of 5: the interval reaches down to 48 %"
    assert toy([1.0] * 6).loc["a_less", "verdict"] == "holds"


def test_unknown_studies_and_too_few_seeds_are_told_in_one_line() -> None:
    with pytest.raises(InputError, match="unknown study 'year_round': did you mean 'year_round_pcr'"):
        run_studies(["year_round"], 2)
    with pytest.raises(InputError, match="seeds is 1; expected at least 2"):
        run_studies(["year_round_pcr"], 1)


@pytest.mark.slow
def test_the_number_of_processes_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(STUDIES._members, "toy", f"{__name__}:Toy")
    steps: list[tuple[str, int, int]] = []
    alone = run_studies(["toy"], 3, progress=lambda *step: steps.append(step))["toy"]
    assert steps == [("toy, seed 0", 1, 3), ("toy, seed 1", 2, 3), ("toy, seed 2", 3, 3)]
    assert run_studies(["toy"], 3, workers=2)["toy"].table.equals(alone.table)
