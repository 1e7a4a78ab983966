"""Ingest with readers and checks replaced by plain ones, then once through the real door."""

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import data.ingest
from data.batch import Batch, Finding
from data.errors import InputError, WorkError
from data.ingest import COLUMNS, IngestReport, ingest
from data.lake import Lake
from data.machine import Machine, Overrule, parse_machine

MACHINE = parse_machine(
    """
machine: vmc
recording: {files: ["*.csv"], time: {column: t, unit: s}, step_s: 60, max_gap_s: 300}
channels:
  T1: {role: temperature, unit: degC, resolution: 0.1, range: [-10, 90]}
  z_um: {role: error, unit: um, resolution: 0.1, range: [-500, 500]}
""",
    "test",
)


def fake_batches(path: Path, machine: Machine) -> Iterator[Batch]:
    """Reads `id,value,rows,dropped` lines, one batch each; `!` is an unusable line, `?` an unforeseen failure."""
    for line in path.read_text().splitlines()[1:]:
        if line == "!":
            raise InputError(f"{path}: row 7: not a number")
        if line == "?":
            raise ValueError("first\nsecond")
        name, value, rows, dropped = line.split(",")
        table = pd.DataFrame({"time_s": np.arange(3) * 60.0, "T1": float(value), "z_um": np.nan})
        channels = machine.batch_channels()
        repairs = {"rows_in": int(rows), "rows_dropped": int(dropped)}
        yield Batch(machine.machine, name, table, channels, source=str(path), repairs=repairs)


@pytest.fixture
def lake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Lake:
    monkeypatch.setattr(data.ingest, "read_batches", fake_batches)
    monkeypatch.setattr(data.ingest, "check_batch", lambda b, m: (Finding("spike", "T1", "one"),))
    return Lake(tmp_path / "lake")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Of the recordings."""
    (tmp_path / "in").mkdir()
    return tmp_path / "in"


def write(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(["header", *lines, ""]))
    return path


def balanced(report: IngestReport) -> None:
    frame = report.as_frame()
    assert tuple(frame.columns) == COLUMNS
    assert report.rows_in == report.rows_stored + report.rows_dropped
    assert report.rows_in == frame["rows_in"].sum() and report.rows_stored == frame["rows_stored"].sum()
    for row in report.rows:
        assert row.rows_in is None or row.rows_in == row.rows_stored + (row.rows_dropped or 0)


def test_files_go_in_once_with_findings_and_row_counts(tmp_path: Path, lake: Lake) -> None:
    files = [write(tmp_path / "a.csv", "a1,1.0,100,5", "a2,2.0,50,0"), write(tmp_path / "b.csv", "b,3.0,20,20")]
    said: list[str] = []
    report = ingest(files, MACHINE, lake, said.append)
    balanced(report)
    assert said == ["1/2 a.csv", "2/2 b.csv"]
    assert [(r.batch_id, r.status, r.version, r.findings) for r in report.rows] == [
        ("a1", "new", 1, 1),
        ("a2", "new", 1, 1),
        ("b", "new", 1, 1),
    ]
    assert (report.rows_in, report.rows_stored, report.rows_dropped) == (170, 145, 25)
    assert lake.load("vmc", "a1").findings == (Finding("spike", "T1", "one"),)
    assert [r.found for r in report.rows] == 3 * [(Finding("spike", "T1", "one"),)]
    again = ingest(files, MACHINE, lake)
    assert {r.status for r in again.rows} == {"unchanged"}
    write(tmp_path / "b.csv", "b,3.5,20,1")
    changed = ingest(files, MACHINE, lake)
    assert [(r.status, r.version, r.reason) for r in changed.rows][2] == ("new_version", 2, "")


def test_findings_of_the_reader_stay_before_those_of_the_checks(
    tmp_path: Path, lake: Lake, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = Finding("clock", None, "set back once", masks=False)
    monkeypatch.setattr(data.ingest, "read_batches", lambda p, m: (b.with_findings((own,)) for b in fake_batches(p, m)))
    ingest([write(tmp_path / "a.csv", "a,1,3,0")], MACHINE, lake)
    assert [f.check for f in lake.load("vmc", "a").findings] == ["clock", "spike"]


def test_a_directory_of_mixed_files(folder: Path, lake: Lake) -> None:
    good = write(folder / "good.csv", "good,1,3,0")
    write(folder / "bad.csv", "!", "never,1,3,0")
    notes = write(folder / "notes.md", "words")
    report = ingest([folder, good, folder], MACHINE, lake)
    balanced(report)
    assert [(Path(r.file).name, r.status) for r in report.rows] == [("bad.csv", "quarantined"), ("good.csv", "new")]
    assert report.ignored == [(notes, "not in recording.files (*.csv)")]
    (entry,) = lake.quarantined("vmc")
    assert entry.reason == f"{folder / 'bad.csv'}: row 7: not a number" == report.quarantined[0].reason
    assert entry.copy is not None and entry.copy.read_bytes() == (folder / "bad.csv").read_bytes()
    assert (report.rows_in, report.rows_stored, report.rows_dropped) == (5, 3, 2)


def test_a_file_that_breaks_half_way_keeps_its_first_batches(tmp_path: Path, lake: Lake) -> None:
    file = write(tmp_path / "a.csv", "a1,1,2,1", "?")
    write(tmp_path / "b.csv", "b,2,3,0")
    report = ingest([file, tmp_path / "b.csv"], MACHINE, lake)
    balanced(report)
    assert [(r.batch_id, r.status) for r in report.rows] == [("a1", "new"), ("", "quarantined"), ("b", "new")]
    (entry,) = lake.quarantined("vmc")
    assert entry.reason == (
        f"{file}: cannot be used (ValueError: first second); expected a recording as the machine file of vmc "
        "describes it; export it again"
    )


def test_two_files_with_one_id_are_a_conflict_and_neither_is_lost(tmp_path: Path, lake: Lake) -> None:
    one, two = write(tmp_path / "one.csv", "run,1,3,0"), write(tmp_path / "two.csv", "run,2,4,0", "more,2,4,0")
    for status in ("new", "unchanged"):  # the same again is the same again
        report = ingest([one, two], MACHINE, lake)
        balanced(report)
        assert [(r.batch_id, r.status) for r in report.rows] == [("run", status), ("run", "conflict"), ("more", status)]
        assert (report.rows_stored, report.rows_dropped) == (7, 4)
        (entry,) = lake.quarantined("vmc")
        assert entry.name == "two.csv"
        assert entry.reason == report.quarantined[0].reason
        assert entry.reason == (
            f"{two}: batch 'run' has other content than the batch of that id in {one}; the first one is stored, "
            "this one is left out; give one of them another name and ingest it again"
        )
    assert lake.load("vmc", "run").values("T1")[0] == 1.0
    assert len(lake.versions("vmc", "run")) == 1


def test_two_files_with_one_id_and_one_content_are_no_conflict(tmp_path: Path, lake: Lake) -> None:
    report = ingest([write(tmp_path / f"{n}.csv", "run,1,3,0") for n in "ab"], MACHINE, lake)
    assert [r.status for r in report.rows] == ["new", "unchanged"] and not lake.quarantined("vmc")


def test_another_file_later_is_a_new_version_that_names_the_old_source(tmp_path: Path, lake: Lake) -> None:
    one, two = write(tmp_path / "one.csv", "run,1,3,0"), write(tmp_path / "two.csv", "run,2,3,0")
    ingest([one], MACHINE, lake)
    (row,) = ingest([two], MACHINE, lake).rows
    assert (row.status, row.version) == ("new_version", 2)
    assert row.reason == f"follows the version from {one}, which stays in the lake"


def test_a_missing_path_stops_before_anything_is_read(tmp_path: Path, lake: Lake) -> None:
    good = write(tmp_path / "a.csv", "a,1,3,0")
    with pytest.raises(InputError, match=r"gone\.csv: no such file or directory; nothing was read"):
        ingest([good, tmp_path / "gone.csv"], MACHINE, lake)
    assert not lake.root.exists()


def test_a_file_without_a_batch_goes_to_quarantine(tmp_path: Path, lake: Lake) -> None:
    report = ingest([write(tmp_path / "empty.csv")], MACHINE, lake)
    assert report.quarantined[0].reason.endswith("no batch in it; expected a recording of at least two rows")


def test_a_lake_that_cannot_be_written_ends_the_work(tmp_path: Path, lake: Lake) -> None:
    lake.root.write_text("a file stands where the lake should be")
    with pytest.raises(WorkError, match=r"lake .*: cannot be written .*; nothing stored was lost"):
        ingest([write(tmp_path / "a.csv", "a,1,3,0")], MACHINE, lake)


def test_a_batch_that_the_lake_refuses_goes_to_quarantine(
    tmp_path: Path, lake: Lake, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(data.ingest, "read_batches", lambda p, m: (replace(b, channels={}) for b in fake_batches(p, m)))
    report = ingest([write(tmp_path / "a.csv", "a,1,3,0")], MACHINE, lake)
    assert "column 'T1' is no channel of the batch" in report.quarantined[0].reason


def test_through_the_real_readers_and_checks(tmp_path: Path, folder: Path) -> None:
    """Real CSV in, the same numbers out; every kind of unusable file beside it is named."""
    rng = np.random.default_rng(1)
    wanted = {}
    for name in ("run1", "run2"):
        n = 120
        t = np.arange(n) * 60.0
        frame = pd.DataFrame(
            {
                "t": t,
                "T1": np.round(20.0 + 5.0 * (1.0 - np.exp(-t / 3600.0)) + rng.normal(0, 0.05, n), 1),
                "z_um": np.round(30.0 * (1.0 - np.exp(-t / 3600.0)) + rng.normal(0, 0.3, n), 1),
            }
        )
        wanted[name] = frame
        frame.to_csv(folder / f"{name}.csv", index=False)
    (folder / "empty.csv").write_bytes(b"")
    (folder / "junk.csv").write_bytes(rng.bytes(4096))
    (folder / "one_row.csv").write_text("t,T1,z_um\n0,20.0,0.0\n")
    (folder / "others.csv").write_text("time,a,b\n0,1,2\n60,1,2\n120,1,2\n")
    (folder / "readme.md").write_text("not a recording")
    lake = Lake(tmp_path / "lake")
    report = ingest([folder], MACHINE, lake)
    balanced(report)
    assert {Path(r.file).name for r in report.quarantined} == {"empty.csv", "junk.csv", "one_row.csv", "others.csv"}
    assert all("\n" not in r.reason and Path(r.file).name in r.reason for r in report.quarantined)
    assert len(lake.quarantined("vmc")) == 4 and [p.name for p, _ in report.ignored] == ["readme.md"]
    assert report.rows_stored == 240
    for batch in lake.load_all("vmc"):
        for mine, theirs in (("time_s", "t"), ("T1", "T1"), ("z_um", "z_um")):
            np.testing.assert_allclose(batch.table[mine], wanted[batch.batch_id][theirs], atol=1e-9)
    assert {r.status for r in ingest([folder], MACHINE, lake).batches} == {"unchanged"}
    assert len(lake.quarantined("vmc")) == 4


def test_the_report_tells_what_the_user_overrules_and_the_lake_keeps_what_was_found(tmp_path: Path, lake: Lake) -> None:
    machine = MACHINE.model_copy(update={"overrule": [Overrule(check="spike", reason="checked by hand")]})
    (row,) = ingest([write(tmp_path / "a.csv", "a1,1.0,100,5")], machine, lake).rows
    assert row.found == (Finding("spike", "T1", "one", overruled="checked by hand"),)
    assert lake.load("vmc", "a1").findings == (Finding("spike", "T1", "one"),)


def statuses(report: IngestReport) -> list[tuple[str, str]]:
    balanced(report)
    return [(r.batch_id, r.status) for r in report.rows]


def test_a_copy_under_another_name_is_left_out(folder: Path, lake: Lake) -> None:
    write(folder / "a copy.csv", "a copy,1,30,2")
    write(folder / "run.csv", "run,1,30,2", "more,2,30,2")
    report = ingest([folder], MACHINE, lake)
    assert statuses(report) == [("run", "new"), ("more", "new"), ("a copy", "duplicate")]
    assert report.rows[2].reason == "the same measured values as batch run, which is stored"
    assert (report.rows[2].stored_as, report.rows_stored, report.rows_dropped) == ("run", 56, 34)
    report = ingest([write(folder / "later.csv", "later,2,30,2")], MACHINE, lake)
    assert statuses(report) == [("later", "duplicate")] and report.rows[0].stored_as == "more"
    assert lake.batch_ids("vmc") == ["more", "run"] and not lake.quarantined("vmc")


def test_a_withdrawn_recording_stays_out(tmp_path: Path, lake: Lake) -> None:
    files = [write(tmp_path / "a.csv", "a,1,30,2"), write(tmp_path / "b.csv", "b,2,30,2")]
    ingest(files, MACHINE, lake)
    lake.withdraw("vmc", ["a"], "door open")
    files.append(write(tmp_path / "c.csv", "c,1,30,2"))
    report = ingest(files, MACHINE, lake)
    assert statuses(report) == [("a", "withdrawn"), ("b", "unchanged"), ("c", "withdrawn")]
    assert {r.reason for r in report.rows if r.status == "withdrawn"} == {
        "withdrawn: door open; restore with `thermodrift lake restore vmc a`"
    }
    lake.restore("vmc", ["a"])
    assert statuses(ingest(files, MACHINE, lake)) == [("a", "unchanged"), ("b", "unchanged"), ("c", "duplicate")]


def test_subfolders_are_read_and_every_file_is_listed(tmp_path: Path, lake: Lake) -> None:
    for k, name in enumerate(("b.csv", "2025/a.csv", "2025/b.csv", "2025/x/b.csv", ".git/a.csv", "lake/a.csv")):
        (tmp_path / "in" / name).parent.mkdir(parents=True, exist_ok=True)
        write(tmp_path / "in" / name, f"{Path(name).stem},{k + 1},3,0")
    for name in ("lake/_manifest.json", "2025/notes.md", "2025/~$a.csv", "2025/.~lock.b.csv#", "2025/.DS_Store"):
        (tmp_path / "in" / name).write_text("")
    (tmp_path / "in" / "linked").symlink_to(tmp_path / "in" / "2025")
    report = ingest([tmp_path / "in"], MACHINE, lake)
    assert statuses(report) == [("b", "new"), ("2025/a", "new"), ("2025/b", "new"), ("2025/x/b", "new")]
    assert {f.name: reason for f, reason in report.ignored} == {
        ".git": "hidden",
        "lake": "a lake",
        "linked": "link to a folder",
        "notes.md": "not in recording.files (*.csv)",
        "~$a.csv": "lock file of an open document",
        ".~lock.b.csv#": "lock file of an open document",
        ".DS_Store": "hidden",
    }
    assert (report.as_frame()["status"] == "ignored").sum() == 7
    assert lake.load("vmc", "2025/b").values("T1")[0] == 3.0
    assert statuses(ingest([tmp_path / "in" / "2025"], MACHINE, lake)) == [
        ("a", "duplicate"), ("b", "duplicate"), ("x/b", "duplicate"),
    ]  # fmt: skip
    assert lake.load("vmc", "b").values("T1")[0] == 1.0


def test_a_damaged_file_of_the_lake_is_healed_by_its_source(tmp_path: Path, lake: Lake) -> None:
    files = [write(tmp_path / "a.csv", "a,1,30,2"), write(tmp_path / "b.csv", "b,2,30,2")]
    ingest(files, MACHINE, lake)
    stored = lake.root / lake.versions("vmc", "a")[0].files[0]
    stored.chmod(0o644)
    stored.write_bytes(stored.read_bytes()[:-100])
    with pytest.raises(WorkError, match=r"batch a of vmc cannot be read .*or ingest its source .*a\.csv again"):
        lake.load_all("vmc")
    report = ingest(files, MACHINE, lake)
    assert statuses(report) == [("a", "healed"), ("b", "unchanged")]
    assert report.rows[0].reason == (
        "the same content as before; its file in the lake was damaged or gone and is written anew"
    )
    assert lake.load("vmc", "a").values("T1")[0] == 1.0 and len(lake.versions("vmc", "a")) == 1
    assert statuses(ingest(files, MACHINE, lake)) == [("a", "unchanged"), ("b", "unchanged")]


def test_a_growing_file_waits(tmp_path: Path, lake: Lake, monkeypatch: pytest.MonkeyPatch) -> None:
    still, growing = write(tmp_path / "a.csv", "a,1,3,0"), write(tmp_path / "b.csv", "b,2,3,0")
    waits: list[float] = []

    def wait(seconds: float) -> None:
        waits.append(seconds)
        with growing.open("a") as file:
            file.write("c,3,3,0\n")

    now = growing.stat().st_mtime
    clock = SimpleNamespace(time=lambda: now + 1, sleep=wait, monotonic=time.monotonic)
    monkeypatch.setattr(data.ingest, "time", clock)
    report = ingest([still, growing], MACHINE, lake)
    assert statuses(report) == [("a", "new"), ("", "waiting")] and len(waits) == 1
    assert report.waiting[0].reason == f"{growing}: still being written; ingest it again when it is complete"
    assert not lake.quarantined("vmc")
    clock.time = lambda: now + 60
    report = ingest([still, growing], MACHINE, lake)
    assert statuses(report) == [("a", "unchanged"), ("b", "new"), ("c", "new")] and len(waits) == 1


@pytest.mark.parametrize("line", ["b,2,3,0", "!"])
def test_a_file_that_grows_while_it_is_read_waits(
    line: str, tmp_path: Path, lake: Lake, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither its first batches nor the damage at its present end count."""

    def growing(path: Path, machine: Machine) -> Iterator[Batch]:
        lines = path.read_text()
        path.write_text(lines + "c,3,3,0\n")
        yield from fake_batches(path, machine)

    file = write(tmp_path / "a.csv", "a,1,3,0", line)
    monkeypatch.setattr(data.ingest, "read_batches", growing)
    assert statuses(ingest([file], MACHINE, lake)) == [("", "waiting")]
    assert lake.machines() == [] and not lake.quarantined("vmc") and not list(lake.root.rglob("*.parquet"))


def test_the_lakes_own_files_can_be_ingested_again(tmp_path: Path) -> None:
    """Where the recordings are gone: ids, values and units stay, and the machine file's new channel is empty."""
    lake = Lake(tmp_path / "lake")
    table = pd.DataFrame({"t": np.arange(20) * 60.0, "T1": np.linspace(20, 25, 20), "z_um": np.linspace(0, 9, 20)})
    (tmp_path / "in" / "2025").mkdir(parents=True)
    table.to_csv(tmp_path / "in" / "2025" / "run.csv", index=False)
    ingest([tmp_path / "in"], MACHINE, lake)
    more = MACHINE.model_copy(update={"channels": {**MACHINE.channels, "T2": MACHINE.channels["T1"]}})
    assert statuses(ingest([lake.root / "machine=vmc"], more, lake)) == [("2025/run", "new_version")]
    batch = lake.load("vmc", "2025/run")
    assert np.isnan(batch.values("T2")).all()
    np.testing.assert_array_equal(batch.values("T1"), lake.load("vmc", "2025/run", 1).values("T1"))


def test_a_file_that_was_cut_within_a_row_is_named_and_a_link_out_of_the_folder_is_not_followed(
    tmp_path: Path, folder: Path
) -> None:
    lake = Lake(tmp_path / "lake")
    rows = [f"{60 * k},{20 + 0.1 * (k % 7):.1f},{k % 5:.1f}" for k in range(40)]
    whole = "\n".join(["t,T1,z_um", *rows])
    (folder / "run1.csv").write_text(whole[:-9])  # within the last time stamp
    (folder / "run2.csv").write_text(whole)  # whole, without an end of its last line
    secret = tmp_path / "secret.csv"
    secret.write_text("root:x:0")
    (folder / "run3.csv").symlink_to(secret)
    report = ingest([folder], MACHINE, lake)
    found = {r.batch_id: [f.message for f in r.found if f.check == "truncated"] for r in report.rows}
    assert list(found) == ["run1", "run2"] and not found["run2"]
    assert found["run1"][0].startswith("the file ends within a row, 38 min after the start: it was cut")
    assert [r.status for r in report.rows] == ["new", "new"]
    assert [(f.name, reason.partition(";")[0]) for f, reason in report.ignored] == [
        ("run3.csv", "link to a file outside of the folder")
    ]


def test_a_name_that_steers_a_terminal_is_not_taken(tmp_path: Path, folder: Path) -> None:
    for name in ("a\x1b[2J.csv", "b\nthermodrift: all is well.csv"):
        (folder / name).write_text("t,T1,z_um\n0,20,0\n60,21,1\n")
    report = ingest([folder], MACHINE, Lake(tmp_path / "lake"))
    assert not report.rows and {reason for _, reason in report.ignored} == {"control characters in the name; rename it"}
    with pytest.raises(InputError, match=r"a\\x1b\[2J\.csv': a name with control characters; rename it"):
        ingest([folder / "a\x1b[2J.csv"], MACHINE, Lake(tmp_path / "lake"))
