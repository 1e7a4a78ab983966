"""The leak test: whether a classifier without temperatures and errors can predict the concealed effect of a case.

Two learners of different kinds, shrunk linear discriminants (Ledoit and Wolf 2004) and extremely randomised trees
(Geurts, Ernst and Wehenkel 2006), answer for cases left out; their mean is judged by the area under the ROC curve.
Chance is the performance of the same learners after permutation of the answers (Ojala and Garriga 2010, test 1), within
each plant, since plants may be distinguishable.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from numpy.typing import NDArray
from scipy.stats import rankdata
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.ensemble import ExtraTreesClassifier
from sklearn.model_selection import StratifiedKFold, cross_val_predict
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from threadpoolctl import threadpool_limits

from thermodrift_exam.proof.spec import SIMULATED

RARE = 0.03  # of the cases; a word of the machine file present or absent in fewer is no feature
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?$", re.IGNORECASE)


def leak_features(cases: Sequence[Path]) -> pd.DataFrame:
    """A row per case folder, a column per feature; no readings of sensors and probes. Unknown values are nan."""
    texts = [(folder / "machine.yml").read_text(encoding="utf-8") for folder in cases]
    described = [_described(text, folder / "recordings") for text, folder in zip(texts, cases, strict=True)]
    words = pd.DataFrame([_words(text) for text in texts]).notna()
    held = words.mean()
    words = words.loc[:, (held > RARE) & (held < 1 - RARE)].astype(float).add_prefix("word ")
    return pd.concat([pd.DataFrame(described), words], axis=1).astype(float)


def _described(text: str, recordings: Path) -> dict[str, float]:
    tree: Mapping[str, Any] = yaml.load(text, yaml.CSafeLoader)
    role = {name: str(given.get("role")) for name, given in tree["channels"].items()}
    return _machine(text, tree, list(role.values())) | _recordings(recordings, role)


def _machine(text: str, tree: Mapping[str, Any], roles: Sequence[str]) -> dict[str, float]:
    """Sizes of the file and of its parts, and statistics of its numbers."""
    twin = tree.get("twin") or {}
    name = str(tree["machine"])
    out: dict[str, float] = {
        "file characters": len(text),
        "file lines": text.count("\n"),
        "machine name length": len(name),
    }
    out |= {f"machine name {k}": ord(c) for k, c in enumerate(name[:8])}
    out |= {f"{role} channels": roles.count(role) for role in ("temperature", "ambient", "driver", "error")}
    out |= {f"{part} in the file": len(given) for part, given in sorted(twin.items()) if isinstance(given, Mapping)}
    errors = (twin.get("errors") or {}).values()
    out |= {kind: sum(len(e.get(kind) or ()) for e in errors) for kind in ("chain", "tilts")}
    for part, given in sorted(twin.items()):
        values = np.array([v for key, v in _numbers(given) if key == "value"])
        spreads = np.array([v for key, v in _numbers(given) if key == "spread"])
        size = np.log(np.abs(values[values != 0]))
        out |= {f"{part} value mean": _mean(size), f"{part} value sd": _sd(size)}
        out |= {f"{part} spread mean": _mean(spreads), f"{part} spread sd": _sd(spreads)}
    return {k: float(v) for k, v in out.items()}


def _words(text: str) -> dict[str, bool]:
    """Every key and every non-numeric word of the file."""
    return {word: True for word in re.findall(r"[A-Za-z_][\w-]*", text) if len(word) > 1}


def _numbers(tree: Any, key: str = "") -> list[tuple[str, float]]:
    """Numbers of a part of the file with the key that they stand at; of "12.5 W/K" the number."""
    if isinstance(tree, Mapping):
        return [found for k, v in tree.items() for found in _numbers(v, str(k))]
    if isinstance(tree, list):
        return [found for v in tree for found in _numbers(v, key)]
    first = str(tree).partition(" ")[0]
    return [(key, float(first))] if NUMBER.match(first) else []


def _recordings(folder: Path, role: Mapping[str, str]) -> dict[str, float]:
    """Rows, gaps, clocks, drivers and surroundings of the recordings: means and standard deviations over them."""
    rows = pd.DataFrame([_recording(path, role) for path in sorted(folder.iterdir())])
    out = {f"{c}, mean": _mean(rows[c].dropna()) for c in rows} | {f"{c}, sd": _sd(rows[c].dropna()) for c in rows}
    return out | {"recordings": float(len(rows))}


def _recording(path: Path, role: Mapping[str, str]) -> dict[str, float]:
    table = pd.read_csv(path, comment="#")
    clock = table["time_s"].to_numpy(float)
    steps = np.diff(clock)
    digits = [int(d) for d in re.findall(r"\d", path.stem)]
    out: dict[str, float] = {
        "bytes": path.stat().st_size, "rows": len(table), "columns": len(table.columns), "name length": len(path.stem),
        "first row": clock[0], "step": float(np.median(steps)), "step sd": float(np.std(steps)),
        "longest step": float(steps.max()), "end": clock[-1],
    }  # fmt: skip
    out |= {f"name digit {k}": float(d) for k, d in enumerate(digits[:14])}
    for kind in ("temperature", "ambient", "driver", "error"):
        own = table[[c for c in table.columns if role.get(str(c)) == kind]]
        out[f"{kind} columns"] = len(own.columns)
        out[f"{kind} cells empty"] = float(own.isna().to_numpy().mean()) if own.size else 0.0
        if kind in ("ambient", "driver"):
            for name in own:
                out |= _input(str(name), own[name].dropna().to_numpy(float))
    return out


def _input(name: str, values: np.ndarray) -> dict[str, float]:
    if not len(values):
        return {}
    changes = np.diff(values)
    return {
        f"{name} level": float(values.mean()), f"{name} scatter": float(values.std()),
        f"{name} top": float(values.max()), f"{name} on": float((values > 0).mean()),
        f"{name} changes": float((changes != 0).mean()), f"{name} drift": float(values[-1] - values[0]),
    }  # fmt: skip


def _mean(values: Any) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def _sd(values: Any) -> float:
    return float(np.std(values)) if len(values) else float("nan")


PLANTS = SIMULATED  # real recordings are public
SOUND = ("nothing", "decoy")
FOLDS = 5
LEAST = 2 * FOLDS  # cases of a class
RESAMPLED = 500
TREES = 20
ENOUGH = 10  # permutations as good as the truth at which the test stops (Besag and Clifford 1991)
COLUMNS = ("question", "auc", "low90", "high90", "chance", "p", "n")
Possible = Callable[[str, Mapping[str, Any]], bool]
Features = NDArray[np.float64]
Labels = NDArray[np.int64]


@dataclass(frozen=True)
class Question:
    """Features (n, F), classes (n,) from 0, and the group (n,) within which classes can be permuted."""

    label: str
    features: Features
    classes: Labels
    group: Labels


@threadpool_limits.wrap(limits=1)  # small matrices; results must not depend on threads
def leak_table(
    cases: Path,
    answers: Mapping[str, Mapping[str, Any]],
    possible: Possible | None = None,
    deals: int = 100,
    seed: int = 0,
    done: Callable[[str, int, int], None] | None = None,
) -> pd.DataFrame:
    """Columns `COLUMNS`: area under the curve with a bootstrap interval, chance, and the share of permutations as good.

    Questions: is physics missing, of which kind is the case, and which effect is it among those that the case's
    machine could have. A question with too few cases is left out.

    Args:
        cases: folder that holds one folder a case, by its name.
        possible: whether a case of these options (of the answer's `redraw`) could have an effect; None: all could.
    """
    names = [n for n in sorted(answers) if answers[n]["plant"] in PLANTS]
    if len(names) < 2 * LEAST:
        return pd.DataFrame(columns=list(COLUMNS))
    features = _filled(leak_features([cases / n for n in names]))
    keys = [answers[n] for n in names]
    questions = [*kind_questions(features, keys), *effect_questions(features, keys, possible)]
    rows = []
    for number, part in enumerate(questions):
        rows.append(_row(part, deals, np.random.default_rng([seed, number])))
        if done is not None:
            done("leak test", number + 1, len(questions))
    return pd.DataFrame(rows, columns=list(COLUMNS))


def _filled(features: pd.DataFrame) -> Features:
    """Features that differ between cases; what a case lacks gets a value far off."""
    known = features.fillna(features.min() - features.std().fillna(1.0) - 1.0).fillna(0.0).to_numpy(float)
    return np.asarray(known[:, np.ptp(known, axis=0) > 0])


def kind_questions(features: Features, keys: Sequence[Mapping[str, Any]]) -> list[Question]:
    plant = np.array([PLANTS.index(k["plant"]) for k in keys])
    kinds = pd.Series([str(k["kind"]) for k in keys])
    missing = np.array([k not in SOUND for k in kinds], dtype=np.int64)
    common = kinds.isin([k for k, n in kinds.value_counts().items() if n >= LEAST]).to_numpy()
    classes = pd.factorize(kinds[common], sort=True)[0]
    out = [Question("is physics missing", features, missing, plant)]
    if classes.max(initial=0) > 1:  # with two kinds it is the same question
        out.append(Question("kind of the case", features[common], classes, plant[common]))
    return [q for q in out if np.bincount(q.classes, minlength=2).min() >= LEAST]


def effect_questions(
    features: Features, keys: Sequence[Mapping[str, Any]], possible: Possible | None
) -> list[Question]:
    """For each effect: cases with it against those that could have it and have another one."""
    single = [k for k, key in enumerate(keys) if key["kind"] == "one"]
    effect = {k: str(keys[k]["terms"][0]["effect"]) for k in single}
    out = []
    for name in sorted(set(effect.values())):
        could = [k for k in single if effect[k] == name or possible is None or _could(possible, name, keys[k])]
        has = np.array([effect[k] == name for k in could], dtype=np.int64)
        if min(has.sum(), len(has) - has.sum()) >= LEAST:
            plant = np.array([PLANTS.index(keys[k]["plant"]) for k in could])
            out.append(Question(f"is it {name}, among what is possible", features[could], has, plant))
    return out


def _could(possible: Possible, effect: str, key: Mapping[str, Any]) -> bool:
    return possible(effect, key["redraw"]["options"])


def _row(
    question: Question, deals: int, rng: np.random.Generator
) -> tuple[str, float, float, float, float, float, int]:
    probability = predicted(question.features, question.classes)
    auc = area_under_curve(question.classes, probability)
    dealt: list[float] = []
    while len(dealt) < deals and sum(d >= auc for d in dealt) < ENOUGH:
        classes = _dealt(question.classes, question.group, rng)
        dealt.append(area_under_curve(classes, predicted(question.features, classes)))
    as_good = sum(d >= auc for d in dealt)
    p = as_good / len(dealt) if as_good == ENOUGH else (1 + as_good) / (1 + len(dealt))
    low, high = _interval(question.classes, probability, rng)
    return question.label, auc, low, high, float(np.mean(dealt)), p, len(question.classes)


def predicted(features: Features, classes: Labels) -> Features:
    """Probability of each class (n, C) by learners trained without the case."""
    linear = make_pipeline(StandardScaler(), LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto"))
    trees = ExtraTreesClassifier(TREES, min_samples_leaf=3, class_weight="balanced", random_state=0)
    folds = StratifiedKFold(FOLDS, shuffle=True, random_state=0)
    both = [cross_val_predict(m, features, classes, cv=folds, method="predict_proba") for m in (linear, trees)]
    return np.asarray(np.mean(both, axis=0))


def area_under_curve(classes: Labels, probability: Features) -> float:
    """Under the ROC curve, by ranks (Mann and Whitney 1947); of several classes the mean of each against the rest."""
    own = classes[:, None] == np.arange(probability.shape[1])
    has = own.sum(axis=0)
    ranks = np.where(own, rankdata(probability, axis=0), 0.0).sum(axis=0)
    return float(np.mean((ranks - has * (has + 1) / 2) / (has * (len(classes) - has))))


def _dealt(classes: Labels, group: Labels, rng: np.random.Generator) -> Labels:
    out = classes.copy()
    for g in np.unique(group):
        out[group == g] = rng.permutation(classes[group == g])
    return out


def _interval(classes: Labels, probability: Features, rng: np.random.Generator) -> tuple[float, float]:
    """90 % bootstrap interval, cases resampled within each class."""
    members = [np.flatnonzero(classes == c) for c in range(probability.shape[1])]
    areas = []
    for _ in range(RESAMPLED):
        drawn = np.concatenate([rng.choice(m, len(m)) for m in members])
        areas.append(area_under_curve(classes[drawn], probability[drawn]))
    low, high = np.quantile(areas, [0.05, 0.95])
    return float(low), float(high)
