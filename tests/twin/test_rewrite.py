"""Calibrated values go into the machine file's text and leave the rest of it alone."""

from __future__ import annotations

from pathlib import Path

import pytest

from data.errors import InputError
from data.machine import parse_machine
from twin.calibration.calibrated_file import Update, with_calibrated, with_values
from twin.compile import compile_network
from twin.schema import Calibrated

TEXT = (Path(__file__).parents[2] / "machines" / "sample_vmc.yml").read_text()


def test_every_free_parameter_of_the_sample_machine_can_be_written_and_read_back() -> None:
    network = compile_network(parse_machine(TEXT, "sample"))
    free = [network.parameters[k] for k in network.free]
    updates = {
        p.name: Update(p, p.value * 1.25, (p.value * 1.1, p.value * 1.4)) for p in free if p.value * 1.25 < p.high
    }
    text = with_values(TEXT, updates, "sample")
    again = compile_network(parse_machine(text, "calibrated"))
    for old in free:
        new = again.parameters[again.index(old.name)]
        assert new.value == pytest.approx(old.value * 1.25, rel=1e-4)
        assert new.prior_value == pytest.approx(old.value, rel=1e-4)
        assert (new.spread, new.free, new.unit) == (old.spread, True, old.unit)


def test_comments_and_other_lines_stay() -> None:
    network = compile_network(parse_machine(TEXT, "sample"))
    p = network.parameters[network.index("links.shaft-front.conductance")]
    text = with_values(TEXT, {p.name: Update(p, 12.3456789, (11.0, 13.5))}, "sample")
    old, new = TEXT.splitlines(), text.splitlines()
    assert len(old) == len(new)
    changed = [(a, b) for a, b in zip(old, new, strict=True) if a != b]
    assert changed == [
        (
            "    shaft-front: {value: 14 W/K, spread: 0.5}",
            "    shaft-front: {value: 12.346 W/K, spread: 0.5, prior: 14 W/K, interval90: [11, 13.5]}",
        )
    ]
    twice = with_values(text, {p.name: Update(p, 12.5, (11.0, 13.5))}, "sample")
    assert "shaft-front: {value: 12.5 W/K, spread: 0.5, prior: 14 W/K, interval90: [11, 13.5]}" in twice


def test_a_block_style_value_gets_lines_of_its_own() -> None:
    text = "twin:\n  links:\n    a-b:\n      conductance:\n        value: 3 W/K  # by hand\n        spread: 0.5\n"
    network = compile_network(parse_machine(TEXT, "sample"))
    p = network.parameters[network.index("links.shaft-front.conductance")]
    new = with_values(text, {"links.a-b.conductance": Update(p, 4.0, (3.0, 5.0))}, "m")
    assert "        value: 4 W/K  # by hand\n        spread: 0.5\n        prior: 14 W/K\n" in new


def test_where_it_came_from_is_written_once() -> None:
    text = with_calibrated(TEXT, Calibrated(batches=("a", "b"), when="at first"))
    assert "  calibrated:\n    batches: [a, b]\n    when: at first\n" in text
    text = with_calibrated(text, Calibrated(batches=("c",), when="again"))
    assert text.count("calibrated:") == 1 and "batches: [c]" in text
    assert "\n  surroundings:\n" in text
    parse_machine(text, "again")


def test_a_parameter_that_is_not_in_the_file_is_told() -> None:
    network = compile_network(parse_machine(TEXT, "sample"))
    p = network.parameters[0]
    with pytest.raises(InputError, match=r"m.yml: twin.links.x.conductance does not stand in the file"):
        with_values(TEXT, {"links.x.conductance": Update(p, 1.0, (0.5, 2.0))}, "m.yml")
