"""The leak test notices what gives answers away, and stays quiet where nothing does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from sklearn.metrics import roc_auc_score

from thermodrift_exam.proof.sealing import leak
from thermodrift_exam.proof.sealing.leak import (
    COLUMNS,
    area_under_curve,
    effect_questions,
    leak_features,
    leak_table,
    predicted,
)
from thermodrift_exam.proof.spec import CaseSpec
from thermodrift_exam.proof.suite import build, small_suite, write_built

NAMES = [f"case_{k:04d}" for k in range(1, 45)]
EFFECTS = ("floor_sink", "sun")


@pytest.fixture(autouse=True)
def few_trees(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leak, "TREES", 5)


def written(folder: Path, rng: np.random.Generator, rows: int, machine: str) -> None:
    """A recording drawn by lot, with so many rows, of a machine of that name."""
    (folder / "recordings").mkdir(parents=True)
    channels = {"t_bed": "temperature", "room": "ambient", "spindle_rpm": "driver", "z": "error"}
    file = {
        "machine": machine,
        "channels": {name: {"role": role} for name, role in channels.items()},
        "twin": {"bodies": {"bed": {"capacity": {"value": f"{rng.uniform(1, 2):.3g} J/K", "spread": 0.1}}}},
    }
    (folder / "machine.yml").write_text(yaml.safe_dump(file), encoding="utf-8")
    lines = [f"{300 * k},{rng.normal(20, 1):.2f},{rng.normal(20, 1):.2f},{rng.integers(8)},1" for k in range(rows)]
    text = "\n".join(["time_s,t_bed,room,spindle_rpm,z", *lines]) + "\n"
    (folder / "recordings" / "20260101_0800.csv").write_text(text, encoding="utf-8")


def keys() -> dict[str, dict[str, Any]]:
    """Half of the cases lack nothing, the others one of two effects."""
    out = {}
    for k, name in enumerate(NAMES):
        lacks = k % 2 == 1
        terms = [{"effect": EFFECTS[k // 2 % 2]}] if lacks else []
        out[name] = {"plant": "volumes", "kind": "one" if lacks else "nothing", "terms": terms}
    return out


def table_of(tmp_path: Path, extra_rows: bool, deals: int) -> Any:
    rng = np.random.default_rng(3)
    for name, key in keys().items():
        rows = int(rng.integers(20, 30)) + (12 if extra_rows and key["terms"] else 0)
        written(tmp_path / name, rng, rows, f"m{rng.integers(16**8):08x}")
    return leak_table(tmp_path, keys(), deals=deals).set_index("question")


def test_a_planted_leak_is_noticed(tmp_path: Path) -> None:
    table = table_of(tmp_path, extra_rows=True, deals=4)
    row = table.loc["is physics missing"]
    assert row["auc"] > 0.95 and row["low90"] > 0.9 and row["p"] == pytest.approx(0.2) and row["n"] == 44
    assert abs(row["chance"] - 0.5) < 0.1
    effect = table.loc["is it sun, among what is possible"]
    assert effect["n"] == 22


@pytest.mark.slow
def test_cases_by_lot_score_at_chance(tmp_path: Path) -> None:
    row = table_of(tmp_path, extra_rows=False, deals=1).loc["is physics missing"]
    assert row["low90"] < 0.5 and 0.2 < row["auc"] < 0.8


def test_real_recordings_and_few_cases_are_not_asked(tmp_path: Path) -> None:
    real = {name: {**key, "plant": "withheld"} for name, key in keys().items()}
    assert list(leak_table(tmp_path, real).columns) == list(COLUMNS) and leak_table(tmp_path, real).empty


def test_an_effect_is_sought_among_cases_that_could_have_it() -> None:
    twice = [*keys().values(), *keys().values()]
    answers = [{**k, "redraw": {"options": {"sunny": n % 3 > 0}}} for n, k in enumerate(twice)]
    asked = effect_questions(np.zeros((88, 1)), answers, lambda effect, options: effect != "sun" or options["sunny"])
    sun = next(q for q in asked if q.label.startswith("is it sun"))
    others = sum(k["terms"] == [{"effect": "floor_sink"}] and k["redraw"]["options"]["sunny"] for k in answers)
    assert sun.classes.sum() == 22 and len(sun.classes) == 22 + others < 44


def test_a_learner_answers_for_cases_it_has_not_seen() -> None:
    rng = np.random.default_rng(0)
    classes = rng.integers(0, 2, 80)
    told = predicted(rng.normal(size=(80, 30)), classes)
    np.testing.assert_allclose(told.sum(axis=1), 1.0)
    assert np.mean(told.argmax(axis=1) == classes) < 0.75  # a learner that had seen them would be right


@pytest.mark.parametrize("kinds", [2, 4])
def test_the_area_is_that_under_the_curve(kinds: int) -> None:
    rng = np.random.default_rng(kinds)
    classes = rng.integers(0, kinds, 60)
    told = np.round(rng.dirichlet(np.ones(kinds), 60) + 0.3 * np.eye(kinds)[classes], 1)  # with ties
    areas = [roc_auc_score(classes == k, told[:, k]) for k in range(kinds)]
    assert area_under_curve(classes, told) == pytest.approx(np.mean(areas))


@pytest.mark.slow
def test_features_tell_nothing_of_temperatures_and_errors(tmp_path: Path) -> None:
    """A built case and the same one without its effect: whatever differs is not among the features."""
    spec = next(s for s in small_suite() if s.kind == "one" and s.plant == "volumes")
    plain = CaseSpec(spec.name, "nothing", spec.plant, spec.seed, dict.fromkeys(spec.effects, 0.0), {}, spec.options)
    for name, given in (("with", spec), ("without", plain)):
        write_built(build(given), tmp_path / name)
    features = leak_features([tmp_path / "with", tmp_path / "without"])
    texts = [(tmp_path / n / "recordings").iterdir() for n in ("with", "without")]
    assert [p.read_text() for p in sorted(texts[0])] != [p.read_text() for p in sorted(texts[1])]
    different = {c for c in features if features[c].nunique(dropna=False) > 1}
    assert different <= {"bytes, mean", "bytes, sd"}
    assert {"rows, mean", "room level, mean", "spindle_rpm on, mean", "bodies spread mean"} <= set(features)
