"""Every threshold of the diagnosis stands in its policy, with a unit, a reason and its evidence."""

from __future__ import annotations

import ast
from dataclasses import FrozenInstanceError, fields
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from sklearn.linear_model import LogisticRegression

from diagnosis.policy import POLICY, STAGES, Policy, markdown
from diagnosis.search.claims import Figures

ROOT = Path(__file__).parents[2]
# Numerics and presentation: grids, guards against division by zero, digits, widths, axes of tables.
NO_DECISION = {
    "export/machine_file.py": {"PRIOR_SAME", "SAME"},
    "export/yaml_text.py": {"WIDTH", "DIGITS"},
    "drafting/first_guess.py": {"LAWS"},  # the powers in which laws state their drivers
    "drafting/groups.py": {"DIFFERENCE_ORDERS", "NORMAL_MEDIAN"},
    "findings/report_data.py": {"ACF_LAGS"},
    "findings/schema.py": {"DIGITS", "LARGEST_PROBABILITY"},
    "findings/statement.py": {"_DIGITS", "_MAX_NAMED"},
    "fitting/marginal.py": {"TINY"},
    "localisation/free_series.py": {"STEP_HALVINGS", "UNUSED_CORNER"},
    "localisation/linearised.py": {"MAX_MODAL_VALUES"},
    "localisation/where_when.py": {"CLOCK_EDGES_H", "MAX_DRIVER_LEVELS", "SINCE_START_EDGES_MIN"},
    "screening/screen.py": {"NO_TRACE"},
    "fitting/signatures.py": {"EVEN_STEPS", "NEARLY_OFF"},
}  # fmt: skip


def numeric(node: ast.expr) -> bool:
    """Whether an expression holds numbers and nothing else that is named."""
    kinds = {type(n.value) for n in ast.walk(node) if isinstance(n, ast.Constant)}
    return bool(kinds & {int, float}) and not any(isinstance(n, ast.Call) for n in ast.walk(node))


def constants(text: str) -> set[str]:
    """Module-level upper-case names that are assigned numbers."""
    found: set[str] = set()
    for node in ast.parse(text).body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [n for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)]
            values = (
                node.value.elts if isinstance(node.value, ast.Tuple) and len(names) > 1 else [node.value] * len(names)
            )
            found |= {n.id for n, v in zip(names, values, strict=True) if n.id.isupper() and numeric(v)}
    return found


def test_no_other_module_assigns_a_threshold() -> None:
    room = ROOT / "diagnosis"
    found = {
        path.relative_to(room).as_posix(): names
        for path in sorted(room.rglob("*.py"))
        if path.name != "policy.py" and (names := constants(path.read_text(encoding="utf-8")))
    }
    beyond = {name: sorted(own - NO_DECISION.get(name, set())) for name, own in found.items()}
    assert {name: own for name, own in beyond.items() if own} == {}, "put it into diagnosis/policy.py"


def test_numbers_are_seen_however_they_are_assigned() -> None:
    text = "A, B = 1.0, 'b'\nC: float = 2\nD = (1, 2)\nE = {'um': 0.1}\nF = 'text'\nG = len('abc')\nh = 3\n_I = -4\n"
    assert constants(text) == {"A", "C", "D", "E", "_I"}


@pytest.mark.parametrize("field", fields(Policy), ids=lambda f: f.name)
def test_every_threshold_has_a_unit_a_reason_and_its_evidence(field: object) -> None:
    metadata = field.metadata  # type: ignore[attr-defined]
    assert metadata["unit"] and len(metadata["reason"]) > 10
    known = ("analytic", "physical", "development plants", "computing time", "convention")
    assert metadata["evidence"] in known


def test_a_policy_is_not_changed_in_place() -> None:
    with pytest.raises(FrozenInstanceError):
        POLICY.max_effects = 9  # type: ignore[misc]
    assert Policy() == POLICY and set(STAGES) <= {f.name for f in fields(Policy)}


def test_the_documentation_shows_the_policy() -> None:
    """After a change: ``python -m diagnosis.policy > docs/policy.md``."""
    assert (ROOT / "docs" / "policy.md").read_text(encoding="utf-8") == "\n".join(markdown()) + "\n"


def test_the_probability_of_a_claim_is_the_fit_to_the_stored_claims() -> None:
    stored = pd.read_csv(ROOT / "results" / "claims.csv")
    x, right = np.log(np.maximum(stored[["relative_gain"]].to_numpy(), 1e-9)), stored["right"] == "yes"
    fit = LogisticRegression(C=1e6).fit(x, right)
    assert (POLICY.claim_offset, POLICY.claim_weight) == pytest.approx((fit.intercept_[0], fit.coef_[0, 0]), abs=0.01)
    probabilities = [Figures(gain, 0.0, 1.0, 1.0).probability for gain in stored["relative_gain"]]
    assert np.mean(probabilities) == pytest.approx(right.mean(), abs=0.01)
