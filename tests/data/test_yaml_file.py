"""YAML files: every mistake is one line that names the file, the place and the remedy."""

import time
import tracemalloc

import pytest

from data.errors import InputError
from data.machine import Machine, load_machine, parse_machine
from data.yaml_file import MAX_BYTES, parse_plain, parse_yaml

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


def bomb(levels: int) -> str:
    """Each level names the one before ten times; the last one stands where a short text belongs."""
    lines = ["twin:", "  a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"  a{i}: &a{i} [{', '.join(10 * [f'*a{i - 1}'])}]" for i in range(1, levels)]
    return "\n".join([*lines, f"machine: *a{levels - 1}", "channels: {z: {role: error, unit: um}}"])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (bomb(9), "line 5: not valid YAML (the aliases up to *a2 stand for more than 10000 values; write fewer)"),
        ("a: &a " + 5000 * "x" + "\nb: [" + 1000 * "*a, " + "]", "stand for more than 10000 values"),
        ("twin: &a {b: *a}\n" + GOOD, "line 1: not valid YAML (alias *a contains itself; write its values out)"),
        ("twin: " + 3000 * "[", "line 1: not valid YAML (more than 50 levels of nesting)"),
        ("twin: " + 300 * "{a: " + "1" + 300 * "}", "not valid YAML (more than 50 levels of nesting)"),
        ("\n".join(i * " " + "a:" for i in range(300)), "line 50: not valid YAML (more than 50 levels of nesting)"),
        (GOOD + "#" * MAX_BYTES, "more than 1 MB, expected a file written by hand"),
        (GOOD + "? [a, b]\n: 1", "line 3: not valid YAML (a key is a list or a mapping, expected text or a number)"),
        ("machine: 2024-13-45", "line 1: not valid YAML ('2024-13-45' is no valid timestamp; correct it, or put it in"),
        ("machine: " + 5000 * "9", "is no valid int; correct it"),
        ("machine: 0x" + 5000 * "f", "is no valid int; correct it"),
        ("machine: !!int abc", "'abc' is no valid int"),
        ("machine: !!bool maybe", "'maybe' is no valid bool"),
        ("machine: !!timestamp soon", "'soon' is no valid timestamp"),
        ("machine: a\ud800", "not valid YAML ("),
        ("machine: a\0b", "not valid YAML (unacceptable character #x0000: control characters are not allowed in"),
        ("machine: [" + 9000 * "a, " + "]\nchannels: {}", "'a', 'a', 'a'"),
    ],
)
def test_what_would_take_all_time_or_memory_is_refused(text: str, words: str) -> None:
    begun = time.process_time()
    with pytest.raises(InputError) as caught:
        parse_machine(text, "m.yml")
    assert time.process_time() - begun < 5.0
    said = str(caught.value)
    assert said.startswith("machine file m.yml") and words in said and len(said.splitlines()) == 1 and len(said) < 600


def test_a_bomb_takes_no_memory() -> None:
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="stand for more than 10000 values"):
            parse_machine(bomb(7), "m.yml")  # a line of 50 million characters without the bound
        assert tracemalloc.get_traced_memory()[1] < 5e6
    finally:
        tracemalloc.stop()


def test_a_huge_file_is_not_read_whole(tmp_path) -> None:
    path = tmp_path / "m.yml"
    with path.open("wb") as file:
        file.truncate(1 << 40)  # a hole, which takes no room on the disk
    with pytest.raises(InputError, match=r"m\.yml: more than 1 MB, expected a file written by hand"):
        load_machine(path)


def test_aliases_that_stand_for_little_are_read() -> None:
    text = (
        "machine: m1\nchannels:\n  a: &t {role: temperature, unit: degC, range: [0, 80]}\n  b: *t\n"
        "  c: {<<: *t, range: [0, 90]}\n  z: {role: error, unit: um}\n"
    )
    machine = parse_machine(text, "m.yml")
    assert machine.channels["a"] == machine.channels["b"] and machine.channels["c"].range == (0, 90)
    assert parse_plain("a: &x [1, 2]\nb: [*x, *x]", "x") == {"a": [1, 2], "b": [[1, 2], [1, 2]]}
    assert parse_plain("", "x") is None


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
