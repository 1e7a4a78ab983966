"""The convergence of the plants as the proof's page takes it: which plants, which columns."""

from __future__ import annotations

from importlib import import_module

import pandas as pd
import pytest

from thermodrift_exam.proof import tables as proof_convergence
from thermodrift_exam.proof.report.tables import TABLES
from thermodrift_exam.proof.tables import STUDIES, convergence_of


@pytest.mark.parametrize("plant", STUDIES)
def test_a_study_gives_the_columns_of_the_page(plant: str) -> None:
    module = import_module(STUDIES[plant].__module__)
    assert set(TABLES["convergence"]) <= set(module.COLUMNS)


def test_studies_of_the_plants_stand_together_and_real_recordings_have_none(monkeypatch: pytest.MonkeyPatch) -> None:
    def study(plant: str) -> pd.DataFrame:
        return pd.DataFrame({c: [plant if c == "plant" else 1.0] for c in (*TABLES["convergence"], "more")})

    made = {"elements": lambda: study("elements"), "volumes": lambda: study("volumes")}
    monkeypatch.setattr(proof_convergence, "STUDIES", made)
    table = convergence_of(("elements", "volumes", "withheld"))
    assert list(table["plant"]) == ["elements", "volumes"] and list(table.columns) == list(TABLES["convergence"])
    assert convergence_of(("withheld",)).empty
