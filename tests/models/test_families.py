"""Every registered family keeps the contract; `thermodrift.testing.families` holds its checks."""

from __future__ import annotations

import pytest

from models import FAMILIES
from thermodrift.testing import ContractCheck, check_family


@pytest.mark.parametrize("check", [c for key in FAMILIES for c in check_family(key, generate_only=True)], ids=str)
def test_contract(check: ContractCheck) -> None:
    check()


def test_keys_are_those_of_the_registry() -> None:
    assert {key: family.key for key, family in FAMILIES.items()} == {key: key for key in FAMILIES}
