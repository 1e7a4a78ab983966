"""Lakes of earlier versions, and signed manifests."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from data.errors import InputError, WorkError
from data.lake import Lake
from data.lake_migration import migrate
from tests.conftest import make_toy_batches

HEAD, OWN = "_manifest.json", "_manifest/machine=toy.json"
KEY = "a key"


@pytest.fixture
def lake(tmp_path: Path) -> Lake:
    """Three batches of one machine, one of another; one of them withdrawn and purged."""
    lake, (a, b, c, d) = Lake(tmp_path), make_toy_batches(4, 20)
    lake.put_many([a, b, c, replace(d, machine="lathe")])
    lake.withdraw("toy", ["b02"], "door open")
    lake.purge("toy", ["b02"])
    return lake


def earlier(root: Path, version: int, *lacking: str) -> None:
    """The lake as an earlier version wrote it; its process was killed before it replaced a current file."""
    machines: dict[str, Any] = {}
    for file in sorted((root / "_manifest").iterdir()):
        found = json.loads(file.read_text())
        for entry in (e for batches in found["machines"].values() for entries in batches.values() for e in entries):
            for key in lacking:
                del entry[key]
        machines |= found["machines"]
        pending = [["toy", "b01"]] if "toy" in found["machines"] else []
        file.write_text(json.dumps({**found, "schema": "thermodrift.lake/2", "pending": pending}))
        if version == 1:
            file.unlink()
    head = {"schema": f"thermodrift.lake/{version}"}
    whole = {**head, "pending": [["toy", "b01"]], "machines": machines}
    (root / HEAD).write_text(json.dumps(whole if version == 1 else head))
    for current in root.glob("machine=toy/*/b01.parquet"):
        current.unlink()


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("lacking", [(), ("sha256", "measured")])
def test_a_lake_of_an_earlier_version_is_refused_until_it_is_migrated(
    lake: Lake, tmp_path: Path, version: int, lacking: tuple[str, ...]
) -> None:
    before = json.loads((tmp_path / OWN).read_text())["machines"]
    batches = {b.batch_id: b.table for b in lake.load_all("toy")}
    earlier(tmp_path, version, *lacking)
    old, (batch, *_) = Lake(tmp_path), make_toy_batches(1, 20)
    for use in (lambda: old.load_all("toy"), old.machines, lambda: old.put(batch), lambda: old.batch_ids("toy")):
        with pytest.raises(WorkError, match=r"of an earlier version \(thermodrift.lake/\d\); run `thermodrift lake"):
            use()
    done = migrate(tmp_path)
    assert (done.machines, done.damaged) == (("lathe", "toy"), ())
    after = json.loads((tmp_path / OWN).read_text())
    if lacking:  # the content of a purged one is gone, and with it what it could be known by
        (purged,) = before["toy"]["b02"]
        purged["measured"] = purged["sha256"][purged["file"]] = ""
    assert after == {"schema": "thermodrift.lake/3", "pending": ["b01"], "machines": before}
    new = Lake(tmp_path)
    assert new.machines() == ["lathe", "toy"] and all(b.table.equals(batches[b.batch_id]) for b in new.load_all("toy"))
    assert new.put(batch).status == "unchanged"
    assert len(list(tmp_path.glob("machine=toy/*/b01.parquet"))) == 1
    again = replace(new.load("toy", "b01"), batch_id="other")
    assert new.commit([new.stage(again)], distinct=True)[0].status == "duplicate"
    assert migrate(tmp_path).files == 0


def test_a_damaged_file_of_an_earlier_version_is_named_and_healed(lake: Lake, tmp_path: Path) -> None:
    file = tmp_path / lake.versions("toy", "b00")[-1].files[-1]
    earlier(tmp_path, 2, "sha256")
    file.chmod(0o600)
    file.write_bytes(file.read_bytes()[:-50])
    (line,) = migrate(tmp_path).damaged
    assert str(file) in line and "\n" not in line
    with pytest.raises(WorkError, match=r"the file was changed or cut after its ingest"):
        Lake(tmp_path).load("toy", "b00")
    assert Lake(tmp_path).put(make_toy_batches(1, 20)[0]).status == "healed"
    assert len(Lake(tmp_path).load_all("toy")) == 2


def test_a_place_without_a_lake_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nothing is stored there; give the folder or address of a lake$"):
        migrate(tmp_path)


def edited(root: Path, change: Callable[[dict[str, Any]], object]) -> None:
    manifest = json.loads((root / OWN).read_text())
    change(manifest)
    (root / OWN).write_text(json.dumps(manifest))


FORGED: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "rows": (lambda m: m["machines"]["toy"]["b00"][0].update(rows=21), "its HMAC does not fit its content"),
    "hash": (
        lambda m: m["machines"]["toy"]["b00"][0]["sha256"].update(x="0" * 64), "its HMAC does not fit its content"
    ),
    "dropped": (lambda m: m["machines"]["toy"].pop("b01"), "its HMAC does not fit its content"),
    "no HMAC": (lambda m: m.pop("hmac"), "has no HMAC, and a key is set; run `thermodrift lake migrate`"),
}  # fmt: skip


@pytest.mark.parametrize("what", FORGED)
def test_a_signed_manifest_that_was_changed_is_refused(tmp_path: Path, what: str) -> None:
    batches = make_toy_batches(3, 20)
    Lake(tmp_path, KEY).put_many(batches[:2])
    assert len(Lake(tmp_path, KEY).load_all("toy")) == 2
    change, words = FORGED[what]
    edited(tmp_path, change)
    for use in (lambda: Lake(tmp_path, KEY).load_all("toy"), lambda: Lake(tmp_path, KEY).put(batches[2])):
        with pytest.raises(WorkError, match=words):
            use()
    if what != "no HMAC":
        with pytest.raises(WorkError, match=words):  # and not signed again
            migrate(tmp_path, KEY)


def test_another_key_is_refused_and_a_lake_is_signed_by_its_migration(lake: Lake, tmp_path: Path) -> None:
    with pytest.raises(WorkError, match=r"has no HMAC"):
        Lake(tmp_path, KEY).batch_ids("toy")
    assert migrate(tmp_path, KEY).files == 0
    assert Lake(tmp_path, KEY).batch_ids("toy") == ["b00", "b01"]
    with pytest.raises(WorkError, match=r"set the key that it was signed with"):
        Lake(tmp_path, "another").batch_ids("toy")
    assert Lake(tmp_path).batch_ids("toy") == ["b00", "b01"]  # who has no key verifies plain hashes
