"""The kept structural null: the same as a new one, never one of something else, and no file can break it."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import diagnosis.search.null as null_cache
from diagnosis.contracts import Fitted
from diagnosis.policy import POLICY
from diagnosis.screening.evidence import Evidence
from diagnosis.screening.screen import proposed, screen
from diagnosis.search.null import CACHED_NULLS, Null, cached_null, structural_null
from tests.diagnosis.small_cases import consistent


@cache
def seen() -> tuple[Fitted, Evidence, dict[str, int]]:
    done = consistent()
    found = screen(done, proposed(done))
    return done, found.evidence, {s.candidate.name: s.column for s in found.scored if s.column >= 0}


@cache
def new() -> Null:
    return structural_null(*seen())


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The seeds of the nulls that were worked out."""
    out: list[int] = []

    def counted(fitted: Fitted, evidence: Evidence, counts: dict[str, int], seed: int, progress: object) -> Null:
        out.append(seed)
        return new()

    monkeypatch.setattr(null_cache, "structural_null", counted)
    return out


def same(one: Null, other: Null) -> None:
    for f in fields(Null):
        np.testing.assert_array_equal(getattr(one, f.name), getattr(other, f.name), strict=f.name != "names")


def test_what_is_kept_comes_back_to_the_last_digit(tmp_path: Path, calls: list[int]) -> None:
    folder = tmp_path / "not" / "yet"
    same(cached_null(folder, *seen()), new())
    same(cached_null(folder, *seen()), new())
    assert calls == [0]
    (file,) = folder.iterdir()
    with np.load(file, allow_pickle=False) as kept:
        assert set(kept.files) == {f.name for f in fields(Null)}


def test_nothing_is_kept_without_a_folder(calls: list[int]) -> None:
    cached_null(None, *seen())
    cached_null(None, *seen())
    assert calls == [0, 0]


def test_another_seed_fit_recording_or_list_of_candidates_is_another_null(tmp_path: Path, calls: list[int]) -> None:
    fitted, evidence, counts = seen()
    cached_null(tmp_path, fitted, evidence, counts)
    cached_null(tmp_path, fitted, evidence, counts, 1)
    state = replace(fitted.state, z=fitted.state.z + 1e-9)
    cached_null(tmp_path, replace(fitted, state=state), evidence, counts)
    first, *rest = fitted.problem.measured
    moved = (replace(first, value=first.value + 0.1), *rest)
    cached_null(tmp_path, replace(fitted, problem=replace(fitted.problem, measured=moved)), evidence, counts)
    cached_null(tmp_path, fitted, evidence, dict(list(counts.items())[1:]))
    part = fitted.part.model_copy(update={"mechanisms": {}})
    cached_null(tmp_path, replace(fitted, part=part), evidence, counts)
    assert len(calls) == 6


def test_another_policy_or_program_is_another_null(
    tmp_path: Path, calls: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    cached_null(tmp_path, *seen())
    monkeypatch.setattr(null_cache, "POLICY", replace(POLICY, null_cells=POLICY.null_cells + 1))
    cached_null(tmp_path, *seen())
    monkeypatch.setattr(null_cache, "source_digest", lambda *rooms: "another")
    cached_null(tmp_path, *seen())
    assert len(calls) == 3


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 torn", b"no archive at all"], ids=["empty", "torn", "text"])
def test_a_file_that_cannot_be_read_is_made_anew(tmp_path: Path, calls: list[int], content: bytes) -> None:
    cached_null(tmp_path, *seen())
    (file,) = tmp_path.iterdir()
    file.write_bytes(content)
    same(cached_null(tmp_path, *seen()), new())
    same(cached_null(tmp_path, *seen()), new())
    assert calls == [0, 0]


def test_objects_in_a_file_are_never_loaded(tmp_path: Path, calls: list[int]) -> None:
    cached_null(tmp_path, *seen())
    (file,) = tmp_path.iterdir()
    with file.open("wb") as stream:
        np.savez(stream, **{f.name: np.array([{}], dtype=object) for f in fields(Null)})  # type: ignore[arg-type]
    same(cached_null(tmp_path, *seen()), new())
    assert calls == [0, 0]


def test_a_folder_that_cannot_be_written_keeps_nothing(tmp_path: Path, calls: list[int]) -> None:
    (tmp_path / "file").write_text("no folder")
    same(cached_null(tmp_path / "file", *seen()), new())
    assert calls == [0]


def test_the_oldest_go(tmp_path: Path, calls: list[int]) -> None:
    for k in range(CACHED_NULLS + 3):
        (tmp_path / f"null-{k}.npz").write_bytes(b"old")
    cached_null(tmp_path, *seen())
    assert len(list(tmp_path.iterdir())) == CACHED_NULLS
    cached_null(tmp_path, *seen())
    assert calls == [0]
