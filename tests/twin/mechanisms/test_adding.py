"""The example in docs/adding_a_mechanism.md is a whole mechanism: it passes what every registered one passes."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import ModuleType

import cases
import pytest
import signatures_heat
import test_mechanisms as promises
import test_what_a_diagnosis_needs as needs
from small_machine import BODIES, machine_with

from diagnosis.candidates.library import candidates
from diagnosis.screening.linearisation import asleep
from twin.mechanisms import MECHANISMS
from twin.schema import twin_part

KEY = "wiper_friction"


@pytest.fixture
def example(monkeypatch) -> str:
    text = (Path(__file__).parents[3] / "docs" / "adding_a_mechanism.md").read_text(encoding="utf-8")
    law, test = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    module = ModuleType("wipers")
    exec(law, module.__dict__)
    monkeypatch.setitem(sys.modules, "wipers", module)
    monkeypatch.setitem(MECHANISMS._members, KEY, "wipers:WiperFriction")
    monkeypatch.setitem(cases.CASES, KEY, None)  # so that it is gone afterwards
    names = {"CASES": cases.CASES, "Case": cases.Case, "heat": signatures_heat.heat, "pytest": pytest}
    exec(test, names)
    monkeypatch.setitem(promises.SIGNATURES, KEY, names[KEY])
    return text


def test_the_example_passes(example):
    kept = 0
    for name, promise in [*vars(promises).items(), *vars(needs).items()]:
        marks = getattr(promise, "pytestmark", [])
        if name.startswith("test_") and any("motor_loss" in m.args[1] for m in marks):
            promise(KEY)
            kept += 1
    assert kept >= 19


def test_the_line_in_the_docs_is_how_lines_look(example):
    assert '"wiper_friction": "twin.mechanisms.wipers:WiperFriction",' in example
    assert MECHANISMS[KEY].key == KEY


def test_a_diagnosis_considers_it(example):
    machine = machine_with(MECHANISMS[KEY]())  # it is at work in the first body already
    part = twin_part(machine)
    proposed = candidates(machine, part, [KEY])
    assert [c.name for c in proposed] == [f"{KEY}_{body}_feed_driver" for body in sorted(BODIES[1:])]
    assert [c.label for c in proposed[:1]] == [f"friction of the wipers: {sorted(BODIES[1:])[0]} (feed_driver)"]
    found = asleep(machine, part, proposed)
    assert not found.left_out and set(found.amplitudes) == {c.name for c in proposed}
    every = candidates(machine, part)
    assert {c.name for c in proposed} < {c.name for c in every}
