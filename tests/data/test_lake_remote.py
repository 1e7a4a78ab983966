"""The lake in an object store: in memory, and on an S3 server of the test's own."""

from __future__ import annotations

import io
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import uuid4

import pandas as pd
import pytest

from data import lakestore
from data.batch import Batch
from data.errors import InputError, WorkError
from data.lake import Lake
from tests.conftest import make_toy_batches
from tests.data.lakes import files


def changed(batch: Batch) -> Batch:
    return replace(batch, table=batch.table.assign(z=batch.table["z"] + 1.0))


def test_files_are_named_as_in_a_folder(address: str, tmp_path: Path) -> None:
    batches = make_toy_batches(4, 20)
    far, near = Lake(address), Lake(tmp_path)
    assert far.machines() == [] and far.quarantined("toy") == [] and far.root == address
    for lake in (far, near):
        lake.put_many(batches)
        assert lake.put(changed(batches[0])).status == "new_version"
    kept = [{name: body for name, body in files(lake).items() if name.endswith(".parquet")} for lake in (far, near)]
    assert kept[0] == kept[1]


@pytest.mark.parametrize(
    "address",
    [
        "https://TOKEN@127.0.0.1:9/lake",
        "https://127.0.0.1:9/lake?access_token=TOKEN",
        "ftp://TOKEN@127.0.0.1/?api_key=TOKEN",
    ],
)
def test_what_cannot_be_reached_is_named_without_what_is_secret(address: str) -> None:
    with pytest.raises((InputError, WorkError)) as said:
        Lake(address).machines()
    assert "TOKEN" not in str(said.value) and "127.0.0.1" in str(said.value)


@pytest.mark.integration
def test_a_lake_on_s3(s3: str) -> None:
    """The small version of what the others do."""
    address = f"{s3}/lake-{uuid4().hex}"
    batches = make_toy_batches(2, 10)
    with ThreadPoolExecutor(2) as pool:  # only one of them can create the manifest
        list(pool.map(lambda b: Lake(address).put(b), batches))
    held = Lake(address).load_all("toy")
    assert [b.table["z"].to_list() for b in held] == [b.table["z"].to_list() for b in batches]


def test_an_interrupted_write_leaves_the_old_state(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = make_toy_batches(2, 20)
    lake = Lake(address)
    lake.put(first)

    def interrupted(*_: Any, **__: Any) -> bool:
        raise OSError("the network is gone")

    with monkeypatch.context() as patch:
        patch.setattr(lakestore.Bucket, "swap", interrupted)
        with pytest.raises(WorkError, match="the network is gone"):
            lake.put(second)
    assert Lake(address).batch_ids("toy") == ["b00"]
    assert lake.put(second).status == "new" and Lake(address).batch_ids("toy") == ["b00", "b01"]


def test_writers_at_once_lose_nothing(address: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Eight writers of one machine: batches, reasons and withdrawals of all of them are there, without any lock."""
    monkeypatch.setattr("data.lake.POLL_S", 0.01)
    batches = make_toy_batches(8, 10)

    def work(batch: Batch) -> None:
        lake, bad = Lake(address), tmp_path / f"{batch.batch_id}.csv"
        lake.put(batch)
        bad.write_text(f"nothing in {batch.batch_id}")
        lake.quarantine(bad, "toy", "no table")
        if batch.batch_id == "b05":
            lake.withdraw("toy", ["b05"], "door open")
        lake.put(changed(batch))

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(work, batches))
    lake = Lake(address)
    assert lake.batch_ids("toy") == [b.batch_id for b in batches]
    assert all(lake.load("toy", b.batch_id).table["z"].equals(b.table["z"] + 1.0) for b in batches)
    assert sorted(q.name for q in lake.quarantined("toy")) == [f"{b.batch_id}.csv" for b in batches]
    kept = files(lake)
    assert sum(f.startswith("machine=toy/") for f in kept) == 8
    for batch in batches:
        current = pd.read_parquet(io.BytesIO(kept[f"machine=toy/year=2025/{batch.batch_id}.parquet"]))
        assert current["z"].to_list() == (batch.table["z"] + 1.0).to_list()


def test_a_change_is_made_again_on_what_another_writer_has_written(
    address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another writer commits between this one's look and its put; it replaces a current file, too."""
    monkeypatch.setattr("data.lake.POLL_S", 0.01)
    first, second = make_toy_batches(2, 10)
    Lake(address).put(first)
    swap, others = lakestore.Bucket.swap, [second, changed(first)]

    def raced(self: Any, *args: Any, **options: Any) -> bool:
        if others:
            monkeypatch.setattr(lakestore.Bucket, "swap", swap)
            Lake(address).put(others.pop())
            monkeypatch.setattr(lakestore.Bucket, "swap", raced)
        return swap(self, *args, **options)

    monkeypatch.setattr(lakestore.Bucket, "swap", raced)
    stored = Lake(address).put(replace(first, table=first.table.assign(z=first.table["z"] + 2.0)))
    assert (stored.status, stored.version) == ("new_version", 3) and not others
    assert [v.version for v in Lake(address).versions("toy", "b00")] == [1, 2, 3]
    assert Lake(address).batch_ids("toy") == ["b00", "b01"]


def test_what_stays_contested_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("data.lake.POLL_S", 0.01)
    monkeypatch.setattr("data.lake.LOCK_WAIT_S", 0.2)
    monkeypatch.setattr(lakestore.Bucket, "swap", lambda *_, **__: False)
    with pytest.raises(WorkError, match="locked by another ingest"):
        Lake(f"memory://lake-{uuid4().hex}").put_many(make_toy_batches(1, 10))


def test_an_address_that_cannot_be_used_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="no place that obstore knows") as caught:
        Lake("nowhere://user:secret@bucket/lake")
    assert "secret" not in str(caught.value) and "\n" not in str(caught.value)
    monkeypatch.setitem(sys.modules, "obstore.store", None)
    with pytest.raises(InputError, match=r"pip install 'thermodrift\[s3\]'"):
        Lake("s3://bucket/another")


@pytest.mark.slow
def test_a_server_that_does_not_answer_is_one_line(s3: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:1")
    with pytest.raises(WorkError, match=r"^lake s3://factory/gone/[^\n]* \([^\n]*\); check address"):
        Lake("s3://factory/gone").machines()
