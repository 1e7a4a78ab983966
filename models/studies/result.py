"""What a study came to over its seeds: one tidy table, and from it figures with their spread and orderings counted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from models.studies.base import Study

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
        return [
            {n: float(v) for n, v in zip(names, row, strict=True)} for row in self.wide[list(names)].to_numpy(float)
        ]

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
                    "words": f.words,
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
        return tuple(self._said(text) for text in self.study.remarks)

    def _said(self, text: str) -> str:
        wide = self.wide
        means = {f.key: f"{wide[f.key].mean():.{f.digits}f}".replace("-", "−") for f in self.study.figures}
        return text.format_map(means)

    def orderings(self) -> pd.DataFrame:
        """One row per ordering, evidence behind what it explains.

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
                    "words": o.words,
                    "evidence_for": o.evidence_for,
                    "why": self._said(o.why),
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
