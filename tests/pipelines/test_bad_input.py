"""Every bad input, through the command: one clear line or a quarantine entry, the rest goes in, nothing is lost."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from data.lake import Lake
from tests.toys.command import Call, Done
from tests.toys.small_year import recording, write_machine, write_year

NAME = "small-bad"


@dataclass
class Place:
    """A folder of the test's own, with a home, a machine file and a way to call the command."""

    folder: Path
    machine: Path
    call: Call

    @property
    def lake(self) -> Lake:
        return Lake(self.folder / "home" / "lake")

    def ingest(self, *paths: Path) -> Done:
        return self.call("ingest", *paths, "--machine", self.machine)

    def reasons(self) -> dict[str, str]:
        return {Path(q.source).name: q.reason for q in self.lake.quarantined(NAME)}


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: Call) -> Place:
    monkeypatch.setenv("THERMODRIFT_HOME", str(tmp_path / "home"))
    return Place(tmp_path, write_machine(tmp_path / "small.yml", NAME), call)


def trouble(err: str) -> str:
    """The one line of trouble; progress lines may come before it."""
    told = [line for line in err.splitlines() if line.startswith("thermodrift: ")]
    assert len(told) == 1 and "Traceback" not in err
    return told[0].removeprefix("thermodrift: ")


def empty(path: Path) -> None:
    path.write_bytes(b"")


def junk(path: Path) -> None:
    path.write_bytes(np.random.default_rng(0).bytes(4000))


def cut_xlsx(path: Path) -> None:
    recording(0).to_excel(path, index=False)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def unknown_columns(path: Path) -> None:
    pd.DataFrame({f"u{i}": np.arange(20.0) for i in range(200)}).to_csv(path, index=False)


def no_error(path: Path) -> None:
    recording(0).drop(columns=["x", "z"]).to_csv(path, index=False)


def one_row(path: Path) -> None:
    recording(0).head(1).to_csv(path, index=False)


def header_only(path: Path) -> None:
    recording(0).head(0).to_csv(path, index=False)


def all_nan(path: Path) -> None:
    table = recording(0)
    table.loc[:, table.columns != "time_s"] = np.nan
    table.to_csv(path, index=False, na_rep="NaN")


def no_time(path: Path) -> None:
    recording(0).drop(columns="time_s").to_csv(path, index=False)


def words_for_time(path: Path) -> None:
    recording(0).assign(time_s="later").to_csv(path, index=False)


BAD = [
    (empty, "a.csv", r"^a\.csv: the file is empty \(0 bytes\); expected a header and at least 2 rows; copy it again$"),
    (junk, "a.csv", r"^a\.csv: not a text file \(binary content\); expected CSV text; export the recording again$"),
    (cut_xlsx, "a.xlsx", r"^a\.xlsx: .*(cut|damaged|cannot be read|not a).*; .*(again|export)"),
    (unknown_columns, "a.csv", r"^a\.csv: none of its 200 columns is a channel of machine small-bad; got 'u0', 'u1', "
                               r"'u2' …, expected 'front', 'bed', 'room' …; correct column: in the machine file, or"),
    (no_error, "a.csv", r"^a\.csv: no error channel; got 'time_s', 'front', 'bed' …, expected column 'x', 'z'"),
    (one_row, "a.csv", r"^a\.csv: 1 data rows?, expected at least 2; record or copy it again$"),
    (header_only, "a.csv", r"^a\.csv: (0|no) data rows?, expected at least 2; record or copy it again$"),
    (all_nan, "a.csv", r"^a\.csv: no channel has a value, all are empty or NaN; record again$"),
    (no_time, "a.csv", r"^a\.csv: .*time_s.*recording\.time"),
    (words_for_time, "a.csv", r"^a\.csv: 0 of 73 rows have a readable time in column 'time_s' as s, expected"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "name", "words"), BAD, ids=[b[0].__name__ for b in BAD])
def test_a_file_that_cannot_be_used(make: Callable[[Path], None], name: str, words: str, place: Place) -> None:
    """Alone it ends with exit code 2; among others it is in quarantine and they go in; its bytes are kept."""
    folder = place.folder / "in"
    (good,) = write_year(folder, 1)
    make(folder / name)
    code, out, err = place.ingest(folder / name)
    assert code == 2
    assert trouble(err) == "no file could be used (1 in quarantine); the reasons are above"
    assert re.search(words, place.reasons()[name]), place.reasons()[name]
    (shown,) = [line for line in out.splitlines() if line.startswith("  quarantine: ")]
    assert shown == f"  quarantine: {folder}/{place.reasons()[name]}"
    code, out, err = place.ingest(folder)
    assert code == 0 and "batches new: 1" in out and "files in quarantine: 1" in out
    assert place.lake.batch_ids(NAME) == [good.stem]
    (kept,) = place.lake.quarantined(NAME)
    assert kept.copy is not None and kept.copy.read_bytes() == (folder / name).read_bytes()


def test_what_is_not_there(place: Place) -> None:
    good, *_ = write_year(place.folder / "in", 1)
    code, out, err = place.ingest(good, place.folder / "gone.csv")
    assert (code, out) == (2, "")
    assert trouble(err) == (
        f"{place.folder / 'gone.csv'}: no such file or directory; nothing was read, give existing recordings or folders"
    )
    assert place.lake.machines() == []


def test_a_folder_of_everything(place: Place) -> None:
    """Good files in every format, bad files, strangers: what is good goes in, what is bad is told, rows add up."""
    folder = place.folder / "in"
    good = write_year(folder, 3)
    recording(4).to_excel(folder / "20250901.xlsx", index=False)
    for k, (make, name, _) in enumerate(BAD):
        make(folder / f"bad{k}{Path(name).suffix}")
    (folder / "notes.md").write_text("hello")
    (folder / "sub").mkdir()
    (folder / ".hidden.csv").write_text("x")
    code, out, err = place.call("ingest", folder, "--machine", place.machine, "--json")
    assert (code, err) == (0, "")
    rows = pd.DataFrame(json.loads(out))
    assert set(rows[rows["status"] == "new"]["batch_id"]) == {*(g.stem for g in good), "20250901"}
    assert (rows["status"] == "quarantined").sum() == len(BAD) == len(place.lake.quarantined(NAME))
    counted = rows[rows["rows_in"].notna()]
    assert (counted["rows_in"] == counted["rows_stored"] + counted["rows_dropped"]).all()
    assert rows[rows["status"] == "new"]["rows_stored"].sum() == sum(len(recording(k)) for k in (0, 1, 2, 4))


def test_a_folder_without_recordings(place: Place) -> None:
    (place.folder / "in").mkdir()
    (place.folder / "in" / "notes.md").write_text("hello")
    code, _, err = place.ingest(place.folder / "in")
    assert code == 2
    assert trouble(err) == (
        f"{place.folder / 'in'}: no recording there, 1 other files; the machine file takes *.csv, *.xlsx; give "
        "another folder or correct recording.files"
    )


def test_two_batches_of_one_name(place: Place) -> None:
    """Within one ingest the first stays and the other waits in quarantine; a later one is a new version."""
    (first,) = write_year(place.folder / "a", 1)
    (other,) = write_year(place.folder / "b", 1)
    recording(0).head(40).to_csv(other, index=False)
    code, out, _ = place.ingest(place.folder / "a", place.folder / "b")
    assert code == 0 and "batches new: 1" in out and "batches conflict: 1" in out
    reason = place.reasons()[first.name]
    assert f"has other content than the batch of that id in {first}" in reason
    assert "the first one is stored, this one is left out; give one of them another name" in reason
    assert len(place.lake.versions(NAME, first.stem)) == 1
    code, out, _ = place.ingest(other)
    assert code == 0 and "batches new version: 1" in out
    versions = place.lake.versions(NAME, first.stem)
    assert [v.rows for v in versions] == [73, 40] and [v.current for v in versions] == [False, True]
    assert place.lake.load(NAME, first.stem, 1).n_rows == 73


def test_what_is_stored_stays_when_the_source_turns_bad(place: Place) -> None:
    (good,) = write_year(place.folder / "in", 1)
    place.ingest(good)
    before = place.lake.load(NAME, good.stem)
    junk(good)
    assert place.ingest(good)[0] == 2
    after = place.lake.load(NAME, good.stem)
    pd.testing.assert_frame_equal(before.table, after.table)
    assert place.lake.batch_ids(NAME) == [good.stem]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("step_s:", "stepp_s:", "unknown key 'recording.stepp_s'; did you mean 'step_s'? Allowed: decimal"),
        ("resolution: 1,", "resolutoin: 1,", "unknown key 'channels.speed.resolutoin'; did you mean 'resolution'?"),
        ("role: ambient", "role: room", "key 'channels.room.role': got 'room'"),
        ("step_s: 300", "step_s: -1", "key 'recording.step_s': got -1"),
        ("machine: small-bad", "machin: small-bad", "unknown key 'machin'; did you mean 'machine'?"),
        ("channels:", "channels: [", "not valid YAML"),
        ("unit: um", "unit: furlong", "channel 'x' (error) has the unknown unit 'furlong'; write unit: um"),
        ("unit: um", "unit: mm", "channel 'x' (error) has unit 'mm', expected 'um'; write unit: um and"),
        ("unit: degC", "unit: um", "channel 'front' (temperature) has unit 'um', expected 'degC'; correct it"),
    ],
)
def test_a_machine_file_that_is_wrong(old: str, new: str, words: str, place: Place) -> None:
    files = write_year(place.folder / "in", 1)
    text = place.machine.read_text()
    assert old in text
    place.machine.write_text(text.replace(old, new, 1))
    code, out, err = place.ingest(*files)
    assert code == 2
    assert words in trouble(err) and out == ""
    assert place.lake.machines() == []


def test_a_machine_file_that_is_not_there_or_not_one(place: Place) -> None:
    files = write_year(place.folder / "in", 1)
    code, _, err = place.call("ingest", *files, "--machine", place.folder / "gone.yml")
    assert code == 2 and "gone.yml: cannot be read" in trouble(err) and "give the path of a .yml file" in trouble(err)
    code, _, err = place.call("ingest", *files, "--machine", files[0])
    assert code == 2 and "expected a mapping with the keys machine and channels" in trouble(err)


def test_a_machine_without_an_error_channel_learns_nothing(place: Place) -> None:
    place.machine.write_text(place.machine.read_text().replace("role: error", "role: position"))
    code, _, err = place.call("train", "--machine", place.machine, "--direct")
    assert code == 2
    assert trouble(err) == (
        f"machine {NAME}: no channel has role: error, so there is nothing to learn; give the displacement that role in "
        "the machine file"
    )


def test_training_from_an_empty_lake(place: Place) -> None:
    code, _, err = place.call("train", "--machine", place.machine, "--direct")
    assert code == 2
    assert trouble(err) == (
        f"lake {place.lake.root}: no batch of machine '{NAME}'; it is empty. Run thermodrift ingest first"
    )


def test_training_from_one_recording(place: Place) -> None:
    files = write_year(place.folder / "in", 1)
    code, _, err = place.call("train", "--machine", place.machine, "--recordings", files[0], "--direct",
                              "--families", "zero", "--selectors", "none")  # fmt: skip
    assert code == 2
    assert trouble(err).startswith(
        f"{NAME}: got 1 batch(es), {files[0].stem}, need at least 2; ingest more recordings, or"
    )
    assert "recording.split (driver, pause or every; `thermodrift describe` proposes one)" in trouble(err)
    assert place.lake.batch_ids(NAME) == [files[0].stem]


def test_training_says_what_went_to_quarantine(place: Place) -> None:
    write_year(place.folder / "in", 1)
    junk(place.folder / "in" / "junk.csv")
    code, _, err = place.call("train", "--machine", place.machine, "--recordings", place.folder / "in", "--direct",
                                "--families", "zero", "--selectors", "none")  # fmt: skip
    assert code == 2
    assert "; files in quarantine: 1, first junk.csv: not a text file (binary content); expected" in trouble(err)


def test_the_recording_of_another_machine_for_a_model(
    place: Place, store: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from pipelines.store import model_store
    from tests.toys.training import machine_yaml, toy_batches, toy_model

    model, region = toy_model(toy_batches("toy-other", 4))
    model_store.save(tmp_path / "model", model, machine_yaml("toy-other"), region)
    pd.DataFrame({"Zeit": range(9), "T1": range(9)}).to_csv(tmp_path / "run.csv", index=False)
    code, out, err = place.call("predict", "--model", tmp_path / "model", tmp_path / "run.csv")
    assert (code, out) == (2, "")
    assert trouble(err).startswith("run.csv: none of its 2 columns is a channel of machine toy-other; got 'Zeit', 'T1'")
    code, out, err = place.call("predict", "--model", tmp_path, tmp_path / "run.csv")
    assert code == 2 and "not a stored model" in trouble(err) and "expected the files model.json" in trouble(err)


@pytest.mark.parametrize("make", [empty, junk, cut_xlsx, header_only], ids=lambda f: f.__name__)
def test_describe_of_what_is_no_recording(make: Callable[[Path], None], place: Place) -> None:
    path = place.folder / ("a.xlsx" if make is cut_xlsx else "a.csv")
    make(path)
    code, out, err = place.call("describe", path)
    assert (code, out) == (2, "")
    assert trouble(err).startswith(path.name)


def test_describe_writes_into_a_new_folder_or_says_why_not(place: Place) -> None:
    source = place.folder / "20240101.csv"
    recording(1).to_csv(source, index=False)
    code, _, err = place.call("describe", source, "--out", place.folder / "new" / "m.yml")
    few = "a champion needs at least 9 runs, there is 1; with fewer `train` makes a provisional model at most\n"
    assert (code, err) == (0, few) and (place.folder / "new" / "m.yml").read_text().startswith("# Drafted from")
    (place.folder / "file").write_text("x")
    code, _, err = place.call("describe", source, "--out", place.folder / "file" / "m.yml")
    assert code == 2 and trouble(err).startswith(f"--out {place.folder}/file/m.yml: cannot be written (")
    for args in (["a" * 5000], [source, "--out", "b" * 5000]):
        code, _, err = place.call("describe", *args)
        assert code == 2 and len(trouble(err)) < 200


@pytest.mark.parametrize("home", ["/proc/nope", "{}/small.yml"])
@pytest.mark.parametrize("command", [["status"], ["train", "--recordings", "{}/in", "--machine", "{}/small.yml"]])
def test_a_home_that_cannot_be_made_is_one_line(
    place: Place, monkeypatch: pytest.MonkeyPatch, home: str, command: list[str]
) -> None:
    write_year(place.folder / "in", 1)
    monkeypatch.delenv("PREFECT_HOME", raising=False)
    monkeypatch.setenv("THERMODRIFT_HOME", home.format(place.folder))
    code, out, err = place.call(*(part.format(place.folder) for part in command))
    assert (code, out) == (2, "")
    assert re.match(
        r"/.*/prefect: no folder can be made there \(.*\); let THERMODRIFT_HOME name another$", trouble(err)
    )


def test_comments_and_blank_lines_are_no_rows(place: Place) -> None:
    (place.folder / "a.csv").write_text("# logger 7\n\ntime_s,front,bed,room,speed,x,z\n\n")
    done = place.call("ingest", place.folder / "a.csv", "--machine", place.machine, "--json")
    assert json.loads(done.out)[0]["rows_in"] == 0


def test_describe_of_what_is_no_file(place: Place) -> None:
    code, _, err = place.call("describe", place.folder / "gone.csv")
    assert (code, trouble(err)) == (2, "gone.csv: no such file; give the path of a recording")
    code, _, err = place.call("describe", place.folder)
    assert code == 2
    assert trouble(
        err
    ) == f"{place.folder.name}: is a directory, expected one recording file; give its files, such as " + (
        f"{place.folder}/*.csv"
    )


@pytest.mark.parametrize(
    "text", ["[" * 100_000, '{"a":' * 100_000, "{", "\0"], ids=["lists", "objects", "cut", "no text"]
)
@pytest.mark.parametrize(
    ("file", "command"),
    [
        (f"home/lake/_manifest/machine={NAME}.json", ("lake", "list")),
        (f"home/lake/_quarantine/machine={NAME}/reasons.jsonl", ("lake", "list")),
        ("model/model.json", ("predict", "in", "--model", "model")),
        ("small.yml", ("ingest", "in", "--machine", "small.yml")),
        ("mlflow.yml", ("status",)),
    ],
)  # fmt: skip
def test_a_file_that_is_damaged_or_nested_without_end_is_one_line(
    place: Place, monkeypatch: pytest.MonkeyPatch, file: str, command: tuple[str, ...], text: str
) -> None:
    monkeypatch.chdir(place.folder)
    write_year(place.folder / "in", 1)
    place.ingest(place.folder / "in")
    (place.folder / file).parent.mkdir(parents=True, exist_ok=True)
    (place.folder / file).write_text(text)
    done = place.call(*command)
    assert done.code in (1, 2) and Path(file).name in trouble(done.err)
