"""The calibrated machine file: the old text with new values, read back before it replaces anything."""

from __future__ import annotations

from pathlib import Path

import pytest

from data.errors import InputError, WorkError
from data.machine import load_machine, parse_machine
from twin.calibration.calibrated_file import (
    Update,
    calibrated_text,
    check_writable,
    with_calibrated,
    with_values,
    write_file,
)
from twin.calibration.identifiability import Interval
from twin.compile import compile_network
from twin.network import Network
from twin.schema import Calibrated, twin_part

TEXT = """# by hand
machine: two
recording: {step_s: 60}
channels:
  t: {role: temperature, unit: degC, resolution: 0.1}
  room: {role: ambient, unit: degC, resolution: 0.1}
twin:
  surroundings: {room: {channel: room}}
  bodies:
    head: {capacity: {value: 40 kJ/K, spread: 0.3}}  # guessed
  exposures:
    head-room: {value: 8 W/K, spread: 0.5, bounds: [1 W/K, 20 W/K]}
  sensors:
    t: {at: head}
"""
SAMPLE = (Path(__file__).parents[2] / "machines" / "sample_vmc.yml").read_text()
CAPACITY, COOLING = "bodies.head.capacity", "exposures.head-room.conductance"
ORIGIN = Calibrated(
    batches=("b1", "b2"), when="2026-11-21T10:00:00+01:00", simulated=True, left_out_rms={"t_K": 0.12345},
    words="converged after 4 steps",
)  # fmt: skip


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "two.yml"
    path.write_text(TEXT, encoding="utf-8")
    return path


def network_of(text: str = TEXT) -> Network:
    return compile_network(parse_machine(text, "two"))


def new_text(text: str = TEXT, cooling: float = 9.5) -> str:
    values = {CAPACITY: 43210.0, COOLING: cooling}
    units = {CAPACITY: "J/K", COOLING: "W/K"}
    intervals = [Interval(n, units[n], v, 0.9 * v, 1.1 * v, 0.2) for n, v in values.items()]
    return calibrated_text(text, network_of(), values, intervals, ORIGIN, "machine file new.yml")


def test_it_says_values_intervals_priors_and_where_they_come_from(source: Path) -> None:
    out = source.with_name("new.yml")
    write_file(out, new_text(), source)
    machine = load_machine(out)
    part, network = twin_part(machine), compile_network(machine)
    capacity = network.parameters[network.index(CAPACITY)]
    assert (capacity.value, capacity.prior_value, capacity.spread) == (43210.0, 40000.0, 0.3)
    assert part.exposures["head-room"].conductance is not None
    assert part.exposures["head-room"].conductance.interval90 == (8.55, 10.45)
    assert part.calibrated is not None
    assert part.calibrated.batches == ("b1", "b2")
    assert part.calibrated.when == "2026-11-21T10:00:00+01:00"
    assert part.calibrated.simulated is True
    assert part.calibrated.left_out_rms == {"t_K": 0.123}
    assert part.calibrated.words == "converged after 4 steps"
    text = out.read_text(encoding="utf-8")
    assert text.startswith("# by hand\n") and "# guessed" in text
    assert source.read_text(encoding="utf-8") == TEXT
    assert sorted(p.name for p in source.parent.iterdir()) == ["new.yml", "two.yml"]


def test_calibrating_again_keeps_the_first_prior() -> None:
    again = calibrated_text(
        new_text(), network_of(new_text()), {CAPACITY: 42000.0},
        [Interval(CAPACITY, "J/K", 42000.0, 41000.0, 43000.0, 0.1)], ORIGIN, "new.yml",
    )  # fmt: skip
    parameter = network_of(again).parameters[0]
    assert (parameter.value, parameter.prior_value) == (42000.0, 40000.0)
    assert again.count("calibrated:") == 1


def test_a_text_that_does_not_read_back_is_no_file() -> None:
    words = "machine file new.yml: the calibrated file does not read back .*outside the bounds.*nothing was written"
    with pytest.raises(WorkError, match=words):
        new_text(cooling=25.0)


def test_the_input_is_not_overwritten_unasked(source: Path) -> None:
    with pytest.raises(InputError, match=r"two.yml: is the machine file to calibrate; give another file, or ask to"):
        write_file(source, new_text(), source)
    other = source.with_name("other.yml")
    other.write_text("mine", encoding="utf-8")
    with pytest.raises(InputError, match=r"other.yml: exists; give another file, or ask to overwrite it"):
        write_file(other, new_text(), source)
    assert (source.read_text(encoding="utf-8"), other.read_text(encoding="utf-8")) == (TEXT, "mine")
    write_file(source, new_text(), source, overwrite=True)
    assert "calibrated:" in source.read_text(encoding="utf-8")


def test_a_failure_while_writing_leaves_what_stood_there(source: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(self: Path, target: Path) -> Path:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(
        WorkError, match=r"two.yml: cannot be written .*No space left.*; the previous content is unchanged"
    ):
        write_file(source, new_text(), source, overwrite=True)
    assert source.read_text(encoding="utf-8") == TEXT
    assert [p.name for p in source.parent.iterdir()] == ["two.yml"]


def test_targets_that_cannot_be_are_told(source: Path) -> None:
    with pytest.raises(InputError, match=r"no folder .*nowhere; make it, or give another file"):
        write_file(source.parent / "nowhere" / "x.yml", new_text(), source)
    with pytest.raises(InputError, match="is a folder, expected a file name"):
        write_file(source.parent, new_text(), source)


def test_what_cannot_be_written_is_told_before_the_work(source: Path) -> None:
    assert check_writable(source, network_of()) == TEXT
    with pytest.raises(InputError, match=r"absent.yml: cannot be read"):
        check_writable(source.with_name("absent.yml"), network_of())
    hidden = TEXT.replace("{value: 8 W/K, spread: 0.5, bounds: [1 W/K, 20 W/K]}", "8 W/K").replace(
        "head-room", "a-room"
    )
    source.write_text(hidden, encoding="utf-8")
    with pytest.raises(InputError, match=r"twin.exposures.head-room.conductance is no value with a spread"):
        check_writable(source, network_of())


def test_every_free_parameter_of_the_sample_machine_can_be_written_and_read_back(sample: Network) -> None:
    free = [sample.parameters[k] for k in sample.free]
    updates = {
        p.name: Update(p, p.value * 1.25, (p.value * 1.1, p.value * 1.4)) for p in free if p.value * 1.25 < p.high
    }
    text = with_values(SAMPLE, updates, "sample")
    again = compile_network(parse_machine(text, "calibrated"))
    for old in free:
        new = again.parameters[again.index(old.name)]
        assert new.value == pytest.approx(old.value * 1.25, rel=1e-4)
        assert new.prior_value == pytest.approx(old.value, rel=1e-4)
        assert (new.spread, new.free, new.unit) == (old.spread, True, old.unit)


def test_comments_and_other_lines_stay(sample: Network) -> None:
    p = sample.parameters[sample.index("links.shaft-front.conductance")]
    text = with_values(SAMPLE, {p.name: Update(p, 12.3456789, (11.0, 13.5))}, "sample")
    old, new = SAMPLE.splitlines(), text.splitlines()
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


def test_a_block_style_value_gets_lines_of_its_own(sample: Network) -> None:
    text = "twin:\n  links:\n    a-b:\n      conductance:\n        value: 3 W/K  # by hand\n        spread: 0.5\n"
    p = sample.parameters[sample.index("links.shaft-front.conductance")]
    new = with_values(text, {"links.a-b.conductance": Update(p, 4.0, (3.0, 5.0))}, "m")
    assert "        value: 4 W/K  # by hand\n        spread: 0.5\n        prior: 14 W/K\n" in new


def test_where_it_came_from_is_written_once() -> None:
    text = with_calibrated(SAMPLE, Calibrated(batches=("a", "b"), when="at first"))
    assert "  calibrated:\n    batches: [a, b]\n    when: at first\n" in text
    text = with_calibrated(text, Calibrated(batches=("c",), when="again"))
    assert text.count("calibrated:") == 1 and "batches: [c]" in text
    assert "\n  surroundings:\n" in text
    parse_machine(text, "again")


def test_a_parameter_that_is_not_in_the_file_is_told(sample: Network) -> None:
    p = sample.parameters[0]
    with pytest.raises(InputError, match=r"m.yml: twin.links.x.conductance is no value with a spread"):
        with_values(SAMPLE, {"links.x.conductance": Update(p, 1.0, (0.5, 2.0))}, "m.yml")
