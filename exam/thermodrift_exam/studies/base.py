"""A study: a published system repeated on simulated machines, its figures and orderings as data.

To add one: a class below `Study` in a file of its own and a line in `studies/__init__.py`. A seed is another
machine and another year of it. An ordering states which figures the source found to be less than which; how
often that holds over the seeds is counted, never asserted.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import binomtest
from threadpoolctl import threadpool_limits

from data.arrays import Array
from data.errors import InputError
from data.processes import Processes
from features.design import Design
from features.selectors import SELECTORS
from models.base import Family
from models.metrics import residual_std_um
from thermodrift_exam.studies import STUDIES


@dataclass(frozen=True)
class Figure:
    """One number of a study, per seed: label, unit, and the published value (None: not published)."""

    key: str
    label: str
    unit: str = "µm"
    published: float | None = None
    digits: int = 2


@dataclass(frozen=True)
class Ordering:
    """A claim about figures: of every pair in `less` the first is less than the second, in one and the same seed.

    `published_gain` is the printed part by which the first pair's smaller lies below its greater, 1 − a/b. Evidence is
    an ordering that no source printed: `evidence_for` names the ordering that it is to explain. `why` explains, with
    the means of figures in braces, a claim that does not hold here.
    """

    key: str
    label: str
    less: tuple[tuple[str, str], ...]
    published_gain: float | None = None
    evidence_for: str = ""
    why: str = ""

    def holds(self, values: Mapping[str, float]) -> bool:
        """Whether one seed's figures are in this order; a figure that is not a number is in none."""
        return all(values[a] < values[b] for a, b in self.less)


class Study(ABC):
    """A published system. `assumed` are the things its description leaves open and what stands for them here.

    `remarks` on the figures themselves hold means of figures in braces.
    """

    key: ClassVar[str]
    title: ClassVar[str]
    summary: ClassVar[str]
    source: ClassVar[str]
    machine: ClassVar[str]
    assumed: ClassVar[tuple[str, ...]]
    remarks: ClassVar[tuple[str, ...]] = ()
    figures: ClassVar[tuple[Figure, ...]]
    orderings: ClassVar[tuple[Ordering, ...]]

    @abstractmethod
    def run(self, seed: int) -> dict[str, float]:
        """Every figure of `figures` on one simulated machine-year; the same seed gives the same numbers."""


CONFIDENCE = 0.95


@dataclass(frozen=True)
class StudyResult:
    """`table`: one row per seed and figure with the columns study, seed, figure, value. All of it is simulated."""

    study: type[Study]
    seeds: tuple[int, ...]
    table: pd.DataFrame

    @classmethod
    def of(cls, study: type[Study], runs: Sequence[tuple[int, dict[str, float]]]) -> StudyResult:
        """From (seed, figures) pairs."""
        rows = [(study.key, seed, figure, value) for seed, figures in runs for figure, value in figures.items()]
        table = pd.DataFrame(rows, columns=["study", "seed", "figure", "value"])
        return cls(study, tuple(seed for seed, _ in runs), table)

    @property
    def wide(self) -> pd.DataFrame:
        """A row per seed, a column per figure, in the study's order."""
        table = self.table.pivot(index="seed", columns="figure", values="value")
        return table.loc[list(self.seeds), [f.key for f in self.study.figures]]

    def by_seed(self, names: Sequence[str]) -> list[dict[str, float]]:
        """The named figures of every seed."""
        return self.wide[list(names)].astype(float).to_dict("records")  # type: ignore[return-value]

    def figures(self) -> pd.DataFrame:
        """One row per figure: figure, words, unit, published (NaN: not printed), mean, sd (ddof 1), p5, p95, digits."""
        wide = self.wide
        rows = []
        for f in self.study.figures:
            values = wide[f.key].to_numpy(float)
            values = values[np.isfinite(values)]
            rows.append(
                {
                    "study": self.study.key,
                    "figure": f.key,
                    "words": f.label,
                    "unit": f.unit,
                    "published": np.nan if f.published is None else f.published,
                    "mean": values.mean() if len(values) else np.nan,
                    "sd": values.std(ddof=1) if len(values) > 1 else np.nan,
                    "p5": np.quantile(values, 0.05) if len(values) else np.nan,
                    "p95": np.quantile(values, 0.95) if len(values) else np.nan,
                    "seeds": len(values),
                    "digits": f.digits,
                }
            )
        return pd.DataFrame(rows)

    @property
    def remarks(self) -> tuple[str, ...]:
        """The study's remarks with this run's means."""
        return tuple(self._filled(text) for text in self.study.remarks)

    def _filled(self, text: str) -> str:
        wide = self.wide
        means = {f.key: f"{wide[f.key].mean():.{f.digits}f}".replace("-", "−") for f in self.study.figures}
        return text.format_map(means)

    def orderings(self) -> pd.DataFrame:
        """One row per ordering, evidence after the ordering that it explains.

        Columns: ordering, words, evidence_for, why (with the means), held (seeds), seeds, share, low and high (95 % by
        Clopper and Pearson 1934), verdict (`holds` where low > ½, `fails` where high < ½, else `undecided`),
        published_gain and gain, the median over the seeds of 1 − a/b of the first pair, with gain_p5 and gain_p95.
        """
        rows = []
        for o in self.study.orderings:
            names = list(dict.fromkeys(name for pair in o.less for name in pair))
            known = [v for v in self.by_seed(names) if np.isfinite(list(v.values())).all()]
            held, n = sum(o.holds(v) for v in known), len(known)
            low, high = (0.0, 1.0) if n == 0 else binomtest(held, n).proportion_ci(CONFIDENCE, "exact")
            a, b = o.less[0]
            with np.errstate(divide="ignore", invalid="ignore"):
                gain = 1 - np.array([v[a] for v in known]) / np.array([v[b] for v in known])
            rows.append(
                {
                    "study": self.study.key,
                    "ordering": o.key,
                    "words": o.label,
                    "evidence_for": o.evidence_for,
                    "why": self._filled(o.why),
                    "held": held,
                    "seeds": n,
                    "share": held / n if n else np.nan,
                    "low": float(low),
                    "high": float(high),
                    "verdict": "holds" if low > 0.5 else "fails" if high < 0.5 else "undecided",
                    "published_gain": np.nan if o.published_gain is None else o.published_gain,
                    "gain": float(np.median(gain)) if n else np.nan,
                    "gain_p5": float(np.quantile(gain, 0.05)) if n else np.nan,
                    "gain_p95": float(np.quantile(gain, 0.95)) if n else np.nan,
                }
            )
        table = pd.DataFrame(rows)
        order = [r for o in self.study.orderings if not o.evidence_for
                 for r in range(len(rows)) if o.key in (rows[r]["ordering"], rows[r]["evidence_for"])]  # fmt: skip
        return table.loc[order].reset_index(drop=True)


Job = tuple[type[Study], int]


def run_studies(
    keys: Sequence[str], seeds: int, workers: int = 1, progress: Callable[[str, int, int], None] | None = None
) -> dict[str, StudyResult]:
    """Every study on seeds 0 … `seeds` − 1. `progress` is called with a label, the number done and the total.

    Raises:
        InputError: an unknown study, or fewer than 2 seeds (a spread needs two).
    """
    if seeds < 2:
        raise InputError(f"reproduce: seeds is {seeds}; expected at least 2, for a spread, and 20 for a verdict")
    jobs: list[Job] = [(STUDIES[key], seed) for key in keys for seed in range(seeds)]
    done: dict[str, list[tuple[int, dict[str, float]]]] = {key: [] for key in keys}

    def note(job: Job, figures: dict[str, float]) -> None:
        study, seed = job
        done[study.key].append((seed, figures))
        if progress:
            progress(f"{study.title}, seed {seed}", sum(map(len, done.values())), len(jobs))

    with Processes(workers) as pool:
        for job, figures in zip(jobs, pool.map(_run, jobs), strict=True):
            note(job, figures)
    return {key: StudyResult.of(STUDIES[key], runs) for key, runs in done.items()}


def _run(job: Job) -> dict[str, float]:
    study, seed = job
    with threadpool_limits(limits=1):
        return study().run(seed)


Inputs = tuple[str, ...]


def choices(design: Design, selector: str, trains: Sequence[Sequence[int]], n_tsp: int) -> list[Inputs]:
    """The inputs that a selector takes in every training set, from that set alone."""
    return [SELECTORS[selector]().select_design(design, train, [n_tsp])[n_tsp] for train in trains]


def predictions_um(design: Design, family: Family, trains: Sequence[Sequence[int]], inputs: Sequence[Inputs]) -> Array:
    """Predictions (n, F) on all rows by F models, model f fitted on the batches `trains[f]` with `inputs[f]`.

    The family in its published form, with a free level.
    """
    family = family.as_published()
    everything = range(design.n_batches)
    out = np.empty((len(design.y_um), len(trains)))
    for same in dict.fromkeys(inputs):
        which = [f for f, i in enumerate(inputs) if i == same]
        part = design.subset(same)
        fitted = family.fit_folds(part, [trains[f] for f in which])
        for f, batches in zip(which, family.predict_folds(part, fitted, [everything] * len(which)), strict=True):
            out[:, f] = np.concatenate(batches)
    return out


def residual_stds_um(design: Design, predicted_um: Array) -> Array:
    """S (F, K) in µm of F models on K batches."""
    error_um = design.y_um[:, None] - predicted_um
    return np.array(
        [[residual_std_um(error_um[design.rows(k), f]) for k in range(design.n_batches)]
         for f in range(predicted_um.shape[1])]
    )  # fmt: skip


def accuracy_and_robustness_um(S_um: Array, tested: NDArray[np.bool_]) -> tuple[float, float]:
    """Mean over the models of the mean and of the std (ddof 1) of S (F, K) over the batches each is tested on."""
    rows = [s[t] for s, t in zip(S_um, tested, strict=True)]
    return float(np.mean([r.mean() for r in rows])), float(np.mean([r.std(ddof=1) for r in rows]))
