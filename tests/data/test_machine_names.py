"""Names of channels and machines: what they may be, since they become those of files, columns and models."""

import pytest

from data.errors import InputError
from data.groups import grouped
from data.machine import MAX_NAME, TAKEN, parse_machine


def named(name: str, machine: str = "m1") -> str:
    escaped = "".join(f"\\U{ord(c):08x}" if not c.isascii() or not c.isprintable() or c in '"\\' else c for c in name)
    return f'machine: {machine}\nchannels:\n  "{escaped}": {{role: error, unit: um}}\n'


@pytest.mark.parametrize("name", ["z", "T1", "z_um", "Spindel vorn", "冬1", "Δz", "nut-x", "T1.5", "T+", "load 50 %",
                                  "_own", "°C front", "front (old)", "x" * MAX_NAME, "क्षैतिज", "2"])  # fmt: skip
def test_names_that_machine_files_use_are_kept(name: str) -> None:
    assert parse_machine(named(name), "m.yml").names("error") == (name,)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        *((n, f"has the character {c!r}, allowed are letters and digits") for n, c in [
            ("../../../../x", "/"), ("a\\b", "\\"), ("a\0b", "\0"), ("a\nb", "\n"), ("a\x1bb", "\x1b"), ("a|b", "|"),
            ("z@start", "@"), ("C:x", ":"), ("a*", "*"), ("a?", "?"), ("a#b", "#"), ('a"b', '"'), ("a'b", "'"),
            ("a<b", "<"), ("a=b", "="), ("a,b", ","), ("a[0]", "["), ("a\u202eb", "\u202e"), ("a\u200bb", "\u200b"),
            ("a\u2028b", "\u2028"), ("x😀", "😀"),
        ]),
        *((n, "must begin with a letter, a digit") for n in ["", " ", "   ", ".", "..", ".hidden", " z", "z ", "z.",
                                                            "-z", "+z"]),
        ("x" * (MAX_NAME + 1), f"has {MAX_NAME + 1} characters, allowed are {MAX_NAME}"),
        ("冬" * 60, "has 60 characters, allowed are 80 (and 160 bytes)"),
        *((n, "thermodrift adds a column of this name (batch,") for n in TAKEN),
    ],
)  # fmt: skip
def test_other_names_are_refused_in_one_line(name: str, words: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_machine(named(name), "m.yml")
    said = str(caught.value)
    assert len(said.splitlines()) == 1
    assert said.startswith(f"machine file m.yml line 3: key {f'channels.{name}'!r}: got ") and words in said
    assert said.endswith(("rename the channel", "shorten it"))


@pytest.mark.parametrize("machine", ["../up", "a/b", "m 1", "M1", ".m", "m\\n", "m=1", "x" * (MAX_NAME + 1)])
def test_a_machine_is_a_folder_of_the_lake(machine: str) -> None:
    with pytest.raises(InputError, match=r"^machine file m\.yml line 1: key 'machine': got '.*'; String should"):
        parse_machine(named("z", f'"{machine}"'), "m.yml")


def test_a_draft_uses_names_that_may_be_loaded(tmp_path) -> None:
    header = ["time", "year", "machine", "batch_id", "T" * 200, "z"]
    rows = [[60 * i, 2026, 7, 1, 20.0 + i, i] for i in range(20)]
    path = tmp_path / "run.csv"
    path.write_text("\n".join(",".join(map(str, row)) for row in [header, *rows]) + "\n")
    (group,), _ = grouped([path])
    for name in group.names:
        parse_machine(named(name), "m.yml")
