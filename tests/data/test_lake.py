"""The lake against plain readers, plain copies of what was put, and random histories."""

import io
import tempfile
from dataclasses import replace
from pathlib import Path

import duckdb
import numpy as np
import pandas as pd
import pyarrow.dataset as ds
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from data.batch import Batch, Channel, Finding
from data.errors import InputError, WorkError
from data.lake import Lake
from data.lakefile import content_digest, encode, safe_name
from tests.data.lakes import files, make, overwrite, same

FINDING = Finding("frozen", "T1", "T1 stands at 20.0 degC for 3 h", 0.0, 60.0)


def test_round_trip_keeps_everything(place: Path | str) -> None:
    batch = make(findings=(FINDING,), repairs={"duplicates": 2}, labels={"speed": 4000, "who": "Ä 冬"}, simulated=True)
    stored = Lake(place).put(batch)
    back = Lake(place).load("vmc", "run1")
    same(back, batch)
    assert (back.digest, back.version, back.source) == (stored.digest, 1, "in/run1.csv")
    assert content_digest(back) == stored.digest == content_digest(batch)


def test_plain_readers_see_current_rows_only(tmp_path: Path) -> None:
    lake = Lake(tmp_path)
    lake.put(make("run1", seed=1))
    lake.put_many([make("run1", seed=2), make("run2", start=None, simulated=True)])
    lake.quarantine(Path(__file__), "vmc", "not a recording")
    frames = {
        "pyarrow": ds.dataset(tmp_path, format="parquet", partitioning="hive").to_table().to_pandas(),
        "pandas": pd.read_parquet(tmp_path),
        "duckdb": duckdb.sql(f"from read_parquet('{tmp_path}/*/*/*.parquet', hive_partitioning=true)").df(),
    }
    for name, frame in frames.items():
        assert len(frame) == 10, name
        assert set(frame["machine"].astype(str)) == {"vmc"}, name
        one, two = frame[frame["batch"] == "run1"], frame[frame["batch"] == "run2"]
        assert set(one["year"].astype(int)) == {2026} and set(two["year"].astype(int)) == {0}, name
        assert not one["simulated"].any() and two["simulated"].all(), name
        np.testing.assert_array_equal(one["T1"], make(seed=2).values("T1"), err_msg=name)
    query = f"select avg(z_um) as mean from read_parquet('{tmp_path}/*/*/*.parquet') where batch = 'run2'"
    assert duckdb.sql(query).df()["mean"][0] == pytest.approx(
        np.nanmean(make().values("z_um"))
    )  # nothing recorded is null, not NaN


def test_same_content_is_stored_once(tmp_path: Path) -> None:
    lake = Lake(tmp_path)
    batch = make()
    first = lake.put(batch)
    before = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*") if p.is_file()}
    turned = replace(batch, table=batch.table[["z_um", "time_s", "T1"]], source="elsewhere/run1.csv")
    again = lake.put(turned)
    assert (first.status, again.status, again.version, again.digest) == ("new", "unchanged", 1, first.digest)
    assert {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*") if p.is_file()} == before
    assert lake.load("vmc", "run1").source == "in/run1.csv"


def changed(batch: Batch, what: str) -> Batch:
    table = batch.table.copy()
    if what == "a float":
        table.loc[3, "T1"] = np.nextafter(table.loc[3, "T1"], 99.0)
    elif what == "a hole":
        table.loc[3, "T1"] = np.nan
    elif what == "a row":
        table = table.iloc[:-1]
    elif what == "a name":
        table = table.rename(columns={"T1": "rpm"})
    elif what == "a unit":
        return replace(batch, channels={**batch.channels, "T1": Channel("T1", "temperature", "K")})
    else:
        return replace(
            batch,
            **{"the start": {"start": pd.Timestamp("2027-03-01")}, "a label": {"labels": {"speed": 4001}}}.get(
                what, {"simulated": True}
            ),
        )
    return replace(batch, table=table)


@pytest.mark.parametrize(
    "what", ["a float", "a hole", "a row", "a name", "a unit", "the start", "a label", "simulated"]
)
def test_any_changed_content_is_a_new_version(place: Path | str, what: str) -> None:
    lake = Lake(place)
    old, new = make(), changed(make(), what)
    lake.put(old)
    stored = lake.put(new)
    assert (stored.status, stored.version) == ("new_version", 2)
    same(lake.load("vmc", "run1", version=1), old)
    assert lake.load("vmc", "run1").digest == stored.digest
    assert [v.current for v in lake.versions("vmc", "run1")] == [False, True]
    assert sum(name.startswith("machine=vmc/year=") for name in files(lake)) == 1


def test_new_findings_refresh_the_version_and_keep_the_old_ones(place: Path | str) -> None:
    lake = Lake(place)
    first = lake.put(make())
    second = lake.put(make(findings=(FINDING,)))
    assert (second.status, second.version, second.digest) == ("refreshed", 1, first.digest)
    assert lake.load("vmc", "run1").findings == (FINDING,)
    (version,) = lake.versions("vmc", "run1")
    assert len(version.files) == 2 and {*version.files} <= {*files(lake)} and lake.size(version.files[0]) > 1000
    assert lake.put(make(findings=(FINDING,))).status == "unchanged"


def test_load_all_sorts_by_start_then_id(place: Path | str) -> None:
    lake = Lake(place)
    lake.put_many([make("c", start="2026-01-02"), make("z", start=None), make("b", start="2025-07-01"), make("a")])
    lake.put(make("other", machine="lathe"))
    assert [b.batch_id for b in lake.load_all("vmc")] == ["b", "c", "a", "z"]
    assert (lake.machines(), lake.batch_ids("lathe")) == (["lathe", "vmc"], ["other"])


@pytest.mark.parametrize("batch_id", ["_hidden", ".dot", "a/b", "../up", "100%", "冬 1", "x" * 300, "", "a=b", "K*[1]"])
def test_any_id_is_a_file_that_plain_readers_find(tmp_path: Path, batch_id: str) -> None:
    lake = Lake(tmp_path)
    lake.put(make(batch_id))
    same(lake.load("vmc", batch_id), make(batch_id))
    assert set(pd.read_parquet(tmp_path)["batch"]) == {batch_id}
    assert all(tmp_path in p.resolve().parents for p in tmp_path.rglob("*.parquet"))


@given(st.text(), st.text())
def test_different_ids_never_share_a_name(a: str, b: str) -> None:
    assert (safe_name(a) == safe_name(b)) == (a == b)


def test_a_deleted_current_file_comes_back_and_versions_are_read_only(tmp_path: Path) -> None:
    lake = Lake(tmp_path)
    lake.put(make())
    (current,) = tmp_path.glob("machine=vmc/year=2026/*.parquet")
    assert current.stat().st_mode & 0o222 == 0
    current.unlink()
    assert lake.put(make()).status == "unchanged"
    assert len(pd.read_parquet(current)) == 5


def test_without_hard_links_the_current_file_is_a_copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError("no hard links here")

    monkeypatch.setattr("os.link", refuse)
    lake = Lake(tmp_path)
    for seed in (1, 2, 2):
        lake.put(make(seed=seed))
    np.testing.assert_array_equal(pd.read_parquet(tmp_path)["T1"], make(seed=2).values("T1"))


def test_quarantine_keeps_bytes_and_reason_once(place: Path | str, tmp_path: Path) -> None:
    source = tmp_path / "run 7.csv"
    source.write_bytes(b"\x00junk")
    lake = Lake(place)
    copy = lake.quarantine(source, "vmc", "run 7.csv: not text")
    assert lake.quarantine(source, "vmc", "run 7.csv: not text") == copy
    (kept,) = [body for name, body in files(lake).items() if name.endswith("-run 7.csv")]
    assert kept == source.read_bytes() and copy.name.endswith("-run 7.csv")
    (entry,) = lake.quarantined("vmc")
    assert (entry.reason, entry.source, entry.copy) == ("run 7.csv: not text", str(source), copy)
    source.write_bytes(b"other junk")
    assert lake.quarantine(source, "vmc", "run 7.csv: not text") != copy
    assert len(lake.quarantined("vmc")) == 2 and sum("-run 7.csv" in name for name in files(lake)) == 2


def test_quarantine_of_an_unreadable_file_keeps_the_reason(tmp_path: Path) -> None:
    folder = tmp_path / "folder.csv"
    folder.mkdir()
    assert Lake(tmp_path / "lake").quarantine(folder, "vmc", "no recording").exists()
    (entry,) = Lake(tmp_path / "lake").quarantined("vmc")
    assert entry.copy is None and entry.reason.startswith("no recording (no copy kept: its bytes cannot be read,")


def test_unknown_names_are_told_with_the_closest(tmp_path: Path) -> None:
    lake = Lake(tmp_path / "lake")
    assert lake.machines() == [] and lake.batch_ids("vmc") == [] and lake.quarantined("vmc") == []
    with pytest.raises(InputError, match=r"lake .*: no batch of machine 'vmc'; it is empty\. Run thermodrift ingest"):
        lake.load_all("vmc")
    assert not (tmp_path / "lake").exists()
    lake.put(make())
    with pytest.raises(InputError, match="no batch of machine 'vmd'; did you mean 'vmc'"):
        lake.load_all("vmd")
    with pytest.raises(InputError, match="vmc has no batch 'run2'; did you mean 'run1'"):
        lake.load("vmc", "run2")
    with pytest.raises(InputError, match=r"has no version 3; expected 1$"):
        lake.load("vmc", "run1", 3)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"table": pd.DataFrame({"T1": [1.0]})}, "expected time_s and one column per channel"),
        ({"table": pd.DataFrame({"time_s": [0.0], "T9": [1.0]})}, "column 'T9' is no channel of the batch"),
        ({"labels": {"who": object()}}, "label of type object cannot be stored"),
        (
            {
                "table": pd.DataFrame({"time_s": [0.0], "year": [1.0]}),
                "channels": {"year": Channel("year", "driver", "1")},
            },
            "channel 'year' has a name that the lake keeps for itself",
        ),
    ],
)
def test_a_batch_that_cannot_be_stored_leaves_the_lake_as_it_was(
    tmp_path: Path, change: dict[str, object], words: str
) -> None:
    with pytest.raises(InputError, match=f"batch run1 of vmc: .*{words}"):
        Lake(tmp_path).put(make(**change))
    assert list(tmp_path.rglob("*.parquet")) == []


def test_damage_is_told_in_one_line(tmp_path: Path) -> None:
    lake = Lake(tmp_path)
    lake.put(make())
    overwrite(lake, lake.versions("vmc", "run1")[0].files[0], b"PAR1")
    with pytest.raises(WorkError, match=r"cannot be read .*; restore it from a backup") as told:
        lake.load("vmc", "run1")
    assert "\n" not in str(told.value)
    (tmp_path / "_manifest.json").write_text("{")
    with pytest.raises(WorkError, match=r"_manifest\.json: cannot be read"):
        lake.machines()


@pytest.mark.parametrize("damage", ["values", "cut", "a byte", "gone"])
def test_a_file_changed_after_its_ingest_is_refused_and_healed(place: Path | str, damage: str) -> None:
    lake = Lake(place)
    batch = make(findings=(FINDING,))
    digest = lake.put_many([batch, make("run2", seed=2)])[0].digest
    file = lake.versions("vmc", "run1")[-1].files[-1]
    body = files(lake)[file]
    other_values = encode(make(seed=7), digest).to_pybytes()  # valid, with the note of the right ones
    changed = {"values": other_values, "cut": body[:-40], "a byte": body[:9] + b"?" + body[10:], "gone": None}
    overwrite(lake, file, changed[damage])
    for reading in (lambda: lake.load("vmc", "run1"), lambda: lake.load_all("vmc")):
        with pytest.raises(WorkError, match=r"(?s)lake file .*: .*cannot be read .*ingest its source .*again") as told:
            reading()
        assert len(str(told.value).splitlines()) == 1
        assert f"{lake.name}/{file}" in str(told.value) and "batch run1 of vmc" in str(told.value)
        assert "in/run1.csv" in str(told.value)
    stored = lake.put(batch)
    assert stored.status == "healed"
    assert (stored.version, stored.digest) == (1, digest)
    same(lake.load("vmc", "run1"), batch)
    current = pd.read_parquet(io.BytesIO(files(lake)["machine=vmc/year=2026/run1.parquet"]))
    np.testing.assert_array_equal(current["T1"], batch.values("T1"))
    assert lake.put(batch).status == "unchanged"
    assert len(lake.load_all("vmc")) == 2


def test_one_file_of_two_versions_is_healed_for_both(place: Path | str) -> None:
    lake = Lake(place)
    for seed in (1, 2, 1):
        lake.put(make(seed=seed))
    overwrite(lake, lake.versions("vmc", "run1")[-1].files[-1], b"PAR1")
    assert lake.put(make(seed=1)).status == "healed"
    for version in (1, 3):
        same(lake.load("vmc", "run1", version), make(seed=1))


STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("put"), st.sampled_from("ab"), st.integers(0, 2), st.sampled_from([None, "2025", "2026"])),
        st.tuples(st.just("note"), st.sampled_from("ab"), st.integers(0, 2), st.none()),
        st.tuples(st.just("junk"), st.sampled_from("ab"), st.integers(0, 2), st.none()),
    ),
    max_size=10,
)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(STEPS)
def test_any_history_is_kept(steps: list[tuple[str, str, int, str | None]]) -> None:
    """Held against a plain list of everything that was put."""
    with tempfile.TemporaryDirectory() as folder:
        lake, history, junk = Lake(Path(folder) / "lake"), {"a": [], "b": []}, set()
        for kind, name, seed, start in steps:
            if kind == "junk":
                file = Path(folder) / f"{name}.csv"
                file.write_text(f"junk {seed}")
                lake.quarantine(file, "vmc", "junk")
                junk.add((file.name, f"junk {seed}"))
                continue
            old = history[name]
            if kind == "note":
                batch = replace(old[-1] if old else make(name), repairs={"duplicates": seed})
            else:
                batch = make(name, seed=seed, start=start)
            stored = lake.put(batch)
            if old and content_digest(old[-1]) == content_digest(batch):
                old[-1] = batch
            else:
                old.append(batch)
            assert stored.version == len(old)
        for name, versions in history.items():
            for number, batch in enumerate(versions, 1):
                same(lake.load("vmc", name, number), batch)
            if versions:
                same(lake.load("vmc", name), versions[-1])
                (current,) = lake.root.glob(f"machine=vmc/year=*/{name}.parquet")
                np.testing.assert_array_equal(pd.read_parquet(current)["T1"], versions[-1].values("T1"))
                listed = lake.versions("vmc", name)
                assert [v.current for v in listed] == [False] * (len(versions) - 1) + [True]
                assert [v.digest for v in listed] == [content_digest(b) for b in versions]
        kept = {(e.name, e.copy.read_text()) for e in lake.quarantined("vmc") if e.copy}
        assert kept == junk


def test_a_write_touches_the_manifest_of_its_machine_alone(tmp_path: Path) -> None:
    lake = Lake(tmp_path)
    lake.put_many([make(), replace(make("run3", seed=3), machine="lathe")])
    other, head = tmp_path / "_manifest/machine=lathe.json", tmp_path / "_manifest.json"
    before, changed = other.stat().st_mtime_ns, head.read_text()
    lake.put(make("run2", seed=2))
    assert other.stat().st_mtime_ns == before and head.read_text() != changed
    assert lake.batch_ids("lathe") == ["run3"]
