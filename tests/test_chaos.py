"""What `tests.chaos` counts as broken is found, and killed commands leave nothing of it."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from data.ingest import ingest
from data.lake import Lake
from data.machine import load_machine
from tests import chaos

WHOLE: dict[str, Any] = {
    "lake": {"20250114": ["a"]}, "lake_trouble": [], "quarantine": [], "running": [], "noted": [], "newest": "t",
    "trainings": {"t": [["x", "mlr", 3, 1.0]]}, "versions": {"1": "champion"}, "champion": 1, "logged": 1, "shown": 1,
    "predicted": [0.0, 1.5], "cell": "none|mlr|3",
}  # fmt: skip


@pytest.fixture(scope="module")
def held(tmp_path_factory: pytest.TempPathFactory) -> Path:
    work = chaos.Work(tmp_path_factory.mktemp("chaos"))
    ingest([work.recordings], load_machine(work.machine), Lake(work.home / "lake"))
    return work.home


@pytest.fixture
def home(held: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(held, tmp_path / "home"))


def test_a_whole_lake_is_whole(home: Path) -> None:
    known = chaos.facts(home)
    assert len(known["lake"]) == chaos.BATCHES and [name for name, _ in known["quarantine"]] == ["20251214.csv"]
    assert not list(chaos.broken_now(known)) and not list(chaos.differs(known, known))


def _parquet(home: Path) -> Path:
    return next((home / "lake" / "_versions").rglob("*.parquet"))


@pytest.mark.parametrize("damage", ["cut", "gone", "current gone", "quarantined"])
def test_damage_of_the_lake_is_seen(home: Path, damage: str) -> None:
    file = _parquet(home)
    if damage == "cut":
        file.chmod(0o600)
        file.write_bytes(file.read_bytes()[:-1])
    elif damage == "gone":
        file.unlink()
    elif damage == "current gone":
        next((home / "lake" / f"machine={chaos.NAME}").rglob("*.parquet")).unlink()
    else:
        copy = next((home / "lake" / "_quarantine").rglob("*20251214.csv"))
        copy.chmod(0o600)
        copy.write_bytes(b"other")
    assert {name for name, _ in chaos.broken_now(chaos.facts(home))} == {"lake"}


def changes() -> Iterator[tuple[dict[str, Any], str]]:
    yield {"running": ["r"]}, "running"
    yield {"champion": 2}, "registry"
    yield {"shown": None}, "registry"
    yield {"versions": {"1": ""}}, "half-promoted"
    yield {"unreadable": "Traceback"}, "unreadable"


@pytest.mark.parametrize(("change", "name"), list(changes()))
def test_what_is_broken_in_the_store_is_named(change: dict[str, Any], name: str) -> None:
    assert not list(chaos.broken_now(WHOLE))
    assert name in {n for n, _ in chaos.broken_now(WHOLE | change)}


@pytest.mark.parametrize(
    "change",
    [{"lake": {}}, {"predicted": [0.0, 1.5001]}, {"trainings": {"t": [["x", "mlr", 3, 1.1]]}}, {"predicted": None}],
)
def test_other_numbers_are_seen(change: dict[str, Any]) -> None:
    assert {n for n, _ in chaos.differs(WHOLE | change, WHOLE)} == {"numbers"}


@pytest.mark.slow
def test_killed_commands_leave_everything_whole(tmp_path: Path) -> None:
    only = ["ingest", "train", "promote", "compensate"]
    kills = chaos.run(tmp_path, 4, 1, only)
    assert [k.command for k in kills] == only
    assert not [k for k in kills if k.wrong], kills
    assert [row["kills"] for row in chaos.summary(kills)] == [1, 1, 1, 1]
