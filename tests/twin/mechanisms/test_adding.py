"""The example in docs/adding_a_mechanism.md is a whole mechanism: it keeps the contract as the registered ones do."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import cases
import pytest
import signatures_heat

from diagnosis.candidates.library import candidates
from diagnosis.fitting.signatures import with_disabled
from tests.contracts import test_mechanism_contract as contract
from tests.toys.small_machine import BODIES, machine_with
from twin.mechanisms import MECHANISMS
from twin.schema import twin_part

KEY = "wiper_friction"


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch) -> tuple[str, Any]:
    """The page's text, and its blocks of code: the mechanism, and what its tests need."""
    text = (Path(__file__).parents[3] / "docs" / "adding_a_mechanism.md").read_text(encoding="utf-8")
    law, test = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    module = ModuleType("wipers")
    exec(law, module.__dict__)
    monkeypatch.setitem(sys.modules, "wipers", module)
    monkeypatch.setattr(MECHANISMS, "_members", {**MECHANISMS._members, KEY: "wipers:WiperFriction"})
    return text, (module, test)


def test_the_example_keeps_the_contract(example: tuple[str, Any]) -> None:
    module, test = example[1]
    names = {"CASES": {}, "Case": cases.Case, "heat": signatures_heat.heat, "pytest": pytest}
    exec(test, names)
    names[KEY](module.WiperFriction())
    given = contract.Given(module.WiperFriction(), names["CASES"][KEY])
    for check in (function for name, function in vars(contract).items() if name.startswith("test_")):
        check(given)


def test_the_line_in_the_docs_is_how_lines_look(example: tuple[str, Any]) -> None:
    assert '"wiper_friction": "twin.mechanisms.wipers:WiperFriction",' in example[0]
    assert MECHANISMS[KEY].key == KEY


@pytest.mark.usefixtures("example")
def test_a_diagnosis_considers_it() -> None:
    machine = machine_with(MECHANISMS[KEY]())  # it is at work in the first body already
    part = twin_part(machine)
    proposed = candidates(machine, part, [KEY])
    assert [c.name for c in proposed] == [f"{KEY}_{body}_feed_driver" for body in sorted(BODIES[1:])]
    assert [c.label for c in proposed[:1]] == [f"friction of the wipers: {sorted(BODIES[1:])[0]} (feed_driver)"]
    found = with_disabled(machine, part, proposed)
    assert not found.left_out and set(found.amplitudes) == {c.name for c in proposed}
    every = candidates(machine, part)
    assert {c.name for c in proposed} < {c.name for c in every}
