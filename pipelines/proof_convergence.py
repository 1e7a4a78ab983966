"""How the simulated plants' own numerics converge, for the page of the proof."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from data.registry import Registry
from pipelines.report.proof_run import TABLES

# Called without arguments; gives the columns of the page's table.
STUDIES = Registry(
    "convergence study",
    {"elements": "twin.plants.elements.convergence:study", "volumes": "twin.plants.volumes.convergence:study"},
)


def convergence_of(plants: Sequence[str]) -> pd.DataFrame:
    """One row a plant, quantity and refinement; real recordings have none. Tens of seconds a plant."""
    studied = [STUDIES[p]() for p in plants if p in STUDIES]
    columns = list(TABLES["convergence"])
    return pd.concat(studied, ignore_index=True)[columns] if studied else pd.DataFrame(columns=columns)
