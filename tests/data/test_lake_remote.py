"""The lake on file systems of fsspec: in memory, and on an S3 server of the test's own."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import uuid4

import fsspec
import pandas as pd
import pytest

from data import lakestore
from data.batch import Batch
from data.errors import InputError, WorkError
from data.lake import Lake
from tests.conftest import make_toy_batches


@pytest.fixture(scope="module")
def s3() -> Iterator[str]:
    """The address of a bucket on a server of 127.0.0.1."""
    server_module = pytest.importorskip("moto.server", reason="moto is not installed; pip install 'thermodrift[dev]'")
    pytest.importorskip("s3fs", reason="s3fs is not installed; pip install 'thermodrift[s3]'")
    server = server_module.ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    keys = {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "AWS_DEFAULT_REGION": "us-east-1",
            "AWS_ENDPOINT_URL": f"http://{host}:{port}"}  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        for name, value in keys.items():
            patch.setenv(name, value)
        fsspec.filesystem("s3", use_listings_cache=False).mkdir("s3://factory")
        yield "s3://factory"
    server.stop()


@pytest.fixture(params=["memory", pytest.param("s3", marks=pytest.mark.slow)])
def address(request: pytest.FixtureRequest) -> str:
    """A place of the test's own."""
    base = "memory:/" if request.param == "memory" else request.getfixturevalue("s3")
    return f"{base}/lake-{uuid4().hex}"


def plain_files(address: str) -> dict[str, bytes]:
    """Every object below an address by its name there."""
    fs, root = fsspec.url_to_fs(address, use_listings_cache=False)
    return {f.removeprefix(root + "/"): fs.cat_file(f) for f in fs.find(root)}


def changed(batch: Batch) -> Batch:
    return replace(batch, table=batch.table.assign(z=batch.table["z"] + 1.0))


def test_batches_come_back_as_from_a_folder(address: str, tmp_path: Path) -> None:
    batches = make_toy_batches(4, 20)
    far, near = Lake(address), Lake(tmp_path)
    assert far.machines() == [] and far.quarantined("toy") == []
    for lake in (far, near):
        lake.put_many(batches)
        assert lake.put(changed(batches[0])).status == "new_version"
        assert lake.put(batches[1]).status == "unchanged"
    for a, b in zip(Lake(address).load_all("toy"), near.load_all("toy"), strict=True):
        pd.testing.assert_frame_equal(a.table, b.table, check_exact=True)
        assert (a.batch_id, a.version, a.digest, a.channels) == (b.batch_id, b.version, b.digest, b.channels)
    assert Lake(address).load("toy", "b00", 1).table["z"].equals(batches[0].table["z"])
    kept = {p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*.parquet")}
    files = plain_files(address)
    assert {f for f in files if f.endswith(".parquet")} == kept and "_lock" not in files
    assert far.size(far.versions("toy", "b00")[0].files[0]) > 1000
    assert far.root == address


def test_a_lake_on_s3(s3: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The small version of what the others do."""
    monkeypatch.setattr(lakestore, "POLL_S", 0.01)
    address = f"{s3}/lake-{uuid4().hex}"
    batches = make_toy_batches(2, 10)
    with ThreadPoolExecutor(2) as pool:  # only one of them can create the lock
        list(pool.map(lambda b: Lake(address).put(b), batches))
    held = Lake(address).load_all("toy")
    assert [b.table["z"].to_list() for b in held] == [b.table["z"].to_list() for b in batches]
    assert "_lock" not in plain_files(address)


def test_a_plain_reader_finds_the_current_versions(address: str) -> None:
    batch = make_toy_batches(1, 20)[0]
    lake = Lake(address)
    lake.put(batch)
    lake.put(changed(batch))
    name = f"{address}/machine=toy/year=2025/b00.parquet"
    assert pd.read_parquet(name)["z"].to_list() == (batch.table["z"] + 1.0).to_list()


def test_withdrawn_restored_purged(address: str) -> None:
    lake = Lake(address)
    lake.put_many(make_toy_batches(3, 20))
    assert lake.withdraw("toy", ["b01"], "door open") == ["b01"]
    assert lake.batch_ids("toy") == ["b00", "b02"]
    assert not any("b01.parquet" in f for f in plain_files(address))
    assert lake.restore("toy", ["b01"]) == ["b01"] and len(Lake(address).load_all("toy")) == 3
    lake.withdraw("toy", ["b01"], "door open")
    lake.purge("toy", ["b01"])
    assert not any("b01" in f for f in plain_files(address))


def test_a_changed_object_is_refused_and_healed(address: str) -> None:
    lake, batch = Lake(address), make_toy_batches(1, 20)[0]
    lake.put(batch)
    file = lake.versions("toy", "b00")[-1].files[-1]
    fs, root = fsspec.url_to_fs(address, use_listings_cache=False)
    whole = fs.cat_file(f"{root}/{file}")
    fs.pipe_file(f"{root}/{file}", whole[:-100])
    with pytest.raises(WorkError, match=r"the file was changed or cut after its ingest: sha256 "):
        Lake(address).load("toy", "b00")
    assert lake.put(batch).status == "healed"
    assert Lake(address).load("toy", "b00").table.equals(batch.table)
    fs.rm_file(f"{root}/{file}")
    with pytest.raises(WorkError, match=r"batch b00 of toy: cannot be read"):
        lake.load_all("toy")


def test_an_interrupted_write_leaves_the_old_state(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = make_toy_batches(2, 20)
    lake = Lake(address)
    lake.put(first)
    write = lakestore.Remote.write

    def interrupted(self: Any, file: str, *rest: Any, **options: Any) -> None:
        if file.startswith("_manifest/"):
            raise OSError("the network is gone")
        write(self, file, *rest, **options)

    with monkeypatch.context() as patch:
        patch.setattr(lakestore.Remote, "write", interrupted)
        with pytest.raises(WorkError, match="the network is gone"):
            lake.put(second)
    assert Lake(address).batch_ids("toy") == ["b00"]
    assert lake.put(second).status == "new" and Lake(address).batch_ids("toy") == ["b00", "b01"]


def test_quarantined_bytes_and_reasons(address: str, tmp_path: Path) -> None:
    bad = tmp_path / "bad.csv"
    bad.write_bytes(b"nothing to read")
    lake = Lake(address)
    copy = lake.quarantine(bad, "toy", "no table")
    lake.quarantine(bad, "toy", "no table")
    assert plain_files(address)[copy.as_posix()] == b"nothing to read"
    assert [(q.name, q.reason) for q in Lake(address).quarantined("toy")] == [("bad.csv", "no table")]


def test_writers_at_once_lose_nothing(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lakestore, "POLL_S", 0.01)
    batches = make_toy_batches(6, 10)
    with ThreadPoolExecutor(3) as pool:
        list(pool.map(lambda b: Lake(address).put(b), batches))
    assert Lake(address).batch_ids("toy") == [b.batch_id for b in batches]
    assert "_lock" not in plain_files(address)


def test_a_lock_whose_holder_ended_is_removed(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lakestore, "POLL_S", 0.01)
    monkeypatch.setattr(lakestore, "DEAD_S", 0.2)
    fs, root = fsspec.url_to_fs(address, use_listings_cache=False)
    fs.pipe_file(f"{root}/_lock", b'{"host": "gone"}')
    lake = Lake(address)
    lake.put_many(make_toy_batches(1, 10))
    assert lake.batch_ids("toy") == ["b00"]


def test_a_lock_that_is_held_is_waited_for_and_then_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    address = f"memory://lake-{uuid4().hex}"
    monkeypatch.setattr(lakestore, "POLL_S", 0.01)
    monkeypatch.setattr(lakestore, "RENEWED_S", 0.02)
    monkeypatch.setattr(lakestore, "DEAD_S", 0.2)
    monkeypatch.setattr(lakestore, "LOCK_WAIT_S", 0.6)
    entered, leave = threading.Event(), threading.Event()

    def hold() -> None:
        with lakestore.open_store(address).locked():
            entered.set()
            leave.wait(30)

    holder = threading.Thread(target=hold)
    holder.start()
    assert entered.wait(30)
    with pytest.raises(WorkError, match="locked by another ingest"):
        Lake(address).put_many(make_toy_batches(1, 10))
    leave.set()
    holder.join()
    assert Lake(address).put_many(make_toy_batches(1, 10))[0].status == "new"


def test_a_writer_that_was_taken_for_dead_writes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    address = f"memory://lake-{uuid4().hex}"
    monkeypatch.setattr(lakestore, "RENEWED_S", 0.01)
    store = lakestore.open_store(address)
    fs, root = fsspec.url_to_fs(address)
    with store.locked():
        fs.pipe_file(f"{root}/_lock", b"another's")
        while True:  # until the sign of life finds it
            try:
                store.write("a", b"1")
            except OSError as error:
                assert "lost to another writer" in str(error)
                break
    assert fs.cat_file(f"{root}/_lock") == b"another's"


def test_an_address_that_cannot_be_used_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="got nowhere://, which is no file system that fsspec knows"):
        Lake("nowhere://user:secret@bucket/lake")
    with pytest.raises(InputError) as caught:
        Lake("nowhere://user:secret@bucket/lake")
    assert "secret" not in str(caught.value)

    def missing(address: str, **options: object) -> None:
        raise ImportError("Install s3fs to access S3")

    monkeypatch.setattr("fsspec.url_to_fs", missing)
    with pytest.raises(InputError, match=r"pip install 'thermodrift\[s3\]'"):
        Lake("s3://bucket/lake")


@pytest.mark.slow
def test_a_server_that_does_not_answer_is_one_line(s3: str, monkeypatch: pytest.MonkeyPatch) -> None:
    lake = Lake("s3://factory/x")
    monkeypatch.setattr(lake._store, "_fs", fsspec.filesystem("s3", endpoint_url="http://127.0.0.1:1"))
    monkeypatch.setattr(lake._store._fs, "retries", 1)
    with pytest.raises(WorkError, match=r"^lake s3://factory/x/_manifest.json: cannot be read \([^\n]*\)"):
        lake.machines()
