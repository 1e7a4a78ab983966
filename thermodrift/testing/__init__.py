"""Contract suites: what a plug-in promises, as checks that its author runs on it.

Each `check_…` takes a class (or the key of a registered one) and runs named checks::

    td.testing.check_family(NearestBatch)

    @pytest.mark.parametrize("check", td.testing.check_family(NearestBatch, generate_only=True), ids=str)
    def test_contract(check):
        check()

A failure is a `ContractError` (an AssertionError) that says what was expected, what came and why it matters. The suites
need no test framework. The registered plug-ins pass the same ones.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from thermodrift.testing.contract import ContractCheck, ContractError

if TYPE_CHECKING:
    from features.selectors.base import Selector
    from models.base import Family
    from thermodrift.testing.points import Case
    from twin.mechanisms.base import Mechanism

__all__ = ["ContractCheck", "ContractError", "check_family", "check_mechanism", "check_selector"]


def check_family(family: type[Family] | str, *, generate_only: bool = False) -> Iterator[ContractCheck]:
    """Run a family on simulated runs with a known law: fit, predict, store, refuse.

    Args:
        generate_only: give the checks without running them.

    Raises:
        ContractError: checks failed; each is named.
    """
    from models import FAMILIES
    from thermodrift.testing.families import SUITE, FamilyCase

    return SUITE.of(FAMILIES, family, FamilyCase, generate_only)


def check_selector(selector: type[Selector] | str, *, generate_only: bool = False) -> Iterator[ContractCheck]:
    """Run a selector on stacked rows of a year: what it learns from, what must not matter, what it refuses.

    Args:
        generate_only: give the checks without running them.

    Raises:
        ContractError: checks failed; each is named.
    """
    from features.selectors import SELECTORS
    from thermodrift.testing.selectors import SUITE, SelectorCase

    return SUITE.of(SELECTORS, selector, SelectorCase, generate_only)


def check_mechanism(
    law: type[Mechanism] | str, case: Case | None = None, *, generate_only: bool = False
) -> Iterator[ContractCheck]:
    """Evaluate a mechanism at a point, over its prior and in a small machine.

    Args:
        case: its equation over quantities with units, and what else must be known; without an equation the units are
            not checked. `thermodrift.testing.points.Case`.
        generate_only: give the checks without running them.

    Raises:
        ContractError: checks failed; each is named.
    """
    from thermodrift.testing.mechanisms import SUITE, MechanismCase
    from thermodrift.testing.points import Case
    from twin.mechanisms import MECHANISMS

    return SUITE.of(MECHANISMS, law, lambda found: MechanismCase(found(), case or Case()), generate_only)
