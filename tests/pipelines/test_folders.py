"""Watched folders: a change is noticed, and taken when files have been quiet."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from pipelines.fleet import folders as module
from pipelines.fleet.fleet_file import Fleet, FleetMachine, When
from pipelines.fleet.folders import Folders


def fleet_of(**folders: Path) -> Fleet:
    when = When(watch=True, quiet_min=1.0)
    machines = tuple(FleetMachine(n, f"/m/{n}.yml", (str(f),), when) for n, f in folders.items())
    by_date = FleetMachine("dated", "/m/dated.yml", ("/nowhere",))
    return Fleet("/m/fleet.yml", (*machines, by_date))


def soon(condition: Callable[[], object]) -> bool:
    end_s = time.monotonic() + 30
    while not (reached := bool(condition())) and time.monotonic() < end_s:
        time.sleep(0.02)
    return reached


def changed(folders: Folders) -> set[str]:
    """Machines with a change, quiet or not."""
    return set(folders.settled(datetime.now(UTC) + timedelta(hours=1)))


def test_what_arrived_while_nobody_watched_is_looked_for_at_once(tmp_path: Path) -> None:
    folders = Folders(fleet_of(mill=tmp_path), print)
    assert set(folders.settled(datetime.now(UTC))) == {"mill"}
    folders.taken("mill")
    assert not changed(folders)


def test_a_new_file_is_due_when_it_has_been_quiet(tmp_path: Path) -> None:
    for name in ("mill", "lathe"):
        (tmp_path / name / "2026").mkdir(parents=True)
    folders = Folders(fleet_of(mill=tmp_path / "mill", lathe=tmp_path / "lathe"), print)
    with folders.watching():
        folders.taken("mill")
        folders.taken("lathe")
        for k in range(1000):  # until the thread watches
            (tmp_path / "mill" / "2026" / "run.csv").write_text(str(k))
            if soon_once(folders):
                break
        now = datetime.now(UTC)
        assert changed(folders) == {"mill"} and not folders.settled(now)
        assert set(folders.settled(now + timedelta(minutes=1))) == {"mill"}


def soon_once(folders: Folders) -> bool:
    time.sleep(0.05)
    return bool(changed(folders))


def test_a_folder_that_comes_later_is_watched_then(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "LOOK_AGAIN_S", 0.05)
    folders = Folders(fleet_of(mill=tmp_path / "mill", lathe=tmp_path / "lathe"), print)
    (tmp_path / "lathe").mkdir()
    folders.taken("mill")
    folders.taken("lathe")
    with folders.watching():
        time.sleep(0.2)
        (tmp_path / "mill").mkdir()
        assert soon(lambda: changed(folders) == {"mill"})
        folders.taken("mill")
        for k in range(1000):
            (tmp_path / "mill" / "run.csv").write_text(str(k))
            if soon_once(folders):
                break
        assert changed(folders) == {"mill"}


def test_two_machines_that_record_into_one_folder_both_hear_of_a_file(tmp_path: Path) -> None:
    folders = Folders(fleet_of(mill=tmp_path, lathe=tmp_path), print)
    assert changed(folders) == {"mill", "lathe"}
    for name in ("mill", "lathe"):
        folders.taken(name)
    folders._touch_all(tmp_path, datetime.now(UTC))
    assert changed(folders) == {"mill", "lathe"}
