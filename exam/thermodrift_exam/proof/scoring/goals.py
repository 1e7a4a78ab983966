"""The goals of the proof, fixed before any case is drawn, and the intervals of the measured values.

Each entry of `GOALS` names a measure, the cases over which it is taken, and the value wanted. Shares have exact
binomial intervals, other statistics bootstrap intervals over whole cases.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import stats

from thermodrift_exam.proof.scoring.outcomes import visible_physics

LEVEL = 0.9
DRAWS = 1000
Statistic = Callable[[NDArray[np.float64]], float]


def clopper_pearson(right: int, n: int) -> tuple[float, float]:
    """Exact interval of a share (Clopper and Pearson 1934); 0 and 1 of no cases."""
    if n == 0:
        return 0.0, 1.0
    low, high = stats.binomtest(right, n).proportion_ci(LEVEL, method="exact")
    return float(low), float(high)


def bootstrap(values: pd.Series, statistic: Statistic, seed: int = 0) -> tuple[float, float]:
    """Percentile interval (Efron 1979) of a statistic; whole cases (the index) are drawn, as their terms agree.

    Raises:
        ValueError: no values.
    """
    ordered = values.sort_index(kind="stable")
    _, first = np.unique(ordered.index.to_numpy(), return_index=True)
    groups = np.split(np.asarray(ordered, float), first[1:])
    return of_groups(groups, lambda chosen: statistic(np.concatenate(chosen)), seed)


def of_groups(
    groups: Sequence[NDArray[np.float64]], statistic: Callable[[Sequence[NDArray[np.float64]]], float], seed: int = 0
) -> tuple[float, float]:
    """The same for a statistic of groups that are resampled as a whole."""
    if not groups:
        raise ValueError("bootstrap: no values")
    if len(groups) == 1:
        only = float(statistic(groups))
        return only, only
    found = stats.bootstrap(
        (np.arange(len(groups)),),
        lambda drawn: statistic([groups[k] for k in drawn]),
        n_resamples=DRAWS,
        vectorized=False,
        confidence_level=LEVEL,
        method="percentile",
        rng=seed,
    )
    return float(found.confidence_interval.low), float(found.confidence_interval.high)


Select = Callable[[pd.DataFrame, pd.DataFrame], pd.Series]
Sizes = Callable[[pd.DataFrame, pd.DataFrame], pd.DataFrame]
Better = Literal["higher", "lower"]


@dataclass(frozen=True)
class Wanted:
    """The value wanted of a measure: a share, or a number with its unit."""

    measure: str
    wanted: float
    better: Better
    unit: str | None = field(default=None, kw_only=True)

    @property
    def label(self) -> str:
        """``≥ 97 %``"""
        sign = "≥" if self.better == "higher" else "≤"
        wanted = f"{100 * self.wanted:g} %" if self.unit is None else f"{self.wanted:g} {self.unit}".strip()
        return f"{sign} {wanted}"

    def met(self, value: float) -> bool:
        return value >= self.wanted if self.better == "higher" else value <= self.wanted


@dataclass(frozen=True)
class Goal(Wanted):
    """One goal. `of` gives the values from outcomes and terms, indexed by case; `statistic` None: a share of yes or no.

    `informed` gives the same values for the true model, which contains all concealed effects and claims those that pass
    the thresholds of a claim: effects that it misses are not supported by the recordings. None: not defined.
    """

    of: Select
    statistic: Statistic | None = None
    informed: Select | None = field(default=None, kw_only=True)


def quantile(share: float) -> Statistic:
    return lambda values: float(np.quantile(values, share))


def mean(values: NDArray[np.float64]) -> float:
    return float(np.mean(values))


def _cases(column: str, *kinds: str, visible: bool = False) -> Select:
    """A column of the cases of these kinds (none named: all), of those only that are visible."""

    def select(outcomes: pd.DataFrame, terms: pd.DataFrame) -> pd.Series:
        at = outcomes["kind"].isin(kinds) if kinds else pd.Series(True, outcomes.index)
        if visible:
            at &= outcomes["visible"].fillna(False).astype(bool)
        return _known(outcomes[at], column)

    return select


def _known(rows: pd.DataFrame, column: str) -> pd.Series:
    return rows.set_index("case")[column].dropna()


def _false_alarms(outcomes: pd.DataFrame, terms: pd.DataFrame) -> pd.Series:
    return _cases("false_claims", "nothing", "decoy")(outcomes, terms) > 0


def _all_visible(kind: str) -> Select:
    """`all_named` of the cases in which every term is visible."""

    def select(outcomes: pd.DataFrame, terms: pd.DataFrame) -> pd.Series:
        at = (outcomes["kind"] == kind) & (outcomes["visible_terms"] == outcomes["terms"]).fillna(False)
        return _known(outcomes[at], "all_named")

    return select


def _claims_of_two(outcomes: pd.DataFrame, terms: pd.DataFrame) -> pd.Series:
    """Every claim of a case with two effects: whether it is true."""
    rows = outcomes[(outcomes["kind"] == "two") & outcomes["claims"].notna()]
    true = {
        case: [True] * max(int(claims) - int(false), 0) + [False] * int(false)
        for case, claims, false in zip(rows["case"], rows["claims"], rows["false_claims"], strict=True)
    }
    index = [case for case, own in true.items() for _ in own]
    return pd.Series([v for own in true.values() for v in own], index=index, dtype="boolean")


def _sized(outcomes: pd.DataFrame, terms: pd.DataFrame) -> pd.DataFrame:
    """Visible physics that is found, with an amplitude in key and finding."""
    rows = visible_physics(terms)
    return _both_stated(rows[rows["found"].fillna(False).astype(bool)])


def _both_stated(rows: pd.DataFrame) -> pd.DataFrame:
    at = rows["amplitude_true"].notna() & rows["amplitude_found"].notna()
    return rows[at & (rows["amplitude_true"] != 0)].set_index("case")


def _amplitude_error(sizes: Sizes) -> Select:
    def select(outcomes: pd.DataFrame, terms: pd.DataFrame) -> pd.Series:
        rows = sizes(outcomes, terms)
        return (rows["amplitude_found"] - rows["amplitude_true"]).abs() / rows["amplitude_true"].abs()

    return select


def _covered(sizes: Sizes) -> Select:
    def select(outcomes: pd.DataFrame, terms: pd.DataFrame) -> pd.Series:
        rows = sizes(outcomes, terms).dropna(subset=["low90", "high90"])
        return (rows["low90"] <= rows["amplitude_true"]) & (rows["amplitude_true"] <= rows["high90"])

    return select


def _claimable(terms: pd.DataFrame) -> pd.DataFrame:
    """Visible physics with a candidate; `passes`: whether its gain in the true model passes the thresholds."""
    rows = visible_physics(terms)
    rows = rows[rows["gain_nats"].notna() & rows["bar_nats"].notna()]
    return rows.assign(passes=(rows["gain_nats"] > rows["bar_nats"]).astype(bool))


def _informed(*kinds: str) -> Select:
    """By case of these kinds (none named: all) with a visible effect that a candidate describes: whether one passes."""

    def select(outcomes: pd.DataFrame, terms: pd.DataFrame) -> pd.Series:
        rows = _claimable(terms)
        return (rows[rows["kind"].isin(kinds)] if kinds else rows).groupby("case")["passes"].any()

    return select


def _informed_all(kind: str) -> Select:
    def select(outcomes: pd.DataFrame, terms: pd.DataFrame) -> pd.Series:
        named = _claimable(terms).groupby("case")["passes"].all()
        at = (outcomes["kind"] == kind) & (outcomes["visible_terms"] == outcomes["terms"]).fillna(False)
        return named[named.index.isin(outcomes.loc[at, "case"])]

    return select


def _informed_sizes(outcomes: pd.DataFrame, terms: pd.DataFrame) -> pd.DataFrame:
    """Those that pass, with the amplitudes of the true model in place of those found."""
    rows = _claimable(terms).drop(columns=["amplitude_found", "low90", "high90"])
    rows = rows.rename(columns=lambda c: {"informed_amplitude": "amplitude_found"}.get(c, c.removeprefix("informed_")))
    return _both_stated(rows[rows["passes"]])


def _falsely_flagged(outcomes: pd.DataFrame, terms: pd.DataFrame) -> pd.Series:
    return _known(outcomes[outcomes["kind"] != "unlisted"], "flagged_unlisted")


ONE = ("one", "invisible")  # of one listed effect each; the true model decides which are visible


def _one(column: str) -> Select:
    """A column of the cases with one visible effect."""
    return _cases(column, *ONE, visible=True)


_ERROR, _INFORMED_ERROR = _amplitude_error(_sized), _amplitude_error(_informed_sizes)
_COVERED, _INFORMED_COVERED = _covered(_sized), _covered(_informed_sizes)
_CLOSED = _cases("closed", "one", visible=True)
_BY_ONE, _BY_UNLISTED = _informed(*ONE), _informed("unlisted")
_FLAGGED = _cases("flagged_unlisted", "unlisted", visible=True)
_DRIVEN = _cases("driver_right", "unlisted", visible=True)
_SETTLED, _HOLDS = (_cases(column, "confounded", visible=True) for column in ("settled", "set_holds_truth"))
GOALS: tuple[Goal, ...] = (
    Goal("false alarms, nothing missing", 0.01, "lower", _false_alarms),
    Goal("detection, visible", 0.97, "higher", _cases("detected", visible=True), informed=_informed()),
    Goal("place exact, one visible effect", 0.92, "higher", _one("place_exact"), informed=_BY_ONE),
    Goal("place exact or neighbour, one visible effect", 0.99, "higher", _one("place_near"), informed=_BY_ONE),
    Goal("mechanism first, one visible effect", 0.95, "higher", _one("first_right"), informed=_BY_ONE),
    Goal("mechanism within the reported set", 0.98, "higher", _one("in_set"), informed=_BY_ONE),
    Goal("mean size of the reported set", 2.0, "lower", _one("set_size"), mean, unit="explanations"),
    Goal("when: overlap in time, mean", 0.8, "higher", _one("overlap"), mean, unit=""),
    Goal("amplitude error, median", 0.12, "lower", _ERROR, quantile(0.5), informed=_INFORMED_ERROR),
    Goal("amplitude error, 90 % quantile", 0.40, "lower", _ERROR, quantile(0.9), informed=_INFORMED_ERROR),
    Goal("90 % intervals that cover, at least", 0.85, "higher", _COVERED, informed=_INFORMED_COVERED),
    Goal("90 % intervals that cover, at most", 0.95, "lower", _COVERED, informed=_INFORMED_COVERED),
    Goal("left-out error closed, median", 0.95, "higher", _CLOSED, quantile(0.5), informed=_informed("one")),
    Goal("left-out error closed, worst tenth", 0.80, "higher", _CLOSED, quantile(0.1), informed=_informed("one")),
    Goal("two visible effects: both named", 0.85, "higher", _all_visible("two"), informed=_informed_all("two")),
    Goal("two effects: claims that are true", 0.97, "higher", _claims_of_two),
    Goal("three visible effects: all named", 0.65, "higher", _all_visible("three"), informed=_informed_all("three")),
    Goal("confounded: the set holds the truth", 0.97, "higher", _HOLDS, informed=_informed("confounded")),
    Goal("confounded: the proposed run settles it", 0.90, "higher", _SETTLED),
    Goal("unlisted: flagged", 0.95, "higher", _FLAGGED, informed=_BY_UNLISTED),
    Goal("listed or nothing: falsely flagged as unlisted", 0.03, "lower", _falsely_flagged),
    Goal("unlisted: driver found", 0.85, "higher", _DRIVEN, informed=_BY_UNLISTED),
    Goal("time of one case, median", 30.0, "lower", _cases("seconds"), quantile(0.5), unit="s"),
    Goal("time of one case, 90 % quantile", 30.0, "lower", _cases("seconds"), quantile(0.9), unit="s"),
)
