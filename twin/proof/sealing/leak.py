"""The leak test: can a classifier that sees no temperature and no error tell what a case conceals? It must not.

Two learners of different kinds, shrunk linear discriminants (Ledoit and Wolf 2004) and extremely randomised trees
(Geurts, Ernst and Wehenkel 2006), answer for cases left out; their mean is judged by the area under the ROC curve.
Chance is what the same learners reach after the answers were dealt anew (Ojala and Garriga 2010, test 1), within each
plant, since a plant may be told from another.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import rankdata
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.ensemble import ExtraTreesClassifier
from sklearn.model_selection import StratifiedKFold, cross_val_predict
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from threadpoolctl import threadpool_limits

from twin.proof.sealing.leak_features import leak_features

PLANTS = ("elements", "volumes")  # real recordings are public, and are no secret
SOUND = ("nothing", "decoy")
FOLDS = 5
LEAST = 2 * FOLDS  # cases of a class
RESAMPLED = 500
TREES = 20
ENOUGH = 10  # deals as good as the truth: more of them would not change the verdict (Besag and Clifford 1991)
COLUMNS = ("question", "auc", "low90", "high90", "chance", "p", "n")
Possible = Callable[[str, Mapping[str, Any]], bool]
Features = NDArray[np.float64]
Labels = NDArray[np.int64]


@dataclass(frozen=True)
class Question:
    """Features (n, F), classes (n,) from 0, and the group (n,) within which classes could be dealt anew."""

    words: str
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
    """Columns `COLUMNS`: area under the curve with a bootstrap interval, chance, and the share of deals as good.

    Asked are: is physics missing, of which kind is the case, and which effect is it among those that the case's
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
    asked = [*_kinds(features, keys), *_effects(features, keys, possible)]
    rows = []
    for number, part in enumerate(asked):
        rows.append(_row(part, deals, np.random.default_rng([seed, number])))
        if done is not None:
            done("leak test", number + 1, len(asked))
    return pd.DataFrame(rows, columns=list(COLUMNS))


def _filled(features: pd.DataFrame) -> Features:
    """Features that differ between cases; what a case lacks is told by a value far off."""
    known = features.fillna(features.min() - features.std().fillna(1.0) - 1.0).fillna(0.0).to_numpy(float)
    return np.asarray(known[:, np.ptp(known, axis=0) > 0])


def _kinds(features: Features, keys: Sequence[Mapping[str, Any]]) -> list[Question]:
    plant = np.array([PLANTS.index(k["plant"]) for k in keys])
    kinds = pd.Series([str(k["kind"]) for k in keys])
    missing = np.array([k not in SOUND for k in kinds], dtype=np.int64)
    common = kinds.isin([k for k, n in kinds.value_counts().items() if n >= LEAST]).to_numpy()
    classes = pd.factorize(kinds[common], sort=True)[0]
    out = [Question("is physics missing", features, missing, plant)]
    if classes.max(initial=0) > 1:  # of two it would be the same question again
        out.append(Question("kind of the case", features[common], classes, plant[common]))
    return [q for q in out if np.bincount(q.classes, minlength=2).min() >= LEAST]


def _effects(features: Features, keys: Sequence[Mapping[str, Any]], possible: Possible | None) -> list[Question]:
    """For each effect: cases that have it against those that could have it and have another."""
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


def _row(asked: Question, deals: int, rng: np.random.Generator) -> tuple[str, float, float, float, float, float, int]:
    told = _told(asked.features, asked.classes)
    auc = _area(asked.classes, told)
    dealt: list[float] = []
    while len(dealt) < deals and sum(d >= auc for d in dealt) < ENOUGH:
        classes = _dealt(asked.classes, asked.group, rng)
        dealt.append(_area(classes, _told(asked.features, classes)))
    as_good = sum(d >= auc for d in dealt)
    p = as_good / len(dealt) if as_good == ENOUGH else (1 + as_good) / (1 + len(dealt))
    low, high = _interval(asked.classes, told, rng)
    return asked.words, auc, low, high, float(np.mean(dealt)), p, len(asked.classes)


def _told(features: Features, classes: Labels) -> Features:
    """Probability of each class (n, C) by learners that have not seen the case."""
    linear = make_pipeline(StandardScaler(), LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto"))
    trees = ExtraTreesClassifier(TREES, min_samples_leaf=3, class_weight="balanced", random_state=0)
    folds = StratifiedKFold(FOLDS, shuffle=True, random_state=0)
    both = [cross_val_predict(m, features, classes, cv=folds, method="predict_proba") for m in (linear, trees)]
    return np.asarray(np.mean(both, axis=0))


def _area(classes: Labels, told: Features) -> float:
    """Under the ROC curve, by ranks (Mann and Whitney 1947); of several classes the mean of each against the rest."""
    own = classes[:, None] == np.arange(told.shape[1])
    has = own.sum(axis=0)
    ranks = np.where(own, rankdata(told, axis=0), 0.0).sum(axis=0)
    return float(np.mean((ranks - has * (has + 1) / 2) / (has * (len(classes) - has))))


def _dealt(classes: Labels, group: Labels, rng: np.random.Generator) -> Labels:
    out = classes.copy()
    for g in np.unique(group):
        out[group == g] = rng.permutation(classes[group == g])
    return out


def _interval(classes: Labels, told: Features, rng: np.random.Generator) -> tuple[float, float]:
    """90 %, cases of each class drawn anew."""
    members = [np.flatnonzero(classes == c) for c in range(told.shape[1])]
    areas = []
    for _ in range(RESAMPLED):
        drawn = np.concatenate([rng.choice(m, len(m)) for m in members])
        areas.append(_area(classes[drawn], told[drawn]))
    low, high = np.quantile(areas, [0.05, 0.95])
    return float(low), float(high)
