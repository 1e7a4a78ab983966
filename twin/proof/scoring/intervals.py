"""How far a share, a mean or a quantile of so few cases may be from the truth: 90 % intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import beta

LEVEL = 0.9
DRAWS = 1000
Statistic = Callable[[NDArray[np.float64]], float]


def clopper_pearson(right: int, n: int) -> tuple[float, float]:
    """Exact interval of a share (Clopper and Pearson 1934); 0 and 1 of no cases."""
    tail = (1.0 - LEVEL) / 2.0
    low = float(beta.ppf(tail, right, n - right + 1)) if right > 0 else 0.0
    high = float(beta.ppf(1.0 - tail, right + 1, n - right)) if right < n else 1.0
    return low, high


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
    """The same of any statistic of groups that are drawn whole."""
    if not groups:
        raise ValueError("bootstrap: no values")
    rng = np.random.default_rng(seed)
    drawn = [statistic([groups[k] for k in rng.integers(len(groups), size=len(groups))]) for _ in range(DRAWS)]
    tail = (1.0 - LEVEL) / 2.0
    low, high = np.quantile(drawn, [tail, 1.0 - tail])
    return float(low), float(high)
