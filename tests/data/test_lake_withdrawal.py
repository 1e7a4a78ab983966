"""Batches out of use and back: withdrawn, restored, purged; copies under another name; kills in between."""

import contextlib
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch, Channel
from data.errors import InputError, WorkError
from data.lake import Lake
from data.lakefile import measured_digest
from tests.data.lakes import crash_everywhere, files, make, plain, run, same


@pytest.fixture
def lake(place: Path | str) -> Lake:
    lake = Lake(place)
    lake.put_many([make("run1", seed=1), make("run2", seed=2), make("other", seed=3, machine="lathe")])
    return lake


@pytest.fixture
def folder(tmp_path: Path) -> Lake:
    lake = Lake(tmp_path / "lake")
    lake.put_many([make("run1", seed=1), make("run2", seed=2)])
    return lake


def versions_of(lake: Lake, batch_id: str) -> list[str]:
    return [name for name in files(lake) if name.startswith(f"_versions/machine=vmc/{batch_id}/")]


def test_a_withdrawn_batch_is_out_of_use_until_it_is_restored(lake: Lake) -> None:
    lake.put(make("run1", seed=9))
    assert lake.withdraw("vmc", ["run1"], " door open ") == ["run1"]
    assert lake.batch_ids("vmc") == ["run2"] and [b.batch_id for b in lake.load_all("vmc")] == ["run2"]
    assert plain(lake) == {"run2", "other"}
    with pytest.raises(
        InputError, match=r"run1 of vmc is withdrawn \(door open\); `thermodrift lake restore vmc run1`"
    ):
        lake.load("vmc", "run1", 1)
    assert [(v.withdrawn.reason, v.current) for v in lake.versions("vmc", "run1") if v.withdrawn] == [
        ("door open", False)
    ] * 2
    assert lake.put(make("run1", seed=1)).status == lake.put(make("run1", seed=9)).status == "withdrawn"
    assert lake.restore("vmc", ["run1"]) == ["run1"]
    assert plain(lake) == {"run1", "run2", "other"}
    same(lake.load("vmc", "run1"), make("run1", seed=9))
    same(lake.load("vmc", "run1", 1), make("run1", seed=1))


def test_a_corrected_recording_follows_a_withdrawn_one(lake: Lake) -> None:
    lake.withdraw("vmc", ["run1"], "wrong sensor")
    stored = lake.put(make("run1", seed=7))
    assert (stored.status, stored.version) == ("new_version", 2)
    same(lake.load("vmc", "run1"), make("run1", seed=7))
    assert lake.put(make("run1", seed=1)).status == "withdrawn"
    lake.restore("vmc", ["run1"])
    assert [v.current for v in lake.versions("vmc", "run1")] == [False, True]
    same(lake.load("vmc", "run1", 1), make("run1", seed=1))


def test_a_forgotten_machine_comes_back_whole(lake: Lake) -> None:
    assert lake.forget_machine("vmc", "sold") == ["run1", "run2"]
    assert lake.machines() == ["lathe"] and lake.machines(withdrawn=True) == ["lathe", "vmc"]
    with pytest.raises(InputError, match="every batch of machine 'vmc' is withdrawn; `thermodrift lake restore vmc"):
        lake.load_all("vmc")
    assert lake.restore("vmc", ["*"]) == ["run1", "run2"] and lake.machines() == ["lathe", "vmc"]


def test_purged_content_is_gone_and_stays_out_until_it_is_forgotten(lake: Lake, tmp_path: Path) -> None:
    junk = tmp_path / "junk.csv"
    junk.write_text("junk")
    lake.quarantine(junk, "vmc", "junk")
    lake.withdraw("vmc", ["run1"], "private")
    assert lake.purge("vmc", ["*"]) == ["run1"] and lake.quarantined("vmc")
    assert not versions_of(lake, "run1")
    assert lake.versions("vmc", "run1")[0].withdrawn.purged_at  # type: ignore[union-attr]
    assert lake.put(make("run1", seed=1)).status == "withdrawn"
    assert not versions_of(lake, "run1")
    lake.restore("vmc", ["run1"])
    assert lake.put(make("run1", seed=1)).status == "new"
    lake.forget_machine("vmc", "sold")
    lake.purge("vmc", ["*"], quarantined=True)
    left = [name for name in files(lake) if "vmc" in name]
    assert left == ["_manifest/machine=vmc.json"] and plain(lake) == {"other"}  # digests and reasons


def test_purging_keeps_versions_in_use(lake: Lake) -> None:
    lake.withdraw("vmc", ["run1"], "wrong sensor")
    lake.put(make("run1", seed=7))
    lake.purge("vmc", ["run1"])
    same(lake.load("vmc", "run1"), make("run1", seed=7))
    lake.restore("vmc", ["run1"])
    assert [(v.version, v.current) for v in lake.versions("vmc", "run1")] == [(2, True)]
    assert lake.put(make("run1", seed=8)).version == 3


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda lake: lake.withdraw("vmc", ["run1"], " "), "the reason is empty"),
        (lambda lake: lake.withdraw("vmc", ["run3"], "x"), "no batch in use that fits 'run3'; did you mean 'run"),
        (lambda lake: lake.withdraw("vmd", ["run1"], "x"), "no batch of machine 'vmd'; did you mean 'vmc'"),
        (lambda lake: lake.restore("vmc", ["run1"]), "no withdrawn batch that fits 'run1'"),
        (lambda lake: lake.purge("vmc", ["run1"]), "no withdrawn batch that fits 'run1'"),
    ],
)
def test_what_cannot_be_done_changes_nothing(lake: Lake, call: object, words: str) -> None:
    before = files(lake)
    with pytest.raises(InputError, match=words):
        call(lake)  # type: ignore[operator]
    assert files(lake) == before


def copy(of: Batch, batch_id: str) -> Batch:
    """The same recording under another name, with what names give: start, labels, the schedule's drivers."""
    table = of.table.assign(rpm=500.0)
    return replace(of, batch_id=batch_id, table=table, start=pd.Timestamp("2027-01-01"), labels={"speed": 500})


def test_measured_values_identify_a_recording_under_any_name() -> None:
    batch = make("run1", seed=1)
    renamed = batch.table.rename(columns={"T1": "front"})
    channels = {**batch.channels, "front": Channel("front", "temperature", "degC")}
    for other in (copy(batch, "b"), replace(batch, table=renamed, channels=channels)):
        assert measured_digest(other) == measured_digest(batch)
    changed = batch.table.assign(T1=batch.table["T1"] + 1e-12)
    assert measured_digest(replace(batch, table=changed)) != measured_digest(batch)


def test_a_copy_is_left_out_where_batches_shall_be_distinct(lake: Lake) -> None:
    def put(batch: Batch) -> tuple[str, str]:
        (stored,) = lake.commit([lake.stage(batch)], distinct=True)
        return stored.status, stored.batch_id

    assert put(copy(make("run1", seed=1), "run9")) == ("duplicate", "run1")
    assert lake.batch_ids("vmc") == ["run1", "run2"]
    if isinstance(lake.root, Path):  # elsewhere another writer may just be using the file
        assert not versions_of(lake, "run9")
    assert put(copy(make("run1", seed=1), "run1")) == ("new_version", "run1")  # other labels of the same batch
    assert put(replace(make("run1", seed=1), batch_id="x", machine="lathe")) == ("new", "x")
    lake.withdraw("vmc", ["run2"], "door open")
    assert put(copy(make("run2", seed=2), "run9")) == ("withdrawn", "run2")


def store_copies(root: Path, who: str) -> None:
    lake = Lake(root)
    for seed in range(20):
        lake.commit([lake.stage(make(f"{who}{seed}", seed=seed))], distinct=True)
        if seed % 5 == 4:
            withdraw_one(lake, who)


def withdraw_one(lake: Lake, who: str) -> None:
    """The first batch in use; the other writer may have withdrawn it since it was looked up."""
    while True:
        with contextlib.suppress(InputError):
            lake.withdraw("vmc", [lake.batch_ids("vmc")[0]], who)
            return


@pytest.mark.slow
def test_two_writers_at_once_store_one_of_two_copies(tmp_path: Path) -> None:
    calls = [f"store_copies(t.Path({str(tmp_path / 'lake')!r}), {who!r})" for who in ("x", "y")]
    assert [w.wait(300) for w in [run(call, "test_lake_withdrawal") for call in calls]] == [0, 0]
    lake = Lake(tmp_path / "lake")
    contents = lake.contents("vmc")
    assert sorted(int(i[1:]) for i in contents) == list(range(20)) and len(lake.batch_ids("vmc")) == 12
    stored = {f for versions in contents.values() for v in versions for f in v.files}
    assert {p.relative_to(lake.root).as_posix() for p in (lake.root / "_versions").rglob("*.parquet")} == stored
    assert plain(lake) == set(lake.batch_ids("vmc"))


def crash_withdrawal(base: Path) -> None:
    def work(root: Path) -> None:
        Lake(root).withdraw("vmc", ["run1"], "x")
        Lake(root).purge("vmc", ["run1"])

    crash_everywhere(base, lambda root: Lake(root).put_many([make("run1", seed=1), make("run2", seed=2)]), work)


@pytest.mark.integration
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_kill_at_any_step_of_withdraw_and_purge_is_healed(tmp_path: Path) -> None:
    """Versions in use always load; the next write completes what was begun."""
    assert run(f"crash_withdrawal(t.Path({str(tmp_path)!r}))", "test_lake_withdrawal").wait(300) == 0
    states = []
    for root in sorted(tmp_path.iterdir()):
        lake = Lake(root)
        gone = lake.contents("vmc")["run1"][-1].withdrawn
        states.append("in use" if gone is None else "purged" if gone.purged_at else "withdrawn")
        for b in lake.load_all("vmc"):
            np.testing.assert_array_equal(b.values("T1"), make(seed=int(b.batch_id[-1])).values("T1"))
        lake.put(make("run3", seed=3))
        assert plain(lake) == {"run2", "run3"} | ({"run1"} if states[-1] == "in use" else set())
        assert (root / "_versions/machine=vmc/run1").exists() == (states[-1] != "purged")
    assert list(dict.fromkeys(states)) == ["in use", "withdrawn", "purged"] and len(states) > 30


@pytest.mark.parametrize(
    ("file", "key"),
    [("../victim/data.parquet", "file"), ("/tmp/victim.parquet", "file"),
     ("_versions/machine=vmc/run2/x.parquet", "file"),
     ("_versions/machine=vmc/run1/../../../../victim/data.parquet", "earlier"), ("../../victim", "year")],
)  # fmt: skip
def test_a_manifest_that_names_other_files_is_refused_and_nothing_is_deleted(folder: Lake, file: str, key: str) -> None:
    victim = folder.root.parent / "victim" / "data.parquet"
    victim.parent.mkdir()
    victim.write_text("not of this lake")
    folder.withdraw("vmc", ["run1"], "private")
    path = folder.root / "_manifest" / "machine=vmc.json"
    manifest = json.loads(path.read_text())
    entry = manifest["machines"]["vmc"]["run1"][-1]
    entry[key] = [file] if key == "earlier" else file
    entry["sha256"] = {file: "0" * 64}
    path.write_text(json.dumps(manifest))
    with pytest.raises(WorkError, match=r"batch run1 of vmc: got (file|year) .*restore it from a backup"):
        folder.purge("vmc", ["run1"])
    assert victim.exists() and list((folder.root / "_versions/machine=vmc/run2").iterdir())


def test_files_in_quarantine_are_for_their_owner_alone_and_large_ones_get_no_copy(
    folder: Lake, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small, large = tmp_path / "small.csv", tmp_path / "large.csv"
    small.write_text("secret")
    large.write_text("secret" * 100)
    monkeypatch.setattr("data.lake.COPY_MAX_BYTES", 500)
    copies = folder.quarantine_many([(small, "bad"), (large, "bad"), (small, "bad")], "vmc")
    assert [p.name for p in copies][1] == "reasons.jsonl" and copies[0] == copies[2]
    assert {oct(p.stat().st_mode & 0o777) for p in copies} == {"0o600"}
    found = folder.quarantined("vmc")
    assert [(e.name, e.copy is None) for e in found] == [("small.csv", False), ("large.csv", True)]
    assert "no copy kept: larger than" in found[1].reason
