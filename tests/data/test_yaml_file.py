"""YAML files: every mistake is one line that names the file, the place and the remedy."""

import pytest

from data.errors import InputError
from data.machine import Machine, load_machine, parse_machine
from data.yaml_file import parse_yaml

GOOD = "machine: m1\nchannels: {z: {role: error, unit: um}}\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("channls: {}\n" + GOOD, "unknown key 'channls'; did you mean 'channels'? Allowed: channels, description"),
        (GOOD + "recording: {time: {colum: 1}}", "unknown key 'recording.time.colum'; did you mean 'column'?"),
        (
            "machine: m1\nchannels: {z: {role: error, unit: um, rang: [0, 1]}}",
            "'channels.z.rang'; did you mean 'range'?",
        ),
        ("machine: m1\nchanels: {}", "m.yml line 2: unknown key 'chanels'; did you mean 'channels'?"),
        (
            "machine: m1\nchannels:\n  unit: {role: error, unit: um}\n  range: {role: error, units: um}\n",
            "m.yml line 4: unknown key 'channels.range.units'; did you mean 'unit'?",
        ),
        (
            GOOD + "overrule:\n- {reason: a}\n- {reason: b, chek: c}\n",
            "line 5: unknown key 'overrule.1.chek'; did you mean",
        ),
        (
            GOOD + "recording: {schedule: {file: a, batch_column: b, stages: [{hours: c, driver: {}}]}}",
            "line 3: unknown key 'recording.schedule.stages.0.driver'; did you mean 'drivers'?",
        ),
        ("machine: m1", "key 'channels' is missing"),
        (GOOD + "recording: {step_s: -1}", "key 'recording.step_s': got -1; Input should be greater than 0"),
        ("machine: m1\nchannels: {z: {role: eror, unit: um}}", "key 'channels.z.role': got 'eror'; Input should be"),
        (
            "machine: m1\nchannels: {z: {role: error, unit: um, range: [5, 1]}}",
            "'range': [5, 1]}; range [5.0, 1.0]: the first must be below the second",
        ),
        (GOOD + "machine: m2\n", "line 3: not valid YAML (key 'machine' is given twice)"),
        ("machine: [m1", "not valid YAML"),
        ("- a\n- b", "expected a mapping with the keys machine and channels, got list"),
        ("", "key 'machine' is missing"),
        (GOOD + "x: !!python/object/apply:os.system [ls]", "not valid YAML (could not determine a constructor"),
    ],
)
def test_one_line_with_file_place_and_remedy(text: str, words: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_machine(text, "m.yml")
    said = str(caught.value)
    assert said.startswith("machine file m.yml") and words in said and "\n" not in said


def test_how_many_more_problems_there_are() -> None:
    with pytest.raises(InputError, match=r"\(and 2 more problems\)$"):
        parse_machine(GOOD + "a: 1\nb: 2\nc: 3\n", "m.yml")


def test_a_missing_file_and_one_that_is_no_text(tmp_path) -> None:
    with pytest.raises(InputError, match=r"machine file .*none\.yml: cannot be read .*; give the path of a \.yml file"):
        load_machine(tmp_path / "none.yml")
    (tmp_path / "junk.yml").write_bytes(b"\xff\xfe\x00\x01\x02")
    with pytest.raises(InputError, match="cannot be read"):
        load_machine(tmp_path / "junk.yml")


def test_what_is_right_is_read() -> None:
    assert parse_yaml(GOOD, Machine, "machine file m.yml").names("error") == ("z",)
