"""What no mechanism lists: every term at every place, its words, and which terms one mechanism states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from diagnosis.candidates.free_forms import Form, Level, candidate_of, free_forms, levels
from diagnosis.contracts import Where
from tests.diagnosis.concealed import BODIES, chain, empty
from twin.compile import compile_network
from twin.mechanisms import MECHANISMS
from twin.quantity import Value
from twin.schema import twin_part

RPM, COOLANT, LAMP = Level("rpm", "rpm", 5000.0, False), Level("coolant", "1", 1.0, True), Level("lamp", "1", 1.0, True)
BED, Z = Where("node", "bed"), Where("error", "z")


def test_every_term_at_every_place_once() -> None:
    machine, batches = chain(), empty()
    batches = [replace(b, table=b.table.assign(rpm=np.where(b.table["coolant"] > 0, 4000.0, 2500.0))) for b in batches]
    forms = free_forms(machine, twin_part(machine), batches)
    assert len(set(forms)) == len(forms)
    heat = [(f.role, f.label) for f in forms if f.where == BED]
    assert heat == [
        ("constant", "1"), ("linear", "rpm"), ("square", "rpm^2"), ("linear", "coolant"), ("cross", "rpm coolant"),
        ("square_cross", "rpm^2 coolant"), ("per_K", "T_bed - 20"), ("product", "rpm (T_bed - 20)"),
        ("product", "coolant (T_bed - 20)"),
    ]  # fmt: skip
    assert {f.where.name for f in forms if f.heat} == set(BODIES)
    shift = [f.label for f in forms if f.where == Z]
    assert shift[:2] == ["rpm", "rpm^2"] and "θ_bed" in shift and "rpm θ_bed" in shift and "1" not in shift
    for f in forms:
        c = candidate_of([f], "head")
        one = Value(value=f"1 {MECHANISMS[c.mechanism].spec(f.role).unit}")
        compile_network(machine, part=c.applied(twin_part(machine), {f.role: one}))


def test_drivers_that_say_nothing_are_left_out() -> None:
    batches = empty()
    assert [d.name for d in levels([replace(b, table=b.table.assign(rpm=3000.0)) for b in batches])] == ["coolant"]
    gone = [replace(b, table=b.table.assign(rpm=np.nan) if k == 2 else b.table) for k, b in enumerate(batches)]
    assert [d.name for d in levels(gone)] == ["coolant"]
    assert [(d.name, d.switched) for d in levels(batches)] == [("rpm", False), ("coolant", True)]


@pytest.mark.parametrize(
    ("form", "value", "label"),
    [
        (Form(BED, "constant"), 25.0, "25 W into bed"),
        (Form(BED, "linear", COOLANT), -60.0, "60 W out of bed while coolant is on"),
        (Form(BED, "linear", RPM), 0.01, "50 W into bed in proportion to rpm (at 5000 rpm)"),
        (Form(BED, "square", RPM), 4e-6, "100 W into bed with the square of rpm (at 5000 rpm)"),
        (Form(BED, "cross", RPM, COOLANT), 0.01,
         "50 W into bed in proportion to rpm (at 5000 rpm) while coolant is on"),
        (Form(BED, "cross", COOLANT, LAMP), 50.0, "50 W into bed while coolant is on and while lamp is on"),
        (Form(BED, "square_cross", RPM, COOLANT), 4e-6,
         "100 W into bed with the square of rpm (at 5000 rpm) while coolant is on"),
        (Form(BED, "per_K", body="bed"), -3.0, "3.0 W out of bed per K of bed above 20 degC"),
        (Form(BED, "product", RPM, body="bed"), 0.0008,
         "4.0 W into bed per K of bed above 20 degC, in proportion to rpm (at 5000 rpm)"),
        (Form(Z, "per_K", body="head"), -2.0, "−2.0 um of z per K of head's rise"),
        (Form(Z, "product", COOLANT, body="head"), 2.0, "2.0 um of z per K of head's rise, while coolant is on"),
    ],
)  # fmt: skip
def test_words(form: Form, value: float, label: str) -> None:
    assert form.phrase(value) == label.replace("um", "µm")


def test_terms_of_one_mechanism() -> None:
    """It has one place, a driver, a second one beside it, and one body; no parameter stands twice."""
    linear, warm = Form(BED, "linear", RPM), Form(BED, "product", RPM, body="bed")
    assert warm.goes_with([linear]) and Form(BED, "cross", RPM, COOLANT).goes_with([linear, warm])
    assert Form(BED, "constant").goes_with([linear])
    assert not Form(BED, "linear", COOLANT).goes_with([linear])
    assert not Form(BED, "product", COOLANT, body="bed").goes_with([linear])
    assert not Form(Where("node", "head"), "square", RPM).goes_with([linear])
    assert not Form(Z, "per_K", body="head").goes_with([Form(Z, "product", RPM, body="bed")])
    assert not Form(BED, "square_cross", RPM, LAMP).goes_with([Form(BED, "cross", RPM, COOLANT)])
    both = candidate_of([linear, Form(BED, "cross", RPM, COOLANT)])
    assert both.part is not None and both.part.drivers == {"level": "rpm", "other": "coolant"}
    assert both.amplitudes == {"linear": 0.0, "cross": 0.0} and both.part.into == "bed"
