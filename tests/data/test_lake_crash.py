"""Kills at every step and two writers at once: the lake shows the old or the new state, never a third."""

import os
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch
from data.lake import Lake
from data.lakefile import content_digest
from tests.data.lakes import crash_everywhere, make, run

OLD, NEW = make("a", 1, "2025-12-31"), make("a", 2, "2026-01-01")
NEWCOMER = make("b", 3)


def scenario(root: Path) -> None:
    """A batch changes content and year, another comes along, a file goes to quarantine."""
    lake = Lake(root)
    lake.put_many([NEW, NEWCOMER])
    lake.quarantine(root.parent / "junk.csv", "vmc", "junk")


def crash_scenario(base: Path) -> None:
    crash_everywhere(base, lambda root: Lake(root).put(OLD), scenario)


def check(root: Path) -> dict[str, list[Batch]]:
    """Everything the manifest lists loads, is what its digest says, and plain readers see one file a batch."""
    lake = Lake(root)
    found = {}
    for batch_id in lake.batch_ids("vmc"):
        versions = lake.versions("vmc", batch_id)
        found[batch_id] = [lake.load("vmc", batch_id, v.version) for v in versions]
        assert [v.version for v in versions] == list(range(1, len(versions) + 1))
        assert [v.digest for v in versions] == [content_digest(b) for b in found[batch_id]]
        assert [v.current for v in versions] == [False] * (len(versions) - 1) + [True]
        current = list(root.glob(f"machine=vmc/year=*/{batch_id}.parquet"))
        assert len(current) <= 1
        if current:
            shown = pd.read_parquet(current[0])["T1"].to_numpy()
            assert any(np.array_equal(shown, b.values("T1")) for b in found[batch_id][-2:])
    for entry in lake.quarantined("vmc"):
        assert entry.copy is not None and entry.copy.read_text() == "junk"
    return found


def shown_by_plain_readers(root: Path) -> dict[str, list[float]]:
    frame = pd.read_parquet(root)
    assert len(frame) == 5 * frame["batch"].nunique()
    return {str(name): part["T1"].tolist() for name, part in frame.groupby("batch")}


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_kill_at_any_step_leaves_the_old_or_the_new_state(tmp_path: Path) -> None:
    (tmp_path / "junk.csv").write_text("junk")
    assert run(f"crash_scenario(t.Path({str(tmp_path)!r}))", "test_lake_crash").wait(300) == 0
    roots = sorted(p for p in tmp_path.iterdir() if p.is_dir())
    assert len(roots) > 60
    seen = set()
    for n, root in enumerate(roots):
        found = check(root)
        new = "b" in found
        assert [b.values("T1").tolist() for b in found["a"]] == [
            b.values("T1").tolist() for b in ([OLD, NEW] if new else [OLD])
        ]
        seen.add((new, len(Lake(root).quarantined("vmc"))))
        Lake(root).put(make("c", 9))  # any next write heals
        wanted = {"a": NEW if new else OLD, "c": make("c", 9)} | ({"b": NEWCOMER} if new else {})
        assert shown_by_plain_readers(root) == {n: b.values("T1").tolist() for n, b in wanted.items()}
        assert list((root / "_tmp").iterdir()) == []
        if n % 5:
            continue
        scenario(root)  # and the killed work can be done again
        assert len(check(root)["a"]) == 2 and len(Lake(root).quarantined("vmc")) == 1
        assert len(shown_by_plain_readers(root)) == 3
    assert seen == {(False, 0), (True, 0), (True, 1)}


def store_range(root: Path, who: str, go: Path) -> None:
    lake = Lake(root)
    while not go.exists():
        time.sleep(0.002)
    for i in range(30):
        lake.put(make(f"{who}{i}", i))
        lake.put(make("shared", 1000 * (who == "x") + i))
        lake.quarantine(Path(__file__), "vmc", f"{who}{i}")


@pytest.mark.integration
def test_two_writers_at_once_lose_nothing(tmp_path: Path) -> None:
    root, go = tmp_path / "lake", tmp_path / "go"
    call = "store_range(t.Path({!r}), {!r}, t.Path({!r}))"
    writers = [run(call.format(str(root), who, str(go)), "test_lake_crash") for who in ("x", "y")]
    go.touch()
    assert [w.wait(300) for w in writers] == [0, 0]
    lake = Lake(root)
    assert lake.batch_ids("vmc") == sorted([f"{w}{i}" for w in "xy" for i in range(30)] + ["shared"])
    put = {content_digest(make("shared", 1000 * k + i)) for k in (0, 1) for i in range(30)}
    digests = [v.digest for v in lake.versions("vmc", "shared")]
    assert set(digests) == put and len(digests) == 60
    assert {e.reason for e in lake.quarantined("vmc")} == {f"{w}{i}" for w in "xy" for i in range(30)}
    assert len(lake.load_all("vmc")) == 61
    assert len(pd.read_parquet(root)) == 61 * 5
